"""Who turns off amid a link, at nodes without signals, and never comes to its stop line.

On a ring with signals where roads come onto it half of all do that left the signal before. To wait for them would draw
out greens for nobody. Loops count who comes onto a link and who leaves it amid it; as many will as did of late.

Not where others come onto the link amid it as well: these arrive instead, and who waits there for a gap finds one in
what longer greens let go, not in short ones.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.compiling import compiled
from utn_sumo.contract import ZONES_M, Floats, Network

MEMORY_S = 300.0
"""Over what time it is counted who turns off."""
KNOWN_VEH = 3.0
"""So many who came onto a link besides are thought to have gone on."""


class Parting:
    """Keeps how many of those who come onto a link leave it amid it."""

    def __init__(self, network: Network, bin_s: float):
        self._fading = 1 - bin_s / MEMORY_S
        self._ahead = np.array(
            [_ahead(link.length_m, () if link.joining else link.parting_m) for link in network.links]
        )
        """(Z, zones + 1) of the places at which a link's traffic parts the share that is ahead in each zone, then of
        those farther off."""
        self._is_any = bool(self._ahead.any())
        self._came_veh, self._off_veh = np.zeros((2, len(network.links)))
        """(Z,) that came of late, and that turned off."""
        self._came_before, self._off_before = np.zeros((2, len(network.links)))
        self.onward = np.ones_like(self._ahead)
        """(Z, zones + 1) share of those in each zone of a link who come to its stop line, then of those farther off."""

    def look(self, entered_veh: Floats, parted_veh: Floats) -> None:
        """A bin has gone by; so many (Z,) have come onto each link since the run began, and left it amid it."""
        if self._is_any:
            _look(
                entered_veh, parted_veh, self._came_before, self._off_before, self._fading, self._came_veh,
                self._off_veh, self._ahead, self.onward,
            )  # fmt: skip


@compiled
def _look(
    entered: Floats, parted: Floats, came_before: Floats, off_before: Floats, fading: float, came: Floats, off: Floats,
    ahead: Floats, onward: Floats,
) -> None:  # fmt: skip
    """Brings who `came` (Z,), who turned `off` (Z,) and who goes `onward` (Z, zones + 1) up to date."""
    for link in range(len(came)):
        came[link] = fading * came[link] + (entered[link] - came_before[link])
        off[link] = fading * off[link] + (parted[link] - off_before[link])
        came_before[link], off_before[link] = entered[link], parted[link]
        share = min(off[link] / (came[link] + KNOWN_VEH), 1.0)
        for place in range(ahead.shape[1]):
            onward[link, place] = 1 - share * ahead[link, place]


def _ahead(length_m: float, parting_m: tuple[float, ...]) -> Floats:
    """(zones + 1,) of places so far before the stop line the share that is ahead in each zone, and farther off."""
    places_m = np.unique(parting_m)
    if len(places_m) == 0:
        return np.zeros(len(ZONES_M) + 1)
    near, far = np.minimum([0.0, *ZONES_M[:-1]], length_m), np.minimum(ZONES_M, length_m)
    beyond = far - np.clip(places_m[:, None], near, far)
    share = np.where(far > near, beyond / np.maximum(far - near, 1e-9), 1.0)
    return np.append(share.mean(axis=0), 1.0)
