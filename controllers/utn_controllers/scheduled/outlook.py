"""Who stands before a signal and who will come, by stream, in bins of time."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from utn_controllers.scheduled.parting import Parting
from utn_controllers.scheduled.pockets import held_up, rooms_veh, taken
from utn_controllers.scheduled.streams import Streams
from utn_sumo.compiling import compiled
from utn_sumo.contract import ZONES_M, Bools, Floats, Ints, Network

MEMORY_S = 120.0
"""Over what time the rate is taken with which vehicles come from where no schedule is known."""


class Seen(Protocol):
    """What of a view it takes to know who comes (contract.View)."""

    @property
    def free(self) -> Bools: ...
    @property
    def x_veh(self) -> Floats: ...
    @property
    def entered_veh(self) -> Floats: ...
    @property
    def parted_veh(self) -> Floats: ...


class Outlook:
    """Says who arrives before each signal in each bin ahead, if nobody stood in their way.

    Within 200 m the detectors show where vehicles are, and so when they could be at the stop line, whether they stand
    now or not. Farther off are those whom the upstream loops have counted, then those whom the neighbours' schedules
    send, and as many more as have been coming of late from elsewhere. Some of them turn off before (`parting.py`).
    """

    def __init__(self, network: Network, streams: Streams, bins: int, bin_s: float):
        self.network = network
        self.streams = streams
        self.bin_s = bin_s
        speed_m_s = np.array([link.free_speed_m_s for link in network.links])
        length_m = np.array([link.length_m for link in network.links])
        reach_m = np.minimum(length_m[:, None], [0.0, *ZONES_M])
        self._arrival = _arrival(reach_m / speed_m_s[:, None] / bin_s, bins)
        """(Z, zones, K) share of those in each zone that could arrive in each bin, but for the first zone: it is by
        the stop line."""
        self._due_s = network.free_time_s
        """(Z,) from entry to arrival."""
        self._sight_s = reach_m[:, -1] / speed_m_s
        """(Z,) from where the lane-area detectors begin to arrival."""
        self._came = np.zeros((int(np.ceil(self._due_s.max(initial=0.0) / bin_s)) + 1, len(network.links)))
        """Vehicles that came onto each link in each of the last bins, in a ring."""
        self._now = 0
        self._before_veh = np.zeros(len(network.links))
        self._rate = np.zeros((2, len(network.links)))
        """Vehicles a bin that come onto each link of late, and of these those that schedules said."""
        self.sent_veh = np.zeros((len(streams.link), bins))
        """(N, K) vehicles that each stream's schedule sends off in each bin, from the one that it was made in on."""
        self._parting = Parting(network, bin_s)
        set_veh, before_veh = rooms_veh(network)
        self._room = np.bincount(network.set_group, set_veh, len(network.groups)), before_veh, taken(network)
        self.take_up(network.fraction)

    @property
    def come_veh(self) -> Floats:
        """(N,) vehicles that have come in a bin of late, without who turns off."""
        come = self._rate[0] * self._parting.onward[:, -1]
        return np.asarray(come[self.streams.link] * self.shares.of_link)

    def take_up(self, fraction: Floats) -> None:
        """Go by these turning fractions (M,) from now on."""
        self.shares = self.streams.shares(fraction)
        self._group_share = self.network.group_shares(fraction)

    def look(self, view: Seen, zones: tuple[Floats, Floats], parked_veh: Floats) -> tuple[Floats, Floats, Floats]:
        """(N,) vehicles by the stop line, (N, K) those that could be in each bin. A bin has gone by since.

        By the vehicles in `zones` (View.zone_veh) before junctions that are free: before others, who decide nothing
        now, there are none. Those who are parked, `parked_veh` (Z,), are not among them. And (G,) how many times as
        much those weigh who hold others up.
        """
        self._now = (self._now + 1) % len(self._came)
        streams, network = self.streams, self.network
        self._parting.look(view.entered_veh, view.parted_veh)
        stand, come, held = _look(
            view.free,
            *zones,
            view.x_veh - parked_veh,
            view.entered_veh,
            self._before_veh,
            self._came,
            self._now,
            self._rate,
            self.sent_veh,
            self._arrival,
            self._parting.onward,
            self._due_s,
            self._sight_s,
            *self._room,
            network.link_junction,
            network.group_link,
            network.set_group,
            streams.link,
            streams.lane_set,
            streams.next_link,
            self.shares.of_link,
            self.shares.of_set,
            self._group_share,
            self.bin_s,
        )
        return stand, come, held


def _arrival(reach: Floats, bins: int) -> Floats:
    """(Z, zones, K) by where the zones of each link begin and end, (Z, zones + 1) in bins of driving to the line."""
    edges = np.arange(bins + 1)
    begin, end = reach[:, :-1, None], reach[:, 1:, None]
    until = np.clip((edges - begin) / np.maximum(end - begin, 1e-9), 0.0, 1.0)
    share = np.diff(until, axis=2)
    share[:, 0] = 0.0
    return np.asarray(share)


