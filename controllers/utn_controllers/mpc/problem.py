"""The numbers of a junction's problem: (state, forecast) in, quadratic programme out.

Junctions of the same structure can be had side by side: their arrays are then as long as all of them together need.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from utn_controllers.mpc.place import Place
from utn_controllers.mpc.settings import ProblemSettings
from utn_controllers.mpc.statement import Pattern, Statement, Structure
from utn_sumo.contract import Floats, Forecast, Ints, State
from utn_sumo.errors import ControllerError
from utn_sumo.model import LinkModel, green_windows


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
class Programs:
    """The programmes of a problem's junctions, one a row."""

    problem: JunctionProblem
    gradient: Floats
    values: Floats
    lower: Floats
    upper: Floats
    constant: Floats
    """(junctions,)"""

    @property
    def only(self) -> QuadraticProgram:
        """The only junction's."""
        rows = [each[0] for each in (self.gradient, self.values, self.lower, self.upper)]
        gradient, values, lower, upper = rows
        problem = self.problem
        return QuadraticProgram(
            problem.hessian, gradient, values, problem.pattern, lower, upper, float(self.constant[0])
        )


@dataclass(frozen=True)
class Timing:
    """What the problem is frozen at: where the green stands in the model steps of a control step, and the delays."""

    shown: Floats
    """(n, S) seconds of green in each model step for a second of the planned green."""
    held_s: Floats
    """(n, M) green of each turn that no plan changes (`GreenWindows.held_s`)."""
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
        by_turn = model.operations.matmul(model.served, windows.shown_s) + windows.held_s
        opening = model.opening(by_turn, windows.end_s)
        return cls(windows.shown_s / green_s, windows.held_s, windows.end_s, opening, delay_s)

    @classmethod
    def anywhere(cls, model: LinkModel, green_s: Floats, delay_s: Floats | None = None) -> Timing:
        """The timing where an execution shows as much green, but in short pieces whenever it likes.

        Every model step has its share of it, nobody arrives too late for the last piece, and room is let out evenly.
        """
        placed = cls.of(model, green_s, delay_s)
        end_s = np.full_like(placed.end_s, model.step_s)
        shown, held_s = (np.broadcast_to(each.mean(axis=0), each.shape) for each in (placed.shown, placed.held_s))
        return cls(shown, held_s, end_s, model.opening(end_s, end_s), delay_s)

    @classmethod
    def joined(cls, timings: Sequence[Timing], places: Sequence[Place]) -> Timing:
        """The whole network's timing from its parts'."""
        links, turns, stages = (
            np.argsort(np.concatenate([getattr(place, name) for place in places]))
            for name in ("links", "turns", "stages")
        )
        delays = [timing.delay_s for timing in timings]
        known = [delay for delay in delays if delay is not None]
        return cls(
            np.concatenate([timing.shown for timing in timings], axis=1)[:, stages],
            np.concatenate([timing.held_s for timing in timings], axis=1)[:, turns],
            np.concatenate([timing.end_s for timing in timings], axis=1)[:, turns],
            np.concatenate([timing.opening for timing in timings], axis=1)[:, turns],
            np.concatenate(known, axis=1)[:, links] if len(known) == len(delays) else None,
        )

    def part(self, place: Place) -> Timing:
        """What of the whole network's timing concerns one junction."""
        delay_s = None if self.delay_s is None else self.delay_s[:, place.links]
        held_s, end_s, opening = (each[:, place.turns] for each in (self.held_s, self.end_s, self.opening))
        return Timing(self.shown[:, place.stages], held_s, end_s, opening, delay_s)


def _share(number: Any) -> Floats:
    return np.asarray(np.minimum(np.maximum(number, 0.0), 1.0))


