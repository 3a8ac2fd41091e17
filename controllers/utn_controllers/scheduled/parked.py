"""Who stands amid the way to a stop line and does not come: parked there, at a bus stop, waiting to change lanes.

By where he is he could be at the line in a moment, and so would call for green, and keep it, for as long as he stays.
Who has had green for long, with nobody before him, is not coming; short greens add up.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.compiling import compiled
from utn_sumo.contract import ZONES_M, Bools, Floats, Ints, Network

AFTER_S = 16.0
"""Who is slow, or far off, has come to the next zone by then."""


class Parked:
    """Keeps since when somebody in each zone could go, and how many have stayed."""

    def __init__(self, network: Network, streams: Streams):
        self._streams = streams
        self._links = len(network.links)
        self._set_link = network.set_link
        self._set_junction = network.link_junction[network.set_link]
        shape = len(network.lane_sets), len(ZONES_M)
        self._could_s = np.zeros(shape)
        """(L, zones) for how long somebody who has been there since could have gone: green, and nobody before him."""
        self._time_s = 0.0
        self._least_veh = np.full(shape, np.inf)
        """(L, zones) least number of vehicles seen there meanwhile."""
        self._stay_veh = np.zeros(shape)
        """(L, zones) vehicles that do not come."""

    def leave_out(self, time_s: float, free: Bools, present: Ints, zone_veh: Floats) -> Floats:
        """Take who does not come off the vehicles (L, zones) that are seen before the junctions that are `free` (J,).

        (Z,) how many that are on each link. `present` (J,) is the row of each junction's stage in `Streams.serves`.
        """
        lasted_s, self._time_s = time_s - self._time_s, time_s
        return np.asarray(
            _leave_out(
                lasted_s, free, present, self._streams.serves, self._streams.lane_set, self._set_junction,
                self._set_link, zone_veh, self._could_s, self._least_veh, self._stay_veh, self._links,
            )
        )  # fmt: skip


@compiled
def _leave_out(
    lasted_s: float, free: Bools, present: Ints, serves: Bools, stream_set: Ints, set_junction: Ints, set_link: Ints,
    zone: Floats, could_s: Floats, least: Floats, stay: Floats, links: int,
) -> Floats:  # fmt: skip
    parked = np.zeros(links)
    green = np.zeros(len(zone), np.bool_)
    for stream, lane_set in enumerate(stream_set):
        if serves[present[set_junction[lane_set]], stream]:
            green[lane_set] = True
    for lane_set, junction in enumerate(set_junction):
        if not free[junction]:
            continue
        # With nobody at the line, nor between it and him but who stays as well.
        is_clear = green[lane_set] and zone[lane_set, 0] < 1
        for part in range(1, zone.shape[1]):
            seen = zone[lane_set, part]
            stay[lane_set, part] = min(stay[lane_set, part], seen)
            if seen < 1:
                could_s[lane_set, part], least[lane_set, part] = 0.0, np.inf
            else:
                if is_clear and np.isfinite(least[lane_set, part]):
                    could_s[lane_set, part] += lasted_s
                least[lane_set, part] = min(least[lane_set, part], seen)
                if could_s[lane_set, part] >= AFTER_S:
                    stay[lane_set, part] = least[lane_set, part]
            zone[lane_set, part] -= stay[lane_set, part]
            parked[set_link[lane_set]] += stay[lane_set, part]
            is_clear = is_clear and zone[lane_set, part] < 1
    return parked
