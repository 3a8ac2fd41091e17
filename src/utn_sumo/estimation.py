"""Detector counts to the state vector: vehicles, queues, source queues and turning, all in veh.

x is counted in at the entry loops, in and out at side roads, and out at the turn loops, so that it is conserved from
link to link. Loops miscount,
and a count that is summed up never forgets; so a Kalman filter by link holds the count against what can be seen: where
no queue stands, the vehicles in view of the lane-area detectors and those that entered too short ago to be in view are
all there are. Its second state is by how much the link's loops differ, which is what makes a count drift; its third how
many come onto the link amid it in a step that no loop counts (e_z of SPEC 2.1).
q comes from the lane-area detectors by lane group, and its split by turn within one from who came and who went.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import AREA_REACH_M, Floats, Measurement, Network, State
from utn_sumo.model import share_on_the_way

FULL_SHARE = 0.8
"""Share of its storage from which the watched stretch counts as full, and the queue as reaching beyond it."""
QUIET_SHARE = 0.3
"""Share of its storage up to which the watched stretch leaves the vehicles before it moving freely."""
CROWDED_SHARE, CROWDED_SD_VEH = 0.5, 8.0
"""Share from which nothing can be said of those before it, and the standard deviation of what is said just under it."""
BIAS_STEP_SHARE = 0.01
"""By how much of the loops' error a link's loops may come to differ in a step."""
DISTURBANCE_STEP_SHARE = 0.1
"""By how much of what is usual the disturbance of a link may change in a step."""
SEEN_SD_VEH, SEEN_SD_SHARE = 1.0, 0.1
"""Standard deviation of what can be seen: of all, and of the share that is not in view."""
FREE_SHARE = 0.4
"""Share of its storage up to which a source link is surely not turning traffic away."""
SLOW, BLOCKED = 1.3, 1.5
"""Time that a vehicle covers the entry loops, against free traffic, from which some may be, and all are, kept out."""
SHUT_SD = 2.0
"""So many standard deviations too few entering a link that is not free: those who came have to wait."""
TURN_MEMORY_STEPS = 30.0
"""Control steps after which what was seen turning weighs 1/e."""
NEVER = 1e-9
"""Share of a turn that nobody takes: queues are split by shares, and these must not vanish."""


class Estimator:
    """Follows one plant through its detectors."""

    def __init__(self, network: Network, known: Network, loop_error: float = 0.0, disturbance_veh: float = 0.0):
        """`network` is the road as it is, `known` the same as the controllers know it: its delays and turning.

        `loop_error` is by how much loops miscount, as in `detectors.Miscount`; at 0 they are believed.
        `disturbance_veh` is how many vehicles usually come onto a link amid it in a control step; at 0 nobody does.
        """
        links, turns = len(network.links), len(network.turns)
        self.network = network
        self.known = known
        self._x_veh = np.zeros(links)
        self._bias = np.zeros(links)
        """(Z,) how much more the exit loops count than the entry loops, relative."""
        self._disturbance_veh = np.zeros(links)
        """(Z,) as `State.disturbance_veh`."""
        self._usual_veh = np.zeros(links)
        """(Z,) what it is in a usual step."""
        self._covariance = np.zeros((links, 3, 3))
        self._covariance[:, 1, 1] = 2 * loop_error**2
        self._covariance[:, 2, 2] = disturbance_veh**2
        # They come at random: their number varies by its root.
        self._disturbance_variance = disturbance_veh
        self._disturbance_step_variance = (DISTURBANCE_STEP_SHARE * disturbance_veh) ** 2
        # A loop that misses a share p at random adds p (1 - p) to the variance for each vehicle; p is normal.
        self._count_variance = np.sqrt(2 / np.pi) * loop_error
        self._bias_step_variance = (BIAS_STEP_SHARE * loop_error) ** 2
        self._q_veh = np.zeros(turns)
        self._source_queue_veh = np.zeros(links)
        self._past_inflow_veh = np.zeros((known.delay_samples, links))
        self._known_turning_veh = known.turning_worth_veh[known.turn_link] * known.fraction
        self._turning_veh = self._known_turning_veh
        length_m = np.array([link.length_m for link in network.links])
        speed_m_s = np.array([link.free_speed_m_s for link in known.links])
        self._watched_veh = network.watched_veh
        set_m, before_m = network.watched_lane_m
        group_m = np.bincount(network.set_group, set_m, len(network.groups))
        lane_m = before_m + np.bincount(network.group_link, group_m, links)
        self._group_veh = np.maximum(self._watched_veh[network.group_link] * group_m / lane_m[network.group_link], 1.0)
        """(G,) vehicles that the part of each lane group in view holds."""
        self._before_veh = self._watched_veh * before_m / lane_m
        """(Z,) vehicles that the part in view before the lanes part holds."""
        hidden_s = np.maximum(length_m - AREA_REACH_M, 0) / speed_m_s
        self._hidden = share_on_the_way(hidden_s, network.sample_s, known.delay_samples)
        """(H, Z) share of each past sample's inflow that has not come into view, on a free road."""
        # Turns of a lane group that always have green together: one number each.
        greens = [(group, *row) for group, row in zip(network.turn_group, _windows_of(network), strict=True)]
        number = {green: place for place, green in enumerate(dict.fromkeys(greens))}
        self._together = np.array([number[green] for green in greens], dtype=np.int64)
        """(M,) which turns of a lane group always have green together: these have the same number."""
        self._free_cover_s = np.full(links, np.nan)
        """(Z,) time that a vehicle covers the loops at a source's entry when nothing holds it up."""
        self._cycle = 0

    def initial(self) -> State:
        """The state of an empty network at time zero."""
        return self._state(0.0, np.zeros(len(self.network.turns)))

    def update(self, seen: Measurement, expected_veh: Floats) -> State:
        """The state after one more control step. `expected_veh` (Z,) is the demand forecast for that step."""
        entered = seen.entered_veh.sum(axis=0)
        newest_first = np.vstack([seen.entered_veh[::-1], self._past_inflow_veh])
        self._past_inflow_veh = newest_first[: len(self._past_inflow_veh)]
        self._count(seen, entered)
        self._turn(seen.turned_veh)
        self._queue(seen)
        self._wait_outside(seen, entered, expected_veh)
        self._cycle += 1
        return self._state(seen.time_s, seen.turned_veh)

    def _count(self, seen: Measurement, entered_veh: Floats) -> None:
        """X by the Kalman filter: counted on, and held against what is seen where the road is free."""
        left = self._by_link(seen.turned_veh)
        entered_veh = entered_veh + seen.beside_veh + seen.uncounted_veh
        x = self._x_veh + entered_veh - (1 - self._bias) * left + self._usual_veh
        move = np.tile(np.eye(3), (len(x), 1, 1))
        move[:, 0, 1], move[:, 0, 2] = left, 1.0
        covariance = move @ self._covariance @ move.transpose(0, 2, 1)
        covariance[:, 0, 0] += self._count_variance * (np.abs(entered_veh) + left) + self._disturbance_variance
        covariance[:, 1, 1] += self._bias_step_variance
        covariance[:, 2, 2] += self._disturbance_step_variance

        hidden = (self._hidden * self._past_inflow_veh).sum(axis=0)
        crowd = (self._crowded(seen) - QUIET_SHARE) / (CROWDED_SHARE - QUIET_SHARE)
        quiet = crowd < 1
        variance = SEEN_SD_VEH**2 + (SEEN_SD_SHARE * hidden) ** 2 + (CROWDED_SD_VEH * np.maximum(crowd, 0.0)) ** 2
        # Where side roads meet a link before what is watched of it, who came there may not be in view yet.
        variance = variance + np.where(self._watched_veh < self.network.storage_veh, seen.beside_veh, 0.0) ** 2
        gain = quiet[:, None] * covariance[:, :, 0] / (covariance[:, 0, 0] + variance)[:, None]
        residual = seen.seen_veh + hidden - x
        self._covariance = covariance - gain[:, :, None] * covariance[:, None, 0, :]
        self._bias = self._bias + gain[:, 1] * residual
        self._usual_veh = self._usual_veh + gain[:, 2] * residual
        # What the lane-area detectors see is there; what they don't see must fit on the rest of the road.
        unwatched_veh = self.network.storage_veh - self._watched_veh
        before = self._x_veh
        self._x_veh = np.clip(x + gain[:, 0] * residual, seen.seen_veh, seen.seen_veh + unwatched_veh)
        self._disturbance_veh = seen.beside_veh.copy()
        if self._disturbance_variance > 0:
            self._disturbance_veh += seen.uncounted_veh + self._x_veh - before - entered_veh + (1 - self._bias) * left

    def _crowded(self, seen: Measurement) -> Floats:
        """(Z,) share of the room in view that is taken, where it is most: one lane may be full beside an empty one."""
        link, links = self.network.group_link, len(self.network.links)
        before = seen.seen_veh - np.bincount(link, seen.group_seen_veh, links)
        shares = np.divide(before, self._before_veh, out=np.zeros(links), where=self._before_veh > 0)
        np.maximum.at(shares, link, seen.group_seen_veh / self._group_veh)
        return shares

    def _queue(self, seen: Measurement) -> None:
        """q: standing in view, and all beyond the view where the view stands full.

        By lane group: who stands on its lanes, and of those who stand before the lanes part its share. By turn: what
        has green at the same times leaves in the order in which it came, so who is left has turns like any other
        arrivals, whatever the last ones happened to choose; between signals with other times, who came and who went
        is kept count of.
        """
        beyond = np.where(seen.queue_veh >= FULL_SHARE * self._watched_veh, self._x_veh - seen.seen_veh, 0.0)
        queue = np.minimum(seen.queue_veh + beyond, self._x_veh)
        fraction, link = self._fraction() + NEVER, self.network.turn_link
        arrived = np.maximum(queue - self._by_link(self._q_veh) + self._by_link(seen.turned_veh), 0.0)
        together = self._together
        balance = np.bincount(together, self._q_veh + fraction * arrived[link] - seen.turned_veh)[together]
        split: Floats = np.maximum(balance, 0.0) * fraction / np.bincount(together, fraction)[together]
        self._q_veh = self._group_queue(seen, queue)[self.network.turn_group] * self._share_of_group(split, fraction)

    def _group_queue(self, seen: Measurement, queue_veh: Floats) -> Floats:
        """(G,) the links' queues by lane group."""
        network = self.network
        groups, link = len(network.groups), network.group_link
        standing = seen.group_queue_veh
        before_parting = np.maximum(queue_veh - np.bincount(link, standing, len(queue_veh)), 0.0)
        queue: Floats = standing + before_parting[link] * np.bincount(network.turn_group, self._fraction(), groups)
        total = np.bincount(link, queue, len(queue_veh))
        return np.asarray(queue * np.minimum(1.0, queue_veh / np.maximum(total, 1e-9))[link])

    def _share_of_group(self, split_veh: Floats, fraction: Floats) -> Floats:
        """(M,) each turn's share of its lane group's queue: as `split_veh`, or where that is nobody as the traffic."""
        group = self.network.turn_group
        counted, usual = (np.bincount(group, each)[group] for each in (split_veh, fraction))
        return np.asarray(np.where(counted > 0, split_veh / np.maximum(counted, 1e-9), fraction / usual))

    def _turn(self, turned_veh: Floats) -> None:
        """Turning fractions: what was known, worth so many vehicles, and what was seen, slowly forgotten."""
        prior = self._known_turning_veh
        self._turning_veh = prior + (self._turning_veh - prior) * np.exp(-1 / TURN_MEMORY_STEPS) + turned_veh

    def _fraction(self) -> Floats:
        return np.asarray(self._turning_veh / self._by_link(self._turning_veh)[self.network.turn_link])

    def _wait_outside(self, seen: Measurement, entered_veh: Floats, expected_veh: Floats) -> None:
        """Who was expected at a source and did not enter waits, if the entry loops show that the way in was blocked."""
        network = self.network
        lanes = np.array([len(network.edge_lanes[link.edges[0]]) for link in network.links])
        covered_s = seen.entry_occupancy * lanes * network.control_step_s
        cover_s = covered_s / np.maximum(entered_veh, 1.0)
        free = self._x_veh <= FREE_SHARE * network.storage_veh
        with_traffic = free & (entered_veh > 0)
        before = np.where(np.isnan(self._free_cover_s), cover_s, self._free_cover_s)
        self._free_cover_s = np.where(with_traffic, before + 0.1 * (cover_s - before), self._free_cover_s)
        known = self._free_cover_s > 0
        slowed = np.divide(cover_s, self._free_cover_s, out=np.ones_like(cover_s), where=known)
        blocked = np.clip((slowed - SLOW) / (BLOCKED - SLOW), 0.0, 1.0)
        missing = expected_veh - entered_veh
        shut = ~free & (missing > SHUT_SD * np.sqrt(expected_veh))
        kept_out = np.where(shut, 1.0, blocked)
        waiting = self._source_queue_veh + np.where(missing > 0, kept_out * missing, missing)
        self._source_queue_veh = np.where(network.is_source & (kept_out > 0), np.maximum(waiting, 0.0), 0.0)

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
            fraction=self._fraction(),
            disturbance_veh=self._disturbance_veh.copy(),
        )


def _windows_of(network: Network) -> list[tuple[int, ...]]:
    """Of each turn the windows in which it has green (`Network.turn_windows`)."""
    window, starts, turns = network.turn_windows
    found: list[tuple[int, ...]] = [()] * len(network.turns)
    for turn, own in zip(turns.tolist(), np.split(window, starts[1:]), strict=True):
        found[turn] = tuple(own.tolist())
    return found
