"""Who has green and must give way to what comes towards him: he goes in its gaps.

How long he waits for one is Adams' (1936) for Poisson traffic in which a gap must last some time: the longer the more
come, so that a green is worth most when it has lasted. Behind who waits stand all on his lane: it goes by as much
faster as fewer of it wait.

Who waits does so amid the junction, and clears it when the green ends: where nobody finds a gap, that is all who go
(the Highway Capacity Manual's sneakers), and the more greens the more.

Two roads of one lane that face each other both go until somebody waits on one of them. From then on what one lane
discharges is all that both have, as long as both queues last: who waits lets those go by who face him until one of them
waits too, then both turn. That is nearly so however many turn left (in SUMO 0.8 veh/s on both lanes in the first 4 s
and 0.42 from then on, whether 11 or 41 % do), and the lane goes the more of which fewer do. As the green ends one of
both waits amid the junction; where who comes towards a lane is no queue, it goes on average and nobody is taken to wait
there. Behind a road that is full neither is so: who goes onto it stands in the way.

With other lanes beside it that average will not do: a lane goes until the first who waits comes to its front, then it
stands while the others go, and a green that is kept for what it would let go on average is kept for long. Which lanes
stand in the present green is seen by who has left them.

So it is behind a short road that is full, as between the two signals of a dual carriageway: who would go onto it stands
in the way of his lane, and it empties in the next green, so that what can't go in this one may go in the one after.

Who waits amid the junction has left his lane, and who is behind him will not go in this green: where a lane is seen to
stand for a gap, nobody more of it goes as the green ends. Schedules go by that where clearances are long or most of a
lane waits. Elsewhere it was found to do harm: a green that ends the sooner costs little there.

Where the road that he goes onto leads to another signal a few metres on, of the same junction or not, and that has red,
nobody finds a gap: the first stands amid the junction until a stage lets him off it, and has left his lane (within.py).

A lane most of whose traffic waits stands for as long as a queue comes towards it, and goes when that has gone by: a
green that ended because it stood would end just then. So there it counts as no sign of what will go, as long as the
lane's road and those that it leads onto have room: on full ones who has red is in more of a hurry.

Where another stage of the junction has a lane set to itself, or people walk, yielding.py has learnt what it does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from utn_controllers.scheduled.standstill import ROOM, START_S, Shown
from utn_controllers.scheduled.streams import Shares, Streams
from utn_sumo.clearances import GIVES_WAY, HAS_WAY
from utn_sumo.compiling import compiled, inlined
from utn_sumo.contract import CAR_ACCELERATION_M_S2, EXIT, Bools, Floats, Ints, Network

ALL = 0.95
"""Who discharges at so much of what he can has a queue."""
GAP_S, GAP_CROSSING_M, GAP_S_M = 4.0, 14.0, 0.1
"""How long there must be nobody for who has so far to go across the junction or less, and for each metre more. In SUMO
Adams' formula has left turns go as they do with 3.6 s and as much for each metre; schedules do best with less."""
SLOWER = 0.5
"""Of the time that who speeds up slowly takes more than a car to get across: so much longer is the gap in SUMO."""
SEEN_S = 5.0
"""Over how much green it is seen whether a lane stands: of a queue that goes somebody leaves it every two seconds."""
STANDING = 0.25
"""Who has way and goes at less than so much of what he can stands behind something."""
SHORT_VEH = 6.0
"""A road that holds fewer a lane empties in one green: on longer ones what goes now says less of what will."""
HEADWAY_S = 2.0
"""Between two who leave a lane of a queue."""
NO_GAP_VEH = 20.0
"""With so many coming while a gap must last there is none."""
NO_QUEUE = -1.0
"""Whose lanes have no queue, or none that goes."""
SOME_VEH = 1e-3
"""With fewer than so many nobody waits for one."""
LEAST_TRAFFIC = 1e-9
"""Share of a link's traffic that is none."""
SOME_SHARE = 0.01
"""Of a lane's traffic: fewer who would wait for gaps are none."""
LONG_BINS = 4
"""Clearances of 7 s and more are long."""
MOST_SHARE = 0.75
"""Of a lane's traffic is most of it."""
AMID_VEH = 1.0
"""Of a lane on which somebody waits, as its green ends, as in the Highway Capacity Manual: of the two that it counts
one has found a gap, as a rule."""


