"""Detector counts to the state vector: vehicles, queues, source queues, turning counts, all in veh.

x is counted in and out at the loops, so that it is conserved from link to link; the lane-area detectors bound
it, so that a miscount can't live on for ever. q comes from the lane-area detectors. Turning counts are the table
that the stop-line counts (rows) and the entry counts of the next roads (columns) allow, nearest to the
turning fractions (iterative proportional fitting).
"""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import Floats, Measurement, Network, State
from utn_sumo.detectors import AREA_REACH_M

FULL_SHARE = 0.8
"""Share of its storage from which the watched stretch counts as full, and the queue as reaching beyond it."""
BLOCKED_SHARE = 0.5
"""Share of its storage from which a source link may be turning traffic away: one lane can be full before the other."""
FITTING_ROUNDS = 20


class CountingEstimator:
    """Counts vehicles in and out of every link."""

    def __init__(self, network: Network):
        links = len(network.links)
        self.network = network
        self._x_veh = np.zeros(links)
        self._q_veh = np.zeros(len(network.turns))
        self._source_queue_veh = np.zeros(links)
        self._past_inflow_veh = np.zeros((network.delay_steps, links))
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
        counted = self._x_veh + seen.entered_veh - seen.left_veh
        # What the lane-area detectors see is there; what they don't see must fit on the rest of the road.
        self._x_veh = np.clip(counted, seen.seen_veh, seen.seen_veh + unwatched_veh)
        self._past_inflow_veh = np.vstack([seen.entered_veh, self._past_inflow_veh[:-1]])

        turned = turning_counts(network, seen)
        queue = self._queue(seen)
        # Who is queued for which turn: what was queued and came less what went, brought to the queue's measure.
        before = self._by_link(self._q_veh)
        arrived = np.maximum(queue - before + self._by_link(turned), 0.0)
        split = np.maximum(self._q_veh + network.fraction * arrived[network.turn_link] - turned, 0.0)
        total = self._by_link(split)[network.turn_link]
        share = np.where(total > 0, split / np.maximum(total, 1e-9), network.fraction)
        self._q_veh = share * queue[network.turn_link]

        # Nobody waits outside a link with plenty of room; who was expected at another and did not enter, waits.
        full = self._x_veh >= BLOCKED_SHARE * network.storage_veh
        waiting = self._source_queue_veh + expected_veh - seen.entered_veh
        self._source_queue_veh = np.where(network.is_source & full, np.maximum(waiting, 0.0), 0.0)
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


def turning_counts(network: Network, seen: Measurement) -> Floats:
    """(M,) vehicles that made each turn, summing by link to exactly what left it.

    Iterative proportional fitting (Deming and Stephan 1940) of the turning fractions to the counts at the
    stop lines and at the entries of the roads that follow; the last fit is to the stop lines.
    """
    roads = {edge: row for row, edge in enumerate(dict.fromkeys(turn.to_edge for turn in network.turns))}
    road = np.array([roads[turn.to_edge] for turn in network.turns])
    arrived_at_road = np.zeros(len(roads))
    arrived_at_road[road] = seen.to_edge_veh

    table = network.fraction * seen.left_veh[network.turn_link]
    for _ in range(FITTING_ROUNDS):
        columns = np.bincount(road, table, minlength=len(roads))
        table = table * (arrived_at_road / np.maximum(columns, 1e-9))[road]
        rows = np.bincount(network.turn_link, table, minlength=len(network.links))
        # Where the fit took all traffic off a link that did discharge, start over from its fractions.
        table = np.where(
            rows[network.turn_link] > 0,
            table * (seen.left_veh / np.maximum(rows, 1e-9))[network.turn_link],
            network.fraction * seen.left_veh[network.turn_link],
        )
    return np.asarray(table)
