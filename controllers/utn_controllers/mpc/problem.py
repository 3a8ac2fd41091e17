"""The MPC of SPEC 3 and 4, stated once in CasADi for one junction, as a convex quadratic programme.

The model is SPEC 2 with its minimum relaxed: the leaving flow is at most each of the three terms. Frozen are the
delays, at what the last plan predicted, and where in the cycle the green stands, at what was planned last
(`Timing`). The whole network's problem is the sum of these problems under `inflow of a link as its consumer has it =
outflow to it as its producer has it`, which is what the agents coordinate.

Everything is in veh per model step and, for the cost, veh times control steps. Junctions of the same structure share
one CasADi function: Hessian and constraint pattern are found once, the loop then only evaluates numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from utn_controllers.mpc.settings import ProblemSettings
from utn_sumo.contract import EXIT, Floats, Forecast, Ints, Network, State
from utn_sumo.errors import ControllerError
from utn_sumo.model import CasadiOperations, LinkModel, LinkNumbers, green_windows

REGULARISATION = 1e-3
"""Weight of the squared flows: makes the Hessian definite and the plan unique; 1e-3 veh a step at 1 veh."""
STORAGE_PENALTY = 20.0
"""Cost of a vehicle over storage for one step. Exact: far above the 1 + horizon that holding it elsewhere costs."""


@dataclass(frozen=True)
class Pattern:
    """Where a constraint matrix has numbers, column by column (CSC)."""

    shape: tuple[int, int]
    rows: Ints
    columns: Ints
    starts: Ints
    """(columns + 1,) where each column begins."""


@dataclass(frozen=True)
class QuadraticProgram:
    """min 1/2 z'Hz + f'z  s.t.  lower <= (z, Az) <= upper, simple bounds first."""

    hessian: Floats
    gradient: Floats
    values: Floats
    """Numbers of the constraint matrix, in the order of its pattern."""
    pattern: Pattern
    lower: Floats
    upper: Floats
    constant: float

    @property
    def matrix(self) -> Floats:
        """The constraint matrix, dense."""
        dense = np.zeros(self.pattern.shape)
        dense[self.pattern.rows, self.pattern.columns] = self.values
        return dense

    def cost(self, solution: Floats) -> float:
        """What a solution costs."""
        return float(solution @ self.hessian @ solution / 2 + self.gradient @ solution + self.constant)


@dataclass(frozen=True)
class Layout:
    """Where an agent's variables sit in its decision vector; each (steps, n) of positions."""

    green: Ints
    leaving: Ints
    inflow: Ints
    over_storage: Ints
    """Of the links that a neighbour feeds: a source is never forced to take more than it holds."""
    size: int

    @classmethod
    def of(cls, part: Network, control_horizon: int, steps: int) -> Layout:
        """The layout for one junction's part of a network, over so many model steps."""
        links = len(part.links)
        start = 0

        def block(rows: int, columns: int) -> Ints:
            nonlocal start
            start += rows * columns
            return np.arange(start - rows * columns, start).reshape(rows, columns)

        green = block(control_horizon, len(part.stages))
        leaving, inflow = block(steps, len(part.turns)), block(steps, links)
        over = block(steps, int(np.count_nonzero(~part.is_source)))
        return cls(green, leaving, inflow, over, size=start)


@dataclass(frozen=True)
class Timing:
    """What the problem is frozen at: where the green stands in the model steps of a control step, and the delays."""

    shown: Floats
    """(n, S) seconds of green in each model step for a second of the planned green."""
    end_s: Floats
    """(n, M) when each turn's last green ends, from the model step's start."""
    opening: Floats
    """(n, M) share of what leaves in a model step whose room reaches the link's entry within it."""
    delay_s: Floats | None = None
    """(steps, Z) from entry to the queue's tail at the start of each model step of the horizon, the first of which
    is the state's own in any case; without them all are."""

    @classmethod
    def of(cls, model: LinkModel, green_s: Floats, delay_s: Floats | None = None) -> Timing:
        """The timing of the plan `green_s` (S,) on the model's network and step."""
        windows = green_windows(model.network, green_s, model.step_s)
        by_turn = model.operations.matmul(model.served, windows.shown_s)
        return cls(windows.shown_s / green_s, windows.end_s, model.opening(by_turn, windows.end_s), delay_s)

    def part(self, place: Place) -> Timing:
        """What of the whole network's timing concerns one junction."""
        delay_s = None if self.delay_s is None else self.delay_s[:, place.links]
        return Timing(self.shown[:, place.stages], self.end_s[:, place.turns], self.opening[:, place.turns], delay_s)


