"""Who drives where, and the ways that SUMO finds for trips that have none: fastest on empty roads.

SUMO routes at the speeds of the moment of departure; on empty roads that is this. Its penalties for minor links and
turnarounds are kept (options `weights.minor-penalty`, `weights.turnaround-penalty` of SUMO 1.28, defaults).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from utn_sumo.network.roads import TURNAROUND, for_motors, free_s

MINOR_S, TURNAROUND_S = 1.5, 5.0
MINOR = frozenset("m=")
"""States of connections that give way everywhere."""
AT_ONCE = 200
"""Origins whose trees are held in memory at the same time."""


@dataclass(frozen=True)
class Traffic:
    """Who drives where within a case's window."""

    turned_veh: Mapping[tuple[str, str], float]
    """Vehicles that go on from one edge to the next, by (edge, next edge), as their routes have it."""
    space_m: float
    """Mean length and gap of a motor vehicle; a passenger car's where nobody drives."""
    by_class_veh: Mapping[str, float]
    """Vehicles by vClass."""
    trips_veh: Mapping[tuple[str, ...], float]
    """Those among them whose way SUMO finds itself, by the edges that it leads from, via and to: they are in no
    `turned_veh`. What begins or ends elsewhere than on an edge has fewer than two."""
    shortest_m: float
    """Length of the shortest vehicle that drives on a road; a passenger car's where none is shorter."""
    acceleration_m_s2: float
    """How fast queues of motor vehicles speed up: harmonic mean of the slowest of SLOWEST_OF_VEH, a passenger car's
    where nobody drives."""
    named_by: Mapping[str, str]
    """Edges on their ways, as far as these are known, and who names each of them first."""
    called: frozenset[str] = frozenset()
    """Vehicles that depart when somebody calls for them, by id."""

    @property
    def without_route_veh(self) -> float:
        """Vehicles whose way SUMO finds itself."""
        return sum(self.trips_veh.values())

    @property
    def without_ends_veh(self) -> float:
        """Those among them of whom nobody knows the edges either that they begin and end on."""
        return sum(veh for passed, veh in self.trips_veh.items() if len(passed) < 2)  # noqa: PLR2004 - a way's ends


def turned_veh(net: Any, trips_veh: Mapping[tuple[str, ...], float]) -> dict[tuple[str, str], float]:
    """Vehicles by (edge, next edge) on the fastest ways of trips, given as (from, via ..., to) and how many there are.

    `net` is sumolib's. Who has no way turns nowhere.
    """
    edges = net.getEdges(withInternal=False)
    place = {edge.getID(): number for number, edge in enumerate(edges)}
    legs: dict[int, dict[int, float]] = defaultdict(lambda: defaultdict(float))
    for stops, veh in trips_veh.items():
        for leg in pairwise(stops):
            if all(stop in place for stop in leg):
                legs[place[leg[0]]][place[leg[1]]] += veh
    times = _times(edges, place)
    turned: dict[tuple[str, str], float] = defaultdict(float)
    for first in range(0, len(legs), AT_ONCE):
        origins = sorted(legs)[first : first + AT_ONCE]
        _, before = dijkstra(times, indices=origins, return_predecessors=True)
        for origin, row in zip(origins, before, strict=True):
            tree = row.tolist()
            for end, veh in legs[origin].items():
                at = end
                while at != origin and tree[at] >= 0:
                    turned[edges[tree[at]].getID(), edges[at].getID()] += veh
                    at = tree[at]
    return dict(turned)


def _times(edges: list[Any], place: Mapping[str, int]) -> Any:
    """Time from each edge's end to the next one's end [s], a sparse matrix."""
    rows, columns, times_s = [], [], []
    for number, edge in enumerate(edges):
        for ahead, connections in edge.getOutgoing().items():
            able = [each for each in for_motors(connections) if each.getFromLane().allows("passenger")]
            if able:
                penalty_s = TURNAROUND_S if all(each.getDirection() == TURNAROUND for each in able) else 0.0
                penalty_s += MINOR_S if all(each.getState() in MINOR for each in able) else 0.0
                rows.append(number)
                columns.append(place[ahead.getID()])
                times_s.append(free_s(ahead) + penalty_s)
    return sp.csr_array((np.array(times_s), (rows, columns)), shape=(len(edges), len(edges)))
