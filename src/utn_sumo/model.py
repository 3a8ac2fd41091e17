"""The macroscopic S model of SPEC 2, one definition for numbers and for CasADi symbols.

Everything here is written against `Operations`, which numpy and CasADi both offer, and the step is cut into
the pieces that the controllers need one by one: the vehicles that reach the tail of the queue, the three
terms of the leaving flow, and conservation. `LinkModel.step` composes them into the exact model; the
convex problem of the MPC turns the same three terms into inequalities.

Units: vehicles per model step (flow times step) throughout, so that a rate in SPEC is a count here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from utn_sumo.contract import EXIT, SAMPLE_S, Floats, Ints, Network
from utn_sumo.errors import SettingError

Sparse = Any
"""A scipy.sparse CSR matrix: a network's incidences are many zeros."""


class Operations(Protocol):
    """The few operations that the model needs besides + - * /."""

    def matmul(self, matrix: Sparse, vector: Any) -> Any: ...
    def take(self, vector: Any, places: Ints) -> Any:
        """The vector's numbers at these places, one of them as often as it is named."""

    def minimum(self, a: Any, b: Any) -> Any: ...
    def maximum(self, a: Any, b: Any) -> Any: ...
    def share(self, a: Any) -> Any:
        """`a`, but no less than 0 and no more than 1."""

    def settled(self, a: Any, b: Any) -> bool:
        """Whether a sweep changed nothing any more, where that can be known."""


SETTLED_VEH = 1e-12
"""Change of an inflow by a sweep under which it has settled."""


class NumpyOperations:
    """Numbers. The last axis is that of links, turns or stages; any axes before it are a batch of cases."""

    def matmul(self, matrix: Sparse, vector: Any) -> Any:
        batch = np.shape(vector)[:-1]
        return (matrix @ vector.reshape(-1, matrix.shape[1]).T).T.reshape(*batch, -1) if batch else matrix @ vector

    def take(self, vector: Any, places: Ints) -> Any:
        return np.take(vector, places, axis=-1)

    def minimum(self, a: Any, b: Any) -> Any:
        return np.minimum(a, b)

    def maximum(self, a: Any, b: Any) -> Any:
        return np.maximum(a, b)

    def share(self, a: Any) -> Any:
        return np.minimum(np.maximum(a, 0.0), 1.0)

    def settled(self, a: Any, b: Any) -> bool:
        return bool(np.max(np.abs(a - b), initial=0.0) < SETTLED_VEH)


class CasadiOperations:
    """CasADi symbols (SX or MX column vectors)."""

    def __init__(self) -> None:
        import casadi  # noqa: PLC0415 - heavy, and only symbolic use needs it

        self._casadi = casadi

    def matmul(self, matrix: Sparse, vector: Any) -> Any:
        return self._casadi.mtimes(self._casadi.DM(matrix.tocsc()), vector)

    def take(self, vector: Any, places: Ints) -> Any:
        # Of a vector of one the same place taken twice would be a row.
        return self._casadi.reshape(vector[places.tolist()], len(places), 1)

    def minimum(self, a: Any, b: Any) -> Any:
        return self._casadi.fmin(a, b)

    def maximum(self, a: Any, b: Any) -> Any:
        return self._casadi.fmax(a, b)

    def share(self, a: Any) -> Any:
        return self._casadi.fmin(self._casadi.fmax(a, 0.0), 1.0)

    def settled(self, a: Any, b: Any) -> bool:  # noqa: ARG002 - symbols never know
        return False


class SmoothOperations(CasadiOperations):
    """CasADi symbols with a minimum and a maximum that Newton's method can follow: their kinks are rounded.

    At a kink they are off by half an epsilon, `apart` from it by epsilon^2 / (4 apart). Shares have an epsilon of
    their own, as what is off in a share is then multiplied by vehicles.
    """

    def __init__(self, epsilon: Any, share_epsilon: Any) -> None:
        """`epsilon` in the unit of what is compared (veh or s), `share_epsilon` in shares: numbers or symbols."""
        super().__init__()
        self._epsilon, self._share_epsilon = epsilon, share_epsilon

    def minimum(self, a: Any, b: Any) -> Any:
        return (a + b - self._apart(a - b, self._epsilon)) / 2

    def maximum(self, a: Any, b: Any) -> Any:
        return (a + b + self._apart(a - b, self._epsilon)) / 2

    def share(self, a: Any) -> Any:
        return (self._apart(a, self._share_epsilon) - self._apart(a - 1.0, self._share_epsilon) + 1.0) / 2

    def _apart(self, difference: Any, epsilon: Any) -> Any:
        return self._casadi.sqrt(difference**2 + epsilon**2)


