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

from utn_sumo.contract import EXIT, Floats, Network


class Operations(Protocol):
    """The few operations that the model needs besides + - * /."""

    def matmul(self, matrix: Floats, vector: Any) -> Any: ...
    def minimum(self, a: Any, b: Any) -> Any: ...
    def maximum(self, a: Any, b: Any) -> Any: ...
    def settled(self, a: Any, b: Any) -> bool:
        """Whether a sweep changed nothing any more, where that can be known."""


SETTLED_VEH = 1e-12
"""Change of an inflow by a sweep under which it has settled."""


class NumpyOperations:
    """Numbers. The last axis is that of links, turns or stages; any axes before it are a batch of cases."""

    def matmul(self, matrix: Floats, vector: Any) -> Any:
        return vector @ matrix.T

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

    def matmul(self, matrix: Floats, vector: Any) -> Any:
        return self._casadi.mtimes(self._casadi.sparsify(self._casadi.DM(matrix)), vector)

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
    """Inflow (Z,) of the last steps, newest first."""


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
INFINITE_ROOM_VEH = 1e9
"""Room beyond an exit: the third term of SPEC 2.3 does not bind there."""


class LinkModel:
    """SPEC 2 on the links of one network, with a step of `step_s` seconds."""

    def __init__(self, network: Network, step_s: float, operations: Operations | None = None):
        self.network = network
        self.step_s = step_s
        self.operations: Operations = operations or NumpyOperations()
        links, turns = len(network.links), len(network.turns)
        fed = network.turn_next != EXIT
        self.leaves = np.zeros((links, turns))
        """(Z, M) 1 where a turn leaves a link: sums by link."""
        self.leaves[network.turn_link, np.arange(turns)] = 1
        self.feeds = np.zeros((links, turns))
        """(Z, M) 1 where a turn feeds a link."""
        self.feeds[network.turn_next[fed], np.flatnonzero(fed)] = 1
        self._is_exit = (~fed).astype(float)
        self._is_source = network.is_source.astype(float)
        self._saturation_veh_s = network.saturation_flow_veh_s[network.turn_link]
        # Room that opens at the stop line reaches the entry as a wave: within one step, only so much of it does.
        wave_s = np.array([link.length_m for link in network.links]) / WAVE_SPEED_M_S
        self._room_share = np.minimum(1.0, step_s / wave_s)
        self._space_s_veh = network.free_time_s / network.storage_veh
        self.lags = 1 + int(np.ceil(network.free_time_s.max() / step_s))
        """Past inflows that the delay reaches back to."""
        self.sweeps = self._sweeps_needed()

    def _sweeps_needed(self) -> int:
        """Sweeps after which the loop through links shorter than a step has settled to 1e-12.

        With a delay under one step (delta = 0) an inflow passes on within the step, round a circuit too.
        One sweep hands it on by one link, and shrinks it by the turning fraction: the spectral radius of the
        turning matrix bounds what is left (SPEC 2, known weak points).
        """
        network = self.network
        matrix = self.feeds @ (network.fraction[:, None] * self.leaves.T)
        radius = max(np.abs(np.linalg.eigvals(matrix)).max(), 1e-6) if len(matrix) else 1e-6
        return int(min(200, max(len(network.junctions), np.ceil(np.log(1e-12) / np.log(min(radius, 0.87))))))

    def delay_s(self, queue_veh: Any) -> Any:
        """(Z,) time from entry to the tail of the queue (SPEC 2.6), never negative."""
        free_veh = self.operations.maximum(self.network.storage_veh - queue_veh, 0.0)
        return free_veh * self._space_s_veh

    def on_the_way(self, delay_s: Any) -> list[Any]:
        """Share (Z,) of the inflow of each lag 0, 1, ... that is still on its way after `delay_s`."""
        steps = delay_s / self.step_s
        clip = self.operations
        return [clip.minimum(clip.maximum(steps - lag, 0.0), 1.0) for lag in range(self.lags)]

    def arriving_veh(self, moving_veh: Any, inflow_veh: Any, past: Sequence[Any], share: Sequence[Any]) -> Any:
        """(Z,) vehicles that reach the tail of the queue in a step (SPEC 2.5 as cumulative curves).

        Who is on the link and not queued, or comes in now, arrives unless it entered less than the delay
        ago. For a constant delay this is SPEC 2.5 exactly; for a varying one it conserves vehicles,
        and nobody arrives twice or never. It may be negative only where the delay has just grown.
        """
        still = share[0] * inflow_veh
        for lag in range(1, self.lags):
            still = still + share[lag] * past[lag - 1]
        return moving_veh + inflow_veh - still

    def saturated_veh(self, green_s: Any, fraction: Any) -> Any:
        """(M,) what green lets through: the second term of SPEC 2.3. `green_s` is by turn."""
        return fraction * self._saturation_veh_s * green_s

    def room_veh(self, x_veh: Any) -> Any:
        """(Z,) vehicles that a link still takes: C - x, the third term of SPEC 2.3 before it is shared out."""
        return self.network.storage_veh - x_veh

    def step(self, state: ModelState, green_s: Any, demand_veh: Any, fraction: Any) -> tuple[ModelState, StepFlows]:
        """One step of the exact model.

        `green_s` (S,) is the green of each stage within the step, `demand_veh` (Z,) what comes from outside,
        `fraction` (M,) the turning fractions. Vehicles are conserved, and 0 <= q <= x <= storage holds
        afterwards if it held before.
        """
        ops = self.operations
        turn_green_s = ops.matmul(self.network.serves.T.astype(float), green_s)
        saturated = self.saturated_veh(turn_green_s, fraction)
        room = ops.maximum(self.room_veh(state.x_veh), 0.0) * self._room_share
        # Each turn's share of the room on the link that it feeds, among the turns that have green in this step;
        # exits have all the room in the world.
        open_fraction = fraction * ops.minimum(turn_green_s, 1.0)
        feeding = ops.matmul(self.feeds, open_fraction)
        claim = open_fraction / ops.maximum(ops.matmul(self.feeds.T, feeding) + self._is_exit, 1e-9)
        oversaturated = claim * ops.matmul(self.feeds.T, room) + INFINITE_ROOM_VEH * self._is_exit
        limit = ops.minimum(saturated, oversaturated)

        queue = ops.matmul(self.leaves, state.q_veh)
        moving = state.x_veh - queue
        share = self.on_the_way(self.delay_s(queue))
        entering = ops.minimum(state.source_queue_veh + demand_veh, room) * self._is_source

        # With delays under one step the inflow depends on itself round a circuit: sweep to its fixed point.
        inflow = entering
        for _ in range(self.sweeps):
            arriving = ops.maximum(self.arriving_veh(moving, inflow, state.past_inflow_veh, share), 0.0)
            unsaturated = state.q_veh + fraction * ops.matmul(self.leaves.T, arriving)
            leaving = ops.minimum(unsaturated, limit)
            last, inflow = inflow, entering + ops.matmul(self.feeds, leaving)
            if ops.settled(last, inflow):
                break

        after = ModelState(
            x_veh=state.x_veh + inflow - ops.matmul(self.leaves, leaving),
            q_veh=unsaturated - leaving,
            source_queue_veh=state.source_queue_veh + demand_veh * self._is_source - entering,
            past_inflow_veh=(inflow, *state.past_inflow_veh[:-1]),
        )
        return after, StepFlows(leaving, inflow, arriving)


def green_windows(network: Network, green_s: Floats, step_s: float) -> Floats:
    """(..., steps, S) seconds of green of each stage in each model step of a control step.

    `green_s` (..., S) is what was planned. A junction's cycle starts at its offset and repeats within the control
    step; before its first start the previous repetition of the same plan is still running. Discharge starts
    `startup_lag_s` after the green and runs as long into the yellow.
    """
    steps = round(network.control_step_s / step_s)
    begin = np.arange(steps) * step_s
    windows = np.zeros((*green_s.shape[:-1], steps, green_s.shape[-1]))
    for junction in network.junctions:
        repeats = int(np.ceil(network.control_step_s / junction.cycle_s))
        for repeat in range(-1, repeats):
            start = np.full(green_s.shape[:-1], junction.offset_s % junction.cycle_s + repeat * junction.cycle_s)
            for stage in junction.stages:
                end = start + green_s[..., stage]
                shown = [np.asarray(edge + network.startup_lag_s)[..., None] for edge in (start, end)]
                overlap = np.minimum(shown[1], begin + step_s) - np.maximum(shown[0], begin)
                windows[..., stage] += np.maximum(overlap, 0.0)
                start = end + network.stages[stage].clearance_s
    return windows
