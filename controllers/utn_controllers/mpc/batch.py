"""Agents of one structure, solved side by side: what hundreds of calls of a solver cost, one call here does.

A call is a few steps of the operator splitting of OSQP (Stellato et al. 2020) from where the last one ended, one
factorisation a control step, all agents in step. The answers are not exact; they become so together with what is
agreed, since every round goes on from the last.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.mpc.agent import NOWHERE, gram
from utn_controllers.mpc.ldl import Factorisation, factorise, substitute
from utn_controllers.mpc.problem import Programs
from utn_controllers.mpc.receding import RecedingProblem
from utn_sumo.compiling import compiled
from utn_sumo.contract import Floats, Forecast, Ints, State
from utn_sumo.errors import ControllerError

LANES = 32
"""Most agents in a stack: their numbers stay in a core's cache for the steps of a call."""
STEPS = 5
"""Of a call. With one the rounds may diverge, with three they may need twice as many; more cost more than they save."""
RELAXATION = 1.6
SIGMA = 1e-6
"""OSQP's: keeps the system definite."""
PENALTY, EQUALITY_FACTOR = 0.1, 1e3
"""OSQP's: rho of a row, and how many times that of an equality."""
SCALINGS = 10
"""Rounds of Ruiz' equilibration."""


class Batch:
    """The agents of one structure; like `Agent`, but that its answers are those of all of them, and approximate.

    What is (agents, n) elsewhere goes in and out as one vector in the order of the solver: by stack, variable, lane.
    """

    def __init__(self, receding: RecedingProblem, shared: Ints):
        """`shared` (agents, n) names, for each variable, the shared flow that it is part of, or `NOWHERE`."""
        self.receding = receding
        self.problem = problem = receding.problem
        self.place = receding.place
        stacks = -(-problem.count // LANES)
        self._shape = (stacks, -(-problem.count // stacks))
        """Stacks, and lanes in each; the last agent fills up the last stack."""
        self._size, self._rows = problem.layout.size, problem.pattern.shape[0]
        # The agents that fill up share nothing.
        self.shared = self._stacked(shared, fill=NOWHERE).ravel()
        pattern = np.zeros((self._size + self._rows,) * 2, dtype=np.bool_)
        pattern[self._size + problem.pattern.rows, problem.pattern.columns] = True
        for hessian, own in zip(problem.hessians(), shared, strict=True):
            pattern[: self._size, : self._size] |= (hessian != 0) | (gram(own) != 0)
        self._factor = Factorisation(pattern)
        self._order = np.argsort(self._factor.position)
        rows, columns = np.nonzero(np.tril(pattern[: self._size, : self._size], -1))
        self._curved = rows, columns, self._factor.places(rows, columns)
        self._bound = self._factor.places(self._size + problem.pattern.rows, problem.pattern.columns)
        self._curvature, self._diagonal = (
            [np.array([matrix[at] for matrix in each]) for each in (problem.hessians(), map(gram, shared))]
            for at in ((rows, columns), np.diag_indices(self._size))
        )
        """Numbers below the diagonal and on it, of the Hessians and of what rho adds to them."""
        self._programs: Programs | None = None
        self._scale = np.zeros(0)
        self._unsolved = np.zeros(self._shape)
        self.forget()

    def forget(self) -> None:
        """Let the solver begin anew."""
        length = self._size + self._rows
        self._x, self._z, self._y = (self._zeros(k) for k in (self._size, length, length))

    def prepare(self, state: State, forecast: Forecast, rho: float) -> None:
        """Take up a new state; the solver goes on from the last one's answers."""
        self._programs = self.receding.programs(state, forecast)
        self.factorise(rho)

    def factorise(self, rho: float) -> None:
        """Set the solver up for a penalty `rho`."""
        programs = self._numbers()
        pattern, size = self.problem.pattern, self._size
        if not self._scale.size:
            self._scale = self._equilibrate(programs, rho)
        columns, rows = np.split(self._scale, [size])
        if self.problem.settings.cost == "paper" and not self._y.any():
            # Begin with nobody over storage: from none its multipliers take too many calls up to so high a price.
            over = self.problem.layout.over_storage.ravel()
            self._y[:, over] = -(programs.gradient[0, over] * columns[over])[:, None]
        equality = (programs.lower == programs.upper).all(axis=0)
        self._penalty = np.where(equality, PENALTY * EQUALITY_FACTOR, PENALTY)
        by_bound = np.concatenate([1 / columns, rows])
        self._lower, self._upper = (self._stacked(side * by_bound) for side in (programs.lower, programs.upper))
        # What of the answer must hold: flows. Greens are brought to their budget in the end (`settle`).
        self._weight = np.concatenate([columns, 1 / rows])
        self._weight[self.problem.layout.green.ravel()] = 0.0
        self._weight[equality] = 0.0

        diagonal = np.empty((self.problem.count, size + len(rows)))
        curvature = self._diagonal[0] + rho * self._diagonal[1]
        diagonal[:, :size] = curvature * columns**2 + SIGMA + self._penalty[:size]
        diagonal[:, size:] = -1 / self._penalty[size:]
        below = np.zeros((self.problem.count, len(self._factor.rows)))
        first, second, at = self._curved
        below[:, at] = (self._curvature[0] + rho * self._curvature[1]) * (columns[first] * columns[second])
        below[:, self._bound] = programs.values * (rows[pattern.rows] * columns[pattern.columns])
        self._below, self._inverse = self._stacked(below), self._stacked(diagonal[:, self._order])
        factorise(self._below, self._inverse, self._factor.starts, self._factor.targets)
        self._gradient = self._stacked(programs.gradient)

    def solve(self, linear: Floats) -> Floats:
        """Better answer to the linear terms that each variable has of the shared flow that it is part of."""
        answer = np.empty_like(self._gradient)
        factor = self._factor
        _sweep(
            (self._below, self._inverse, factor.starts, factor.rows),
            (self._gradient, linear.reshape(answer.shape), self._lower, self._upper),
            (factor.position, self._penalty, self._scale, self._weight),
            (self._x, self._z, self._y),
            (answer, self._unsolved),
        )
        if not np.isfinite(answer).all():
            raise ControllerError(f"agents {self.place.part.name}: their answers are not finite")
        self._answer = answer
        return answer.ravel()

    @property
    def residual(self) -> float:
        """Sum of squares by which the last answers break their rows [veh^2]."""
        return float(self._unsolved.ravel()[: self.problem.count].sum())

    def settle(self) -> Floats:
        """(Kc, S) greens of the last answers, from which the next step's problem starts."""
        solution = self._answer.swapaxes(1, 2).reshape(-1, self._size)[: self.problem.count].copy()
        if self.problem.settings.constraints == "kept":
            part, green = self.place.part, self.problem.layout.green
            least = part.min_green_s.reshape(self.problem.count, 1, -1)
            solution[:, green] = nearest_split(solution[:, green], least, part.green_budget_s[:, None, None])
        return self.receding.settle(solution)

    def _numbers(self) -> Programs:
        if self._programs is None:
            raise ControllerError(f"agents {self.place.part.name}: prepare() comes before solve()")
        return self._programs

    def _zeros(self, size: int) -> Floats:
        stacks, lanes = self._shape
        return np.zeros((stacks, size, lanes))

    def _stacked(self, numbers: Floats | Ints, fill: int | None = None) -> Floats:
        """(stacks, k, lanes) of (agents, k); those that fill up are the last agent's or `fill`."""
        stacks, lanes = self._shape
        missing = stacks * lanes - len(numbers)
        last = numbers[-1:] if fill is None else np.full_like(numbers[-1:], fill)
        full = np.concatenate([numbers, np.repeat(last, missing, axis=0)])
        return np.ascontiguousarray(full.reshape(stacks, lanes, -1).swapaxes(1, 2))

    def _equilibrate(self, programs: Programs, rho: float) -> Floats:
        """(n + rows,) scale of variables and rows that evens out the numbers of the mean agent (Ruiz 2001)."""
        size, pattern = self._size, self.problem.pattern
        whole = np.zeros((size + self._rows,) * 2)
        first, second, _ = self._curved
        whole[first, second] = np.abs(self._curvature[0] + rho * self._curvature[1]).mean(axis=0)
        whole[range(size), range(size)] = (self._diagonal[0] + rho * self._diagonal[1]).mean(axis=0)
        whole[size + pattern.rows, pattern.columns] = np.abs(programs.values).mean(axis=0)
        whole = np.maximum(whole, whole.T)
        scale = np.ones(len(whole))
        for _ in range(SCALINGS):
            largest = np.sqrt((whole * scale * scale[:, None]).max(axis=1))
            scale /= np.where(largest > 0, largest, 1.0)
        return scale


def nearest_split(green_s: Floats, least_s: Floats, budget_s: Floats) -> Floats:
    """The greens (..., S) nearest to these that keep their least and add up to the budget (Held et al. 1974)."""
    over = green_s - least_s
    given = budget_s - np.sum(np.broadcast_to(least_s, green_s.shape), axis=-1, keepdims=True)
    falling = -np.sort(-over, axis=-1)
    beyond = (np.cumsum(falling, axis=-1) - given) / np.arange(1, green_s.shape[-1] + 1)
    kept = np.maximum((falling > beyond).sum(axis=-1, keepdims=True), 1)
    return np.asarray(least_s + np.maximum(over - np.take_along_axis(beyond, kept - 1, axis=-1), 0.0))


@compiled
def _sweep(
    system: tuple[Floats, Floats, Ints, Ints],
    statement: tuple[Floats, Floats, Floats, Floats],
    by_row: tuple[Ints, Floats, Floats, Floats],
    iterate: tuple[Floats, Floats, Floats],
    found: tuple[Floats, Floats],
) -> None:
    """`STEPS` of the splitting on every stack, from where `iterate` stands; `found` are answer and what it breaks."""
    below, inverse, starts, rows = system
    gradient, linear, low, up = statement
    position, penalty, scale, weight = by_row
    answer, unsolved = found
    stacks, size, lanes = gradient.shape
    right = np.empty((len(penalty), lanes))
    cost = np.empty((size, lanes))
    for stack in range(stacks):
        for row in range(size):
            for lane in range(lanes):
                cost[row, lane] = (gradient[stack, row, lane] + linear[stack, row, lane]) * scale[row]
        x, z, y = iterate[0][stack], iterate[1][stack], iterate[2][stack]
        for _ in range(STEPS):
            _state(right, (position, penalty), cost, (x, z, y))
            substitute(below[stack], inverse[stack], starts, rows, right)
            _follow(right, (position, penalty), (low[stack], up[stack]), (x, z, y))
        unsolved[stack] = 0.0
        for row in range(len(penalty)):
            own, lowest, highest = right[position[row]], low[stack, row], up[stack, row]
            for lane in range(lanes):
                apart = own[lane] - min(max(own[lane], lowest[lane]), highest[lane])
                unsolved[stack, lane] += (weight[row] * apart) ** 2
        for row in range(size):
            for lane in range(lanes):
                answer[stack, row, lane] = z[row, lane] * scale[row]


@compiled
def _state(right: Floats, by_row: tuple[Ints, Floats], cost: Floats, iterate: tuple[Floats, Floats, Floats]) -> None:
    """The system's right-hand side, in the factor's order."""
    position, penalty = by_row
    x, z, y = iterate
    size, lanes = cost.shape
    for row in range(len(penalty)):
        own, bound, price, rho = right[position[row]], z[row], y[row], penalty[row]
        if row < size:
            last, slope = x[row], cost[row]
            for lane in range(lanes):
                own[lane] = SIGMA * last[lane] - slope[lane] + rho * bound[lane] - price[lane]
        else:
            inverse = 1 / rho
            for lane in range(lanes):
                own[lane] = bound[lane] - price[lane] * inverse


@compiled
def _follow(
    right: Floats, by_row: tuple[Ints, Floats], bounds: tuple[Floats, Floats], iterate: tuple[Floats, Floats, Floats]
) -> None:
    """Move x, z and the multipliers y after the system's solution; `right` then has every row's own number."""
    position, penalty = by_row
    x, z, y = iterate
    size, lanes = x.shape
    for row in range(len(penalty)):
        own, bound, price, rho = right[position[row]], z[row], y[row], penalty[row]
        inverse = 1 / rho
        if row < size:
            last = x[row]
            for lane in range(lanes):
                last[lane] = RELAXATION * own[lane] + (1 - RELAXATION) * last[lane]
        else:
            for lane in range(lanes):
                own[lane] = bound[lane] + (own[lane] - price[lane]) * inverse
        lowest, highest = bounds[0][row], bounds[1][row]
        for lane in range(lanes):
            relaxed = RELAXATION * own[lane] + (1 - RELAXATION) * bound[lane]
            bound[lane] = min(max(relaxed + price[lane] * inverse, lowest[lane]), highest[lane])
            price[lane] += rho * (relaxed - bound[lane])
