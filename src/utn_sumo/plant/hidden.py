"""How many vehicles are on each link, though no detector sees all of it and some start or end there uncounted.

A count of who comes and who goes is wrong by these, and never forgets. But where traffic flows freely as far as it is
seen, who came long enough ago is in sight by now, or gone, and only who came just now still is hidden. Where it does
not, the link is taken to gain or lose as many of those who come as it did when that could be seen.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.compiling import compiled
from utn_sumo.contract import AREA_REACH_M, ZONES_M, Bools, Floats, Network

FREE_SHARE = 0.25
"""Share of its storage up to which the farthest zone in sight leaves those behind it moving freely."""
FAST, SLOW = 0.8, 1.5
"""Over the time at free speed, that of the fastest and of the slowest."""
LATE_S = 5.0
"""And so much later they may come in sight, from a standing start."""
NOTED_S = 2.0
"""Time between two moments of which it is kept who had come."""
KNOWN_VEH = 30.0
"""After as many as these what a link gains or loses goes half by what was seen of it, half by nobody."""
KEPT_SHARE = float(np.exp(-10 / 900))
"""Of what was seen of that what is kept from one look to the next, where traffic flows freely: a quarter of an hour's
worth, looking every ten seconds."""


class Hidden:
    """Brings a count of who is on each link to what can be."""

    def __init__(self, network: Network, aside: Bools):
        """`aside` (Z,) has the links onto or off which some go amid it, counted."""
        length_m = np.array([link.length_m for link in network.links])
        speed_m_s = np.array([link.free_speed_m_s for link in network.links])
        free_s = np.maximum(length_m - AREA_REACH_M, 0.0) / speed_m_s
        self._fast_s, self._slow_s = FAST * free_s, SLOW * free_s + LATE_S
        """(Z,) from entry to where sight begins, of the fastest and of the slowest."""
        self._free_veh = FREE_SHARE * network.storage_veh * (ZONES_M[-1] - ZONES_M[-2]) / length_m
        """(Z,) vehicles in the farthest zone up to which it flows freely."""
        self._all_come = ~aside
        """(Z,) whether who comes is still to come into sight, or in it."""
        self._unseen_veh = network.storage_veh - network.watched_veh
        """(Z,) vehicles that fit on what the lane-area detectors do not see of each link."""
        self._lanes = np.array([link.lanes for link in network.links], dtype=np.float64)
        """(Z,) one a lane may be seen who is not counted yet, or no more."""
        moments = int(np.ceil(self._slow_s.max(initial=0.0) / NOTED_S)) + 2
        self._noted_s = np.full(moments, -np.inf)
        self._noted_veh = np.zeros((moments, len(network.links)))
        """(moments, Z) vehicles that had come onto each link, in a ring."""
        self._last = 0
        self._gained, self._of = np.zeros((2, len(network.links)))
        """(Z,) vehicles found on each link beyond those counted, of so many that came."""
        self._gain_since, self._came_since = np.zeros((2, len(network.links)))
        """(Z,) the same since traffic last flowed freely there."""
        self._came_veh = np.zeros(len(network.links))

    def note(self, time_s: float, came_veh: Floats) -> None:
        """So many (Z,) have come onto each link by now."""
        if time_s >= self._noted_s[self._last] + NOTED_S:
            self._last = (self._last + 1) % len(self._noted_s)
            self._noted_s[self._last], self._noted_veh[self._last] = time_s, came_veh

    def correct(self, time_s: float, came_veh: Floats, x_veh: Floats, seen_veh: Floats, far_veh: Floats) -> Floats:
        """(Z,) vehicles on each link, of `x_veh` (Z,) that were counted.

        `came_veh` (Z,) have come by now, as in `note`; `seen_veh` (Z,) are in sight, `far_veh` (Z,) of them in the
        farthest zone.
        """
        least_veh, most_veh = _recent(
            time_s, came_veh, self._last, self._noted_s, self._noted_veh, self._fast_s, self._slow_s
        )
        veh: Floats = _corrected(
            x_veh, came_veh, seen_veh, far_veh <= self._free_veh, least_veh, most_veh, self._all_come,
            self._unseen_veh, self._lanes, self._came_veh, self._gained, self._of, self._gain_since, self._came_since,
        )  # fmt: skip
        return veh


@compiled
def _recent(
    time_s: float, came_veh: Floats, last: int, noted_s: Floats, noted_veh: Floats, fast_s: Floats, slow_s: Floats
) -> tuple[Floats, Floats]:
    """(Z,) who came within the time of the fastest to where sight begins, (Z,) and within that of the slowest."""
    least_veh, most_veh = came_veh.copy(), came_veh.copy()
    moments = len(noted_s)
    for link in range(len(came_veh)):
        # From the last moment back to the first within the one time, and to the last before the other.
        early = late = last
        for back in range(1, moments):
            if noted_s[late] <= time_s - slow_s[link]:
                break
            late = (last - back) % moments
            if noted_s[late] >= time_s - fast_s[link]:
                early = late
        least_veh[link] = max(came_veh[link] - noted_veh[early, link], 0.0)
        most_veh[link] = max(came_veh[link] - noted_veh[late, link], 0.0)
    return least_veh, most_veh


@compiled
def _corrected(
    x_veh: Floats, came_veh: Floats, seen_veh: Floats, free: Bools, least_veh: Floats, most_veh: Floats,
    all_come: Bools, unseen_veh: Floats, lanes: Floats,
    came_before: Floats, gained: Floats, of: Floats, gain_since: Floats, came_since: Floats,
) -> Floats:  # fmt: skip
    """As Hidden.correct, (Z,) each, `free` where traffic flows; the last five are taken up to now."""
    can_be = np.empty_like(x_veh)
    for link in range(len(x_veh)):
        came = came_veh[link] - came_before[link]
        came_before[link] = came_veh[link]
        veh = x_veh[link] + min(max(gained[link] / (of[link] + KNOWN_VEH), -1.0), 1.0) * came
        hidden_veh = unseen_veh[link]
        if free[link]:
            low = min(least_veh[link], hidden_veh) if all_come[link] else 0.0
            high = min(most_veh[link], hidden_veh)
        else:
            low, high = -lanes[link], hidden_veh + lanes[link]
        veh = min(max(veh, seen_veh[link] + low), seen_veh[link] + high)
        gain_since[link] += veh - x_veh[link]
        came_since[link] += came
        if free[link]:
            gained[link] = KEPT_SHARE * gained[link] + gain_since[link]
            of[link] = KEPT_SHARE * of[link] + came_since[link]
            gain_since[link] = came_since[link] = 0.0
        can_be[link] = max(veh, 0.0)
    return can_be
