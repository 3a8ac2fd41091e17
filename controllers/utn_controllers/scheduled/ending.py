"""How far a schedule goes, and what it costs to leave somebody there at its end.

Else a change of stages late in it would not pay.

Who is left waits until the schedules after this one, the longer the more time a cycle loses to clearances. And others
wait for him: letting him go takes time of a stage, in which nobody else's vehicles leave. Where one stream has a lane
and the others many, that is the greater part of it, and a schedule that did not count it would skip the one stage in
every other cycle, and have its queue wait twice as long for a second or two of all others.

At a junction apart (`are_apart`) where more are there and will come than can go in a schedule, all who come until they
have gone wait for as long as it takes to let one more go. At capacity that is long, and a schedule that did not count
it would change its stages as if there were time to spare: those of many lanes again and again, while the queue of a
single lane grows.

Not quite as long if he has green at the end: he goes without another clearance, and the longer greens last, the fewer
there are of these. Else it would be all the same when a schedule changes from one long queue to another, since that
costs it one clearance in any case, and whichever road is a little fuller would have green too soon.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations, pairwise

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import HAS_WAY
from utn_sumo.compiling import compiled, inlined
from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network

LEAST_STAYING_BINS = 5.0
"""Who is still there when a schedule ends waits so much longer, or more."""
QUICK_BINS, STAYING_OF_LOST = 2, 2.5
"""Of what the clearances of a cycle take so little does not count, of the rest so many times: as they, cycles grow."""
NEEDING_OF_STAYING = 1.4
"""So many times as long as he waits longer than that have others to wait who come while he is let go."""
MOST_LOAD, LONGEST_BUSY_BINS = 0.9, 150.0
"""With a greater load a junction would be busy for ever: it is taken for no more, and for so long at most."""
OPEN = 0.9
"""So many times as long all wait for who is left with green."""
LEAST_LOAD, NONE_BINS = 1e-6, 1e-9
"""Who hardly comes needs some green too; green that is none."""

FAR_BINS, FARTHER, FARTHEST_BINS = 9, 3.0, 60
"""For each bin more than so many that clearances take of a cycle, a schedule goes so many farther, up to so many, where
it may. One that ends before each stage has had its turn changes them more often than there is time for, and has those
wait of whom fewest leave in a bin."""
FAR_FILLING_S, NEXT_FILLING_S = 60.0, 20.0
"""It may where the roads ahead take all that leaves in such a time, and those beyond the next signals in such a one:
what is let go in longer greens has to get on from there."""
APART_STAGES = 4
"""A junction among others can be apart if it has so many stages: of three a schedule sees most."""
FILLING_S = 84.0
"""Time in which the queues before it would fill each road ahead, at their saturation flows, if nobody left that."""
OUTSIDE = 0.5
"""Share of its roads that come from outside, or more."""


class Ending:
    """Keeps what a vehicle of each stream weighs that is left at a schedule's end."""

    def __init__(self, streams: Streams, lost_bins: Ints, ahead_bins: Ints, apart: Bools):
        """Of `lost`, how far schedules go, and `are_apart` (J,)."""
        self._streams = streams
        self._lost_bins, self._ahead_bins, self._apart = lost_bins, ahead_bins, apart
        self.staying_bins = staying(lost_bins)
        """(J,) that who is left waits longer."""
        self._staying = np.repeat(self.staying_bins, np.diff(streams.first))
        self._weight = NEEDING_OF_STAYING * (self.staying_bins - LEAST_STAYING_BINS)
        self._needing = np.zeros(len(streams.link))
        self._come, self._lanes = np.zeros(len(streams.link)), np.ones(len(streams.link))

    def take_up(self, come_veh: Floats, most_veh: Floats, lanes_veh: Floats) -> None:
        """Go by these vehicles of each stream (N,) in a bin from now on.

        That come of late, that its lane group lets go at most, and that its own lanes do.
        """
        streams = self._streams
        self._come, self._lanes = come_veh, lanes_veh
        for junction, weight in enumerate(self._weight):
            own = slice(*streams.first[junction : junction + 2])
            serves = streams.serves[slice(*streams.first_stage[junction : junction + 2]), own]
            self._needing[own] = weight * needing(serves, come_veh[own], most_veh[own])

    def beyond_bins(self, asked: Bools, stand: Floats, come: Floats) -> Floats:
        """(J,) that those of `asked` (J,) that are apart need beyond their schedules to let all go; else none.

        `stand` (N,), `come` (N, K) vehicles as of `schedules`.
        """
        if not self._apart.any():
            return np.zeros(len(asked))
        streams = self._streams
        return np.asarray(
            beyond(
                asked & self._apart, self._ahead_bins, self._lost_bins, streams.first, streams.first_stage,
                streams.serves, streams.lane_set, self._lanes, stand, come,
            )
        )  # fmt: skip

    def weights(self, worth: Floats, beyond_bins: Floats) -> tuple[Floats, Floats]:
        """(N,) what a vehicle weighs that is left, by what it is worth in a bin and so many bins beyond schedules (J,).

        And (N,) one that has green then, and goes freely.
        """
        ends = worth * self._staying + self._needing
        if not beyond_bins.any():
            return ends, ends
        streams = self._streams
        longer = prices(
            beyond_bins, streams.first, streams.first_stage, streams.serves, streams.lane_set, self._come, self._lanes
        )
        return ends + longer, ends + OPEN * longer


