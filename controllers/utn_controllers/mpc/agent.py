"""One agent: a junction's problem, its solver, and the flows that it shares with its neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np

from utn_controllers.mpc.problem import Place, QuadraticProgram
from utn_controllers.mpc.receding import RecedingProblem
from utn_controllers.mpc.settings import ProblemSettings
from utn_sumo.contract import Floats, Forecast, State
from utn_sumo.errors import ControllerError

EQUALITY = 5
"""DAQP's code for an equality row."""
OPTIMAL = (1, 2)
"""DAQP's exit flags of an optimum: 1, and 2 with a soft constraint in use."""


class Agent:
    """Solves  min phi + sum over its shared flows y [l'y + rho/2 |y|^2]  again and again, for other l (SPEC 4).

    The shared flows are its copies of the inflow of the links that neighbours feed, then its outflows to the links
    that it feeds. An agent whose inflow is `given` does not choose the former: they are set from outside.
    """

    def __init__(self, place: Place, settings: ProblemSettings, *, given: bool):
        import daqp  # noqa: PLC0415 - compiled, loaded at use

        self._new_solver = daqp.Model
        self.receding = RecedingProblem(place, settings)
        self.problem = self.receding.problem
        self.place = place
        problem, consumed, produced = self.problem, place.consumed, place.produced
        blocks = [problem.inflow_rows(link) for link in consumed] + [problem.outflow_rows(link) for link in produced]
        self._coupling = np.vstack(blocks) if blocks else np.zeros((0, problem.layout.size))
        self._taken = len(consumed) * problem.steps
        """How many of the shared numbers are inflows."""
        self._given = given
        chosen = self._coupling[self._taken :] if given else self._coupling
        self._gram = chosen.T @ chosen
        self._inflow = self._coupling[: self._taken].argmax(axis=1)
        self._shape = (len(consumed) + len(produced), problem.steps)
        self.program: QuadraticProgram | None = None
        self.solution: Floats = np.zeros(problem.layout.size)
        self._solver: Any = None
        self._rho = 0.0

    def prepare(self, state: State, forecast: Forecast, rho: float) -> None:
        """Take up a new state. The Hessian is factorised once for each `rho`; later states only bring vectors
        and the constraint matrix, and the solver starts from the last active set.
        """
        self.program = self.receding.program(state, forecast)
        self.load(rho)

    def load(self, rho: float) -> None:
        """Hand the programme to the solver."""
        if self._solver is None or rho != self._rho:
            self.factorise(rho)
        else:
            program = self._program()
            self._solver.update(A=program.matrix, bupper=program.upper, blower=program.lower)

    def factorise(self, rho: float) -> None:
        """Set the solver up for a penalty `rho`, without a memory of earlier states."""
        program = self._program()
        sense = np.zeros(len(program.upper), dtype=np.int32)
        sense[program.lower == program.upper] = EQUALITY
        if self._given:
            sense[self._inflow] = EQUALITY
        self._rho = rho
        self._solver = self._new_solver()
        flag, _ = self._solver.setup(
            program.hessian + rho * self._gram, program.gradient, program.matrix, program.upper, program.lower, sense
        )
        if flag < 0:
            raise ControllerError(f"agent {self.place.part.name}: the solver refused its problem (flag {flag})")

    def _program(self) -> QuadraticProgram:
        if self.program is None:
            raise ControllerError(f"agent {self.place.part.name}: prepare() comes before solve()")
        return self.program

    def solve(self, linear: Floats) -> Floats:
        """Best answer to the linear terms `linear` (n, model steps) of the shared flows; the flows (n, model steps).

        With `given` inflows `linear` holds their values [veh] in their places, and the answer what one vehicle more in
        them costs the agent: the multipliers, mu of SPEC 4.
        """
        terms = linear.ravel()
        bounds = {}
        if self._given:
            upper, lower = self._program().upper.copy(), self._program().lower.copy()
            upper[self._inflow] = lower[self._inflow] = terms[: self._taken]
            bounds = {"bupper": upper, "blower": lower}
            gradient = self._program().gradient + self._coupling[self._taken :].T @ terms[self._taken :]
        else:
            gradient = self._program().gradient + self._coupling.T @ terms
        self._solver.update(f=gradient, **bounds)
        solution, _, flag, info = self._solver.solve()
        if flag not in OPTIMAL:
            # The active set of another state can lead the solver astray: once more, cold.
            self.factorise(self._rho)
            self._solver.update(f=gradient, **bounds)
            solution, _, flag, info = self._solver.solve()
        if flag not in OPTIMAL or not np.isfinite(solution).all():
            raise ControllerError(f"agent {self.place.part.name}: no optimum (flag {flag})")
        self.solution = solution
        shared = self._coupling @ solution
        if self._given:
            shared[: self._taken] = -info["lam"][self._inflow]
        return np.asarray(shared).reshape(self._shape)
