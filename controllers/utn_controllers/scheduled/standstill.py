"""Who has green and does not go: behind a turn that finds no gap, or before a road or a junction that is full.

No detector tells which. Green is lost on them, and what lets them go is often that others get it: the oncoming traffic
has to stop for who turns left, the queue ahead to move. But a change costs its clearances, and behind a turn that has
been let out there is the next: where the road ahead has room it is a gap that is waited for, and the longer the
clearances take, the longer it may be, as long as the queue holds up nobody behind its link.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import GIVES_WAY
from utn_sumo.compiling import compiled
from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network

START_S = 3.0
"""From a green's begin until its flow is counted."""
WAITING_VEH = 0.5
"""Fewer before a green than so many may be nobody."""
QUICK_S, COSTLY_S, MOST_TIMES = 4.0, 8.0, 3.0
"""Who may wait for a gap has no longer where clearances take so little, and so many times as long where so much."""
ROOM = 0.3
"""A road ahead has room if less than this share of its storage is taken."""
HOLDS_UP = 0.5
"""A link of whose storage so much is taken may hold up others behind it."""


class Shown(Protocol):
    """What of a view it takes to know who goes (contract.View)."""

    @property
    def time_s(self) -> float: ...
    @property
    def begin_s(self) -> Floats: ...
    @property
    def left_veh(self) -> Floats: ...
    @property
    def x_veh(self) -> Floats: ...


class Standstill:
    """Keeps when each link last sent somebody off, or had nobody standing before its green."""

    def __init__(self, network: Network, streams: Streams, after_s: float):
        """After so long [s], or longer where it may wait for a gap, a queue that has green is at a standstill."""
        self._streams = streams
        self._after_s = after_s
        clears_s = np.bincount(network.stage_junction, network.clearance_s) / np.bincount(network.stage_junction)
        self._gap_s = after_s * np.interp(clears_s, (QUICK_S, COSTLY_S), (1.0, MOST_TIMES))
        """(J,)"""
        self._yields = _yields(network, streams)
        self._fed = np.zeros(len(network.links), dtype=np.bool_)
        self._fed[network.turn_next[network.turn_next != EXIT]] = True
        self._storage_veh = network.storage_veh
        self._junction = network.link_junction
        self._set_link = network.set_link
        self._went_s = np.zeros(len(network.links))
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
                view.left_veh,
                self._set_link,
                view.x_veh,
                self._storage_veh,
                stand,
                self._streams.serves,
                self._streams.link,
                self._streams.next_link,
                self._junction,
                self._yields,
                self._fed,
                self._left_veh,
                self._went_s,
                self._after_s,
                self._gap_s,
            )
        )


def _yields(network: Network, streams: Streams) -> Bools:
    """(S, Z) links of which somebody has green and must give way in a stage."""
    yields = np.zeros((len(streams.stage), len(network.links)), dtype=np.bool_)
    for row, stage in enumerate(streams.stage):
        state = network.stages[stage].state
        for stream in np.flatnonzero(streams.serves[row]):
            yields[row, streams.link[stream]] |= any(state[letter] == GIVES_WAY for letter in streams.letters[stream])
    return yields


@compiled
def _look(
    time_s: float,
    row: Ints,
    begin_s: Floats,
    set_left: Floats,
    set_link: Ints,
    x: Floats,
    storage: Floats,
    stand: Floats,
    serves: Bools,
    stream_link: Ints,
    next_link: Ints,
    junction: Ints,
    yields: Bools,
    fed: Bools,
    before: Floats,
    went_s: Floats,
    after_s: float,
    gap_s: Floats,
) -> Bools:
    left, taken = np.zeros(len(x)), x / storage
    for lane_set, link in enumerate(set_link):
        left[link] += set_left[lane_set]
    waiting, stuck = np.zeros(len(left)), np.zeros(len(stand), np.bool_)
    for_a_gap = np.empty(len(left), np.bool_)
    for link in range(len(left)):
        for_a_gap[link] = yields[row[junction[link]], link] and not (fed[link] and taken[link] >= HOLDS_UP)
    for stream, link in enumerate(stream_link):
        if serves[row[junction[link]], stream]:
            waiting[link] += stand[stream]
        if next_link[stream] != EXIT and taken[next_link[stream]] >= ROOM:
            for_a_gap[link] = False
    for link in range(len(left)):
        if left[link] > before[link] or waiting[link] < WAITING_VEH:
            went_s[link] = time_s
        before[link] = left[link]
    for stream, link in enumerate(stream_link):
        own = junction[link]
        if serves[row[own], stream]:
            stands_s = time_s - max(went_s[link], begin_s[own])
            stuck[stream] = stands_s >= (gap_s[own] if for_a_gap[link] else after_s)
    return stuck
