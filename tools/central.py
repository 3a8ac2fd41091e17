"""The whole problem by central solvers, timed, and what plans cost beside its optimum."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import osqp
import scipy.sparse as sp

from utn_controllers.mpc.problem import JunctionProblem, QuadraticProgram
from utn_controllers.mpc.whole import WholeProblem
from utn_sumo.contract import Floats, Plan
from utn_sumo.errors import ControllerError


def greens_of(plan: Plan) -> Floats:
    """(Kc, S) all greens of a plan."""
    return np.vstack([plan.green_s, np.asarray(plan.ahead_s)])


class Judge:
    """What plans cost over the least cost of the same problem."""

    def __init__(self, problems: Sequence[JunctionProblem], tolerance: float = 1e-9):
        self.problems = problems
        self._best = WholeProblem(problems, tolerance=tolerance)
        self._fixed = WholeProblem(problems, tolerance=tolerance, fixed_greens=True)

    def least(self, stated: Sequence[QuadraticProgram]) -> float:
        """The optimum."""
        return self._best.solve(stated)[0]

    def gap(self, stated: Sequence[QuadraticProgram], greens: Floats, least: float) -> float:
        """Of greens (Kc, S), relative."""
        return self._fixed.solve(stated, greens)[0] / least - 1


class Stopwatch:
    """Times the calls of a function that it stands in for, by wall clock and by this thread's processor time."""

    def __init__(self, function: Callable[..., Any]):
        self._function = function
        self.spent_s: list[float] = []
        self.cpu_s: list[float] = []

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        started, cpu = time.perf_counter(), time.thread_time()
        answer = self._function(*arguments, **named)
        self.cpu_s.append(time.thread_time() - cpu)
        self.spent_s.append(time.perf_counter() - started)
        return answer


class Central(Protocol):
    """A solver of the whole problem, warm from one solve to the next as far as it can be."""

    watch: Stopwatch

    def solve(self, stated: Sequence[QuadraticProgram]) -> list[Floats]:
        """Each junction's solution."""
        ...


class Piqp:
    """PIQP, an interior-point method."""

    def __init__(self, problems: Sequence[JunctionProblem]):
        self._whole = WholeProblem(problems, tolerance=1e-4)
        self.watch = Stopwatch(self._whole.solve)

    def solve(self, stated: Sequence[QuadraticProgram]) -> list[Floats]:
        solution: list[Floats] = self.watch(stated)[1]
        return solution


class Osqp:
    """OSQP at 1e-3, a first-order method."""

    def __init__(self, problems: Sequence[JunctionProblem]):
        self._whole = WholeProblem(problems)
        self._solver: Any = None
        self.watch = Stopwatch(self._solve)

    def solve(self, stated: Sequence[QuadraticProgram]) -> list[Floats]:
        answer = self.watch(self._whole.numbers(stated))
        if answer.info.status != "solved":
            raise ControllerError(f"OSQP ended with {answer.info.status}")
        return self._whole.parts(answer.x)

    def _solve(self, numbers: dict[str, Any]) -> Any:
        box = sp.identity(len(numbers["c"]), format="csc")
        vectors = {
            "q": numbers["c"],
            "l": np.concatenate([numbers["b"], numbers["h_l"], numbers["x_l"]]),
            "u": np.concatenate([numbers["b"], numbers["h_u"], numbers["x_u"]]),
        }
        rows = sp.vstack([self._whole.equal, numbers["G"], box], format="csc")
        if self._solver is None:
            self._solver = osqp.OSQP()
            upper = sp.triu(self._whole.hessian, format="csc")
            accuracy = {"eps_abs": 1e-3, "eps_rel": 1e-3, "max_iter": 20000}
            self._solver.setup(P=upper, A=rows, **vectors, **accuracy, verbose=False)
        else:
            self._solver.update(**vectors, Ax=rows.data)
        return self._solver.solve()


SOLVERS: dict[str, Callable[[Sequence[JunctionProblem]], Central]] = {"piqp": Piqp, "osqp": Osqp}
"""Those that were found fastest (Clarabel and HiGHS take twice as long and more)."""