@compiled
def _look(
    free: Bools,
    zone: Floats,
    upstream: Floats,
    x: Floats,
    entered: Floats,
    before: Floats,
    came: Floats,
    now: int,
    rate: Floats,
    sent: Floats,
    arrival: Floats,
    onward: Floats,
    due_s: Floats,
    sight_s: Floats,
    room: Floats,
    upstream_room: Floats,
    of_before: Floats,
    junction: Ints,
    group_link: Ints,
    set_group: Ints,
    stream_link: Ints,
    stream_set: Ints,
    next_link: Ints,
    of_link: Floats,
    of_set: Floats,
    share: Floats,
    bin_s: float,
) -> tuple[Floats, Floats, Floats]:
    links, bins = len(x), sent.shape[1]
    asked = free[junction]
    seen, far = _in_sight(zone, upstream, x, set_group, group_link)
    coming = np.zeros((links, bins))
    for link in range(links):
        came[now, link] = max(entered[link] - before[link], 0.0)
        before[link] = entered[link]
        if asked[link] and due_s[link] > sight_s[link]:
            _arrive(came[:, link], now, max(far[link], 0.0), sight_s[link], due_s[link], coming[link], bin_s)
    _send(asked, sent, next_link, came[now], rate, due_s, coming, bin_s)
    shut, held = held_up(seen, upstream, x, share, room, upstream_room, of_before, group_link)
    stand, come = np.zeros(len(stream_link)), np.zeros((len(stream_link), bins))
    for stream in range(len(stream_link)):
        lane_set, link = stream_set[stream], stream_link[stream]
        if not asked[link]:
            continue
        of_upstream = (1 - shut[set_group[lane_set]]) * of_link[stream]
        stand[stream] = of_set[stream] * zone[lane_set, 0] + of_upstream * onward[link, 0] * upstream[link, 0]
        for place in range(bins):
            come[stream, place] = of_upstream * onward[link, -1] * coming[link, place]
        for part in range(1, zone.shape[1]):
            veh = of_set[stream] * zone[lane_set, part] + of_upstream * onward[link, part] * upstream[link, part]
            if veh > 0:
                for place in range(bins):
                    come[stream, place] += veh * arrival[link, part, place]
    return stand, come, held


@compiled
def _in_sight(zone: Floats, upstream: Floats, x: Floats, set_group: Ints, group_link: Ints) -> tuple[Floats, Floats]:
    """(G,) vehicles that are seen on the lanes of each lane group, (Z,) those of each link that are not in sight."""
    seen, far = np.zeros(len(group_link)), x - upstream.sum(axis=1)
    for lane_set, group in enumerate(set_group):
        seen[group] += zone[lane_set].sum()
    for group, link in enumerate(group_link):
        far[link] -= seen[group]
    return seen, far


@compiled
def _arrive(came: Floats, now: int, veh: float, sight_s: float, due_s: float, coming: Floats, bin_s: float) -> None:
    """Puts the last `veh` of those who `came`, each amid the bin in which they did, where they arrive `due_s` later.

    Whoever should be in sight by now, in a queue or slow, is where sight begins.
    """
    for age in range(len(came)):
        left_s = due_s - (age + 0.5) * bin_s
        if left_s <= sight_s:
            break
        here = min(came[(now - age) % len(came)], veh)
        veh -= here
        place = int(left_s / bin_s)
        if place < len(coming):
            coming[place] += here
    coming[min(int(sight_s / bin_s), len(coming) - 1)] += veh


@compiled
def _send(
    asked: Bools,
    sent: Floats,
    next_link: Ints,
    came: Floats,
    rate: Floats,
    due_s: Floats,
    coming: Floats,
    bin_s: float,
) -> None:
    """Adds whom the neighbours will send, if they do as they have planned, and as many more as came of late."""
    links, bins = coming.shape
    fresh = bin_s / MEMORY_S
    for link in range(links):
        rate[0, link] += fresh * (came[link] - rate[0, link])
        rate[1, link] *= 1 - fresh
    for stream in range(len(next_link)):
        link = next_link[stream]
        if link >= 0:
            rate[1, link] += fresh * sent[stream, 0]
            if not asked[link]:
                continue
            # A bin of what it has planned has gone by; who left in it is mostly amid the junction, not yet counted.
            delay = int(due_s[link] / bin_s + 0.5) - 1
            for place in range(max(delay, 0), min(bins, bins + delay)):
                coming[link, place] += sent[stream, place - delay]
    for link in range(links):
        if not asked[link]:
            continue
        others = max(rate[0, link] - rate[1, link], 0.0)
        for place in range(bins):
            if (place + 0.5) * bin_s > due_s[link]:
                coming[link, place] += others