@dataclass(frozen=True)
class Place:
    """A junction and what it has to know of the network round it: nothing else reaches its problem."""

    part: Network
    links: Ints
    """(n,) its links' numbers in the whole network."""
    turns: Ints
    stages: Ints
    turn_next: Ints
    """(M,) link of the whole network that each of its turns feeds, or EXIT."""
    remaining_steps: Floats
    """(n,) control steps that a vehicle on each link still needs to leave the network."""

    @property
    def consumed(self) -> list[int]:
        """Links of this junction that a neighbour feeds."""
        return [int(link) for link in self.links[~self.part.is_source]]

    @property
    def produced(self) -> list[int]:
        """Links that this junction feeds."""
        return sorted(set(self.turn_next[self.turn_next != EXIT].tolist()))


def places(network: Network) -> list[Place]:
    """Every junction's place."""
    remaining = remaining_steps(network)
    return [
        Place(
            network.part(junction),
            network.links_of[junction],
            network.turns_of[junction],
            np.array(item.stages, dtype=np.int64),
            network.turn_next[network.turns_of[junction]],
            remaining[network.links_of[junction]],
        )
        for junction, item in enumerate(network.junctions)
    ]


def remaining_steps(network: Network) -> Floats:
    """(Z,) control steps that a vehicle on each link still needs to leave the network.

    Free travel and half a cycle's wait on each link of its expected way, summed by the turning fractions.
    """
    own = (network.free_time_s + network.cycle_s[network.link_junction] / 2) / network.control_step_s
    fed = np.flatnonzero(network.turn_next != EXIT)
    size = len(network.links)
    onward = sp.csc_array((network.fraction[fed], (network.turn_link[fed], network.turn_next[fed])), shape=(size, size))
    return np.asarray(spsolve(sp.csc_array(sp.eye_array(size)) - onward, own), dtype=float)


@dataclass(frozen=True)
class Structure:
    """What decides the shape of a junction's problem."""

    settings: ProblemSettings
    step_s: float
    substeps: int
    """Model steps of a control step."""
    lags: int
    """Model steps back from which somebody can still be on the way."""
    turn_link: tuple[int, ...]
    stage_turns: tuple[tuple[int, ...], ...]
    is_source: tuple[bool, ...]
    example: Network = field(compare=False)
    """Any junction of this structure."""

    @cached_property
    def steps(self) -> int:
        """Model steps of the horizon."""
        return self.settings.horizon * self.substeps