@compiled
def beyond(
    asked: Bools, ahead_bins: Ints, lost_bins: Ints, first: Ints, first_stage: Ints, serves: Bools, lane_set: Ints,
    most: Floats, stand: Floats, come: Floats,
) -> Floats:  # fmt: skip
    """(J,) bins that junctions `asked` (J,) need beyond their schedules, until all have gone who are there or come.

    Of `ahead_bins` (J,) clearances take `lost_bins` (J,) or more. `serves` (S, N), `lane_set` (N,), vehicles that leave
    its lanes at `most` (N,) in a bin, that `stand` (N,) and `come` (N, K).
    """
    found = np.zeros(len(asked))
    for junction in range(len(asked)):
        if asked[junction]:
            a, b, ahead = first[junction], first[junction + 1], ahead_bins[junction]
            own = serves[first_stage[junction] : first_stage[junction + 1], a:b]
            work = (stand[a:b] + come[a:b, :ahead].sum(axis=1)) / most[a:b]
            found[junction] = max(greens(own, _by_lanes(work, lane_set[a:b])) + lost_bins[junction] - ahead, 0.0)
    return found


@compiled
def prices(
    beyond_bins: Floats, first: Ints, first_stage: Ints, serves: Bools, lane_set: Ints, rate: Floats, most: Floats
) -> Floats:
    """(N,) vehicles times bins that others wait longer for each that is left at a junction busy beyond its schedule.

    It is so until all have gone who are there then or come meanwhile. Who comes until then waits for the time that one
    more of a stream takes in its best stage: of those who go together there each lane set has its part of it, by their
    loads.

    `beyond_bins` (J,), `serves` (S, N), `lane_set` (N,), vehicles that come of late at a `rate` (N,) and leave its
    lanes at `most` (N,) in a bin.
    """
    found = np.zeros(len(rate))
    for junction in range(len(beyond_bins)):
        if beyond_bins[junction] <= 0:
            continue
        a, b = first[junction], first[junction + 1]
        own = serves[first_stage[junction] : first_stage[junction + 1], a:b]
        load = np.maximum(rate[a:b] / most[a:b], LEAST_LOAD)
        loads = _by_lanes(load, lane_set[a:b])
        busy = min(beyond_bins[junction] / (1 - min(greens(own, loads), MOST_LOAD)), LONGEST_BUSY_BINS)
        for stream in range(b - a):
            part = np.inf
            for stage in range(len(own)):
                if own[stage, stream]:
                    part = min(part, loads[stream] / (own[stage] * load).sum())
            if part < np.inf:
                found[a + stream] = rate[a:b].sum() * busy * min(part, 1.0) / most[a + stream]
    return found


@inlined
def _by_lanes(own: Floats, lane_set: Ints) -> Floats:
    """(n,) of each stream what all together have that share its lanes."""
    total = np.zeros(len(own))
    for stream in range(len(own)):
        for other in range(len(own)):
            if lane_set[other] == lane_set[stream]:
                total[stream] += own[other]
    return total


@compiled
def greens(serves: Bools, needed: Floats) -> float:
    """Bins of green in which all streams of a junction have as many as are `needed` (n,), by its stages (s, n).

    Who needs most comes first, in that of his stages that others need most too: seldom more than would have to be.
    """
    left, total = needed.copy(), 0.0
    for stream in range(len(left)):
        if not serves[:, stream].any():
            left[stream] = 0.0
    while len(left) > 0 and left.max() > NONE_BINS:
        first, best, others = int(left.argmax()), -1, -1.0
        lasts = left[first]
        for stage in range(len(serves)):
            also = (serves[stage] * left).sum()
            if serves[stage, first] and also > others:
                best, others = stage, also
        for stream in range(len(left)):
            if serves[best, stream]:
                left[stream] = max(left[stream] - lasts, 0.0)
        total += lasts
    return total


def lost(first_stage: Ints, clearance: Ints, drives: Bools) -> Ints:
    """(J,) bins that the clearances of a cycle take, by `Rules` of the junctions.

    Of the stages in which motor traffic `drives` (S,), where there are several: one for people alone is shown when
    somebody calls for it.
    """
    found = []
    for first, last in pairwise(first_stage):
        driven = [place for place in range(last - first) if drives[first + place]]
        shown = driven if len(driven) > 1 else range(last - first)
        found.append(sum(clearance[first + place, then] for place, then in _turns(shown)))
    return np.array(found, dtype=np.int64)


