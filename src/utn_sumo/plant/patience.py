"""Nobody waits too long: whatever is wished, whom the longest red threatens is served before.

Who waits has a time by which green has to come. As long as all can still be served in the order of these times, each
for the least green, a junction may stay where it is, or go where it likes and back in time; otherwise the first of
them is next (earliest deadline first).
"""

from __future__ import annotations

import numpy as np

from utn_sumo import callers, clearances
from utn_sumo.compiling import compiled
from utn_sumo.contract import SAMPLE_S, Bools, Floats, Ints, Network, View

LONGEST_RED_S = 180.0
"""Nobody is to wait longer without green, whatever is wished."""
PATIENCE = 5 / 6
"""Who has waited for such a share of it is served next; sooner where least greens and clearances are long."""
MOST_PATIENCE_S = PATIENCE * LONGEST_RED_S
STARTING_S = 10.0
"""Where SUMO takes vehicles off the road that stand for long, green comes so long before."""
LEAST_LONGEST_RED_S = 90.0
"""But where that is soon no sooner than this: there would be hardly any time for anything but clearances."""
LOOK_S = 5.0
"""Time between two looks at who waits, or a little more."""
PAUSE_S = SAMPLE_S
"""Who has stood so short a time ago waits still: in a queue that creeps nobody stands for a moment. Reports, which look
so often (metrics), have it so too."""


def longest_red_s(teleport_s: float) -> float:
    """The longest red where SUMO takes vehicles off the road that stand for `teleport_s`, or never if not positive."""
    if teleport_s <= 0:
        return LONGEST_RED_S
    return min(max(teleport_s - STARTING_S, LEAST_LONGEST_RED_S), LONGEST_RED_S)