@dataclass(frozen=True)
class ModelState:
    """State of the model at a step boundary: numpy arrays or CasADi vectors."""

    x_veh: Any
    """(Z,) vehicles on each link."""
    q_veh: Any
    """(M,) queued vehicles by turn."""
    source_queue_veh: Any
    """(Z,) vehicles that wait outside a source link."""
    past_inflow_veh: tuple[Any, ...]
    """Inflow (Z,) of the last samples, newest first: `LinkModel.lags` of `LinkModel.sample_s` each."""


@dataclass(frozen=True)
class Arrivals:
    """Who has reached the tail of the queue by some moment of a step."""

    before_veh: Any
    """Of those who were on the link when the step began."""
    own_share: Any
    """Of who comes in within the step."""

    def veh(self, inflow_veh: Any) -> Any:
        """All of them. It may be negative only where the delay has just grown."""
        return self.before_veh + self.own_share * inflow_veh


@dataclass(frozen=True)
class StepTerms:
    """What decides a step's flows beside the flows themselves."""

    q_veh: Any
    """(M,) queued at the start."""
    fraction: Any
    """(M,)"""
    wanting_veh: Any
    """(Z,) that want to enter from outside."""
    arrivals: Arrivals
    """By link, at the step's end."""
    in_green: Arrivals | None
    """By turn, at the end of each turn's green; None if that is the step's end."""
    saturated_veh: Any
    """(M,) the second term of SPEC 2.3."""
    room_veh: Any
    """(Z,) at the start."""
    claim: Any
    """(M,) share of the room on the link that a turn feeds; 0 at an exit."""
    opening: Any | None
    """(M,) share of what leaves whose room reaches the link's entry within the step, if any does."""


@dataclass(frozen=True)
class StepFlows:
    """What moved in one step."""

    leaving_veh: Any
    """(M,) by turn."""
    inflow_veh: Any
    """(Z,) into each link, from other links and from outside."""
    arriving_veh: Any
    """(Z,) at the tail of the queue."""
    entering_veh: Any
    """(Z,) of the inflow, from outside."""
    queued_veh: Any
    """(M,) queued at the start or arrived since, before anybody leaves."""
    open_room_veh: Any
    """(Z,) room for the inflow: at the start and as it opens within the step."""


@dataclass(frozen=True)
class LinkNumbers:
    """What the terms of SPEC 2.3 need to know of each link; CasADi symbols where many junctions share one problem."""

    saturation_veh_s: Any
    """(M,) saturation flow of each turn's lane group."""
    storage_veh: Any
    """(Z,)"""
    room_share: Any
    """(Z,) share of the room on a link that its entry can use within a step."""


WAVE_SPEED_M_S = 6.0
"""Speed at which a queue's start-up travels upstream: a standing vehicle's 7.5 m in about 1.3 s."""
NO_TRAFFIC = 1e-12
"""Keeps the shares of a lane group finite where all of its turns are out of use."""
STEP_TOLERANCE = 1e-9
MOST_SWEEPS, RADIUS_POWER = 200, 64
INFINITE_ROOM_VEH = 1e6
"""Room beyond an exit: the third term of SPEC 2.3 does not bind there. A rounded minimum loses digits beside more."""


def _incidence(rows: Any, columns: Any, shape: tuple[int, int]) -> Sparse:
    return sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)


