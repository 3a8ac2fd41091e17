"""Who turns off amid a link, at nodes without signals, and never comes to its stop line.

On a ring with signals where roads come onto it half of all do that left the signal before, and before a signal behind
side streets some. To wait for them would draw out greens for nobody. Loops count who comes onto a link and who leaves
it amid it; as many will as did of late.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import ZONES_M, Floats, Network

MEMORY_S = 300.0
"""Over what time it is counted who turns off."""
KNOWN_VEH = 3.0
"""So many who came onto a link besides are thought to have gone on."""


class Parting:
    """Keeps how many of those who come onto a link leave it amid it."""

    def __init__(self, network: Network, bin_s: float):
        self._fading = 1 - bin_s / MEMORY_S
        self._ahead = np.array([_ahead(link.length_m, link.parting_m) for link in network.links])
        """(Z, zones + 1) of the places at which a link's traffic parts the share that is ahead in each zone, then of
        those farther off."""
        self._is_any = bool(self._ahead.any())
        self._came_veh, self._off_veh = np.zeros((2, len(network.links)))
        """(Z,) that came of late, and that turned off."""
        self._before = np.zeros((2, len(network.links)))
        self.onward = np.ones_like(self._ahead)
        """(Z, zones + 1) share of those in each zone of a link who come to its stop line, then of those farther off."""

    def look(self, entered_veh: Floats, parted_veh: Floats) -> None:
        """A bin has gone by; so many (Z,) have come onto each link since the run began, and left it amid it."""
        if not self._is_any:
            return
        came, off = entered_veh - self._before[0], parted_veh - self._before[1]
        self._before = np.array([entered_veh, parted_veh])
        self._came_veh = self._fading * self._came_veh + came
        self._off_veh = self._fading * self._off_veh + off
        share = np.minimum(self._off_veh / (self._came_veh + KNOWN_VEH), 1.0)
        self.onward = 1 - share[:, None] * self._ahead


def _ahead(length_m: float, parting_m: tuple[float, ...]) -> Floats:
    """(zones + 1,) of places so far before the stop line the share that is ahead in each zone, and farther off."""
    places_m = np.unique(parting_m)
    if len(places_m) == 0:
        return np.zeros(len(ZONES_M) + 1)
    near, far = np.minimum([0.0, *ZONES_M[:-1]], length_m), np.minimum(ZONES_M, length_m)
    beyond = far - np.clip(places_m[:, None], near, far)
    share = np.where(far > near, beyond / np.maximum(far - near, 1e-9), 1.0)
    return np.append(share.mean(axis=0), 1.0)