class Gaps(NamedTuple):
    """Who waits for gaps in stages (S), by streams of a junction."""

    waiting: Floats
    """(S, most streams of a junction) share of its lane set that waits for gaps: 0 where nobody does."""
    foes: Ints
    """(S, most streams of a junction, most foes + 1) streams of the junction in whose gaps it goes, then -1."""
    amid_veh: Floats
    """(S, most streams of a junction) of each lane, that go as the green ends if somebody waits then."""
    some: Bools
    """(S,) whether anybody waits for gaps."""
    beside: Bools
    """(S, most streams of a junction) whether there are lanes beside its own that move in another way."""
    facing: Bools
    """(S, most streams of a junction) whether it has all of its road's lanes and those that it leads onto have room."""
    shut: Bools
    """(S, most streams of a junction) whether who waits does so in vain: for a road within the junction with red."""
    flowing: Floats
    """(S, most streams of a junction) share of its discharge that it is thought to have in the stage that is shown: as
    its lanes have had of late where somebody waits or stands, otherwise all."""
    to_come: Floats
    """(S, most streams of a junction) share of its lanes whose first to wait is still to come in the stage that is
    shown: of all in the others."""
    gap_s: Floats
    """(S, most streams of a junction) that a gap must last: by the power of e that it is in bins fewer go for each
    vehicle in a bin that comes towards them."""
    bin_s: float


