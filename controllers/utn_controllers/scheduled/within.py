"""Who stands amid a junction before a short road within it that has red.

Where nodes that are a few metres apart are one junction, as netconvert's `tls.join` leaves carriageways that are apart,
who turns left off the one waits between the two for the stage that lets him over the other. The road there may be
shorter than a vehicle: he stands on the turn that led to it, seen by nobody who looks at roads, and all on his lane
stand behind him. Two from opposite sides may stand in each other's way for good. Lane-area detectors amid the junction
see him; he is of the queue on the road before him, and with somebody in it that queue weighs several times as much.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import Bools, Floats, Ints, Network

IN_THE_WAY = 5.0
"""So many times as much all weigh on a road with a queue: between 3 and 8 it is no matter."""


class Amid(Protocol):
    """What of a view it takes to know who stands amid junctions (contract.View)."""

    @property
    def free(self) -> Bools: ...
    def standing_amid_veh(self, turn: int) -> float: ...


class Road(NamedTuple):
    """One within a junction."""

    junction: int
    sets: Ints
    """Its lane sets."""
    groups: Ints
    """Its lane groups."""
    onward: Ints
    """Streams that go on from it."""
    room_veh: float
    """Vehicles a lane."""
    turns: tuple[tuple[int, Ints], ...]
    """Those onto it, with the streams from whose lanes each comes."""


class Within:
    """Knows the roads within junctions, and who stands on them or before them."""

    def __init__(self, network: Network, streams: Streams):
        self._roads = [_road(network, streams, int(link)) for link in np.flatnonzero(network.within)]
        self.before = np.zeros(len(streams.link), dtype=np.bool_)
        """(N,) streams from whose lanes some go onto a road within the junction that has no room for one more."""

    def look(self, view: Amid, near: Floats, of_link: Floats, stand: Floats, held: Floats) -> None:
        """Add to the queues `stand` (N,) who stands amid free junctions, and to `held` (G,) what all weigh there.

        By the shares `of_link` (N,) that streams have of their links' traffic, and who is `near` (L,) the stop line of
        each lane set.
        """
        self.before[:] = False
        for road in self._roads:
            if view.free[road.junction]:
                there = near[road.sets].sum()
                for turn, own in road.turns:
                    amid = view.standing_amid_veh(turn)
                    stand[road.onward] += amid * of_link[road.onward]
                    self.before[own] |= amid + there >= road.room_veh
                if stand[road.onward].any():
                    held[road.groups] *= IN_THE_WAY


def _road(network: Network, streams: Streams, link: int) -> Road:
    each = network.links[link]
    turns = [index for index, turn in enumerate(network.turns) if turn.next_link == link]
    sets = [[index for index, own in enumerate(network.lane_sets) if turn in own.turns] for turn in turns]
    return Road(
        each.junction,
        np.flatnonzero(network.set_link == link),
        np.flatnonzero(network.group_link == link),
        np.flatnonzero(streams.link == link),
        max(each.lane_room_veh // 1, 1.0),
        tuple((turn, np.flatnonzero(np.isin(streams.lane_set, own))) for turn, own in zip(turns, sets, strict=True)),
    )
