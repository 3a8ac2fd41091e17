"""One agent: a junction's problem and its solver, for whatever its neighbours say of the flows that it shares."""

from __future__ import annotations

from typing import Any

import numpy as np

from utn_controllers.mpc.place import has_slack
from utn_controllers.mpc.problem import QuadraticProgram
from utn_controllers.mpc.receding import RecedingProblem
from utn_sumo.contract import Floats, Forecast, Ints, State
from utn_sumo.errors import ControllerError

EQUALITY = 5
"""DAQP's code for an equality row."""
OPTIMAL = (1, 2)
"""DAQP's exit flags of an optimum: 1, and 2 with a soft constraint in use."""
PATIENCE = 1000
"""Steps without progress until DAQP says that it goes round in circles. Where nobody is on the road many rows meet in
one point, and its own 10 are too few."""
NOWHERE = -1
"""Of a variable that is no part of any shared flow."""


def gram(shared: Ints) -> Floats:
    """(n, n) curvature of the sum of |shared flow|^2 / 2, a shared flow being the sum of the variables that name it."""
    return np.asarray((shared[:, None] == shared) & (shared != NOWHERE), dtype=float)


class Agent:
    """Solves  min phi + sum over its shared flows y [l'y + rho/2 |y|^2]  again and again, for other l (SPEC 4).

    Shared are its copies of the inflow of the links that neighbours feed, and its outflows to the links that it feeds.
    An agent whose inflow is `given` does not choose the former: they are set from outside.
    """

    def __init__(self, receding: RecedingProblem, shared: Ints, *, given: bool):
        """`shared` (1, n) names, for each variable, the shared flow that it is part of, or `NOWHERE`."""
        import daqp  # noqa: PLC0415 - compiled, loaded at use

        self._new_solver = daqp.Model
        self.receding = receding
        self.problem = receding.problem
        self.place = receding.place
        self.shared = shared[0]
        inflow = self.problem.layout.inflow.ravel()
        self._given = inflow[self.shared[inflow] != NOWHERE] if given else inflow[:0]
        chosen = self.shared.copy()
        chosen[self._given] = NOWHERE
        self._gram = gram(chosen)
        self._implied = self._implied_rows()
        self.program: QuadraticProgram | None = None
        self.solution: Floats = np.zeros(self.problem.layout.size)
        self.residual = 0.0
        """Sum of squares by which the solution breaks its rows [veh^2]: none, the solver is exact."""
        self._solver: Any = None
        self._rho = 0.0

    def prepare(self, state: State, forecast: Forecast, rho: float) -> None:
        """Take up a new state. The Hessian is factorised once for each `rho`; later states only bring vectors
        and the constraint matrix, and the solver starts from the last active set.
        """
        self.program = self.receding.programs(state, forecast).only
        self.program.lower[self._implied], self.program.upper[self._implied] = -np.inf, np.inf
        self.load(rho)

    def forget(self) -> None:
        """Let the solver begin anew."""
        self._solver = None

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
        sense[self._given] = EQUALITY
        solver = self._new_solver()
        solver.settings = {"cycle_tol": PATIENCE}
        flag, _ = solver.setup(
            program.hessian + rho * self._gram, program.gradient, program.matrix, program.upper, program.lower, sense
        )
        if flag < 0:
            raise ControllerError(f"agent {self.place.part.name}: the solver refused its problem (flag {flag})")
        self._rho, self._solver = rho, solver

    def _implied_rows(self) -> Ints:
        """The budgets of a junction without slack, with which the solver would refuse the problem."""
        settings = self.problem.settings
        implied = settings.constraints == "kept" and not has_slack(self.place.part)[0]
        # They come first among the rows (Statement._predict).
        return self.problem.layout.size + np.arange(settings.control_horizon if implied else 0)

    def _program(self) -> QuadraticProgram:
        if self.program is None:
            raise ControllerError(f"agent {self.place.part.name}: prepare() comes before solve()")
        return self.program

    def solve(self, linear: Floats) -> Floats:
        """Best answer (n,) to the linear terms `linear` (n,) that each variable has of the flow that it is part of.

        For `given` inflows `linear` holds their values [veh], and the answer what one vehicle more in them costs
        the agent: the multipliers, mu of SPEC 4.
        """
        program, given = self._program(), self._given
        gradient = program.gradient + linear
        bounds = {}
        if len(given):
            gradient[given] = program.gradient[given]
            upper, lower = program.upper.copy(), program.lower.copy()
            # A solver's tolerance under none, as neighbours may send it, is more than some rows can bear.
            upper[given] = lower[given] = np.maximum(linear[given], 0.0)
            bounds = {"bupper": upper, "blower": lower}
        for cold in (False, True):
            if cold:
                # The active set of another state can lead the solver astray, and what is no number stays none.
                self.factorise(self._rho)
            self._solver.update(f=gradient, **bounds)
            solution, _, flag, info = self._solver.solve()
            answer = solution.copy()
            answer[given] = -info["lam"][given]
            if flag in OPTIMAL and np.isfinite(solution).all() and np.isfinite(answer).all():
                self.solution = solution
                return np.asarray(answer)
        raise ControllerError(f"agent {self.place.part.name}: no optimum (flag {flag})")

    def settle(self) -> Floats:
        """(Kc, S) greens of the last solution, from which the next step's problem starts."""
        return self.receding.settle(self.solution)