class Statement:
    """The problem of a structure as CasADi functions of its numbers. Cut `of` a structure, once for all."""

    def __init__(self, structure: Structure):
        import casadi as ca  # noqa: PLC0415 - heavy

        self.structure = structure
        part, settings = structure.example, structure.settings
        self.layout = Layout.of(part, settings.control_horizon, structure.steps)
        z = ca.SX.sym("z", self.layout.size)
        parameters = self._symbols()
        cost, rows = self._predict(z, **parameters)
        expressions = ca.vertcat(*[row[0] for row in rows])
        side = [ca.vertcat(*[ca.repmat(ca.SX(row[end]), row[0].numel(), 1) for row in rows]) for end in (1, 2)]
        hessian, gradient = ca.hessian(cost, z)
        at_zero = ca.substitute(ca.vertcat(gradient, expressions, cost), z, ca.DM.zeros(self.layout.size))
        offset = at_zero[self.layout.size : -1]
        matrix = ca.jacobian(expressions, z)
        starts, filled = (np.array(part, dtype=np.int64) for part in matrix.sparsity().get_ccs())
        columns = np.repeat(np.arange(self.layout.size), np.diff(starts))
        self.pattern = Pattern(matrix.shape, filled, columns, starts)
        outputs = [
            at_zero[: self.layout.size],
            matrix.nz[:],
            side[0] - offset,
            side[1] - offset,
            at_zero[-1],
        ]
        flat = [ca.vertcat(*item) if isinstance(item, list) else item for item in parameters.values()]
        self.function = ca.Function("problem", [ca.vertcat(*flat)], [ca.densify(item) for item in outputs])
        self._curvature = ca.Function("curvature", [parameters["storage"]], [hessian])

    @classmethod
    def of(cls, structure: Structure) -> Statement:
        """The statement of a structure, made once."""
        return _statement(structure)

    def hessian(self, storage_veh: Floats) -> Floats:
        """The Hessian, which depends on nothing but the links' storage."""
        return np.array(self._curvature(storage_veh), dtype=float)

    def _symbols(self) -> dict[str, Any]:
        """The parameters, in the order in which `JunctionProblem` fills them in; lists run over steps or lags."""
        import casadi as ca  # noqa: PLC0415 - heavy

        structure = self.structure
        links, turns, stages = (len(each) for each in (structure.is_source, structure.turn_link, structure.stage_turns))

        def over(name: str, count: int, size: int) -> list[Any]:
            return [ca.SX.sym(f"{name}{index}", size) for index in range(count)]

        return {
            "x": ca.SX.sym("x", links),
            "q": ca.SX.sym("q", turns),
            "waiting": ca.SX.sym("waiting", links),
            "demand": over("demand", structure.steps, links),
            "fraction": ca.SX.sym("fraction", turns),
            "share_in_green": over("share_in_green", structure.steps * (structure.lags + 1), turns),
            "still_in_green": over("still_in_green", structure.lags, turns),
            "shown": over("shown", structure.substeps, stages),
            "opening": over("opening", structure.substeps, turns),
            "excess": ca.SX.sym("excess", links),
            "saturation": ca.SX.sym("saturation", turns),
            "storage": ca.SX.sym("storage", links),
            "room_share": ca.SX.sym("room_share", links),
            "remaining": ca.SX.sym("remaining", links),
            "budget": ca.SX.sym("budget", 1),
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
        excess: Any,
        saturation: Any,
        storage: Any,
        room_share: Any,
        remaining: Any,
        budget: Any,
    ) -> tuple[Any, list[tuple[Any, Any, Any]]]:
        """The horizon: (cost, rows), a row being (expression, lower, upper)."""
        import casadi as ca  # noqa: PLC0415 - heavy

        structure, layout = self.structure, self.layout
        settings, lags = structure.settings, structure.lags + 1
        kept = settings.constraints == "kept"
        numbers = LinkNumbers(saturation, storage, room_share)
        model = LinkModel(structure.example, structure.step_s, CasadiOperations(), numbers)
        source = np.array(structure.is_source, dtype=float)
        fed = sp.csr_array(np.eye(len(source))[:, source == 0])
        cost: Any = 0
        rows = [(ca.sum1(z[green]), budget, budget) for green in layout.green] if kept else []
        inflows: list[Any] = []
        for step in range(structure.steps):
            control_step, substep = divmod(step, structure.substeps)
            green = z[layout.green[min(control_step, settings.control_horizon - 1)]]
            leaving, inflow, over = z[layout.leaving[step]], z[layout.inflow[step]], z[layout.over_storage[step]]
            inflows = [inflow, *inflows][:lags]
            # Who can be in the queue before the green ends: everybody but those still on the way then. q holds who was
            # queued at first less who left; when who arrives joins it makes no difference to the sum.
            in_time = model.at_turns(x - model.by_link(q) + inflow)
            if step < structure.lags:
                in_time = in_time - still_in_green[step]
            for lag, entered in enumerate(inflows):
                in_time = in_time - share_in_green[step * lags + lag] * model.at_turns(entered)
            by_turn_s = model.operations.matmul(model.served, green * shown[substep])
            # The three terms of SPEC 2.3, the third as the consumer's: it knows its storage.
            rows += [
                (leaving - q - fraction * in_time, -np.inf, 0.0),
                (leaving - model.saturated_veh(by_turn_s, fraction), -np.inf, 0.0),
            ]
            if kept:
                room = model.room_veh(x) + room_share * excess + model.by_link(opening[substep] * leaving)
                rows.append((inflow - model.operations.matmul(fed, over) - room, -np.inf, 0.0))
            q = q - leaving
            x = x + inflow - model.by_link(leaving)
            waiting = waiting + source * (demand[step] - inflow)
            rows += [(waiting[int(link)], 0.0, np.inf) for link in np.flatnonzero(source)]
            part_of_step = settings.stage_cost(x, waiting, storage) + STORAGE_PENALTY * ca.sum1(over)
            cost += part_of_step / structure.substeps
            cost += REGULARISATION / 2 * (ca.sumsqr(leaving) + ca.sumsqr(inflow) + ca.sumsqr(over))
        cost += sum(settings.green_cost(z[green]) for green in layout.green)
        return cost + settings.terminal_cost(x, waiting, remaining), rows


