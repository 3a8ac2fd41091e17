"""How fast those go who have green and must give way: as fast as they have gone of late.

A left turn that waits for gaps in what comes towards it hardly moves while that has a queue. Where another stage has
it to itself, that one is to be shown in time.

On a road of one lane not a stage that serves a part of it, as its left turns alone: that lets nobody go any more once
somebody who drives on is in front. Each green of the whole road lets all in front of the first left turn go, and that
one as it ends, so that short greens in turn let more go than such stages (gaps.py). Learnt to be slow, that green
would have to make room for them.

A lane with others beside it, from which some turn in such gaps over a road on which people walk, goes all green long at
a third or a half of what it could, and while who walks is cleared too: what comes towards it is held up as well, so
that there are more gaps than it would leave by itself, and who found one may have to wait again. Taken to go fast as a
green begins and to stand when some wait (gaps.py), it would have another green whenever it stands, with all that
clearances take.

Nor does a lane with others beside it go as it could in a stage that serves a part of it, as an arrow for left turns
from a lane shared with who drives straight on: it goes until the first of the others is in front. How far that is on
average is learnt too.

And who has green does not go at all while the first of his lane has red. Where a stage serves a part of a lane set and
nobody of its queue has gone for a while, in one green or in several short ones, somebody of the other part is in front:
that stage, and whichever serves no more of the lane set, is of no use until another one has let somebody go.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.moves import Moves
from utn_controllers.scheduled.standstill import START_S, Shown
from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import GIVES_WAY, GREEN, HAS_WAY
from utn_sumo.compiling import compiled, inlined
from utn_sumo.contract import Bools, Floats, Ints, Network

MEMORY_S, WALKED_MEMORY_S = 10.0, 120.0
"""Over how much green before a queue its flow is taken, and that of lanes that who walks holds up besides: theirs
is what they have on average, whoever is in front."""
FORGET_S, WALKED_FORGET_S = 300.0, 900.0
"""Over how long what it was is forgotten, and the whole discharge expected again."""
LEAST_SHARE = 0.05
"""Of the discharge: somebody may always find a gap."""
BLOCKED_S = 6.0
"""After so much green in which nobody of a queue went it is known that who is in front has red."""


class Yielding:
    """Keeps which share of its discharge each lane set has in stages in which it gives way, or in part has red."""

    def __init__(self, network: Network, streams: Streams, moves: Moves):
        """What each stream has of its discharge in `moves` is kept up to date."""
        self._network, self._streams, self._moves = network, streams, moves.share
        self._partly = _partly(streams, len(network.lane_sets))
        """(S, L) lane sets of which a stage serves a part."""
        in_part = _give_way(network, streams, self._partly)
        among = _among_walkers(network, streams) & ~in_part
        self.learnt = in_part | among | (self._partly & _beside(network)[network.set_link])
        """(S, L) lane sets that must give way in a stage, and not in another one or to who walks besides, and with
        others beside them those of which it serves a part: whose share is learnt."""
        self._memory_s = np.where(among, WALKED_MEMORY_S, MEMORY_S)
        self._forget_s = np.where(among, WALKED_FORGET_S, FORGET_S)
        self._cleared = _cleared(streams, moves, among)
        self._cleared_share = moves.share[self._cleared[:2]]
        self._stood_s = np.zeros((len(network.lane_sets), int(np.diff(streams.first_stage).max())))
        """(L, most stages of a junction) each one's green since somebody left, or nobody was by the stop line, last."""
        self._share = np.ones(self.learnt.shape)
        """(S, L) of the discharge."""
        self._queued = np.zeros(len(network.lane_sets), dtype=np.bool_)
        """(L,) lane sets that had somebody by the stop line when they were last looked at."""
        self._looked_s = np.zeros(len(network.junctions))
        """(J,) when that was."""
        self._left_veh = np.zeros(len(network.lane_sets))
        """(L,) who had left by then."""
        self._is_needed = bool(self.learnt.any() or self._partly.any())

    def look(self, view: Shown, asked: Bools, present: Ints, zone: Floats) -> None:
        """Take up who has gone before the junctions `asked` (J,) in their `present` stage, the row (J,) that it is.

        `zone` (L, zones) of View.zone_veh.
        """
        if self._is_needed:
            network, streams = self._network, self._streams
            _learn(
                view.time_s, asked, present, view.begin_s, view.left_veh, zone[:, 0],
                network.set_saturation_flow_veh_s, network.link_junction[network.set_link], self.learnt, self._partly,
                self._memory_s, self._forget_s, self._share, self._stood_s, self._queued, self._looked_s,
                self._left_veh, streams.lane_set, streams.first, streams.first_stage, streams.serves, self._moves,
            )  # fmt: skip
            row, place, stage, lane_set = self._cleared
            if len(row):
                self._moves[row, place] = self._cleared_share * self._share[stage, lane_set]