class Giving:
    """Keeps which share of each lane set waits for gaps."""

    def __init__(self, network: Network, streams: Streams, learnt: Bools, bin_s: float, held: Bools, lost_bins: Ints):
        """But for lane sets whose discharge in a stage is `learnt` (S, L). Who is `held`, as in Moves, goes on.

        Clearances take `lost_bins` (J,) of a cycle, without who starts slowly.
        """
        self._streams = streams
        self._waits = np.zeros((len(streams.stage), len(streams.way_stream)), dtype=np.bool_)
        """(S, V) signalled ways that wait for gaps in a stage."""
        foes: dict[tuple[int, int], set[int]] = {}
        self._within: dict[int, list[tuple[int, int, int]]] = {}
        """By junction stages, ways that they let onto a road within it, and which."""
        self._first_way = np.searchsorted(streams.way_stream, streams.first)
        """(J + 1,) where the junctions' ways begin."""
        for row, stage in enumerate(streams.stage):
            junction = network.stage_junction[stage]
            for way in range(*self._first_way[junction : junction + 2]):
                stream = streams.way_stream[way]
                if not streams.serves[row, stream]:
                    continue
                ahead = int(streams.next_link[stream])
                if ahead != EXIT and network.within[ahead]:
                    self._within.setdefault(int(junction), []).append((row, way, ahead))
                if not learnt[row, streams.lane_set[stream]]:
                    own = _foes(network, streams, row, int(stage), way)
                    self._waits[row, way] = len(own) > 0
                    foes.setdefault((row, int(streams.lane_set[stream])), set()).update(own)
        shape, most_foes = held.shape, max((len(own) for own in foes.values()), default=0)
        self.gaps = Gaps(
            waiting=np.zeros(shape),
            foes=np.full((*shape, most_foes + 1), -1),
            amid_veh=np.where(held, 0.0, AMID_VEH),
            some=np.zeros(shape[0], dtype=np.bool_),
            beside=np.zeros(shape, dtype=np.bool_),
            facing=np.zeros(shape, dtype=np.bool_),
            shut=np.zeros(shape, dtype=np.bool_),
            flowing=np.ones(shape),
            to_come=np.ones(shape),
            gap_s=_gap_s(network, streams, self._waits, shape),
            bin_s=bin_s,
        )
        self._amid_veh = self.gaps.amid_veh.copy()
        sets_of_link = np.bincount(network.set_link, minlength=len(network.links))
        for row, stage in enumerate(streams.stage):
            first, last = streams.first[network.stage_junction[stage] :][:2]
            for stream in first + np.flatnonzero(streams.serves[row, first:last]):
                found = sorted(foes.get((row, int(streams.lane_set[stream])), ()))
                self.gaps.foes[row, stream - first, : len(found)] = np.array(found, dtype=np.int64) - first
                self.gaps.beside[row, stream - first] = sets_of_link[streams.link[stream]] > 1
        self._network = network
        self._long = lost_bins >= LONG_BINS * np.diff(streams.first_stage)
        """(J,) whether clearances are long, on average."""
        self._flowing = np.ones(len(network.lane_sets))
        """(L,) share of its discharge that each lane set has had of late in the green that it has."""
        self._queued = np.zeros(len(network.lane_sets), dtype=np.bool_)
        """(L,) lane sets that had somebody by the stop line when they were last looked at."""
        self._looked_s = np.zeros(len(network.junctions))
        """(J,) when that was."""
        self._left_veh = np.zeros(len(network.lane_sets))
        """(L,) who had left by then."""
        self._is_needed = any(foes.values()) or len(self._within) > 0
        self._beyond: dict[int, set[int]] = {}
        """By junction others a few metres on, whose signals end roads within it."""
        for index, onto in self._within.items():
            if others := {int(network.link_junction[ahead]) for _, _, ahead in onto} - {index}:
                self._beyond[index] = others
        self._shown = streams.first_stage[:-1].astype(np.int64)
        """(J,) row of the stage that each junction has shown."""
        self._shares = streams.shares(network.fraction)
        self._short = network.storage_veh < SHORT_VEH * np.array([link.lanes for link in network.links])
        """(Z,) links that empty in one green."""

    def look(self, view: Shown, asked: Bools, present: Ints, zone: Floats, amid: Bools) -> None:
        """Take up how fast those go who have green before the junctions `asked` (J,); as Yielding.look.

        Of lanes of streams `amid` (N,) somebody stands before a road within the junction.
        """
        if self._is_needed:
            network, streams = self._network, self._streams
            changed, self._shown = set(np.flatnonzero(self._shown != present).tolist()), present.copy()
            for junction, others in self._beyond.items():
                if not others.isdisjoint(changed):
                    self._take_up(junction)
            _see(
                view.time_s, asked, present, view.begin_s, view.left_veh, zone[:, 0],
                view.x_veh >= ROOM * network.storage_veh, self._short, amid, network.set_saturation_flow_veh_s,
                network.link_junction[network.set_link], self._long, self._flowing, self._queued, self._looked_s,
                self._left_veh, streams.lane_set, streams.link, streams.next_link, streams.first,
                streams.first_stage, self.gaps,
            )  # fmt: skip

    def take_up(self, shares: Shares) -> None:
        """Go by these shares of traffic from now on."""
        self._shares = shares
        for junction in range(len(self._network.junctions)):
            self._take_up(junction)

    def _take_up(self, junction: int) -> None:
        streams, gaps, of_set = self._streams, self.gaps, self._shares.way_of_set
        first, last = streams.first[junction : junction + 2]
        ways = slice(*self._first_way[junction : junction + 2])
        alike = streams.lane_set[first:last, None] == streams.lane_set[streams.way_stream[ways]]
        rows = range(*streams.first_stage[junction : junction + 2])
        for row, red in zip(rows, self._red(junction), strict=True):
            serves, own = streams.serves[row, first:last], slice(last - first)
            waiting = alike @ (of_set[ways] * np.maximum(self._waits[row, ways], red)) * serves
            waiting[waiting < SOME_SHARE] = 0.0
            shut = alike @ (of_set[ways] * red) * serves >= SOME_SHARE
            gaps.waiting[row, own], gaps.shut[row, own] = waiting, shut
            gaps.amid_veh[row, own] = np.where(shut, 0.0, self._amid_veh[row, own])
            gaps.some[row] = (waiting > 0).any()

    def _red(self, junction: int) -> Floats:
        """By stage and way of a junction the share that stands amid it, before a road within it that has red."""
        streams, of_link = self._streams, self._shares.of_link
        first_row, first_way = streams.first_stage[junction], self._first_way[junction]
        red = np.zeros((streams.first_stage[junction + 1] - first_row, self._first_way[junction + 1] - first_way))
        for row, way, ahead in self._within.get(junction, ()):
            onward, there = streams.link == ahead, int(self._network.link_junction[ahead])
            # Another signal is thought to stay as it is.
            shown = row if there == junction else self._shown[there]
            stands = of_link[onward & ~streams.serves[shown]].sum()
            red[row - first_row, way - first_way] = stands / max(of_link[onward].sum(), LEAST_TRAFFIC)
        return red


def _gap_s(network: Network, streams: Streams, waits: Bools, shape: tuple[int, ...]) -> Floats:
    """As in Gaps, of the ways that are thought to wait (S, V): what the one needs that has farthest to go."""
    crossing_m = np.array([turn.crossing_m for turn in network.turns])[streams.way_turn]
    gap_s = np.full(shape, GAP_S)
    slower = network.acceleration_m_s2**-0.5 - CAR_ACCELERATION_M_S2**-0.5
    for row, way in zip(*waits.nonzero(), strict=True):
        junction = network.stage_junction[streams.stage[row]]
        alike = streams.lane_set == streams.lane_set[streams.way_stream[way]]
        places = np.flatnonzero(alike) - streams.first[junction]
        needs_s = GAP_S + GAP_S_M * (crossing_m[way] - GAP_CROSSING_M)
        needs_s += SLOWER * math.sqrt(2 * (crossing_m[way] + network.shortest_m)) * slower
        gap_s[row, places] = np.maximum(gap_s[row, places], needs_s)
    return gap_s


