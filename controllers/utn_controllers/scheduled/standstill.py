"""Who has green and does not go: behind a turn that finds no gap, or before a road or a junction that is full.

No detector tells which. Green is lost on them, and what lets them go is often that others get it: the oncoming traffic
has to stop for who turns left, the queue ahead to move.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import Bools, Floats, Ints, Network

WAITING_VEH = 0.5
"""Fewer before a green than so many may be nobody."""


class Shown(Protocol):
    """What of a view it takes to know who goes (contract.View)."""

    @property
    def time_s(self) -> float: ...
    @property
    def stage(self) -> Ints: ...
    @property
    def begin_s(self) -> Floats: ...
    @property
    def left_veh(self) -> Floats: ...


class Standstill:
    """Keeps when each link last sent somebody off, or had nobody standing before its green."""

    def __init__(self, network: Network, streams: Streams, after_s: float):
        """After so long [s] a queue that has green is at a standstill."""
        self._streams = streams
        self._after_s = after_s
        self._junction = network.link_junction
        self._row = np.argsort(streams.stage)
        """(S,) row of each of the network's stages in `streams.serves`."""
        self._stream = np.arange(len(streams.link))
        self._stream_junction = network.link_junction[streams.link]
        self._went_s = np.zeros(len(network.links))
        self._left_veh = np.zeros(len(network.links))

    def look(self, view: Shown, stand: Floats) -> Bools:
        """(N,) streams that stand before green on a link from which nobody goes; `stand` (N,) vehicles."""
        streams = self._streams
        green = streams.serves[self._row[view.stage][self._stream_junction], self._stream]
        waiting_veh = np.bincount(streams.link, green * stand, len(self._went_s))
        goes = (view.left_veh > self._left_veh) | (waiting_veh < WAITING_VEH)
        self._left_veh = view.left_veh
        self._went_s[goes] = view.time_s
        since_s = np.maximum(self._went_s, view.begin_s[self._junction])
        return np.asarray(green & (view.time_s - since_s >= self._after_s)[streams.link])
