"""The MPC of SPEC 3 and 4, stated once in CasADi for one junction, as a convex quadratic programme.

The model is SPEC 2 with its minimum relaxed: the leaving flow is at most each of the three terms. Frozen are the
delay, at its present value, and where in the cycle the green stands, at what was planned last (`Timing`). The whole
network's problem is the sum of these problems under `inflow of a link as its consumer has it = outflow to it as its
producer has it`, which is what the agents coordinate.

Everything is in veh per model step and, for the cost, veh times control steps. CasADi derives Hessian and
constraint matrix once; the loop then only evaluates numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from utn_controllers.mpc.settings import ProblemSettings
from utn_sumo.contract import Floats, Forecast, Network, State
from utn_sumo.model import CasadiOperations, LinkModel, green_windows, share_on_the_way

REGULARISATION = 1e-3
"""Weight of the squared flows: makes the Hessian definite and the plan unique; 1e-3 veh a step at 1 veh."""
STORAGE_PENALTY = 20.0
"""Cost of a vehicle over storage for one step. Exact: far above the 1 + horizon that holding it elsewhere costs."""


@dataclass(frozen=True)
class QuadraticProgram:
    """min 1/2 z'Hz + f'z  s.t.  lower <= (z, Az) <= upper, simple bounds first."""

    hessian: Floats
    gradient: Floats
    matrix: Floats
    lower: Floats
    upper: Floats
    constant: float


@dataclass(frozen=True)
class Layout:
    """Where an agent's variables sit in its decision vector; each (steps, n) of positions."""

    green: npt.NDArray[np.int64]
    leaving: npt.NDArray[np.int64]
    inflow: npt.NDArray[np.int64]
    over_storage: npt.NDArray[np.int64]
    size: int

    @classmethod
    def of(cls, part: Network, settings: ProblemSettings, steps: int) -> Layout:
        """The layout for one junction's part of a network, over so many model steps."""
        links = len(part.links)
        start = 0

        def block(rows: int, columns: int) -> npt.NDArray[np.int64]:
            nonlocal start
            start += rows * columns
            return np.arange(start - rows * columns, start).reshape(rows, columns)

        green = block(settings.control_horizon, len(part.stages))
        leaving, inflow, over = block(steps, len(part.turns)), block(steps, links), block(steps, links)
        return cls(green, leaving, inflow, over, size=start)


@dataclass(frozen=True)
class Timing:
    """Where the green stands in the model steps of a control step, at the greens that it was made from."""

    shown: Floats
    """(n, S) seconds of green in each model step for a second of the planned green."""
    end_s: Floats
    """(n, M) when each turn's last green ends, from the model step's start."""
    opening: Floats
    """(n, M) share of what leaves in a model step whose room reaches the link's entry within it."""

    @classmethod
    def of(cls, model: LinkModel, green_s: Floats) -> Timing:
        """The timing of the plan `green_s` (S,) on the model's network and step."""
        windows = green_windows(model.network, green_s, model.step_s)
        opening = model.opening(windows.shown_s @ model.network.serves, windows.end_s)
        return cls(windows.shown_s / green_s, windows.end_s, opening)


@dataclass(frozen=True)
class _Past:
    """Who entered before now, and when they reach their queues after a delay that stays what it is."""

    inflow_veh: Floats
    """(H, n) of each past sample, newest first; by link or by turn."""
    delay_s: Floats
    """(n,)"""
    sample_s: float

    def still_veh(self, at_s: Any) -> Floats:
        """(n,) vehicles still on the way `at_s` from now."""
        share = share_on_the_way(self.delay_s - at_s, self.sample_s, len(self.inflow_veh))
        return np.asarray((share * self.inflow_veh).sum(axis=0))


def remaining_steps(network: Network) -> Floats:
    """(Z,) control steps that a vehicle on each link still needs to leave the network.

    Free travel and half a cycle's wait on each link of its expected way, summed by the turning fractions.
    """
    own = (network.free_time_s + network.cycle_s[network.link_junction] / 2) / network.control_step_s
    fed = np.flatnonzero(network.turn_next >= 0)
    onward = np.zeros((len(network.links), len(network.links)))
    np.add.at(onward, (network.turn_link[fed], network.turn_next[fed]), network.fraction[fed])
    return np.asarray(np.linalg.solve(np.eye(len(network.links)) - onward, own), dtype=float)


