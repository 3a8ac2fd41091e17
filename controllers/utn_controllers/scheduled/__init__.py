"""Schedule-driven signals: each junction plans the next minute anew every two seconds, and shows its beginning.

A dynamic programme over who stands before the junction, who is on the way to it by the loops upstream, and whom its
neighbours' schedules will send; in the tradition of OPAC (Gartner 1983), COP (Sen and Head 1997) and SURTRAC (Xie
and others 2012).

streams.py      what queues before a junction and moves together
moves.py        what moves in a stage, and in the clearance between two
gaps.py         who goes in the gaps of what comes towards him
yielding.py     who gives way, or stands behind a red: how fast he has gone of late
outlook.py      who stands and who comes, by stream
parting.py      who turns off amid a link
parked.py       who stands on the way and does not come
within.py       who waits between nodes a few metres apart
sides.py        who waits on side roads without signals
calling.py      who walks, rides or takes a tram, and calls for green himself
pockets.py      who is held up by a full pocket
worth.py        what a vehicle's waiting weighs, and how many go where links are full
ending.py       what it costs to leave somebody there at a schedule's end
rounds.py       who comes next where far more are there than can go
regret.py       how long a change for nobody is put off
standstill.py   who has green and does not go
traffic.py      what the programme has of those who stand and come
programme.py    the dynamic programme of one junction
execution.py    what goes with a plan: `scheduled`
"""
