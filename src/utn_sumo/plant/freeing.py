"""Who stands amid a junction long into the next green is let out: those who pass him are stopped for a moment.

Who goes straight on and stood behind a turn that found no gap may get away only as the next road's green begins. He
creeps through its traffic then, while its own turns wait for him (inside.py); when these may wait no longer they come
to stand in his way, and he in theirs, and the junction is locked until somebody is taken off the road. So who still
stands there then is waited for a little longer, and after that all others have yellow and red until he is out. Where
that did not help something else stops him, and it is not tried again before he is gone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from utn_sumo.contract import Floats
from utn_sumo.plant.inside import Inside

MOST_STANDING_S = 5.0
"""So much longer turns wait for who stands there, or as long as the least green is; most get out by then."""
MOST_STOPPED_S = 6.0
"""Red for all takes no longer: by then he is over the junction, or does not get away by it."""


class Freeing:
    """Knows when all have to wait for who is stuck amid a junction, and what is shown meanwhile."""

    def __init__(self, inside: Inside, yellow_s: Sequence[Floats], least_green_s: Floats):
        """`yellow_s` has of each junction the yellow of each letter, `least_green_s` (S,) is each stage's."""
        self._inside = inside
        self._yellow_s = yellow_s
        self._standing_s = np.maximum(least_green_s, MOST_STANDING_S)
        """(S,) before others are stopped: whoever has got green before has had the least of it by then."""
        longest_s = max(float(each.max(initial=0.0)) for each in yellow_s)
        self.longest_s = float(self._standing_s.max()) + longest_s + MOST_STOPPED_S
        """By so much a stage may begin later."""
        self._stage: dict[int, int] = {}
        """To which each junction is led, if nobody would wait too long for that."""
        self._in_vain: set[int] = set()
        """Turns on which somebody stands whom red for all has not helped."""

    def leads(self, index: int, then: int, may: bool) -> None:
        """A junction goes to its stage `then`, which `may` begin later by `longest_s`."""
        self._stage.pop(index, None)
        if may:
            self._stage[index] = then

    def shows(self, index: int, now_s: float) -> str | None:
        """Letters while the stage that a junction is led to does not begin for who is stuck, none as soon as it may."""
        inside = self._inside
        since_s = inside.held_s(index, now_s)
        if since_s < 0 and not self._in_vain:
            return None
        behind = inside.behind(index)
        self._in_vain -= {turn for turn, stands in behind.items() if not stands}
        stuck = {turn for turn, stands in behind.items() if stands} - self._in_vain
        if since_s < 0 or index not in self._stage:
            return None
        stopped_s = since_s - float(self._standing_s[self._stage[index]])
        if stopped_s <= 0 and not stuck:
            return None
        if stopped_s < 0:
            return inside.shown(index)
        opened, cleared = inside.closing(index)
        own_s = {letter: float(self._yellow_s[index][letter]) for letter in opened}
        longest_s = max(own_s.values(), default=0.0)
        if stopped_s < longest_s or (stuck and stopped_s < longest_s + MOST_STOPPED_S):
            return "".join(
                shown if letter not in own_s else "y" if stopped_s < own_s[letter] else "r"
                for letter, shown in enumerate(cleared)
            )
        self._in_vain |= stuck
        return None
