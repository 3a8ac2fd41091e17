"""What a vehicle of each stream is worth, and how many of them go in a bin of green: by how full links are."""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.pockets import rooms_veh
from utn_controllers.scheduled.streams import Streams
from utn_sumo.compiling import compiled
from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network

FADING = 0.2
"""Over what share of its storage about `full` a link is fed less and less."""
LEAST_WORTH = 0.05
"""Of a vehicle that would go from an empty link into a full one."""
BLOCKED_VEH = 1e-6
"""What leaves in a bin where nobody goes, or is to go."""
LASTING_S = 100.0
"""Over what time queues are taken that hold up those behind them: within a cycle all come and go."""
DENSE = 0.3
"""Share of the room in sight from which on, over that time, a queue holds up who is behind it."""
STARVED_S = 120.0
"""Who has not been let go to the last one for so long weighs more by all of `starving`."""


class Worth:
    """Keeps how dense lane sets have been of late, and when they were last empty."""

    def __init__(
        self, network: Network, streams: Streams, *, crowding: float, blocking: float, starving: float, full: float
    ):
        self._network, self._streams = network, streams
        self._settings = crowding, blocking, starving, full
        self._set_junction = network.link_junction[network.set_link]
        set_veh, before_veh = rooms_veh(network)
        self._room = set_veh, before_veh
        self._dense = np.zeros(len(network.lane_sets))
        """(L,) share of their room in sight that vehicles have taken up of late."""
        self._looked_s = np.zeros(len(network.lane_sets))
        """(L,) when that was looked at."""
        self._empty_s = np.zeros(len(network.lane_sets))
        """(L,) when nobody was by the stop line of each last."""

    def look(
        self,
        time_s: float,
        asked: Bools,
        zones: tuple[Floats, Floats],
        x: Floats,
        shares: tuple[Floats, Floats],
        most: Floats,
        stuck: Bools,
        held: Floats,
    ) -> tuple[Floats, Floats]:
        """(N,) what a vehicle of each stream is worth, (N,) how many leave in a bin of green.

        By the vehicles in `zones` (View.zone_veh) before the junctions `asked` (J,) and on all links `x` (Z,); the
        `shares` of their links' traffic that streams (N,) and lane sets (L,) have; the `most` (N,) that can leave
        of each stream, whether it is `stuck` (N,) before its green, and how much more lane sets (L,) weigh who hold
        others up.
        """
        network, streams = self._network, self._streams
        _lasting(
            time_s, asked, self._set_junction, network.set_link, *zones, *self._room,
            shares[1], self._dense, self._looked_s, self._empty_s,
        )  # fmt: skip
        worth, moving = _worth(
            x, network.storage_veh, self._dense, network.begins_amid, streams.link, streams.lane_set, streams.group,
            streams.next_link, shares[0], most, stuck, held, time_s, self._empty_s, *self._settings,
        )  # fmt: skip
        return worth, moving


@compiled
def _lasting(
    time_s: float, asked: Bools, set_junction: Ints, set_link: Ints, zone: Floats, upstream: Floats, room: Floats,
    before: Floats, share: Floats, dense: Floats, looked_s: Floats, empty_s: Floats,
) -> None:  # fmt: skip
    """Brings `dense` (L,) and `empty_s` (L,) up to date where somebody has looked."""
    for lane_set, link in enumerate(set_link):
        if asked[set_junction[lane_set]]:
            veh = zone[lane_set].sum() + share[lane_set] * upstream[link].sum()
            now = min(veh / max(room[lane_set] + share[lane_set] * before[link], 1.0), 1.0)
            dense[lane_set] += (1 - np.exp((looked_s[lane_set] - time_s) / LASTING_S)) * (now - dense[lane_set])
            looked_s[lane_set] = time_s
            if zone[lane_set, 0] < 1:
                empty_s[lane_set] = time_s


@compiled
def _lasts(dense: Floats) -> Floats:
    """By how much queues as dense as this hold up who is behind them, 0 to 1."""
    return np.maximum(dense - DENSE, 0.0) / (1 - DENSE)


@compiled
def _worth(
    x: Floats, storage: Floats, dense: Floats, amid: Bools, links: Ints, sets: Ints, groups: Ints, next_links: Ints,
    of_link: Floats, most: Floats, stuck: Bools, held: Floats, time_s: float, empty_s: Floats, crowding: float,
    blocking: float, starving: float, full: float,
) -> tuple[Floats, Floats]:  # fmt: skip
    queue, taken = _lasts(dense), x / storage
    # Where nobody sees who waits behind a link, its own vehicles say it.
    feeding, behind = amid.astype(np.float64), amid * _lasts(np.minimum(taken, 1.0))
    for stream, ahead in enumerate(next_links):
        if ahead != EXIT:
            feeding[ahead] += of_link[stream]
            behind[ahead] += of_link[stream] * queue[sets[stream]]
    worth, moving = np.empty(len(links)), most.copy()
    for stream, ahead in enumerate(next_links):
        link = links[stream]
        there = taken[ahead] if ahead != EXIT else 0.0
        # A queue takes the room of those who would come onto its link, the more of them wait behind.
        blocks = queue[sets[stream]] * behind[link] / feeding[link] if feeding[link] > 0 else 0.0
        value = max(1 + crowding * (taken[link] - there) + blocking * blocks, LEAST_WORTH)
        # With queues enough for the best stages there are others that would never be worth their clearance.
        starved = min((time_s - empty_s[sets[stream]]) / STARVED_S, 1.0)
        worth[stream] = held[groups[stream]] * (1 + starving * starved) * value
        fed = (full + FADING / 2 - there) / FADING
        if fed < 1:
            moving[stream] = max(fed * most[stream], BLOCKED_VEH)
        if stuck[stream]:
            moving[stream] = BLOCKED_VEH
    return worth, moving
