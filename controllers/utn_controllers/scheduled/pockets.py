"""Who is held up by a full pocket: behind it queue those too who go elsewhere, and who will not be in their lanes soon.

Where lanes part shortly before the stop line, a queue that fills its own lanes stands in the way of all others. Who is
behind comes on as that queue goes, so that everybody of it is worth those who wait for him.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints, Network

FULL = 0.75
"""Share of the room on a lane group's own lanes from which on it is full."""
DENSE = 0.4
"""Share of the room on the lanes before them, as far as they are in sight, from which on there is a queue on them."""


def rooms_veh(network: Network) -> tuple[Floats, Floats]:
    """(G,) vehicles that the lanes in sight hold of each lane group, (Z,) and of each link before its lanes part."""
    lane_m = [
        sum(network.edge_length_m[edge] * len(network.edge_lanes[edge]) for edge in link.edges)
        for link in network.links
    ]
    jam_veh_m = network.storage_veh / np.array(lane_m)
    group_m, before_m = network.watched_lane_m
    return group_m * jam_veh_m[network.group_link], before_m * jam_veh_m


@compiled
def held_up(
    zone: Floats, upstream: Floats, x: Floats, share: Floats, room: Floats, before: Floats, group_link: Ints
) -> tuple[Bools, Floats]:
    """(G,) lane groups into which nobody comes from before the lanes part, (G,) by how much those in them weigh more.

    By the vehicles in zones (G, zones), (Z, zones) and on links `x` (Z,), the lane groups' `share` (G,) of the traffic,
    and the `room` of their lanes (G,) and of those `before` (Z,).
    """
    full, shut, weight = np.zeros(len(zone), np.bool_), np.zeros(len(zone), np.bool_), np.ones(len(zone))
    within, stuck_veh, stuck_share = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
    for group, link in enumerate(group_link):
        veh = zone[group].sum()
        within[link] += veh
        full[group] = before[link] > 0 and upstream[link].sum() >= DENSE * before[link] and veh >= FULL * room[group]
        if full[group]:
            stuck_veh[link] += veh
            stuck_share[link] += share[group]
    for group, link in enumerate(group_link):
        if full[group]:
            behind = max(x[link] - within[link], upstream[link].sum())
            weight[group] = (stuck_veh[link] + behind) / (stuck_veh[link] + behind * stuck_share[link])
        else:
            shut[group] = stuck_share[link] > 0
    return shut, weight
