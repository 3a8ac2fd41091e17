"""Who is held up by a full pocket: behind it queue those too who go elsewhere, and who will not be in their lanes soon.

Where lanes part shortly before the stop line, a queue that fills its own lanes stands in the way of all others who are
on as many of the lanes before these. Who is behind comes on as that queue goes, so that everybody of it is worth those
who wait for him.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.compiling import compiled
from utn_sumo.contract import Floats, Ints, Network

HOLDING = (0.35, 0.45), (0.08, 0.12)
"""Shares of the room on a lane group's own lanes, and of that on the lanes before them as far as they are in sight,
between which the queues on both come to hold others up."""
SHUT = (0.4, 0.9), (0.1, 0.4)
"""The same shares, between which fewer and fewer get past such a queue into the other lanes.

Limits that are one number each would have what is worth most change from one decision to the next, and a pocket's
stage put off again and again.
"""


def rooms_veh(network: Network) -> tuple[Floats, Floats]:
    """(L,) vehicles that the lanes in sight hold of each lane set, (Z,) and of each link before its lanes part."""
    lane_m = [
        sum(network.edge_length_m[edge] * len(network.edge_lanes[edge]) for edge in link.edges)
        for link in network.links
    ]
    jam_veh_m = network.storage_veh / np.array(lane_m)
    set_m, before_m = network.watched_lane_m
    return set_m * jam_veh_m[network.set_link], before_m * jam_veh_m


def taken(network: Network) -> Floats:
    """(G,) share that a queue of each lane group takes of the lanes before its own: of three a pocket takes one."""
    lanes = np.bincount(network.set_group, [len(each.lanes) for each in network.lane_sets], len(network.groups))
    before = np.array([len(network.edge_lanes[link.edges[max(len(link.edges) - 2, 0)]]) for link in network.links])
    return np.asarray(np.minimum(lanes / before[network.group_link], 1.0))


@compiled
def held_up(
    seen: Floats, upstream: Floats, x: Floats, share: Floats, room: Floats, before: Floats, of_before: Floats,
    group_link: Ints,
) -> tuple[Floats, Floats]:  # fmt: skip
    """(G,) how few come into a lane group from before the lanes part, 0 to 1; (G,) what a vehicle in it weighs.

    By the vehicles `seen` on the lanes of each (G,), in the zones before them (Z, zones) and on links `x` (Z,), the
    `share` (G,) of the traffic that they have, the `room` of their lanes (G,) and of those `before` (Z,), and what is
    taken `of_before` (G,). On the other ones all go on.
    """
    holds, queues, weight = np.zeros(len(seen)), np.zeros(len(seen)), np.ones(len(seen))
    within, stuck_veh, stuck_share = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
    held, queue = np.zeros(len(x)), np.zeros(len(x))
    for group, link in enumerate(group_link):
        veh = seen[group]
        within[link] += veh
        if before[link] > 0:
            own, dense = veh / room[group], upstream[link].sum() / before[link]
            holds[group], queues[group] = _queues(own, dense, HOLDING), _queues(own, dense, SHUT)
            stuck_veh[link] += holds[group] * veh
            stuck_share[link] += holds[group] * share[group]
            held[link], queue[link] = max(held[link], holds[group]), max(queue[link], queues[group])
    shut = np.zeros(len(seen))
    for group, link in enumerate(group_link):
        if held[link] > 0:
            behind = of_before[group] * max(x[link] - within[link], upstream[link].sum())
            veh, part = stuck_veh[link] / held[link], stuck_share[link] / held[link]
            weight[group] += holds[group] * ((veh + behind) / (veh + behind * part) - 1)
        if queue[link] > 0:
            # Who goes into a queue as long is behind his own, not held up.
            for other in range(len(seen)):
                if group_link[other] == link:
                    shut[group] = max(shut[group], of_before[other] * (queues[other] - queues[group]))
    return shut, weight


@compiled
def _queues(own: float, before: float, limits: tuple[tuple[float, float], tuple[float, float]]) -> float:
    """0 where one of the shares is below its limits, 1 where both are above them."""
    return float(between(own, limits[0]) * between(before, limits[1]))


@compiled
def between(share: float, limits: tuple[float, float]) -> float:
    """0 below the first limit, 1 above the second, straight between."""
    return float(min(max((share - limits[0]) / (limits[1] - limits[0]), 0.0), 1.0))