class JunctionProblem:
    """The problem of one junction, or of several of the same structure side by side."""

    def __init__(self, place: Place, settings: ProblemSettings):
        self.place = place
        self.settings = settings
        part = place.part
        self.count = len(part.junctions)
        """Junctions."""
        alone = part if self.count == 1 else part.part(0)
        self.structure = structure = Structure.of(alone, settings)
        self.model = LinkModel(part, structure.step_s)
        self._statement = statement = Statement.of(structure)
        self.layout, self.pattern = statement.layout, statement.pattern
        self.steps, self.substeps = structure.steps, structure.substeps
        self._begin_s = np.arange(self.steps)[:, None] * structure.step_s
        self._control_step, self._substep = np.divmod(np.arange(self.steps), self.substeps)
        self._following = np.minimum(np.arange(1, self.steps + 1), self.steps - 1)
        self._leaves = self.model.leaves.toarray() if self.count == 1 else self.model.leaves
        self._bind(statement.function if self.count == 1 else statement.function.map(self.count))
        numbers = self.model.numbers
        constants = [numbers.saturation_veh_s, numbers.storage_veh, numbers.room_share, place.remaining_steps]
        self._constants = np.concatenate(
            [self._by_junction(each) for each in (*constants, part.green_budget_s)], axis=1
        )
        self._box = self._simple_bounds()
        self._disturbed_so_far_veh = np.zeros((self.steps, len(part.links)))
        """Of the last programmes."""

    def hessians(self) -> Iterator[Floats]:
        """Each junction's Hessian (n, n)."""
        for storage_veh in np.split(self.place.part.storage_veh, self.count):
            yield self._statement.hessian(storage_veh)

    @cached_property
    def hessian(self) -> Floats:
        """(n, n) of the only junction."""
        (hessian,) = self.hessians()
        return hessian

    def program(self, state: State, forecast: Forecast, timing: Timing) -> QuadraticProgram:
        """The quadratic programme of the only junction; as `programs`."""
        return self.programs(state, forecast, timing).only

    def programs(self, state: State, forecast: Forecast, timing: Timing) -> Programs:
        """The quadratic programmes for the junctions' own state, frozen at their own `timing`.

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
        still_in_green = (before * past[:, link]).sum(axis=1)
        self._disturbed_so_far_veh = self._disturbed_veh(forecast, x, x - queue, still_in_green)
        parameters = [
            x,
            q,
            state.source_queue_veh,
            forecast.demand_veh[self._control_step] / self.substeps,
            np.diff(self._disturbed_so_far_veh, axis=0, prepend=0.0),
            state.fraction,
            share,
            still_in_green,
            timing.shown,
            timing.held_s,
            timing.opening,
            # A source that holds more than it can, by a wrong count, may go on holding it.
            part.is_source * np.maximum(x - part.storage_veh, 0.0),
        ]
        np.concatenate([*map(self._by_junction, parameters), self._constants], axis=1, out=self._parameters)
        if not np.isfinite(self._parameters).all():
            wrong = ~np.isfinite(self._parameters).all(axis=1)
            name = part.junctions[int(wrong.argmax())].id
            raise ControllerError(f"agent {name}: its state or forecast is not finite")
        self._run()
        gradient, values, lower, upper, constant = self._results
        return Programs(
            self,
            gradient.copy(),
            values.copy(),
            np.concatenate([self._box[0], lower], axis=1),
            np.concatenate([self._box[1], upper], axis=1),
            constant[:, 0].copy(),
        )

    def greens(self, solution: Floats) -> Floats:
        """(Kc, S) greens [s] of a solution (n,), or of one each (junctions, n)."""
        return self._together(solution, self.layout.green)

    def predicted_delay_s(self, state: State, solution: Floats, delay_s: Floats | None) -> Floats:
        """(model steps, Z) delays that the next control step's problem is to be frozen at, from this one's solution.

        `delay_s` is what this one was frozen at. Who is on the link and not still on the way by then is queued.
        """
        model, steps, lags = self.model, self.steps, self.structure.lags
        inflow, leaving = (self._together(solution, block) for block in (self.layout.inflow, self.layout.leaving))
        x = state.x_veh + self._disturbed_so_far_veh + np.cumsum(inflow - leaving @ self._leaves.T, axis=0)
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

    def _disturbed_veh(self, forecast: Forecast, x: Floats, moving: Floats, still_in_green: Floats) -> Floats:
        """(model steps, Z) what the disturbances come to by each model step.

        No more than fits, and no fewer than are neither queued nor still on the way at a green's end: with nobody
        entering or leaving there is then always a feasible flow. `still_in_green` is (lags, M).
        """
        if forecast.disturbance_veh is None:
            return np.zeros((self.steps, len(x)))
        sum_veh = np.cumsum(forecast.disturbance_veh[self._control_step] / self.substeps, axis=0)
        least = np.tile(-moving, (self.steps, 1))
        link = self.place.part.turn_link
        np.maximum.at(least[: len(still_in_green)].T, link, (still_in_green - moving[link]).T)
        room = np.maximum(self.place.part.storage_veh - x, 0.0)
        return np.clip(sum_veh, np.minimum(least, 0.0), room)

    def _frozen_delay_s(self, queue_veh: Floats, later_s: Floats | None) -> Floats:
        """(model steps, Z) delays: the state's own, then those foreseen, or without them the state's own for ever."""
        delay_s = np.empty((self.steps, len(queue_veh)))
        delay_s[:] = self.model.delay_s(queue_veh) if later_s is None else later_s
        delay_s[0] = self.model.delay_s(queue_veh)
        return delay_s

    def _by_junction(self, numbers: Floats) -> Floats:
        """(junctions, k) of numbers (..., the junctions' links, turns or stages)."""
        own = numbers.reshape(-1, self.count, numbers.shape[-1] // self.count)
        return own.swapaxes(0, 1).reshape(self.count, -1)

    def _together(self, solution: Floats, block: Ints) -> Floats:
        """(steps, all links, turns or stages) of a solution's `block`: the way back."""
        own = solution.reshape(self.count, -1)[:, block]
        return own.swapaxes(0, 1).reshape(len(block), -1)

    def _bind(self, function: Any) -> None:
        """Tie a CasADi function to arrays of ours: calling it then costs its arithmetic and nothing else."""

        def array(size: tuple[int, int]) -> Floats:
            # CasADi keeps a matrix column by column, a junction in each.
            return np.zeros(size[::-1])

        self._parameters = array(function.size_in(0))
        self._results = [array(function.size_out(index)) for index in range(function.n_out())]
        self._function = function
        self._buffer, self._run = function.buffer()
        self._buffer.set_arg(0, memoryview(self._parameters.data))
        for position, results in enumerate(self._results):
            self._buffer.set_res(position, memoryview(results.data))

    def _simple_bounds(self) -> tuple[Floats, Floats]:
        shape = (self.count, self.layout.size)
        lower, upper = np.zeros(shape), np.full(shape, np.inf)
        part, green = self.place.part, self.layout.green
        entry_veh = np.where(part.is_source, part.entry_flow_veh_s * self.model.step_s, np.inf)
        upper[:, self.layout.inflow] = entry_veh.reshape(self.count, 1, -1)
        if self.settings.constraints == "kept":
            least = part.min_green_s.reshape(self.count, 1, -1)
            lower[:, green] = least
            # What the cycle leaves when every other stage has its least (SPEC 3).
            upper[:, green] = part.green_budget_s[:, None, None] - (least.sum(axis=-1, keepdims=True) - least)
        return lower, upper
