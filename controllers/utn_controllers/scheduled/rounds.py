"""Where far more are there than can go at a junction apart, each stage has its turn once before any has a second one.

A schedule reaches two or three greens. Of four queues or more that are all too long for it, it would show those again
and again that are worth a little more, for less and less long.

Not where a road has green in more than one stage: those who turn left from it are few, and are let go less often. Nor
where fewer are there: then the stage comes next that has a platoon.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints

FEWEST_STAGES = 4
"""Of three stages a schedule sees most: by turns they had 0.98 to 1.05 of the delay."""
FAR_BEYOND = 0.9
"""A junction is far over capacity with more to let go beyond its schedule than so many times what the schedule has."""


class Rounds:
    """Keeps when each stage was last shown."""

    def __init__(self, streams: Streams, follows: Bools, ahead_bins: Ints):
        """Of stages that may follow each other as in `Rules`, and schedules with so many bins (J,)."""
        self._may = have_rounds(streams, follows)
        self._most_bins = FAR_BEYOND * ahead_bins
        self.shown_s = np.full(len(streams.stage), -np.inf)
        """(S,) when each stage was last seen."""

    def look(self, time_s: float, present: Ints, beyond_bins: Floats) -> Bools:
        """(J,) junctions that go by turns now, of which rows `present` (J,) are shown.

        With so many bins (J,) of green in need beyond their schedules.
        """
        self.shown_s[present] = time_s
        return np.asarray(self._may & (beyond_bins > self._most_bins))


def have_rounds(streams: Streams, follows: Bools) -> Bools:
    """(J,) junctions with many stages, of which no link has green in two and any may follow any, as in `Rules`."""
    found = np.zeros(len(streams.first) - 1, dtype=np.bool_)
    for junction in range(len(found)):
        rows = slice(*streams.first_stage[junction : junction + 2])
        own = slice(*streams.first[junction : junction + 2])
        serves, link = streams.serves[rows, own], streams.link[own]
        free = follows[rows, : len(serves)].all()
        apart = all(serves[:, link == each].any(axis=1).sum() <= 1 for each in np.unique(link))
        found[junction] = free and apart and len(serves) >= FEWEST_STAGES
    return found


@compiled
def in_turn(called: Bools, present: int, shown_s: Floats) -> Bools:
    """(s, s) whether of stages that are `called` (s,) the one may follow the other: who was shown longest ago is first.

    After the `present` one, which is the last; `shown_s` (s,) is when.
    """
    follows = np.zeros((len(called), len(called)), np.bool_)
    before = present
    for stage in np.argsort(shown_s, kind="mergesort"):
        if called[stage] and stage != present:
            follows[before, stage] = True
            before = stage
    follows[before, present] = True
    return follows
