"""Model predictive control (SPEC 3 and 4): one statement of the problem, solved whole or by one agent a junction.

settings      what a user may set
problem       one junction's problem, stated in CasADi; the whole is these side by side
agent         one agent: its solver, and the copies that it shares
interactions  who shares the flow onto which link
coordination  how the agents come to terms
whole         everything solved at once
distributed   the controller `dmpc`
"""