class Patience:
    """Keeps since when somebody has been waiting on each way (W), a turn from a lane set, and each caller (C)."""

    def __init__(self, network: Network, held_s: Floats, longest_red_s: float = LONGEST_RED_S):
        """Stages of each junction may begin `held_s` (J,) later than the clearance before is over."""
        self._longest_red_s = longest_red_s
        self._way_set, ways = _ways(network)
        """(W,) lane set of each way."""
        self._needs = np.hstack([ways, callers.served(network)])
        """(S, W + C) which ways and which callers each stage has green for."""
        self._served = self._needs.any(axis=0)
        self._junction = network.stage_junction[self._needs.argmax(axis=0)]
        """(W + C,) whose stages these are."""
        longest_s = np.zeros(len(network.junctions))
        np.maximum.at(longest_s, network.stage_junction, network.clearance_s)
        self._leaves_s = (longest_s + held_s)[network.stage_junction]
        """(S,) from a stage's end until another one begins, whichever that is."""
        self._lasts_s = network.least_green_s + self._leaves_s
        """(S,) from a stage's begin until another one can begin."""
        all_s = np.bincount(network.stage_junction, self._lasts_s)
        self._carefree_s = np.clip(longest_red_s - LOOK_S - all_s, 0.0, PATIENCE * longest_red_s)
        """(J,) before somebody has waited so long all can be served, whoever they are and whatever is wished."""
        self._since_s = np.zeros(self._needs.shape[1])
        """(W + C,) since when somebody has been waiting for each, without green meanwhile."""
        self._stood_s = np.full(self._needs.shape[1], -np.inf)
        """(W + C,) when somebody was last seen standing before each."""
        self._look_s = 0.0
        """When it is looked again who waits."""
        self._next: dict[int, tuple[int, float]] = {}
        """By junction whose time may come the stage to serve first, and when it has to be led to at the latest."""
        self._warm_up(network)

    def allow(self, wish: Ints, stage: Ints, now_s: float) -> Ints:
        """(J,) the wish, but where somebody would have to wait for too long then: whom first, is served next.

        `stage` (J,) are the present ones.
        """
        allowed = wish
        for junction, (first, latest_s) in self._next.items():
            wished = wish[junction]
            back_s = 0.0 if wished == stage[junction] else self._lasts_s[wished]
            if wished != first and now_s + back_s + LOOK_S > latest_s:
                allowed = wish.copy() if allowed is wish else allowed
                allowed[junction] = first
        return allowed

    def spares(self, junction: int, now_s: float, seconds: float) -> bool:
        """Whether all who wait before a junction could be served in time if its next stage began `seconds` later."""
        since_s = self._since_s[self._junction == junction]
        return bool((since_s + self._carefree_s[junction] > now_s + seconds).all())

    def look(self, view: View) -> None:
        """See who waits, if it is time to."""
        if view.time_s < self._look_s:
            return
        # Among the looks are all those of reports: whom these see wait is known here.
        self._look_s = (view.time_s // LOOK_S + 1) * LOOK_S
        waits, troubled = _look(
            view.time_s, view.stage, view.set_waiting_veh, view.calling, self._way_set, self._needs, self._served,
            self._junction, self._carefree_s, self._stood_s, self._since_s,
        )  # fmt: skip
        self._next = {
            junction: self._first(
                int(view.stage[junction]), np.flatnonzero(waits & (self._junction == junction)), view.time_s
            )
            for junction in troubled.nonzero()[0].tolist()
        }

    def _warm_up(self, network: Network) -> None:
        """Have the machine code made now, not at the first look."""
        stage = np.array([junction.stages[0] for junction in network.junctions], dtype=np.int64)
        _look(
            0.0, stage, np.zeros(len(network.lane_sets)), np.zeros(len(network.callers)), self._way_set, self._needs,
            self._served, self._junction, self._carefree_s, self._stood_s.copy(), self._since_s.copy(),
        )  # fmt: skip

    def _first(self, present: int, waiting: Ints, now_s: float) -> tuple[int, float]:
        """The stage to serve first of those that those `waiting` need, and when it has to be led to at the latest."""
        left = waiting[np.lexsort((-waiting, self._since_s[waiting]))]
        is_late = self._since_s[left[0]] + PATIENCE * self._longest_red_s <= now_s
        latest_s, opens_s, stages = -np.inf if is_late else np.inf, self._leaves_s[present], []
        while len(left):
            latest_s = min(latest_s, self._since_s[left[0]] + self._longest_red_s - opens_s)
            # Of those that serve whoever waits the longest: the one that most others wait for too.
            stage = int(np.argmax(np.where(self._needs[:, left[0]], self._needs[:, left].sum(axis=1), -1)))
            stages.append(stage)
            left = left[~self._needs[stage, left]]
            opens_s += self._lasts_s[stage]
        return stages[0], float(latest_s)


@compiled
def _look(
    time_s: float, stage: Ints, waiting: Floats, calling: Floats, way_set: Ints, needs: Bools, served: Bools,
    junction: Ints, carefree_s: Floats, stood_s: Floats, since_s: Floats,
) -> tuple[Bools, Bools]:  # fmt: skip
    """(W + C,) who waits without green, (J,) where somebody's time may come; keeps `stood_s` and `since_s`."""
    waits, troubled = np.zeros(len(since_s), np.bool_), np.zeros(len(carefree_s), np.bool_)
    for each in range(len(since_s)):
        there = waiting[way_set[each]] if each < len(way_set) else calling[each - len(way_set)]
        if there > 0:
            stood_s[each] = time_s
        is_red = served[each] and not needs[stage[junction[each]], each]
        waits[each] = time_s - stood_s[each] <= PAUSE_S and is_red
        if not waits[each]:
            since_s[each] = time_s
        elif since_s[each] + carefree_s[junction[each]] <= time_s:
            troubled[junction[each]] = True
    return waits, troubled


def _ways(network: Network) -> tuple[Ints, Bools]:
    """(W,) lane set of each way from one to a turn, (S, W) whether a stage has green for it."""
    ways = sorted(
        (turn, lane_set, letters)
        for lane_set, each in enumerate(network.lane_sets)
        for turn, letters in zip(each.turns, each.letters, strict=True)
    )
    way_set = np.array([lane_set for _, lane_set, _ in ways], dtype=np.int64)
    way_junction = network.link_junction[network.set_link[way_set]]
    green = np.zeros((len(network.stages), len(ways)), dtype=np.bool_)
    for index, stage in enumerate(network.stages):
        for way in np.flatnonzero(way_junction == stage.junction):
            green[index, way] = any(stage.state[letter] in clearances.GREEN for letter in ways[way][2])
    return way_set, green
