"""The macroscopic S model of SPEC 2, one definition for numbers and for CasADi symbols.

Everything here is written against `Operations`, which numpy and CasADi both offer, and the step is cut into
the pieces that the controllers need one by one: the vehicles that reach the tail of the queue, the three
terms of the leaving flow, and conservation. `LinkModel.step` composes them into the exact model; the
convex problem of the MPC turns the same three terms into inequalities.

Units: vehicles per model step (flow times step) throughout, so that a rate in SPEC is a count here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from utn_sumo.contract import EXIT, SAMPLE_S, Floats, Network
from utn_sumo.errors import SettingError

Sparse = Any
"""A scipy.sparse CSR matrix: a network's incidences are many zeros."""


class Operations(Protocol):
    """The few operations that the model needs besides + - * /."""

    def matmul(self, matrix: Sparse, vector: Any) -> Any: ...
    def minimum(self, a: Any, b: Any) -> Any: ...
    def maximum(self, a: Any, b: Any) -> Any: ...
    def settled(self, a: Any, b: Any) -> bool:
        """Whether a sweep changed nothing any more, where that can be known."""


SETTLED_VEH = 1e-12
"""Change of an inflow by a sweep under which it has settled."""


class NumpyOperations:
    """Numbers. The last axis is that of links, turns or stages; any axes before it are a batch of cases."""

    def matmul(self, matrix: Sparse, vector: Any) -> Any:
        batch = np.shape(vector)[:-1]
        return (matrix @ vector.reshape(-1, matrix.shape[1]).T).T.reshape(*batch, -1) if batch else matrix @ vector

    def minimum(self, a: Any, b: Any) -> Any:
        return np.minimum(a, b)

    def maximum(self, a: Any, b: Any) -> Any:
        return np.maximum(a, b)

    def settled(self, a: Any, b: Any) -> bool:
        return bool(np.max(np.abs(a - b), initial=0.0) < SETTLED_VEH)


class CasadiOperations:
    """CasADi symbols (SX or MX column vectors)."""

    def __init__(self) -> None:
        import casadi  # noqa: PLC0415 - heavy, and only symbolic use needs it

        self._casadi = casadi

    def matmul(self, matrix: Sparse, vector: Any) -> Any:
        return self._casadi.mtimes(self._casadi.DM(matrix.tocsc()), vector)

    def minimum(self, a: Any, b: Any) -> Any:
        return self._casadi.fmin(a, b)

    def maximum(self, a: Any, b: Any) -> Any:
        return self._casadi.fmax(a, b)

    def settled(self, a: Any, b: Any) -> bool:  # noqa: ARG002 - symbols never know
        return False


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
class StepFlows:
    """What moved in one step."""

    leaving_veh: Any
    """(M,) by turn."""
    inflow_veh: Any
    """(Z,) into each link, from other links and from outside."""
    arriving_veh: Any
    """(Z,) at the tail of the queue."""


WAVE_SPEED_M_S = 6.0
"""Speed at which a queue's start-up travels upstream: a standing vehicle's 7.5 m in about 1.3 s."""
STEP_TOLERANCE = 1e-9
MOST_SWEEPS, RADIUS_POWER = 200, 64
INFINITE_ROOM_VEH = 1e9
"""Room beyond an exit: the third term of SPEC 2.3 does not bind there."""


def _incidence(rows: Any, columns: Any, shape: tuple[int, int]) -> Sparse:
    return sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)


