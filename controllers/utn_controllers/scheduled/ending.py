"""How far a schedule goes, and what it costs to leave somebody there at its end.

Else a change of stages late in it would not pay.

Who is left waits until the schedules after this one, the longer the more time a cycle loses to clearances. And others
wait for him: letting him go takes time of a stage, in which nobody else's vehicles leave. Where one stream has a lane
and the others many, that is the greater part of it, and a schedule that did not count it would skip the one stage in
every other cycle, and have its queue wait twice as long for a second or two of all others.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network

LEAST_STAYING_BINS = 5.0
"""Who is still there when a schedule ends waits so much longer, or more."""
QUICK_BINS, STAYING_OF_LOST = 2, 2.5
"""Of what the clearances of a cycle take so little does not count, of the rest so many times: as they, cycles grow."""
NEEDING_OF_STAYING = 1.4
"""So many times as long as he waits longer than that have others to wait who come while he is let go."""

FAR_BINS, FARTHER, FARTHEST_BINS = 9, 3.0, 60
"""For each bin more than so many that clearances take of a cycle, a schedule of a junction alone goes so many farther,
up to so many. One that ends before each stage has had its turn changes them more often than there is time for, and has
those wait of whom fewest leave in a bin."""


class Ending:
    """Keeps what a vehicle of each stream weighs that is left at a schedule's end."""

    def __init__(self, streams: Streams, lost_bins: Ints):
        """`lost_bins` (J,) are those of `lost`."""
        self._streams = streams
        self.staying_bins = staying(lost_bins)
        """(J,) that who is left waits longer."""
        self._staying = np.repeat(self.staying_bins, np.diff(streams.first))
        self._weight = NEEDING_OF_STAYING * (self.staying_bins - LEAST_STAYING_BINS)
        self._needing = np.zeros(len(streams.link))

    def take_up(self, come_veh: Floats, most_veh: Floats) -> None:
        """Go by these vehicles that come of late, and that a stream alone lets go, in a bin (N,) from now on."""
        streams = self._streams
        for junction, weight in enumerate(self._weight):
            own = slice(*streams.first[junction : junction + 2])
            serves = streams.serves[slice(*streams.first_stage[junction : junction + 2]), own]
            self._needing[own] = weight * needing(serves, come_veh[own], most_veh[own])

    def weights(self, worth: Floats) -> Floats:
        """(N,) what a vehicle weighs that is left, by what it is worth in a bin."""
        return np.asarray(worth * self._staying + self._needing)


def lost(first_stage: Ints, clearance: Ints) -> Ints:
    """(J,) bins that the clearances of a cycle take, by `Rules` of the junctions."""
    sizes = np.diff(first_stage)
    found = [
        sum(clearance[first + place, (place + 1) % size] for place in range(size))
        for first, size in zip(first_stage[:-1], sizes, strict=True)
    ]
    return np.array(found, dtype=np.int64)


def ahead_bins(network: Network, streams: Streams, bins: int, lost_bins: Ints) -> Ints:
    """(J,) bins that schedules have: so many, or more where the clearances of a cycle take `lost_bins` (J,).

    Not of junctions between which somebody goes: farther off all depends on what the neighbours do.
    """
    between = streams.next_link != EXIT
    more = FARTHER * np.maximum(lost_bins - FAR_BINS, 0)
    more[network.link_junction[streams.link[between]]] = 0
    more[network.link_junction[streams.next_link[between]]] = 0
    return np.rint(np.minimum(bins + more, max(FARTHEST_BINS, bins))).astype(np.int64)


def staying(lost_bins: Ints) -> Floats:
    """(J,) bins that who is left waits longer, by what clearances take."""
    return np.asarray(np.maximum(STAYING_OF_LOST * (lost_bins - QUICK_BINS), LEAST_STAYING_BINS))


def needing(serves: Bools, come: Floats, most: Floats) -> Floats:
    """(n,) others that come while one vehicle of each stream of a junction is let go, in its best stage.

    Less what it is for the stream with fewest: what all need alike makes no difference to who goes first, and counted
    in full it would draw out all greens. `serves` (s, n), vehicles that `come` (n,) and leave at `most` (n,) in a bin.
    """
    others, served = (~serves * come).sum(axis=1), serves.any(axis=0)
    found = np.zeros(len(come))
    found[served] = np.where(serves, others[:, None], np.inf)[:, served].min(axis=0) / most[served]
    found[served] -= found[served].min(initial=np.inf)
    return found