class LinkModel:
    """SPEC 2 on the links of one network, with a step of `step_s` seconds."""

    def __init__(
        self,
        network: Network,
        step_s: float,
        operations: Operations | None = None,
        numbers: LinkNumbers | None = None,
    ):
        """`numbers` stand in for the network's own."""
        self.network = network
        self.step_s = step_s
        self.operations: Operations = operations or NumpyOperations()
        links, turns = len(network.links), len(network.turns)
        fed = network.turn_next != EXIT
        self.leaves = _incidence(network.turn_link, np.arange(turns), (links, turns))
        """(Z, M) 1 where a turn leaves a link: sums by link."""
        self.feeds = _incidence(network.turn_next[fed], np.flatnonzero(fed), (links, turns))
        """(Z, M) 1 where a turn feeds a link."""
        self._next_link = np.maximum(network.turn_next, 0)
        stages = np.repeat(np.arange(len(network.stages)), [len(stage.turns) for stage in network.stages])
        served = np.concatenate([stage.turns for stage in network.stages]).astype(np.int64)
        self.served = _incidence(served, stages, (turns, len(network.stages)))
        """(M, S) 1 where a stage serves a turn."""
        grouped = _incidence(network.turn_group, np.arange(turns), (len(network.groups), turns))
        self._same_group = (grouped.T @ grouped).tocsr()
        """(M, M) 1 where two turns are of one lane group."""
        self._is_exit = (~fed).astype(float)
        self._is_source = network.is_source.astype(float)
        entry_veh = np.minimum(network.entry_flow_veh_s * step_s, INFINITE_ROOM_VEH)
        self._entry_veh = entry_veh if (entry_veh < INFINITE_ROOM_VEH).any() else None
        """(Z,) most that enters from outside in a step; None where nothing limits it."""
        # Room that opens at the stop line reaches the entry as a wave: within one step, only so much of it does.
        self._wave_s = np.array([link.length_m for link in network.links]) / WAVE_SPEED_M_S
        self.numbers = numbers or LinkNumbers(
            network.group_saturation_flow_veh_s[network.turn_group],
            network.storage_veh,
            np.minimum(1.0, step_s / self._wave_s),
        )
        self.samples = int(np.ceil(step_s / SAMPLE_S))
        """Samples of a step, in which the past is remembered: a long step looks back as sharply as the loops count."""
        self.sample_s = step_s / self.samples
        self.lags = max(self.samples, int(np.ceil(network.free_time_s.max() / self.sample_s)))
        """Past samples that the delay reaches back to."""
        self.sweeps = self._sweeps_needed()

    def _sweeps_needed(self) -> int:
        """Sweeps after which the loop through links shorter than a step has settled to 1e-12.

        With a delay under one step (delta = 0) an inflow passes on within the step, round a circuit too.
        One sweep hands it on by one link, and shrinks it by the turning fraction: the spectral radius of the
        turning matrix bounds what is left (SPEC 2, known weak points), and the row sums of a power
        bound the radius.
        """
        matrix = self.feeds @ sp.diags_array(self.network.fraction) @ self.leaves.T
        reach = np.ones(len(self.network.links))
        for _ in range(RADIUS_POWER):
            reach = matrix @ reach
        radius = np.clip(reach.max(initial=0.0) ** (1 / RADIUS_POWER), 1e-6, 0.87)
        return int(min(MOST_SWEEPS, max(len(self.network.junctions), np.ceil(np.log(1e-12) / np.log(radius)))))

    def by_link(self, turns: Any) -> Any:
        """(..., Z) what (..., M) turns sum up to by the link that they leave."""
        return self.operations.matmul(self.leaves, turns)

    def at_turns(self, links: Any) -> Any:
        """(..., M) each turn's link's number of (..., Z)."""
        return self.operations.take(links, self.network.turn_link)

    def _at_next(self, links: Any) -> Any:
        """(..., M) the number of (..., Z) of the link that each turn feeds; 0 at exits."""
        return self.operations.take(links, self._next_link) * (1.0 - self._is_exit)

    def delay_s(self, queue_veh: Any) -> Any:
        """(Z,) time from entry to the tail of the queue (SPEC 2.6), never negative."""
        free_s = self.network.free_time_s - queue_veh * self.network.queue_spacing_s_veh
        return self.operations.maximum(free_s, 0.0)

    def on_the_way(self, delay_s: Any, at_s: Any | None = None) -> list[Any]:
        """Share of the step's own inflow, then of each past sample's, that is still to arrive `at_s` into the step.

        By link or by turn, as `delay_s` and `at_s` are; without `at_s` at the step's end. Within a step and within a
        sample the inflow is even.
        """
        ops = self.operations
        # Who entered less than this long before the step's start is still on the way.
        since = delay_s - (self.step_s if at_s is None else at_s)

        past = [ops.share(since / self.sample_s - lag) for lag in range(self.lags)]
        return [ops.share(since / self.step_s + 1.0), *past]

    def history(self, counted_veh: Floats, sample_s: float) -> tuple[Floats, ...]:
        """Past inflows as the model remembers them, from counts (..., H, Z) in samples of `sample_s`, newest first."""
        known = counted_veh.shape[-2]
        summed = np.concatenate([np.zeros_like(counted_veh[..., :1, :]), np.cumsum(counted_veh, axis=-2)], axis=-2)
        at = np.clip(np.arange(self.lags + 1) * self.sample_s / sample_s, 0, known)
        low = np.minimum(at.astype(np.int64), known - 1)
        part = (at - low)[:, None]
        curve = summed[..., low, :] * (1 - part) + summed[..., low + 1, :] * part
        return tuple(np.moveaxis(np.diff(curve, axis=-2), -2, 0))

    def _arrivals(self, moving_veh: Any, past: Sequence[Any], share: Sequence[Any]) -> Arrivals:
        """Vehicles that reach the tail of the queue by the time of `share` (SPEC 2.5 as cumulative curves).

        All by link, or all by turn with each link's numbers at its turns.

        Who is on the link and not queued, or comes in now, arrives unless it entered less than the delay
        ago. For a constant delay this is SPEC 2.5 exactly; for a varying one it conserves vehicles,
        and nobody arrives twice or never.
        """
        before = moving_veh
        for inflow_then, share_then in zip(past, share[1:], strict=False):
            before = before - share_then * inflow_then
        return Arrivals(before, 1.0 - share[0])

    def saturated_veh(self, green_s: Any, fraction: Any) -> Any:
        """(M,) what green lets through: the second term of SPEC 2.3. `green_s` is by turn.

        The turns of a lane group share its saturation flow as they share its traffic.
        """
        in_group = self.operations.matmul(self._same_group, fraction) + NO_TRAFFIC
        return fraction / in_group * self.numbers.saturation_veh_s * green_s

    def room_veh(self, x_veh: Any) -> Any:
        """(Z,) vehicles that a link takes in a step: C - x, the third term of SPEC 2.3 before it is shared out."""
        return (self.numbers.storage_veh - x_veh) * self.numbers.room_share

    def opening(self, green_s: Any, green_end_s: Any) -> Any:
        """(M,) share of what leaves in a step whose room reaches the link's entry within the same step.

        `green_s` and `green_end_s` are by turn. With a step of a whole cycle a full link takes up in the step what
        its own early green lets out of it.
        """
        ops = self.operations
        left_s = self.step_s - self._wave_s[self.network.turn_link] - (green_end_s - green_s)
        return ops.share(left_s / ops.maximum(green_s, 1e-9))

    def step(
        self,
        state: ModelState,
        green_s: Any,
        demand_veh: Any,
        fraction: Any,
        green_end_s: Any | None = None,
        *,
        held_s: Any = 0.0,
    ) -> tuple[ModelState, StepFlows]:
        """One step of the exact model.

        `green_s` (S,) is the green of each stage within the step, `held_s` (M,) what green each turn has beside that
        of its stages, `demand_veh` (Z,) what comes from outside, `fraction` (M,) the turning fractions. `green_end_s`
        (M,) is when each turn's last green ends, counted from the step's start: who reaches the queue after it waits
        for the next step. Without it the green may stand anywhere. Vehicles are conserved, and 0 <= q <= x <= storage
        holds afterwards if it held before.
        """
        terms = self.terms(state, green_s, demand_veh, fraction, green_end_s, held_s=held_s)
        # With delays under one step the inflow depends on itself round a circuit, and so does the room: sweep to
        # the fixed point that is reached from below.
        inflow, room = self.operations.minimum(terms.wanting_veh, terms.room_veh), terms.room_veh
        for _ in range(self.sweeps):
            flows = self.flows(terms, inflow, room)
            last, inflow, room = inflow, flows.inflow_veh, flows.open_room_veh
            if self.operations.settled(last, inflow):
                break
        return self.after(state, demand_veh, flows), flows

    def disturbed(self, state: ModelState, disturbance_veh: Any) -> ModelState:
        """The state when `disturbance_veh` (Z,) have come onto the links, or left them, amid them (e_z of SPEC 2.1).

        As far as there is room, or somebody to leave who is not queued. Who comes so reaches the queue within the step.
        """
        ops = self.operations
        room = ops.maximum(self.numbers.storage_veh - state.x_veh, 0.0)
        moving = state.x_veh - self.by_link(state.q_veh)
        change = ops.minimum(ops.maximum(disturbance_veh, -moving), room)
        return replace(state, x_veh=state.x_veh + change)

    def terms(
        self,
        state: ModelState,
        green_s: Any,
        demand_veh: Any,
        fraction: Any,
        green_end_s: Any | None = None,
        *,
        held_s: Any = 0.0,
    ) -> StepTerms:
        """What decides the flows of the step that `step` describes, all but the flows themselves."""
        ops = self.operations
        turn_green_s = ops.matmul(self.served, green_s) + held_s
        # Each turn's share of the room on the link that it feeds, among the turns that have green in this step;
        # exits have all the room in the world.
        open_fraction = fraction * ops.share(turn_green_s)
        feeding = ops.matmul(self.feeds, open_fraction)
        claim = open_fraction / ops.maximum(self._at_next(feeding) + self._is_exit, 1e-9)

        wanting = (state.source_queue_veh + demand_veh) * self._is_source
        queue = self.by_link(state.q_veh)
        moving = state.x_veh - queue
        delay = self.delay_s(queue)
        in_green, opening = None, None
        if green_end_s is not None:
            past_by_turn = [self.at_turns(past) for past in state.past_inflow_veh]
            share = self.on_the_way(self.at_turns(delay), green_end_s)
            in_green = self._arrivals(self.at_turns(moving), past_by_turn, share)
            opening = self.opening(turn_green_s, green_end_s)
        return StepTerms(
            q_veh=state.q_veh,
            fraction=fraction,
            wanting_veh=wanting if self._entry_veh is None else ops.minimum(wanting, self._entry_veh),
            arrivals=self._arrivals(moving, state.past_inflow_veh, self.on_the_way(delay)),
            in_green=in_green,
            saturated_veh=self.saturated_veh(turn_green_s, fraction),
            room_veh=ops.maximum(self.room_veh(state.x_veh), 0.0),
            claim=claim,
            opening=opening,
        )

    def flows(self, terms: StepTerms, inflow_veh: Any, open_room_veh: Any) -> StepFlows:
        """The flows that follow from the terms of a step and a guess of its inflow (Z,) and its room (Z,).

        The guess is right where the flows have the same inflow and room: that is the exact model.
        """
        ops = self.operations
        arriving = ops.maximum(terms.arrivals.veh(inflow_veh), 0.0)
        queued = terms.q_veh + terms.fraction * self.at_turns(arriving)
        unsaturated = queued
        if terms.in_green is not None:
            in_time = terms.in_green.veh(self.at_turns(inflow_veh))
            unsaturated = terms.q_veh + terms.fraction * ops.maximum(in_time, 0.0)
        # SPEC 2.3, the three terms.
        oversaturated = terms.claim * self._at_next(open_room_veh) + INFINITE_ROOM_VEH * self._is_exit
        leaving = ops.minimum(unsaturated, ops.minimum(terms.saturated_veh, oversaturated))
        room = terms.room_veh
        if terms.opening is not None:
            room = room + self.by_link(terms.opening * leaving)
        # Only a source has an outside; a rounded minimum must not make one of a link that has none.
        entering = ops.minimum(terms.wanting_veh, room) * self._is_source
        inflow = entering + ops.matmul(self.feeds, leaving)
        return StepFlows(leaving, inflow, arriving, entering, queued, room)

    def after(self, state: ModelState, demand_veh: Any, flows: StepFlows) -> ModelState:
        """The state at the end of a step that began with `state`: conservation."""
        inflow = flows.inflow_veh
        return ModelState(
            x_veh=state.x_veh + inflow - self.by_link(flows.leaving_veh),
            q_veh=flows.queued_veh - flows.leaving_veh,
            source_queue_veh=state.source_queue_veh + demand_veh * self._is_source - flows.entering_veh,
            past_inflow_veh=(*[inflow / self.samples] * self.samples, *state.past_inflow_veh)[: self.lags],
        )