def _foes(network: Network, streams: Streams, row: int, stage: int, way: int) -> set[int]:
    """Streams that have way in a stage over a signalled way that must give it."""
    shown = network.stages[stage]
    conflicts = network.junctions[shown.junction].conflicts
    giving = [letter for letter in streams.way_letters[way] if shown.state[letter] == GIVES_WAY]
    others = range(streams.first[shown.junction], streams.first[shown.junction + 1]) if giving else ()
    return {
        stream
        for stream in others
        if streams.serves[row, stream]
        for other in streams.letters[stream]
        if shown.state[other] == HAS_WAY and any(conflicts[letter][other] for letter in giving)
    }


@compiled
def _see(
    time_s: float, asked: Bools, present: Ints, begin_s: Floats, left: Floats, near: Floats, full: Bools,
    short: Bools, amid: Bools, flow: Floats, set_junction: Ints, long: Bools, flowing: Floats, queued: Bools,
    looked_s: Floats, before: Floats, stream_set: Ints, stream_link: Ints, next_link: Ints, first: Ints,
    first_stage: Ints, gaps: Gaps,
) -> None:  # fmt: skip
    behind, crowded, beyond = _full(full, short, len(flowing), stream_set, stream_link, next_link)
    for lane_set, junction in enumerate(set_junction):
        if not asked[junction]:
            continue
        since_s = time_s - looked_s[junction]
        if not queued[lane_set] or looked_s[junction] < begin_s[junction] + START_S:
            flowing[lane_set] = 1.0
        elif since_s > 0:
            gone = min((left[lane_set] - before[lane_set]) / (flow[lane_set] * since_s), 1.0)
            flowing[lane_set] += min(since_s / SEEN_S, 1.0) * (gone - flowing[lane_set])
        queued[lane_set] = near[lane_set] >= 1
        before[lane_set] = left[lane_set]
    for junction in range(len(asked)):
        if asked[junction]:
            looked_s[junction] = time_s
            row = present[junction]
            for stream in range(first[junction], first[junction + 1]):
                own, share = stream - first[junction], flowing[stream_set[stream]]
                most = gaps.waiting[row, own] >= MOST_SHARE
                goes = most and gaps.beside[row, own] and not (gaps.shut[row, own] or crowded[stream_set[stream]])
                stands = gaps.waiting[row, own] > 0 or behind[stream_set[stream]] or share < STANDING
                # Who stands amid it has taken the room that there was: whoever comes next for it stops the lane.
                share = min(share, 1 - amid[stream] * gaps.shut[row, own] * gaps.waiting[row, own])
                gaps.flowing[row, own] = share if stands and not goes else 1.0
                counts = gaps.waiting[row, own] > 0 and (long[junction] or most)
                gaps.to_come[row, own] = share if counts and gaps.beside[row, own] else 1.0
                for stage in range(first_stage[junction], first_stage[junction + 1]):
                    gaps.facing[stage, own] = not (gaps.beside[stage, own] or beyond[stream_set[stream]])


@inlined
def _full(
    full: Bools, short: Bools, sets: int, stream_set: Ints, stream_link: Ints, next_link: Ints
) -> tuple[Bools, Bools, Bools]:
    """(L,) lane sets that lead onto a short road that is full, onto one or are on one, and that lead onto any."""
    behind, crowded, beyond = np.zeros((3, sets), np.bool_)
    for stream, ahead in enumerate(next_link):
        crowded[stream_set[stream]] |= full[stream_link[stream]]
        if ahead != EXIT:
            crowded[stream_set[stream]] |= full[ahead]
            beyond[stream_set[stream]] |= full[ahead]
            behind[stream_set[stream]] |= full[ahead] and short[ahead]
    return behind, crowded, beyond


