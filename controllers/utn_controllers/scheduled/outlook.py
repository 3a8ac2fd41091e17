"""Who stands before a signal and who will come, by stream, in bins of time."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from utn_controllers.compiling import compiled
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import AREA_REACH_M, Bools, Floats, Ints, Network

MEMORY_S = 120.0
"""Over what time the rate is taken with which vehicles come from where no schedule is known."""
QUEUED_SHARE = 0.5
"""Share of its jam from which what the lane-area detectors see is a queue that reaches back beyond them."""


class Seen(Protocol):
    """What of a view it takes to know who comes (contract.View)."""

    @property
    def free(self) -> Bools: ...
    @property
    def near_veh(self) -> Floats: ...
    @property
    def x_veh(self) -> Floats: ...
    @property
    def entered_veh(self) -> Floats: ...
    @property
    def left_veh(self) -> Floats: ...


class Outlook:
    """Keeps who has come onto each link and when, and says who arrives before its signal in each bin ahead.

    Beyond those the upstream loops have counted are those whom the neighbours' schedules send, and as many more
    as have been coming of late from elsewhere.
    """

    def __init__(self, network: Network, streams: Streams, bins: int, bin_s: float, early_s: float):
        """`early_s` before it reaches the stop line a vehicle counts as arrived."""
        self.network = network
        self.streams = streams
        self.bin_s = bin_s
        speed_m_s = np.array([link.free_speed_m_s for link in network.links])
        length_m = np.array([link.length_m for link in network.links])
        self._due_s = np.maximum(network.free_time_s - early_s, 0.0)
        """(Z,) from entry to arrival."""
        self._sight_s = np.maximum(np.minimum(length_m, AREA_REACH_M) / speed_m_s - early_s, 0.0)
        """(Z,) from where the lane-area detectors begin to arrival."""
        self._hidden = length_m > AREA_REACH_M
        self._came = np.zeros((2, int(np.ceil(self._due_s.max(initial=0.0) / bin_s)) + 1, len(network.links)))
        """Vehicles that came onto each link, and into sight on it, in each of the last bins, in a ring."""
        self._now = 0
        self._before_veh = np.zeros((2, len(network.links)))
        self._rate = np.zeros((2, len(network.links)))
        """Vehicles a bin that come onto each link of late, and of these those that schedules said."""
        self.sent_veh = np.zeros((len(streams.link), bins))
        """(N, K) vehicles that each stream's schedule sends off in each bin from now on."""
        self.take_up(network.fraction)

    def take_up(self, fraction: Floats) -> None:
        """Go by these turning fractions (M,) from now on."""
        self.of_link, self.of_group = self.streams.shares(fraction)
        self._group_share = self.network.group_shares(fraction)

    def look(self, view: Seen) -> tuple[Floats, Floats]:
        """(N,) vehicles that stand or are about to, (N, K) those that arrive in each bin. A bin has gone by since.

        Before junctions that are not free, who decide nothing now, there are none.
        """
        self._now = (self._now + 1) % self._came.shape[1]
        streams, network = self.streams, self.network
        stand, come = _look(
            view.free,
            view.near_veh,
            view.x_veh,
            view.entered_veh,
            view.left_veh,
            self._before_veh,
            self._came,
            self._now,
            self._rate,
            self.sent_veh,
            self._due_s,
            self._sight_s,
            network.watched_veh,
            self._hidden,
            network.link_junction,
            network.group_link,
            self._group_share,
            streams.link,
            streams.group,
            streams.next_link,
            self.of_link,
            self.of_group,
            self.bin_s,
        )
        return stand, come


@compiled
def _look(
    free: Bools,
    near: Floats,
    x: Floats,
    entered: Floats,
    left: Floats,
    before: Floats,
    came: Floats,
    now: int,
    rate: Floats,
    sent: Floats,
    due_s: Floats,
    sight_s: Floats,
    seen_jam: Floats,
    hidden: Bools,
    junction: Ints,
    group_link: Ints,
    group_share: Floats,
    stream_link: Ints,
    stream_group: Ints,
    next_link: Ints,
    of_link: Floats,
    of_group: Floats,
    bin_s: float,
) -> tuple[Floats, Floats]:
    links, bins = len(x), sent.shape[1]
    in_sight = _note(near, entered, left, group_link, before, came[:, now])
    asked = free[junction]
    coming = np.zeros((links, bins))
    on_way, jammed = np.zeros(links), np.zeros(links)
    for link in np.flatnonzero(asked):
        # In sight are those who came into it last.
        late = _arrive(came[1, :, link], now, in_sight[link], 0.0, sight_s[link], coming[link], bin_s)
        on_way[link] = in_sight[link] - late
        if not hidden[link]:
            continue
        # Before that are those who came onto the link last. Who is late is about to come into sight, or in a jam.
        far = max(x[link] - in_sight[link], 0.0)
        late = _arrive(came[0, :, link], now, far, sight_s[link], due_s[link], coming[link], bin_s)
        if in_sight[link] - on_way[link] >= QUEUED_SHARE * seen_jam[link]:
            jammed[link] = late
        else:
            coming[link, min(bins - 1, int(sight_s[link] / bin_s))] += late
    _send(asked, sent, next_link, came[0, now], rate, due_s, coming, bin_s)
    stand, come = np.zeros(len(stream_link)), np.zeros((len(stream_link), bins))
    for stream in range(len(stream_link)):
        group, link = stream_group[stream], stream_link[stream]
        if not asked[link]:
            continue
        # Who is in sight and not on the way stands, or moves in a queue.
        queue = max(near[group] - group_share[group] * on_way[link], 0.0) + group_share[group] * jammed[link]
        stand[stream] = queue * of_group[stream]
        for place in range(bins):
            come[stream, place] = coming[link, place] * of_link[stream]
    return stand, come


@compiled
def _note(near: Floats, entered: Floats, left: Floats, group_link: Ints, before: Floats, came: Floats) -> Floats:
    """(Z,) who is in sight on each link; `came` (2, Z) is given who has come since `before`, which is given all."""
    in_sight = np.zeros(len(left))
    for group in range(len(near)):
        in_sight[group_link[group]] += near[group]
    for link in range(len(left)):
        for row, until_now in enumerate((entered[link], left[link] + in_sight[link])):
            came[row, link] = max(until_now - before[row, link], 0.0)
            before[row, link] = until_now
    return in_sight


@compiled
def _arrive(came: Floats, now: int, veh: float, from_s: float, due_s: float, coming: Floats, bin_s: float) -> float:
    """Puts the last `veh` of those who `came`, each amid the bin in which they did, where they arrive `due_s` later.

    But none nearer than `from_s`: so many are left, who should have arrived.
    """
    for age in range(len(came)):
        left_s = due_s - (age + 0.5) * bin_s
        if left_s <= from_s:
            break
        here = min(came[(now - age) % len(came)], veh)
        veh -= here
        place = int(left_s / bin_s)
        if place < len(coming):
            coming[place] += here
    return veh


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
            delay = int(due_s[link] / bin_s + 0.5)
            for place in range(delay, bins):
                coming[link, place] += sent[stream, place - delay]
    for link in range(links):
        if not asked[link]:
            continue
        others = max(rate[0, link] - rate[1, link], 0.0)
        for place in range(bins):
            if (place + 0.5) * bin_s > due_s[link]:
                coming[link, place] += others
