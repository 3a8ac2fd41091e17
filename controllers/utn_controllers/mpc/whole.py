"""The same problem solved whole: the junctions' problems side by side under equal flows at every interaction (SPEC 3).

Assembled once; then only numbers change. The controller `cmpc` plans with it; the agents' plans are measured
against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from utn_controllers.mpc.problem import JunctionProblem, QuadraticProgram, Timing
from utn_controllers.mpc.statement import Pattern
from utn_sumo.contract import EXIT, Floats, Forecast, Ints, State
from utn_sumo.errors import ControllerError

TOLERANCE = 1e-9
WIDER = (0.0, 1e-7, 1e-6)
"""How much wider all bounds are made [veh, s] until there is an optimum.

On a road without vehicles no flow has room between its bounds; an interior point method then has nowhere to stand,
and its multipliers no end. A bound that gives way by so little changes the cost by as little times its multiplier.
"""
OUTWARD = {"h_l": -1, "h_u": 1, "x_l": -1, "x_u": 1}
"""Which way each of the bounds is made wider."""
MOST_ITERATIONS = 100
"""Several times what a problem with an interior takes."""


class WholeProblem:
    """min 1/2 z'Pz + c'z  s.t.  Az = b, h_l <= Gz <= h_u, z_l <= z <= z_u  over all junctions, solved by PIQP.

    Coupling and green budgets are the equalities, whose matrix never changes; nor does P.
    """

    def __init__(
        self, problems: Sequence[JunctionProblem], *, tolerance: float = TOLERANCE, fixed_greens: bool = False
    ):
        """With `fixed_greens` the greens are given with every solve, and the budgets left to whoever gives them."""
        self.problems = problems
        sizes = [problem.layout.size for problem in problems]
        self.starts = np.concatenate([[0], np.cumsum(sizes)])
        self._fixed = fixed_greens
        self._greens = np.concatenate(
            [start + problem.layout.green.ravel() for problem, start in zip(problems, self.starts, strict=False)]
        )
        kept = problems[0].settings.constraints == "kept"
        budgets = problems[0].settings.control_horizon if kept else 0
        # The budgets come first among a junction's rows (Statement._predict).
        self._below = [problem.pattern.rows >= budgets for problem in problems]
        self._rows = sp.block_diag([_rows_below(problem.pattern, budgets) for problem in problems], format="csc")
        self._budgets = budgets
        self.equal = sp.vstack([coupling(problems, self.starts), *self._budget_rows()], format="csc")
        self._solver: Any = None
        self.iterations = 0
        """Of the last solve, all its attempts together."""
        self._tolerance = tolerance
        self.hessian = sp.block_diag([sp.csc_matrix(problem.hessian) for problem in problems], format="csc")

    def _budget_rows(self) -> list[Any]:
        if self._fixed or not self._budgets:
            return []
        rows = []
        for problem, start in zip(self.problems, self.starts, strict=False):
            green = problem.layout.green
            steps = np.repeat(np.arange(len(green)), green.shape[1])
            shape = (len(green), int(self.starts[-1]))
            rows.append(sp.csr_matrix((np.ones(green.size), (steps, start + green.ravel())), shape=shape))
        return rows

    def numbers(self, programs: Sequence[QuadraticProgram], greens: Floats | None = None) -> dict[str, Any]:
        """The problem under the names of its statement, but for P and A, which never change."""
        sizes = np.diff(self.starts)

        def gathered(side: str, rows: slice, *, past: bool) -> Floats:
            """Bounds of the variables, or past them those of some rows, over all junctions."""
            bounds = [getattr(program, side) for program in programs]
            return np.concatenate([b[n:][rows] if past else b[:n] for b, n in zip(bounds, sizes, strict=True)])

        box = [gathered(side, slice(None), past=False) for side in ("lower", "upper")]
        if greens is not None:
            at = np.concatenate([greens[:, problem.place.stages].ravel() for problem in self.problems])
            box[0][self._greens] = box[1][self._greens] = at
        self._rows.data[:] = np.concatenate([p.values[mask] for p, mask in zip(programs, self._below, strict=True)])
        equal = np.zeros(self.equal.shape[0])
        if not self._fixed and self._budgets:
            budgets = gathered("upper", slice(self._budgets), past=True)
            equal[len(equal) - len(budgets) :] = budgets
        return {
            "c": np.concatenate([program.gradient for program in programs]),
            "b": equal,
            "G": self._rows,
            "h_l": gathered("lower", slice(self._budgets, None), past=True),
            "h_u": gathered("upper", slice(self._budgets, None), past=True),
            "x_l": box[0],
            "x_u": box[1],
        }

    def solve(self, programs: Sequence[QuadraticProgram], greens: Floats | None = None) -> tuple[float, list[Floats]]:
        """Least cost and each junction's solution; `greens` (Kc, S of the whole network) if they are fixed.

        Primal and dual residual and duality gap are within the tolerance, absolute or relative, of a problem whose
        bounds are at most the last of `WIDER` apart from those given. Raises ControllerError without such an optimum.
        """
        import piqp  # noqa: PLC0415 - compiled, loaded at use

        numbers = self.numbers(programs, greens)
        self.iterations = 0
        for wider in WIDER:
            self._load(numbers | {side: numbers[side] + sign * wider for side, sign in OUTWARD.items()})
            status = self._solver.solve()
            result = self._solver.result
            self.iterations += int(result.info.iter)
            if status == piqp.PIQP_SOLVED:
                cost = result.info.primal_obj + sum(program.constant for program in programs)
                return float(cost), self.parts(result.x)
        raise ControllerError(f"the whole problem has no optimum ({status})")

    def _load(self, numbers: dict[str, Any]) -> None:
        """Hand the problem to the solver, which is set up once."""
        import piqp  # noqa: PLC0415 - compiled, loaded at use

        if self._solver is not None:
            self._solver.update(**numbers)
            return
        self._solver = piqp.SparseSolver()
        settings = self._solver.settings
        settings.eps_abs = settings.eps_rel = self._tolerance
        settings.eps_duality_gap_abs = settings.eps_duality_gap_rel = self._tolerance
        settings.max_iter = MOST_ITERATIONS
        # In vehicles the problem is well scaled; scaled anew with every update it no longer is.
        settings.preconditioner_iter = 0
        self._solver.setup(P=self.hessian, A=self.equal, **numbers)

    def parts(self, solution: Floats) -> list[Floats]:
        """Each junction's part of a solution."""
        return [solution[start:end] for start, end in pairwise(self.starts)]