def lost_at_least(first_stage: Ints, clearance: Ints, has_way: Bools) -> Ints:
    """(J,) bins that clearances take of the shortest cycle in which all streams have way at their stages (S, N).

    It has as few stages as can be, two or more. Where traffic may go round a junction in several ways, as with a stage
    for each arm besides those of opposite ones, schedules need not reach them all.
    """
    found = []
    for first, last in pairwise(first_stage):
        own = has_way[first:last, has_way[first:last].any(axis=0)]
        alone = own[:, own.sum(axis=0) == 1].any(axis=1)
        always: list[int] = np.flatnonzero(alone).tolist()
        others: list[int] = np.flatnonzero(~alone).tolist()
        cycles: list[list[int]] = []
        for count in range(max(2 - len(always), 0), len(others) + 1):
            each = (sorted([*always, *more]) for more in combinations(others, count))
            cycles = [cycle for cycle in each if own[cycle].any(axis=0).all()]
            if cycles:
                break
        found.append(min((sum(clearance[first + a, b] for a, b in _turns(cycle)) for cycle in cycles), default=0))
    return np.array(found, dtype=np.int64)


def _turns(cycle: Sequence[int]) -> Iterable[tuple[int, int]]:
    return zip(cycle, [*cycle[1:], *cycle[:1]], strict=True)


def have_way(network: Network, streams: Streams) -> Bools:
    """(S, N) whether a stage gives a stream way, or green where no stage gives it way."""
    way = np.zeros_like(streams.serves)
    for row, stage in enumerate(streams.stage):
        state = network.stages[stage].state
        for stream in np.flatnonzero(streams.serves[row]):
            way[row, stream] = any(state[letter] == HAS_WAY for letter in streams.letters[stream])
    return np.where(way.any(axis=0), way, streams.serves)


def are_alone(network: Network, streams: Streams) -> Bools:
    """(J,) junctions from which nobody goes on to another one, or comes from there.

    Elsewhere all that is farther off depends on what the neighbours do.
    """
    between = streams.next_link != EXIT
    alone = np.ones(len(network.junctions), dtype=np.bool_)
    alone[network.link_junction[streams.link[between]]] = False
    alone[network.link_junction[streams.next_link[between]]] = False
    return alone


def are_apart(network: Network, streams: Streams, alone: Bools) -> Bools:
    """(J,) junctions at which more greens than those of a schedule count: those `alone` (J,) and others like them.

    Longer greens save clearances, but fill the roads ahead. So it pays where these take all that leaves in a long green
    and most who come are from outside, not where somebody waits unseen behind a road: how much is to be let go is not
    known there.
    """
    count, links = len(alone), np.bincount(network.link_junction, minlength=len(alone))
    fed = np.zeros(len(network.links), dtype=np.bool_)
    fed[streams.next_link[streams.next_link != EXIT]] = True
    from_others = np.bincount(network.link_junction, fed, count)
    apart = (np.diff(streams.first_stage) >= APART_STAGES) & (from_others <= (1 - OUTSIDE) * links)
    apart[filling_s(network, streams) < FILLING_S] = False
    apart[network.link_junction[network.begins_amid]] = False
    return np.asarray(apart | alone)


def are_far(network: Network, streams: Streams) -> Bools:
    """(J,) junctions whose schedules may go farther where clearances take long: with room ahead, and beyond that."""
    ahead_s, beyond_s = filling_s(network, streams), np.full(len(network.junctions), np.inf)
    onward = streams.next_link != EXIT
    here, there = (network.link_junction[links[onward]] for links in (streams.link, streams.next_link))
    np.minimum.at(beyond_s, here, ahead_s[there])
    return np.asarray((ahead_s >= FAR_FILLING_S) & (beyond_s >= NEXT_FILLING_S))


def filling_s(network: Network, streams: Streams) -> Floats:
    """(J,) time in which a queue before each junction would fill a road ahead, if nobody left that [s].

    Of its lanes, at their saturation flow, and of the road that is full first; infinite where none leads to a signal.
    """
    onward = streams.next_link != EXIT
    flow_veh_s = network.set_saturation_flow_veh_s[streams.lane_set[onward]]
    found = np.full(len(network.junctions), np.inf)
    here = network.link_junction[streams.link[onward]]
    np.minimum.at(found, here, network.storage_veh[streams.next_link[onward]] / flow_veh_s)
    return found


def ahead_bins(far: Bools, bins: int, lost_bins: Ints) -> Ints:
    """(J,) bins that schedules have: so many, or more of junctions that `are_far` (J,) whose cycles lose many."""
    more = FARTHER * np.maximum(lost_bins - FAR_BINS, 0) * far
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