@compiled
def let_go(
    row: int, bin_: int, veh: Floats, come: Floats, most: Floats, moves: Floats, going: Ints, gaps: Gaps,
    pace: Floats, free: Floats, to_come: Floats, want: Floats, queue: Floats,
) -> None:  # fmt: skip
    """Brings the vehicles `veh` (n,) of those who have green in a stage, the `row`, up to the end of a bin.

    `pace` (n,) is which share of their discharge those have who wait for gaps, kept from bin to bin of a green (see
    `begin_green`); `free` (n,) which share of their lanes has nobody in front who waits for one: every vehicle that
    goes brings somebody there. `to_come` (n,) is kept for `clear`. `want` (n,) is room for who would go, `queue` (n,)
    for what is `free` of those that have one.
    """
    place = 0
    while going[row, place] >= 0:
        stream = going[row, place]
        veh[stream] += come[stream, bin_]
        goes = moves[row, stream] * most[stream] * pace[stream]
        want[stream] = min(veh[stream], goes)
        queue[stream] = free[stream] if 0 < ALL * goes <= want[stream] else NO_QUEUE
        place += 1
    place = 0
    while going[row, place] >= 0:
        stream = going[row, place]
        if gaps.waiting[row, stream] > 0:
            shut, foe, share = gaps.shut[row, stream], 0, gaps.waiting[row, stream]
            towards, beside = np.inf if shut else 0.0, shut or gaps.beside[row, stream]
            while gaps.foes[row, stream, foe] >= 0:
                other = gaps.foes[row, stream, foe]
                towards += want[other]
                # Between those of a queue there is no room, however few a bin they are.
                if beside and gaps.waiting[row, other] == 0 and want[other] >= ALL * moves[row, other] * most[other]:
                    towards = np.inf
                foe += 1
            gap_s = gaps.gap_s[row, stream]
            found = 1 / (1 + share * headways(gap_s / gaps.bin_s * towards, gap_s))
            open_ = free[stream] if beside else 0.0
            if not beside:
                theirs, still = _faces(row, stream, gaps, queue)
                to_come[stream] = 1.0 if theirs > 0 else 0.0
                if theirs > 0:
                    found, open_ = min(found, theirs / (theirs + share)), free[stream] * still
            pace[stream] = open_ + (1 - open_) * found
            goes = moves[row, stream] * pace[stream]
            if most[stream] > 0:
                # In a bin about one leaves each lane that discharges.
                free[stream] *= (1 - share) ** (min(veh[stream] / most[stream], goes))
            veh[stream] = max(veh[stream] - goes * most[stream], 0.0)
        else:
            veh[stream] -= want[stream]
        place += 1


@inlined
def _faces(row: int, stream: int, gaps: Gaps, queue: Floats) -> tuple[float, float]:
    """Of queues on single lanes that face a stream's: the share that waits too, and on which nobody does so yet."""
    share, still, foe = 0.0, 1.0, 0
    while gaps.foes[row, stream, foe] >= 0:
        other = gaps.foes[row, stream, foe]
        is_alike = gaps.facing[row, stream] and gaps.facing[row, other] and gaps.waiting[row, other] > 0
        if is_alike and queue[other] != NO_QUEUE:
            share, still = max(share, gaps.waiting[row, other]), min(still, queue[other])
        foe += 1
    return share, still


@compiled
def headways(come_veh: float, gap_s: float) -> float:
    """How long somebody waits for a gap, in headways, if so many come while one must last (Adams 1936)."""
    if come_veh < SOME_VEH:
        return 0.0
    if come_veh > NO_GAP_VEH:
        return np.inf
    return float(gap_s / HEADWAY_S * (np.exp(come_veh) - come_veh - 1) / come_veh)


@compiled
def clear(
    row: int, veh: Floats, most: Floats, going: Ints, gaps: Gaps, pace: Floats, to_come: Floats, amid: Floats
) -> None:  # fmt: skip
    """Takes from the vehicles `veh` (n,) those who wait for gaps as a green ends, and puts them into `amid` (n,).

    On lanes on which nobody waited as the green was seen, a share `to_come` (n,) of all; see `begin_green`.
    """
    place = 0
    while going[row, place] >= 0:
        stream = going[row, place]
        amid[stream] = 0.0
        if gaps.waiting[row, stream] > 0:
            wait = max(to_come[stream] - pace[stream], 0.0)
            amid[stream] = min(gaps.amid_veh[row, stream] * wait * most[stream], veh[stream])
            veh[stream] -= amid[stream]
        place += 1


@inlined
def begin_green(row: int, gaps: Gaps, is_shown: bool, pace: Floats, free: Floats, to_come: Floats) -> None:
    """Sets `pace`, `free` and `to_come` (n,) of `let_go` and `clear` for a green that begins, or that goes on."""
    pace[:], free[:], to_come[:] = 1.0, 1.0, 1.0
    if is_shown:
        pace[:] = free[:] = gaps.flowing[row, : len(free)]
        to_come[:] = gaps.to_come[row, : len(free)]