def programs(
    problems: Sequence[JunctionProblem], state: State, forecast: Forecast, timing: Timing
) -> list[QuadraticProgram]:
    """Every junction's programme, of the whole network's state and timing."""
    return [
        problem.program(state.part(place.links, place.turns), forecast.part(place.links), timing.part(place))
        for problem, place in ((problem, problem.place) for problem in problems)
    ]


def optimum(
    problems: Sequence[JunctionProblem],
    state: State,
    forecast: Forecast,
    timing: Timing,
    greens: Floats | None = None,
) -> tuple[float, list[Floats]]:
    """Least cost of the whole network and each junction's solution, from scratch.

    With `greens` (Kc, S) given, the greens are fixed at these: the cost that a plan leads to when the flows under it
    are the best possible ones. Raises ControllerError if the solver finds no optimum.
    """
    whole = WholeProblem(problems, fixed_greens=greens is not None)
    return whole.solve(programs(problems, state, forecast, timing), greens)


def _rows_below(pattern: Pattern, budgets: int) -> Any:
    """The pattern without its first rows, which are the budgets; a matrix of ones."""
    ones = sp.csc_matrix((np.ones(len(pattern.rows)), pattern.rows, pattern.starts), shape=pattern.shape)
    return ones[budgets:]


def coupling(problems: Sequence[JunctionProblem], starts: Ints) -> Any:
    """Rows that say: inflow of a link, as its consumer has it, less the outflow to it, as its producer has it, is 0."""
    steps, size = problems[0].steps, int(starts[-1])
    row_of = {link: row for row, link in enumerate(sorted(link for p in problems for link in p.place.consumed))}
    rows, columns, signs = [], [], []

    def add(link: int, start: int, positions: Ints, sign: float) -> None:
        rows.append(row_of[link] * steps + np.arange(steps))
        columns.append(start + positions)
        signs.append(np.full(steps, sign))

    for problem, start in zip(problems, starts.tolist(), strict=False):
        place, layout = problem.place, problem.layout
        for link in place.consumed:
            add(link, start, layout.inflow[:, int(np.flatnonzero(place.links == link)[0])], 1.0)
        for turn in np.flatnonzero(place.turn_next != EXIT):
            add(int(place.turn_next[turn]), start, layout.leaving[:, turn], -1.0)
    if not rows:
        return sp.csr_matrix((0, size))
    entries = np.concatenate(signs), (np.concatenate(rows), np.concatenate(columns))
    return sp.csr_matrix(entries, shape=(len(row_of) * steps, size))
