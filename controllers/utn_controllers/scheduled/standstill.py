"""Who has green and does not go: behind a turn that finds no gap, or before a road or a junction that is full.

No detector tells which. Green is lost on them, and what lets them go is often that others get it: the oncoming traffic
has to stop for who turns left, the queue ahead to move. Where all leave the net it can only be the first, the oncoming
traffic makes use of the green, and the next turn would stop the queue again: others are served later then.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from utn_controllers.compiling import compiled
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network

WAITING_VEH = 0.5
"""Fewer before a green than so many may be nobody."""
FOR_A_GAP = 3.0
"""So many times as long a queue may stand that waits for a gap while others of its junction go."""


class Shown(Protocol):
    """What of a view it takes to know who goes (contract.View)."""

    @property
    def time_s(self) -> float: ...
    @property
    def begin_s(self) -> Floats: ...
    @property
    def left_veh(self) -> Floats: ...


class Standstill:
    """Keeps when each link last sent somebody off, or had nobody standing before its green, and each junction."""

    def __init__(self, network: Network, streams: Streams, after_s: float):
        """After so long [s] a queue that has green is at a standstill."""
        self._streams = streams
        self._after_s = after_s
        self._junction = network.link_junction
        self._group_link = network.group_link
        self._all_leave = np.ones(len(network.links), dtype=np.bool_)
        self._all_leave[network.turn_link[network.turn_next != EXIT]] = False
        self._went_s = np.zeros(len(network.links))
        self._anybody_went_s = np.zeros(len(network.junctions))
        self._left_veh = np.zeros(len(network.links))

    def look(self, view: Shown, present: Ints, stand: Floats) -> Bools:
        """(N,) streams that stand before green on a link from which nobody goes; `stand` (N,) vehicles.

        `present` (J,) is the row of each junction's stage in `Streams.serves`.
        """
        return np.asarray(
            _look(
                view.time_s,
                present,
                view.begin_s,
                np.bincount(self._group_link, view.left_veh, len(self._left_veh)),
                stand,
                self._streams.serves,
                self._streams.link,
                self._junction,
                self._all_leave,
                self._left_veh,
                self._went_s,
                self._anybody_went_s,
                self._after_s,
            )
        )


@compiled
def _look(
    time_s: float,
    row: Ints,
    begin_s: Floats,
    left: Floats,
    stand: Floats,
    serves: Bools,
    stream_link: Ints,
    junction: Ints,
    all_leave: Bools,
    before: Floats,
    went_s: Floats,
    anybody_went_s: Floats,
    after_s: float,
) -> Bools:
    waiting, stuck = np.zeros(len(left)), np.zeros(len(stand), np.bool_)
    for stream, link in enumerate(stream_link):
        if serves[row[junction[link]], stream]:
            waiting[link] += stand[stream]
    for link in range(len(left)):
        if left[link] > before[link] or waiting[link] < WAITING_VEH:
            went_s[link] = time_s
        if left[link] > before[link] and waiting[link] >= WAITING_VEH:
            anybody_went_s[junction[link]] = time_s
        before[link] = left[link]
    for stream, link in enumerate(stream_link):
        own = junction[link]
        if serves[row[own], stream]:
            for_a_gap = all_leave[link] and time_s - anybody_went_s[own] < after_s
            stands_s = time_s - max(went_s[link], begin_s[own])
            stuck[stream] = stands_s >= after_s * (FOR_A_GAP if for_a_gap else 1.0)
    return stuck