def _beside(network: Network) -> Bools:
    """(Z,) links of more lane sets than one."""
    return np.asarray(np.bincount(network.set_link, minlength=len(network.links)) > 1)


def _give_way(network: Network, streams: Streams, partly: Bools) -> Bools:
    """(S, L) lane sets of which somebody must give way in a stage, and nobody in another one of the junction's.

    On roads of one lane set nor in one that serves a part of it: `partly` (S, L).
    """
    gives_way = np.zeros((len(streams.stage), len(network.lane_sets)), dtype=np.bool_)
    has_way = np.zeros_like(gives_way)
    for row, stage in enumerate(streams.stage):
        state = network.stages[stage].state
        for stream in np.flatnonzero(streams.serves[row]):
            letters = [state[letter] for letter in streams.letters[stream]]
            (gives_way if GIVES_WAY in letters else has_way)[row, streams.lane_set[stream]] = True
    alone = np.zeros((len(network.junctions), len(network.lane_sets)), dtype=np.bool_)
    junction = network.stage_junction[streams.stage]
    np.logical_or.at(alone, junction, has_way & ~gives_way & (_beside(network)[network.set_link] | ~partly))
    return np.asarray(gives_way & alone[junction])


def _among_walkers(network: Network, streams: Streams) -> Bools:
    """(S, L) lane sets with others beside them of which somebody gives way to other traffic while people walk.

    Of a single lane all wait for the first: it goes as gaps.py has it.
    """
    beside = _beside(network)
    found = np.zeros((len(streams.stage), len(network.lane_sets)), dtype=np.bool_)
    for row, stage in enumerate(streams.stage):
        junction, state = network.junctions[network.stage_junction[stage]], network.stages[stage].state
        if not any(state[letter] in GREEN for letter in junction.crossings):
            continue
        having = [letter for letter, turns in enumerate(junction.signal_turns) if turns and state[letter] == HAS_WAY]
        for stream in np.flatnonzero(streams.serves[row] & beside[streams.link]):
            giving = (letter for letter in streams.letters[stream] if state[letter] == GIVES_WAY)
            found[row, streams.lane_set[stream]] |= any(junction.conflicts[a][b] for a in giving for b in having)
    return found


def _cleared(streams: Streams, moves: Moves, among: Bools) -> tuple[Ints, Ints, Ints, Ints]:
    """Where lane sets that are `among` (S, L) those who walk go on in clearances.

    Rows of `Moves` and places of streams there, rows of the stages before and the lane sets.
    """
    going_on, lane_set = np.zeros(moves.share.shape, dtype=np.bool_), np.zeros(moves.share.shape, dtype=np.int64)
    for row in np.flatnonzero(moves.after >= 0):
        stage = moves.after[row]
        junction = np.searchsorted(streams.first_stage, stage, side="right") - 1
        own = slice(*streams.first[junction : junction + 2])
        sets = streams.lane_set[own]
        lane_set[row, : len(sets)] = sets
        going_on[row, : len(sets)] = streams.serves[stage, own] & among[stage, sets]
    rows, places = (going_on & (moves.share > 0)).nonzero()
    return rows, places, moves.after[rows], lane_set[rows, places]


