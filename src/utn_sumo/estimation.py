"""Detector counts to the state vector: vehicles, queues, source queues, turning counts, all in veh.

x is counted in at the entry loops and out at the turn loops, so that it is conserved from link to link; the
lane-area detectors bound it, so that a miscount can't live on for ever. q comes from the lane-area detectors,
and its split by turn from who came and who went.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import Floats, Measurement, Network, State
from utn_sumo.detectors import AREA_REACH_M

FULL_SHARE = 0.8
"""Share of its storage from which the watched stretch counts as full, and the queue as reaching beyond it."""
BLOCKED_SHARE, SURELY_BLOCKED_SHARE = 0.5, 0.8
"""Shares of its storage from which a source link may be, and surely is, turning traffic away: one lane can be full
before the other. In between, that much of who was expected and did not come is taken to wait."""


class CountingEstimator:
    """Counts vehicles in and out of every link."""

    def __init__(self, network: Network, history_steps: int | None = None):
        """`history_steps` is how many past inflows the state is to hold; by default what the network's delays reach."""
        links = len(network.links)
        self.network = network
        self._x_veh = np.zeros(links)
        self._q_veh = np.zeros(len(network.turns))
        self._source_queue_veh = np.zeros(links)
        self._past_inflow_veh = np.zeros((history_steps or network.delay_steps, links))
        length_m = np.array([link.length_m for link in network.links])
        self._watched_veh = network.storage_veh * np.minimum(1, AREA_REACH_M / length_m)
        self._cycle = 0

    def initial(self) -> State:
        """The state of an empty network at time zero."""
        return self._state(0.0, np.zeros(len(self.network.turns)))

    def update(self, seen: Measurement, expected_veh: Floats) -> State:
        """The state after one more control step. `expected_veh` (Z,) is the demand forecast for that step."""
        network = self.network
        unwatched_veh = network.storage_veh - self._watched_veh
        turned = seen.turned_veh
        counted = self._x_veh + seen.entered_veh - self._by_link(turned)
        # What the lane-area detectors see is there; what they don't see must fit on the rest of the road.
        self._x_veh = np.clip(counted, seen.seen_veh, seen.seen_veh + unwatched_veh)
        self._past_inflow_veh = np.vstack([seen.entered_veh, self._past_inflow_veh[:-1]])

        queue = self._queue(seen)
        # Who is queued for which turn: what was queued and came less what went, brought to the queue's measure.
        before = self._by_link(self._q_veh)
        arrived = np.maximum(queue - before + self._by_link(turned), 0.0)
        split = np.maximum(self._q_veh + network.fraction * arrived[network.turn_link] - turned, 0.0)
        total = self._by_link(split)[network.turn_link]
        share = np.where(total > 0, split / np.maximum(total, 1e-9), network.fraction)
        self._q_veh = share * queue[network.turn_link]

        # Nobody waits outside a link with plenty of room; who was expected at another and did not enter, waits.
        fullness = self._x_veh / network.storage_veh
        sure = np.clip((fullness - BLOCKED_SHARE) / (SURELY_BLOCKED_SHARE - BLOCKED_SHARE), 0.0, 1.0)
        missing = expected_veh - seen.entered_veh
        waiting = self._source_queue_veh + np.where(missing > 0, sure * missing, missing)
        blocked = network.is_source & (fullness >= BLOCKED_SHARE)
        self._source_queue_veh = np.where(blocked, np.maximum(waiting, 0.0), 0.0)
        self._cycle += 1
        return self._state(seen.time_s, turned)

    def _queue(self, seen: Measurement) -> Floats:
        """(Z,) queued vehicles: standing in view, and all beyond the view where the view stands full."""
        beyond = np.where(seen.queue_veh >= FULL_SHARE * self._watched_veh, self._x_veh - seen.seen_veh, 0.0)
        return np.minimum(seen.queue_veh + beyond, self._x_veh)

    def _by_link(self, by_turn: Floats) -> Floats:
        return np.asarray(np.bincount(self.network.turn_link, by_turn, minlength=len(self.network.links)), dtype=float)

    def _state(self, time_s: float, turned_veh: Floats) -> State:
        return State(
            cycle=self._cycle,
            time_s=time_s,
            x_veh=self._x_veh.copy(),
            q_veh=self._q_veh.copy(),
            source_queue_veh=self._source_queue_veh.copy(),
            past_inflow_veh=self._past_inflow_veh.copy(),
            turned_veh=turned_veh,
        )
