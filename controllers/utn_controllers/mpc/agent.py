"""One agent: the local problem, its solver, and the copies that it coordinates with its neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np

from utn_controllers.mpc.problem import JunctionProblem, QuadraticProgram, Timing
from utn_sumo.contract import Floats, Forecast, State
from utn_sumo.errors import ControllerError

PRODUCER, CONSUMER = 0, 1
"""The two sides of an interaction."""
EQUALITY = 5
"""DAQP's code for an equality row."""
OPTIMAL = (1, 2)
"""DAQP's exit flags of an optimum: 1, and 2 with a soft constraint in use."""


class Agent:
    """Solves  min phi + sum over produced [lam (w - zb) + rho/2 (w - zb)^2] + sum over consumed [...]  (SPEC 4)."""

    def __init__(self, problem: JunctionProblem, place: dict[int, int]):
        """`place` gives each interaction (a link that has a producer and a consumer) its row."""
        self.problem = problem
        consumed, produced = problem.consumed(), problem.produced()
        self.interactions = np.array([place[link] for link in consumed + produced], dtype=np.int64)
        """(n,) rows of the interactions, consumed ones first."""
        self.side = np.array([CONSUMER] * len(consumed) + [PRODUCER] * len(produced), dtype=np.int64)
        """(n,) which side of each interaction this agent is."""
        self.sign = np.where(self.side == PRODUCER, 1.0, -1.0)
        """(n,) sign of the multiplier in the agent's cost: +1 as producer, -1 as consumer."""
        blocks = [problem.inflow_rows(link) for link in consumed] + [problem.outflow_rows(link) for link in produced]
        self._coupling = np.vstack(blocks) if blocks else np.zeros((0, problem.layout.size))
        self._gram = self._coupling.T @ self._coupling
        self._shape = (len(self.interactions), problem.steps)
        self.program: QuadraticProgram | None = None
        self.solution: Floats = np.zeros(problem.layout.size)
        self._solver: Any = None
        self._rho = 0.0

    def prepare(self, state: State, forecast: Forecast, timing: Timing, rho: float) -> None:
        """Take up a new state. The Hessian is factorised once for each `rho`; later states only bring vectors
        and the constraint matrix, and the solver starts from the last active set.
        """
        self.program = self.problem.program(state, forecast, timing)
        if self._solver is None or rho != self._rho:
            self.factorise(rho)
        else:
            self._solver.update(A=self.program.matrix, bupper=self.program.upper, blower=self.program.lower)

    def factorise(self, rho: float) -> None:
        """Set the solver up for a penalty `rho`, without a memory of earlier states."""
        import daqp  # noqa: PLC0415 - compiled, loaded at use

        program = self._program()
        sense = np.zeros(len(program.upper), dtype=np.int32)
        sense[program.lower == program.upper] = EQUALITY
        self._rho = rho
        self._solver = daqp.Model()
        flag, _ = self._solver.setup(
            program.hessian + rho * self._gram, program.gradient, program.matrix, program.upper, program.lower, sense
        )
        if flag < 0:
            raise ControllerError(f"agent {self.problem.part.name}: the solver refused its problem (flag {flag})")

    def _program(self) -> QuadraticProgram:
        if self.program is None:
            raise ControllerError(f"agent {self.problem.part.name}: prepare() comes before solve()")
        return self.program

    def solve(self, mean: Floats, price: Floats) -> Floats:
        """Best answer to the interactions' means and prices; (n, model steps) copies of their flows [veh].

        `mean` and `price` (n, model steps) are zb and lam of this agent's interactions.
        """
        linear = (self.sign[:, None] * price - self._rho * mean).ravel()
        gradient = self._program().gradient + self._coupling.T @ linear
        self._solver.update(f=gradient)
        solution, _, flag, _ = self._solver.solve()
        if flag not in OPTIMAL:
            # The active set of another state can lead the solver astray: once more, cold.
            self.factorise(self._rho)
            self._solver.update(f=gradient)
            solution, _, flag, _ = self._solver.solve()
        if flag not in OPTIMAL or not np.isfinite(solution).all():
            raise ControllerError(f"agent {self.problem.part.name}: no optimum (flag {flag})")
        self.solution = solution
        return np.asarray(self._coupling @ solution).reshape(self._shape)