class LinkModel:
    """SPEC 2 on the links of one network, with a step of `step_s` seconds."""

    def __init__(self, network: Network, step_s: float, operations: Operations | None = None):
        self.network = network
        self.step_s = step_s
        self.operations: Operations = operations or NumpyOperations()
        links, turns = len(network.links), len(network.turns)
        fed = network.turn_next != EXIT
        self.leaves = _incidence(network.turn_link, np.arange(turns), (links, turns))
        """(Z, M) 1 where a turn leaves a link: sums by link."""
        self.feeds = _incidence(network.turn_next[fed], np.flatnonzero(fed), (links, turns))
        """(Z, M) 1 where a turn feeds a link."""
        stages = np.repeat(np.arange(len(network.stages)), [len(stage.turns) for stage in network.stages])
        served = np.concatenate([stage.turns for stage in network.stages]).astype(np.int64)
        self.served = _incidence(served, stages, (turns, len(network.stages)))
        """(M, S) 1 where a stage serves a turn."""
        self._is_exit = (~fed).astype(float)
        self._is_source = network.is_source.astype(float)
        self._saturation_veh_s = network.saturation_flow_veh_s[network.turn_link]
        # Room that opens at the stop line reaches the entry as a wave: within one step, only so much of it does.
        self._wave_s = np.array([link.length_m for link in network.links]) / WAVE_SPEED_M_S
        self._room_share = np.minimum(1.0, step_s / self._wave_s)
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
        return self.operations.matmul(self.leaves.T, links)

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

        def within(share: Any) -> Any:
            return ops.minimum(ops.maximum(share, 0.0), 1.0)

        past = [within(since / self.sample_s - lag) for lag in range(self.lags)]
        return [within(since / self.step_s + 1.0), *past]

    def history(self, counted_veh: Floats, sample_s: float) -> tuple[Floats, ...]:
        """Past inflows as the model remembers them, from counts (..., H, Z) in samples of `sample_s`, newest first."""
        known = counted_veh.shape[-2]
        summed = np.concatenate([np.zeros_like(counted_veh[..., :1, :]), np.cumsum(counted_veh, axis=-2)], axis=-2)
        at = np.clip(np.arange(self.lags + 1) * self.sample_s / sample_s, 0, known)
        low = np.minimum(at.astype(np.int64), known - 1)
        part = (at - low)[:, None]
        curve = summed[..., low, :] * (1 - part) + summed[..., low + 1, :] * part
        return tuple(np.moveaxis(np.diff(curve, axis=-2), -2, 0))

    def arriving_veh(self, moving_veh: Any, inflow_veh: Any, past: Sequence[Any], share: Sequence[Any]) -> Any:
        """Vehicles that reach the tail of the queue by the time of `share` (SPEC 2.5 as cumulative curves).

        All by link, or all by turn with each link's numbers at its turns.

        Who is on the link and not queued, or comes in now, arrives unless it entered less than the delay
        ago. For a constant delay this is SPEC 2.5 exactly; for a varying one it conserves vehicles,
        and nobody arrives twice or never. It may be negative only where the delay has just grown.
        """
        still = share[0] * inflow_veh
        for inflow_then, share_then in zip(past, share[1:], strict=False):
            still = still + share_then * inflow_then
        return moving_veh + inflow_veh - still

    def saturated_veh(self, green_s: Any, fraction: Any) -> Any:
        """(M,) what green lets through: the second term of SPEC 2.3. `green_s` is by turn."""
        return fraction * self._saturation_veh_s * green_s

    def room_veh(self, x_veh: Any) -> Any:
        """(Z,) vehicles that a link takes in a step: C - x, the third term of SPEC 2.3 before it is shared out."""
        return (self.network.storage_veh - x_veh) * self._room_share

    def opening(self, green_s: Any, green_end_s: Any) -> Any:
        """(M,) share of what leaves in a step whose room reaches the link's entry within the same step.

        `green_s` and `green_end_s` are by turn. With a step of a whole cycle a full link takes up in the step what
        its own early green lets out of it.
        """
        ops = self.operations
        left_s = self.step_s - self._wave_s[self.network.turn_link] - (green_end_s - green_s)
        return ops.minimum(ops.maximum(left_s, 0.0) / ops.maximum(green_s, 1e-9), 1.0)

    def step(
        self, state: ModelState, green_s: Any, demand_veh: Any, fraction: Any, green_end_s: Any | None = None
    ) -> tuple[ModelState, StepFlows]:
        """One step of the exact model.

        `green_s` (S,) is the green of each stage within the step, `demand_veh` (Z,) what comes from outside,
        `fraction` (M,) the turning fractions. `green_end_s` (M,) is when each turn's last green ends, counted from the
        step's start: who reaches the queue after it waits for the next step. Without it the green may
        stand anywhere. Vehicles are conserved, and 0 <= q <= x <= storage holds afterwards if it held before.
        """
        ops = self.operations
        to_next = self.feeds.T
        turn_green_s = ops.matmul(self.served, green_s)
        saturated = self.saturated_veh(turn_green_s, fraction)
        room = ops.maximum(self.room_veh(state.x_veh), 0.0)
        opening = None if green_end_s is None else self.opening(turn_green_s, green_end_s)
        # Each turn's share of the room on the link that it feeds, among the turns that have green in this step;
        # exits have all the room in the world.
        open_fraction = fraction * ops.minimum(turn_green_s, 1.0)
        feeding = ops.matmul(self.feeds, open_fraction)
        claim = open_fraction / ops.maximum(ops.matmul(to_next, feeding) + self._is_exit, 1e-9)

        queue = self.by_link(state.q_veh)
        moving = state.x_veh - queue
        delay = self.delay_s(queue)
        share = self.on_the_way(delay)
        share_at_end = None if green_end_s is None else self.on_the_way(self.at_turns(delay), green_end_s)
        past_by_turn = [self.at_turns(past) for past in state.past_inflow_veh]
        wanting = (state.source_queue_veh + demand_veh) * self._is_source

        # With delays under one step the inflow depends on itself round a circuit, and so does the room: sweep to
        # the fixed point that is reached from below.
        open_room = room
        inflow = entering = ops.minimum(wanting, room)
        for _ in range(self.sweeps):
            arriving = ops.maximum(self.arriving_veh(moving, inflow, state.past_inflow_veh, share), 0.0)
            queued = state.q_veh + fraction * self.at_turns(arriving)
            unsaturated = queued
            if share_at_end is not None:
                inflow_by_turn, moving_by_turn = self.at_turns(inflow), self.at_turns(moving)
                in_time = self.arriving_veh(moving_by_turn, inflow_by_turn, past_by_turn, share_at_end)
                unsaturated = state.q_veh + fraction * ops.maximum(in_time, 0.0)
            # SPEC 2.3, the three terms.
            oversaturated = claim * ops.matmul(to_next, open_room) + INFINITE_ROOM_VEH * self._is_exit
            leaving = ops.minimum(unsaturated, ops.minimum(saturated, oversaturated))
            if opening is not None:
                open_room = room + self.by_link(opening * leaving)
                entering = ops.minimum(wanting, open_room)
            last, inflow = inflow, entering + ops.matmul(self.feeds, leaving)
            if ops.settled(last, inflow):
                break

        after = ModelState(
            x_veh=state.x_veh + inflow - self.by_link(leaving),
            q_veh=queued - leaving,
            source_queue_veh=state.source_queue_veh + demand_veh * self._is_source - entering,
            past_inflow_veh=(*[inflow / self.samples] * self.samples, *state.past_inflow_veh)[: self.lags],
        )
        return after, StepFlows(leaving, inflow, arriving)


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
    end_s: Floats
    """(..., steps, M) end of each turn's last green in each model step, from the model step's start; 0 without one."""