def _partly(streams: Streams, sets: int) -> Bools:
    """(S, L) lane sets of which some streams have green in a stage and some have red."""
    some = np.zeros((len(streams.stage), sets), dtype=np.bool_)
    some_not = np.zeros_like(some)
    for stream, lane_set in enumerate(streams.lane_set):
        some[:, lane_set] |= streams.serves[:, stream]
        some_not[:, lane_set] |= ~streams.serves[:, stream]
    return np.asarray(some & some_not)


@compiled
def _learn(
    time_s: float, asked: Bools, present: Ints, begin_s: Floats, left: Floats, near: Floats, flow: Floats,
    set_junction: Ints, gives_way: Bools, partly: Bools, memory_s: Floats, forget_s: Floats, share: Floats,
    stood_s: Floats, queued: Bools, looked_s: Floats, before: Floats, stream_set: Ints, first: Ints, first_stage: Ints,
    serves: Bools, moves: Floats,
) -> None:  # fmt: skip
    for lane_set, junction in enumerate(set_junction):
        if not asked[junction]:
            continue
        row, since_s = present[junction], time_s - looked_s[junction]
        for stage in range(first_stage[junction], first_stage[junction + 1]):
            share[stage, lane_set] += min(since_s / forget_s[stage, lane_set], 1.0) * (1 - share[stage, lane_set])
        if gives_way[row, lane_set] and queued[lane_set] and looked_s[junction] >= begin_s[junction] + START_S:
            gone = (left[lane_set] - before[lane_set]) / (flow[lane_set] * since_s)
            now = share[row, lane_set] + min(since_s / memory_s[row, lane_set], 1.0) * (gone - share[row, lane_set])
            share[row, lane_set] = min(max(now, LEAST_SHARE), 1.0)
        if left[lane_set] > before[lane_set] or near[lane_set] < 1:
            stood_s[lane_set] = 0.0
        elif partly[row, lane_set]:
            stood_s[lane_set, row - first_stage[junction]] += min(since_s, time_s - begin_s[junction])
        queued[lane_set] = near[lane_set] >= 1
        before[lane_set] = left[lane_set]
    for junction in range(len(asked)):
        if asked[junction]:
            looked_s[junction] = time_s
            _tell(
                first[junction], first[junction + 1], first_stage[junction], first_stage[junction + 1], stream_set,
                serves, gives_way, partly, share, stood_s, moves,
            )  # fmt: skip


@inlined
def _tell(
    first: int, last: int, first_stage: int, last_stage: int, stream_set: Ints, serves: Bools, gives_way: Bools,
    partly: Bools, share: Floats, stood_s: Floats, moves: Floats,
) -> None:  # fmt: skip
    """Puts what is known of one junction's lane sets into its `moves`."""
    for stage in range(first_stage, last_stage):
        for stream in range(first, last):
            lane_set = stream_set[stream]
            if serves[stage, stream] and (gives_way[stage, lane_set] or partly[stage, lane_set]):
                is_blocked = (
                    partly[stage, lane_set]
                    and _known_s(first, last, first_stage, last_stage, stage, lane_set, stream_set, serves, stood_s)
                    >= BLOCKED_S
                )
                moves[stage, stream - first] = LEAST_SHARE if is_blocked else share[stage, lane_set]


@inlined
def _known_s(
    first: int, last: int, first_stage: int, last_stage: int, stage: int, lane_set: int, stream_set: Ints,
    serves: Bools, stood_s: Floats,
) -> float:  # fmt: skip
    """For how long nobody of a lane set has gone in this stage or in one that serves as much of it and more [s]."""
    known_s = 0.0
    for tried in range(first_stage, last_stage):
        stood = stood_s[lane_set, tried - first_stage]
        if stood > 0:
            for stream in range(first, last):
                if stream_set[stream] == lane_set and serves[stage, stream] and not serves[tried, stream]:
                    stood = 0.0
            known_s += stood
    return known_s