def share_on_the_way(since_s: Floats, interval_s: float, intervals: int) -> Floats:
    """(intervals, n) share of each past interval, newest first, that entered less than `since_s` (n,) ago.

    The inflow is even within an interval: `LinkModel.on_the_way` for numbers, all intervals at once.
    """
    return np.clip(since_s / interval_s - np.arange(intervals)[:, None], 0.0, 1.0)


@dataclass(frozen=True)
class GreenWindows:
    """Where the green stands in the model steps of a control step."""

    shown_s: Floats
    """(..., steps, S) seconds of green of each stage in each model step."""
    held_s: Floats
    """(..., steps, M) seconds of green that each turn has in clearances, or because no signal stops it."""
    end_s: Floats
    """(..., steps, M) end of each turn's last green in each model step, from the model step's start; 0 without one."""


def check_step(network: Network, step_s: float) -> None:
    """Raise SettingError unless a model step of `step_s` divides the control step."""
    if step_s <= 0 or abs(network.control_step_s / step_s - round(network.control_step_s / step_s)) > STEP_TOLERANCE:
        whole = f"the control step of {network.control_step_s:g} s"
        raise SettingError(f"setting 'step_s' is {step_s:g}: it must divide {whole}")


def green_windows(network: Network, green_s: Floats, step_s: float, time_s: Floats | None = None) -> GreenWindows:
    """The windows of a plan `green_s` (..., S) [s] in a control step that begins at the times `time_s` (...).

    A junction's cycle starts at its offset and repeats within the control step; before its first start the previous
    repetition of the same plan is still running. Discharge starts `startup_lag_s` after the green and runs as long
    into the yellow. Without a time the control step is any: the first, and of cycles that do not divide it, which begin
    elsewhere in every one, what they show on average.
    """
    steps = round(network.control_step_s / step_s)
    stages, held = len(network.stages), network.held_greens
    # Windows are the stages' greens and then the held ones: (..., S + held).
    stage = np.concatenate([np.arange(stages), [each.stage for each in held]]).astype(np.int64)
    since = network.since_cycle_start_s(green_s)
    after = since[..., stage[stages:]] + green_s[..., stage[stages:]] + np.array([each.after_s for each in held])
    since = np.concatenate([since, after], axis=-1) + network.startup_lag_s
    lasts = np.concatenate([green_s, np.broadcast_to([each.duration_s for each in held], after.shape)], axis=-1)
    # All at once: (..., repetitions, windows), then (..., steps, repetitions, windows).
    starts_s = network.cycle_starts_s(0.0 if time_s is None else time_s)
    start = starts_s[..., stage] + since[..., None, :]
    begin = np.arange(steps)[:, None, None] * step_s
    closes = np.minimum((start + lasts[..., None, :])[..., None, :, :], begin + step_s) - begin
    overlap = np.maximum(closes - np.maximum(start[..., None, :, :] - begin, 0.0), 0.0)
    cycle_s = network.cycle_s[network.stage_junction][stage]
    odd = network.control_step_s % cycle_s > 0
    if odd.any() and time_s is None:
        usual = lasts * network.control_step_s / cycle_s
        shown = overlap.sum(axis=(-3, -2))
        scale = np.where(odd, usual / np.maximum(shown, 1e-9), 1.0)
        overlap = overlap * scale[..., None, None, :]
    last = np.where(overlap > 0, closes, 0.0).max(axis=-2)
    window, starts, turns = network.turn_windows
    by_turn = np.zeros((*last.shape[:-1], len(network.turns)))
    if len(turns):
        by_turn[..., turns] = np.maximum.reduceat(last[..., window], starts, axis=-1)
    shown_s = overlap.sum(axis=-2)
    held_s = np.zeros_like(by_turn)
    for index, each in enumerate(held, start=stages):
        held_s[..., list(each.turns)] += shown_s[..., index, None]
    held_s[..., network.unsignalled] = by_turn[..., network.unsignalled] = step_s
    return GreenWindows(shown_s[..., :stages], held_s, by_turn)