def _share(number: Any) -> Floats:
    return np.asarray(np.minimum(np.maximum(number, 0.0), 1.0))


@cache
def _statement(structure: Structure) -> Statement:
    return Statement(structure)


class JunctionProblem:
    """The problem of one junction: numbers in (state, forecast), quadratic programme out."""

    def __init__(self, place: Place, settings: ProblemSettings):
        self.place = place
        self.settings = settings
        part = place.part
        step_s = settings.step_s or part.control_step_s
        self.model = LinkModel(part, step_s)
        substeps = round(part.control_step_s / step_s)
        structure = Structure(
            settings=ProblemSettings(**settings.model_dump(include=set(ProblemSettings.model_fields))),
            step_s=step_s,
            substeps=substeps,
            lags=min(int(np.ceil(part.free_time_s.max() / step_s)), settings.horizon * substeps),
            turn_link=tuple(part.turn_link.tolist()),
            stage_turns=tuple(stage.turns for stage in part.stages),
            is_source=tuple(part.is_source.tolist()),
            example=part,
        )
        self.structure = structure
        statement = Statement.of(structure)
        self.layout, self.pattern = statement.layout, statement.pattern
        self.steps, self.substeps = structure.steps, structure.substeps
        self.hessian = statement.hessian(part.storage_veh)
        self._begin_s = np.arange(self.steps)[:, None] * step_s
        self._control_step, self._substep = np.divmod(np.arange(self.steps), self.substeps)
        self._following = np.minimum(np.arange(1, self.steps + 1), self.steps - 1)
        self._leaves = self.model.leaves.toarray()
        self._bind(statement.function)
        numbers = self.model.numbers
        self._constants = np.concatenate(
            [
                numbers.saturation_veh_s,
                numbers.storage_veh,
                numbers.room_share,
                place.remaining_steps,
                part.green_budget_s,
            ]
        )
        self._box = self._simple_bounds()

    def inflow_rows(self, link: int) -> Floats:
        """(model steps, variables) matrix that picks the consumer's copy of the inflow of one of its links."""
        rows = np.zeros((self.steps, self.layout.size))
        position = int(np.flatnonzero(self.place.links == link)[0])
        rows[np.arange(self.steps), self.layout.inflow[:, position]] = 1
        return rows

    def outflow_rows(self, link: int) -> Floats:
        """(model steps, variables) matrix that adds up the flows of this junction into `link`."""
        rows = np.zeros((self.steps, self.layout.size))
        for position in np.flatnonzero(self.place.turn_next == link):
            rows[np.arange(self.steps), self.layout.leaving[:, position]] = 1
        return rows

    def program(self, state: State, forecast: Forecast, timing: Timing) -> QuadraticProgram:
        """The quadratic programme for the junction's own state, frozen at the junction's own `timing`.

        Raises ControllerError for a state or a forecast that is not finite.
        """
        part, model, lags = self.place.part, self.model, self.structure.lags
        link = part.turn_link
        x = np.maximum(state.x_veh, 0.0)
        queue = self._leaves @ state.q_veh
        # A queue beyond its link, or a miscount that leaves more on the way than there is, must not leave the first
        # step without a feasible flow.
        q = state.q_veh * np.minimum(1.0, x / np.maximum(queue, 1e-9))[link]
        queue = np.minimum(queue, x)
        delay_s = self._frozen_delay_s(queue, timing.delay_s)
        history = np.arange(len(state.past_inflow_veh))[:, None]
        underway = _share(delay_s[0] / part.sample_s - history) * state.past_inflow_veh
        past = state.past_inflow_veh * np.minimum(1.0, (x - queue) / np.maximum(underway.sum(axis=0), 1e-9))

        # Who entered before this moment is in the queue by the green's end: who comes later never overtakes.
        entry_s = np.maximum.accumulate(self._begin_s + timing.end_s[self._substep] - delay_s[:, link], axis=0)
        behind = (self._begin_s + model.step_s - entry_s) / model.step_s
        share = _share(behind[:, None] - np.arange(lags + 1)[:, None])
        before = _share(-entry_s[:lags, None] / part.sample_s - history)
        parameters = [
            x,
            q,
            state.source_queue_veh,
            forecast.demand_veh[self._control_step] / self.substeps,
            state.fraction,
            share,
            (before * past[:, link]).sum(axis=1),
            timing.shown,
            timing.opening,
            # A source that holds more than it can, by a wrong count, may go on holding it.
            part.is_source * np.maximum(x - part.storage_veh, 0.0),
            self._constants,
        ]
        np.concatenate([each.ravel() for each in parameters], out=self._parameters)
        if not np.isfinite(self._parameters).all():
            raise ControllerError(f"agent {part.name}: its state or forecast is not finite")
        self._run()
        gradient, values, lower, upper, constant = self._results
        return QuadraticProgram(
            self.hessian,
            gradient.copy(),
            values.copy(),
            self.pattern,
            np.concatenate([self._box[0], lower]),
            np.concatenate([self._box[1], upper]),
            float(constant[0]),
        )

    def greens(self, solution: Floats) -> Floats:
        """(Kc, S of this junction) greens [s] of a solution."""
        return solution[self.layout.green]

    def predicted_delay_s(self, state: State, solution: Floats, delay_s: Floats | None) -> Floats:
        """(model steps, n) delays that the next control step's problem is to be frozen at, from this one's solution.

        `delay_s` is what this one was frozen at. Who is on the link and not still on the way by then is queued.
        """
        model, steps, lags = self.model, self.steps, self.structure.lags
        inflow = solution[self.layout.inflow]
        x = state.x_veh + np.cumsum(inflow - solution[self.layout.leaving] @ self._leaves.T, axis=0)
        # On the way at the end of step k is who entered within the delay that step k + 1 was frozen at.
        held = self._frozen_delay_s(self._leaves @ state.q_veh, delay_s)
        behind = held[self._following] / model.step_s
        way = np.zeros_like(x)
        for lag in range(lags):
            way[lag:] += _share(behind[lag:] - lag) * inflow[: steps - lag]
        early_s = (behind[:lags] - 1) * model.step_s - self._begin_s[:lags]
        history = np.arange(len(state.past_inflow_veh))[:, None]
        still = _share(early_s[:, None] / self.place.part.sample_s - history)
        way[:lags] += (still * state.past_inflow_veh).sum(axis=1)
        ahead = np.minimum(np.arange(steps) + self.substeps, steps) - 1
        return np.asarray(model.delay_s(np.maximum(x - way, 0.0))[ahead])

    def _frozen_delay_s(self, queue_veh: Floats, later_s: Floats | None) -> Floats:
        """(model steps, n) delays: the state's own, then those foreseen, or without them the state's own for ever."""
        delay_s = np.empty((self.steps, len(queue_veh)))
        delay_s[:] = self.model.delay_s(queue_veh) if later_s is None else later_s
        delay_s[0] = self.model.delay_s(queue_veh)
        return delay_s

    def _bind(self, function: Any) -> None:
        """Tie a CasADi function to arrays of ours: calling it then costs its arithmetic and nothing else."""
        self._parameters = np.zeros(function.size1_in(0))
        self._results = [np.zeros(function.size1_out(index)) for index in range(function.n_out())]
        self._function = function
        self._buffer, self._run = function.buffer()
        self._buffer.set_arg(0, memoryview(self._parameters.data))
        for position, array in enumerate(self._results):
            self._buffer.set_res(position, memoryview(array.data))

    def _simple_bounds(self) -> tuple[Floats, Floats]:
        lower, upper = np.zeros(self.layout.size), np.full(self.layout.size, np.inf)
        if self.settings.constraints == "kept":
            least = self.place.part.min_green_s
            lower[self.layout.green] = least
            # What the cycle leaves when every other stage has its least (SPEC 3).
            upper[self.layout.green] = self.place.part.green_budget_s[0] - (least.sum() - least)
        return lower, upper