def check_step(network: Network, step_s: float) -> None:
    """Raise SettingError unless a model step of `step_s` divides the control step."""
    if step_s <= 0 or abs(network.control_step_s / step_s - round(network.control_step_s / step_s)) > STEP_TOLERANCE:
        whole = f"the control step of {network.control_step_s:g} s"
        raise SettingError(f"setting 'step_s' is {step_s:g}: it must divide {whole}")


def green_windows(network: Network, green_s: Floats, step_s: float) -> GreenWindows:
    """The windows of a plan `green_s` (..., S) [s].

    A junction's cycle starts at its offset and repeats within the control step; before its first start the previous
    repetition of the same plan is still running. Discharge starts `startup_lag_s` after the green and runs as long
    into the yellow.
    """
    steps = round(network.control_step_s / step_s)
    # All stages at once: (..., repetitions, S), then (..., steps, repetitions, S).
    start = network.cycle_starts_s + (network.since_cycle_start_s(green_s) + network.startup_lag_s)[..., None, :]
    begin = np.arange(steps)[:, None, None] * step_s
    closes = np.minimum((start + green_s[..., None, :])[..., None, :, :], begin + step_s) - begin
    overlap = np.maximum(closes - np.maximum(start[..., None, :, :] - begin, 0.0), 0.0)
    last = np.where(overlap > 0, closes, 0.0).max(axis=-2)
    stages, starts, turns = network.turn_stages
    by_turn = np.zeros((*last.shape[:-1], len(network.turns)))
    by_turn[..., turns] = np.maximum.reduceat(last[..., stages], starts, axis=-1)
    return GreenWindows(overlap.sum(axis=-2), by_turn)