class JunctionProblem:
    """The problem of one junction: numbers in (state, forecast), quadratic programme out."""

    def __init__(self, network: Network, junction: int, settings: ProblemSettings):
        self.network = network
        self.junction = junction
        self.settings = settings
        self.part = network.part(junction)
        self.links = np.flatnonzero(network.link_junction == junction)
        self.turns = np.flatnonzero(np.isin(network.turn_link, self.links))
        self.stages = np.array(network.junctions[junction].stages)
        step_s = settings.step_s or network.control_step_s
        self.substeps = round(network.control_step_s / step_s)
        """Model steps of a control step (n)."""
        self.steps = settings.horizon * self.substeps
        """Model steps of the horizon."""
        self.layout = Layout.of(self.part, settings, self.steps)
        self.model = LinkModel(self.part, step_s, CasadiOperations())
        self._numbers = LinkModel(self.part, step_s)
        self._lags = int(np.ceil(self.part.free_time_s.max() / step_s))
        """Model steps back from which somebody can still be on the way."""
        self._remaining = remaining_steps(network)[self.links]
        self._bind(self._state_problem())

    def consumed(self) -> list[int]:
        """Links of this junction that a neighbour feeds."""
        return [int(link) for link in self.links if not self.network.links[link].is_source]

    def produced(self) -> list[int]:
        """Links that this junction feeds."""
        return sorted({int(link) for link in self.network.turn_next[self.turns] if link >= 0})

    def inflow_rows(self, link: int) -> Floats:
        """(model steps, variables) matrix that picks the consumer's copy of the inflow of one of its links."""
        rows = np.zeros((self.steps, self.layout.size))
        position = int(np.flatnonzero(self.links == link)[0])
        rows[np.arange(self.steps), self.layout.inflow[:, position]] = 1
        return rows

    def outflow_rows(self, link: int) -> Floats:
        """(model steps, variables) matrix that adds up the flows of this junction into `link`."""
        rows = np.zeros((self.steps, self.layout.size))
        for position in np.flatnonzero(self.network.turn_next[self.turns] == link):
            rows[np.arange(self.steps), self.layout.leaving[:, position]] = 1
        return rows

    def program(self, state: State, forecast: Forecast, timing: Timing) -> QuadraticProgram:
        """The quadratic programme for this state, the greens standing where `timing` has them."""
        model, step_s = self._numbers, self._numbers.step_s
        x, q = state.x_veh[self.links], state.q_veh[self.turns]
        queue = model.leaves @ q
        delay_s = model.delay_s(queue)
        inflow = state.past_inflow_veh[:, self.links]
        # A miscount must not leave more on the way than there is: the first step would have no feasible flow.
        on_the_way = _Past(inflow, delay_s, self.network.sample_s).still_veh(0.0)
        inflow = inflow * np.minimum(1.0, np.maximum(x - queue, 0.0) / np.maximum(on_the_way, 1e-9))
        delay_by_turn_s = delay_s[model.network.turn_link]
        past = _Past(inflow[:, model.network.turn_link], delay_by_turn_s, self.network.sample_s)
        ends = timing.end_s[:, self.turns]
        parameters: list[Any] = [
            x,
            q,
            state.source_queue_veh[self.links],
            np.repeat(forecast.demand_veh[: self.settings.horizon, self.links], self.substeps, 0) / self.substeps,
            state.fraction[self.turns],
            [share_on_the_way(delay_by_turn_s - end + step_s, step_s, self._lags + 1) for end in ends],
            [past.still_veh(step * step_s + ends[step % self.substeps]) for step in range(self._lags)],
            timing.shown[:, self.stages],
            timing.opening[:, self.turns],
        ]
        self._parameters[:] = np.concatenate([np.ravel(part) for part in parameters])
        self._run()
        constant = float(self._results[-1][0])
        hessian, gradient, matrix, lower, upper = (array.copy() for array in self._results[:-1])
        return QuadraticProgram(hessian, gradient, matrix, lower, upper, constant)

    def greens(self, solution: Floats) -> Floats:
        """(Kc, S of this junction) greens [s] of a solution."""
        return solution[self.layout.green]

    def _bind(self, function: Any) -> None:
        """Tie a CasADi function to arrays of ours: calling it then costs its arithmetic and nothing else."""
        self._parameters = np.zeros(function.size1_in(0))
        shapes = [function.size_out(i) for i in range(function.n_out())]
        # CasADi writes dense outputs by column: Fortran order; vectors come out flat.
        self._results = [np.zeros(shape, order="F") if shape[1] > 1 else np.zeros(shape[0]) for shape in shapes]
        self._function = function
        self._buffer, self._run = function.buffer()
        self._buffer.set_arg(0, memoryview(self._parameters.data))
        for position, array in enumerate(self._results):
            self._buffer.set_res(position, memoryview(array.T.data))

    def _state_problem(self) -> Any:
        """CasADi function: parameters -> Hessian, gradient, constraint matrix, bounds, constant."""
        import casadi as ca  # noqa: PLC0415 - heavy

        size = self.layout.size
        z = ca.SX.sym("z", size)
        parameters = self._symbols()
        cost, rows = self._predict(z, **parameters)
        expressions = ca.vertcat(*[row[0] for row in rows])
        lower, upper = (
            ca.vertcat(*[ca.repmat(ca.DM(row[side]), row[0].numel(), 1) for row in rows]) for side in (1, 2)
        )
        hessian, gradient = ca.hessian(cost, z)
        at_zero = ca.substitute(ca.vertcat(gradient, expressions, cost), z, ca.DM.zeros(size))
        offset = at_zero[size:-1]
        box = self._simple_bounds()
        outputs = [
            hessian,
            at_zero[:size],
            ca.jacobian(expressions, z),
            ca.vertcat(box[0], lower - offset),
            ca.vertcat(box[1], upper - offset),
            at_zero[-1],
        ]
        flat = [ca.vertcat(*item) if isinstance(item, list) else item for item in parameters.values()]
        return ca.Function("problem", [ca.vertcat(*flat)], [ca.densify(ca.SX(item)) for item in outputs])

    def _symbols(self) -> dict[str, Any]:
        """The problem's parameters, in the order in which `program` fills them in; lists run over steps or lags."""
        import casadi as ca  # noqa: PLC0415 - heavy

        links, turns, stages = len(self.part.links), len(self.part.turns), len(self.part.stages)

        def over(name: str, count: int, size: int) -> list[Any]:
            return [ca.SX.sym(f"{name}{index}", size) for index in range(count)]

        return {
            "x": ca.SX.sym("x", links),
            "q": ca.SX.sym("q", turns),
            "waiting": ca.SX.sym("waiting", links),
            "demand": over("demand", self.steps, links),
            "fraction": ca.SX.sym("fraction", turns),
            "share_in_green": over("share_in_green", self.substeps * (self._lags + 1), turns),
            "still_in_green": over("still_in_green", self._lags, turns),
            "shown": over("shown", self.substeps, stages),
            "opening": over("opening", self.substeps, turns),
        }

    def _predict(
        self,
        z: Any,
        *,
        x: Any,
        q: Any,
        waiting: Any,
        demand: list[Any],
        fraction: Any,
        share_in_green: list[Any],
        still_in_green: list[Any],
        shown: list[Any],
        opening: list[Any],
    ) -> tuple[Any, list[tuple[Any, float, float]]]:
        """The horizon: (cost, rows), a row being (expression, lower, upper)."""
        import casadi as ca  # noqa: PLC0415 - heavy

        settings, part, model, layout = self.settings, self.part, self.model, self.layout
        by_link = model.operations.matmul
        source = part.is_source.astype(float)
        budget_s, lags = float(part.green_budget_s[0]), self._lags + 1
        cost: Any = 0
        rows = [(ca.sum1(z[green]), budget_s, budget_s) for green in layout.green]
        inflows: list[Any] = []
        for step in range(self.steps):
            control_step, substep = divmod(step, self.substeps)
            green = z[layout.green[min(control_step, settings.control_horizon - 1)]]
            leaving, inflow, over = z[layout.leaving[step]], z[layout.inflow[step]], z[layout.over_storage[step]]
            inflows = [inflow, *inflows][:lags]
            # Who can be in the queue before the green ends: everybody but those still on the way then. q holds who was
            # queued at first less who left; when who arrives joins it makes no difference to the sum.
            in_time = by_link(model.leaves.T, x - by_link(model.leaves, q) + inflow)
            if step < self._lags:
                in_time = in_time - still_in_green[step]
            for lag, entered in enumerate(inflows):
                in_time = in_time - share_in_green[substep * lags + lag] * by_link(model.leaves.T, entered)
            saturated = model.saturated_veh(by_link(model.served, green * shown[substep]), fraction)
            room = model.room_veh(x) + by_link(model.leaves, opening[substep] * leaving)
            # The three terms of SPEC 2.3, the third as the consumer's: it knows its storage.
            rows += [
                (leaving - q - fraction * in_time, -np.inf, 0.0),
                (leaving - saturated, -np.inf, 0.0),
                (inflow - over - room, -np.inf, 0.0),
            ]
            q = q - leaving
            x = x + inflow - by_link(model.leaves, leaving)
            waiting = waiting + source * (demand[step] - inflow)
            rows += [(waiting[int(link)], 0.0, np.inf) for link in np.flatnonzero(part.is_source)]
            part_of_step = settings.stage_cost(x, waiting, part.storage_veh) + STORAGE_PENALTY * ca.sum1(over)
            cost += part_of_step / self.substeps
            cost += REGULARISATION / 2 * (ca.sumsqr(leaving) + ca.sumsqr(inflow) + ca.sumsqr(over))
        cost += sum(settings.green_cost(z[green]) for green in layout.green)
        return cost + settings.terminal_cost(x, waiting, self._remaining), rows

    def _simple_bounds(self) -> tuple[Floats, Floats]:
        lower, upper = np.zeros(self.layout.size), np.full(self.layout.size, np.inf)
        least = self.part.min_green_s
        lower[self.layout.green] = least
        # What the cycle leaves when every other stage has its least (SPEC 3).
        upper[self.layout.green] = self.part.green_budget_s[0] - (least.sum() - least)
        return lower, upper
