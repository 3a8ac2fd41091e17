"""Schedules of a junction: as good as any, in the order asked for, and nothing lost on the way; streams; settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.optimize import linprog

from tests.integration import odd_nets
from tests.unit.views import Scene, by_the_line, scene
from utn_controllers.recommended import Recommended
from utn_controllers.scheduled.ending import (
    Ending,
    ahead_bins,
    are_alone,
    are_apart,
    are_far,
    beyond,
    greens,
    have_way,
    lost,
    lost_at_least,
    needing,
    prices,
    staying,
)
from utn_controllers.scheduled.execution import Scheduled
from utn_controllers.scheduled.gaps import Gaps
from utn_controllers.scheduled.moves import Moves, Rules, going
from utn_controllers.scheduled.programme import schedules
from utn_controllers.scheduled.regret import NEEDLESS
from utn_controllers.scheduled.streams import Streams
from utn_controllers.scheduled.worth import Worth
from utn_sumo import streets
from utn_sumo.contract import EXIT, ZONES_M, Bools, Floats, Ints, Network
from utn_sumo.estimation import Estimator
from utn_sumo.plant.heads import Heads

Make = Callable[[Path], Path]

Shares = Sequence[Sequence[float]]

BLOCKED_VEH = 1e-6
NEAR_ENOUGH = 1.1
"""Of the best there is: of two ways to a state the schedule keeps the one that seems better, with its queues."""


@dataclass
class Crossing:
    """A junction whose every stage serves one stream of its own, and some let others go more slowly."""

    clearance: tuple[int, ...] = (2, 2)
    least: tuple[int, ...] = (2, 2)
    bins: int = 25
    cyclic: bool = False
    held: dict[tuple[int, int], Shares] = field(default_factory=dict)
    """Share of each bin that each stream has green in the clearance from a stage to another: else all is red."""
    slowly: dict[tuple[int, int], float] = field(default_factory=dict)
    """Share of its discharge that a stream has in another's stage."""
    waits: dict[tuple[int, int], float] = field(default_factory=dict)
    """Share of a stream that waits in a stage for gaps in the others that it serves."""
    amid_veh: float = 2.0
    """That go of each lane on which somebody waits as its green ends."""
    flowing: float = 1.0
    """Share of their discharge that all lanes have had of late in the stage that is shown."""
    to_come: float = 1.0
    """Share of all lanes there whose first to wait is still to come."""
    staying: float = 5.0
    """Bins that who is left at the end waits longer."""
    needing: tuple[float, ...] = ()
    """(N,) what each of these weighs beside that: else nothing."""
    kept: float = 1.0
    """What one weighs who is left with green, over what he does without."""
    then: int = field(default=-1, init=False)
    """The stage led to in the bin after that of the last decision, as it foresaw."""
    last: int = field(default=-1, init=False)
    """The row that the schedule of the last decision ends with."""
    regret: float = field(default=-1.0, init=False)
    """What it has cost to stay until then."""

    def green(self) -> Floats:
        """(S, N) share of its discharge that each stream has in each stage."""
        share = np.eye(len(self.clearance))
        for (stage, stream), slow in self.slowly.items():
            share[stage, stream] = max(slow, share[stage, stream])
        return share

    def ends(self, worth: object) -> Floats:
        """(N,) what a vehicle weighs that is left at the end."""
        of_each = self.staying * np.array(worth, dtype=float)
        return np.zeros(len(self.clearance)) + of_each + (np.array(self.needing) if self.needing else 0.0)

    def cleared(self, stage: int, other: int) -> Floats:
        """(bins, N) what moves in the clearance from a stage to another."""
        red = np.zeros((self.clearance[stage], len(self.clearance)))
        return np.array(self.held.get((stage, other), red), dtype=float)

    def rules(self) -> Rules:
        stages = len(self.clearance)
        place = np.arange(stages)
        follows = place == ((place + 1) % stages)[:, None] if self.cyclic else np.ones((stages, stages), dtype=bool)
        moves, clearing = self.green(), np.full((stages, stages), -1)
        clearance = np.ones((stages, stages), dtype=np.int64)
        for stage, other in np.ndindex(stages, stages):
            shares = self.cleared(stage, other)
            clearance[stage, other] = len(shares)
            if shares.any():
                clearing[stage, other] = len(moves)
                moves = np.vstack([moves, shares])
        first = np.array([0, stages])
        who = going(moves, stages, clearing, clearance)
        shape = stages, moves.shape[1]
        waiting, foes = np.zeros(shape), np.full((*shape, stages + 1), -1)
        for (stage, stream), share in self.waits.items():
            others = np.flatnonzero((moves[stage] > 0) & (np.arange(stages) != stream))
            waiting[stage, stream] = share * (moves[stage, stream] > 0)
            foes[stage, stream, : len(others)] = others
        gaps = Gaps(
            waiting,
            foes,
            np.full(shape, self.amid_veh),
            (waiting > 0).any(axis=1),
            np.zeros(shape, dtype=np.bool_),
            np.zeros(shape, dtype=np.bool_),
            np.zeros(shape, dtype=np.bool_),
            np.full(shape, self.flowing),
            np.full(shape, self.to_come),
            np.full(shape, 4.0),
            2.0,
        )
        return Rules(
            place,
            first,
            first,
            follows,
            moves,
            who,
            clearing,
            clearance,
            np.array(self.least),
            np.array([self.bins]),
            gaps,
        )

    def decide(
        self,
        stand: object,
        come: Floats | None = None,
        *,
        stage: int = 0,
        rest: int | None = None,
        most: object = 1.0,
        worth: object = 1.0,
        free: bool = True,
        plan: Ints | None = None,
        sent: Floats | None = None,
        shown_s: Sequence[float] | None = None,
        regret: float = np.inf,
    ) -> tuple[int, Floats]:
        """The stage led to, and (N, K) what is sent off; `plan` (K,) is the schedule of the bin before.

        By turns if it is said when stages were shown; what is best unless it is said that nothing is regretted yet.
        """
        stages = len(self.clearance)
        plan = np.zeros(self.bins, dtype=np.int64) if plan is None else plan
        sent = np.zeros((stages, self.bins)) if sent is None else sent.copy()
        shown, regrets = plan[None].copy(), np.array([regret])
        wish, then = schedules(
            np.array([stage]),
            np.array([free]),
            np.array([self.bins if rest is None else rest]),
            self.rules(),
            np.zeros(stages) + np.array(stand, dtype=float),
            np.zeros((stages, self.bins)) if come is None else come,
            np.zeros(stages) + np.array(worth, dtype=float),
            self.ends(worth),
            self.kept * self.ends(worth),
            np.zeros(stages) + np.array(most, dtype=float),
            shown,
            sent,
            np.array([shown_s is not None]),
            np.zeros(stages) if shown_s is None else np.array(shown_s),
            regrets,
        )
        assert wish[0] in (stage, then[0])
        self.then, self.last, self.regret = int(then[0]), int(shown[0, -1]), float(regrets[0])
        return int(wish[0]), sent

    def begins(self, stand: object, come: Floats, most: object = 1.0) -> list[tuple[int, int, Floats]]:
        """(bin, stage, queues) of every end of a green, with a new schedule in every bin of `come` (N, K or more)."""
        leaves = np.zeros(len(self.clearance)) + np.array(most, dtype=float)
        queue = np.zeros(len(self.clearance)) + np.array(stand, dtype=float)
        stage, green_from, ended = 0, 0, []
        for now in range(come.shape[1] - self.bins):
            if now >= green_from + (self.least[stage] if ended else 0):
                wish, _ = self.decide(queue, come[:, now : now + self.bins].copy(), stage=stage, most=most)
                if wish != stage:
                    ended.append((now, stage, queue.copy()))
                    green_from = now + self.clearance[stage]
                    stage = wish
            queue += come[:, now]
            if now >= green_from:
                queue[stage] = max(queue[stage] - leaves[stage], 0.0)
        return ended


Drawn = tuple[Crossing, list[float], list[list[float]], list[float], float]


def every_sequence(crossing: Crossing) -> Iterator[list[int]]:
    """All that a junction of two stages can show, from the first one on: a stage a bin, -1 for clearance."""

    def go_on(shown: list[int], stage: int, may_end: int) -> Iterator[list[int]]:
        for end in range(may_end, crossing.bins):
            cleared = [*shown, *[stage] * (end - len(shown)), *[-1] * crossing.clearance[stage]]
            if len(cleared) >= crossing.bins:
                yield cleared[: crossing.bins]
            else:
                yield from go_on(cleared, 1 - stage, len(cleared) + crossing.least[1 - stage])
        yield [*shown, *[stage] * (crossing.bins - len(shown))]

    yield from go_on([], 0, 0)


def waited(shown: list[int], drawn: Drawn) -> float:
    """Vehicles left behind in each bin, weighted and added up: a queue after the other, without any of ours."""
    crossing, stand, come, worth, most = drawn
    total = 0.0
    for stream, standing in enumerate(stand):
        queue = standing
        for stage, arriving in zip(shown, come[stream], strict=True):
            queue = max(queue + arriving - (most if stage == stream else 0.0), 0.0)
            total += worth[stream] * queue
        total += crossing.ends(worth)[stream] * queue * (crossing.kept if shown[-1] == stream else 1.0)
    return total


def foreseen(drawn: Drawn, sent: Floats) -> float:
    """The same by the schedule of the last decision, which sends off so many."""
    crossing, stand, come, worth, _ = drawn
    left_veh = np.array(stand)[:, None] + np.cumsum(np.array(come) - sent, axis=1)
    ends = crossing.ends(worth)
    if 0 <= crossing.last < len(stand):
        ends[crossing.green()[crossing.last] > 0] *= crossing.kept
    return float(np.array(worth) @ left_veh.sum(axis=1) + ends @ left_veh[:, -1])


def a_bin(green: Floats, place: int, queue: Floats, drawn: Drawn, *, clears: bool) -> tuple[float, Floats]:
    """What is waited in a bin, of a clearance or not, of which streams have the share `green`; the queues."""
    crossing, _, come, worth, most = drawn
    queue = np.maximum(queue + np.array(come)[:, place] - green * most, 0.0)
    ends = crossing.ends(worth) * np.where((green > 0) & (not clears), crossing.kept, 1.0)
    weights = np.array(worth) + ends * (place == len(come[0]) - 1)
    return float(weights @ queue), queue


def plainly(drawn: Drawn, rest: int) -> tuple[set[int], float]:
    """The same programme, each bin gone through anew for each way: what may be led to first, and the least cost."""
    crossing, stand = drawn[0], np.array(drawn[1])
    bins, stages, ends = crossing.bins, len(stand), list[tuple[float, int]]()
    green, comes = crossing.green(), stand + np.sum(drawn[2], axis=1) > 0
    called = [stage for stage in range(stages) if stage == 0 or (comes & (green[stage] > green[0])).any()]
    # (begin, stage): cost, queues, the stage led to in the first bin, cost if it stayed until the end.
    states = {(0, 0): (0.0, stand, 0, 0.0)}
    for begin, stage in np.ndindex(bins, stages):
        spent, queue, first, _ = states.get((begin, stage), (np.inf, stand, 0, 0.0))
        last = bins if begin else min(rest, bins)
        for now in range(begin, last + 1):
            if now == bins:
                ends.append((spent, first))
            elif now >= (begin + crossing.least[stage] if begin else 0):
                for other in called:
                    if other == stage:
                        continue
                    until, cleared, opens = spent, queue, now
                    for still in crossing.cleared(stage, other)[: bins - now]:
                        cost, cleared = a_bin(still, opens, cleared, drawn, clears=True)
                        until, opens = until + cost, opens + 1
                    weights = (bins - opens) * np.array(drawn[3]) + crossing.ends(drawn[3]) * (opens < bins)
                    stayed = until + float((weights * (green[other] == 0)) @ cleared)
                    if stayed < states.get((opens, other), (np.inf,))[-1] - 1e-9:
                        states[opens, other] = until, cleared, other if now == 0 else first, stayed
            if now < last:
                cost, queue = a_bin(green[stage], now, queue, drawn, clears=False)
                spent += cost
    ends += [(cost, first) for (begin, _), (cost, _, first, _) in states.items() if begin == bins]
    least = min(ends, key=lambda end: end[0])[0]
    return {first for cost, first in ends if cost <= least + 1e-9}, least


def lists(items: st.SearchStrategy[Any], count: int) -> st.SearchStrategy[list[Any]]:
    return st.lists(items, min_size=count, max_size=count)


@st.composite
def junctions(draw: st.DrawFn, stages: int = 2) -> Drawn:
    """So many stages, who stands and comes, how much each is worth, and what leaves in a bin."""
    few = lists(st.integers(1, 2), stages).map(tuple)
    longer = draw(st.sampled_from([0.0, 5.0, 20.0]))
    needed = tuple(draw(lists(st.sampled_from([0.0, 3.0, 12.0]), stages)))
    kept = draw(st.sampled_from([1.0, 0.8]))
    crossing = Crossing(draw(few), draw(few), draw(st.integers(8, 10)), staying=longer, needing=needed, kept=kept)
    veh = st.integers(0, 24).map(lambda quarters: quarters / 4)
    share = st.sampled_from([0.0, 0.0, 0.0, 0.25, 0.5, 1.0, 2.0])
    come = draw(lists(lists(share, crossing.bins), stages))
    worth = draw(lists(st.sampled_from([0.5, 1.0, 1.5]), stages))
    return crossing, draw(lists(veh, stages)), come, worth, draw(st.sampled_from([1.0, 1.5]))


@st.composite
def holding(draw: st.DrawFn) -> Drawn:
    """Two stages or three, with clearances of any length in some of which some streams have green for a while.

    In some stages some go more slowly than in their own.
    """
    drawn = draw(st.integers(2, 3).flatmap(junctions))
    stages = len(drawn[1])
    shares = lists(st.sampled_from([0.0, 0.0, 0.5, 1.0]), stages)
    pairs = st.tuples(st.integers(0, stages - 1), st.integers(0, stages - 1))
    held = draw(st.dictionaries(pairs, st.lists(shares, min_size=1, max_size=4), max_size=6))
    slowly = draw(st.dictionaries(pairs, st.sampled_from([0.25, 0.5]), max_size=2))
    return replace(drawn[0], held=held, slowly=slowly), *drawn[1:]


@st.composite
def giving_way(draw: st.DrawFn) -> Drawn:
    """As `holding`, and some wait for gaps in what goes beside them."""
    drawn = draw(holding())
    pairs = st.tuples(*[st.integers(0, len(drawn[1]) - 1)] * 2)
    waits = draw(st.dictionaries(pairs, st.sampled_from([0.2, 1.0]), min_size=1, max_size=3))
    flowing, to_come = draw(st.sampled_from([(0.1, 0.1), (0.1, 1.0), (1.0, 1.0)]))
    return replace(drawn[0], waits=waits, flowing=flowing, to_come=to_come), *drawn[1:]


class TestProgramme:
    @given(drawn=junctions())
    def test_it_waits_hardly_more_than_the_best_of_all_sequences(self, drawn: Drawn) -> None:
        crossing, stand, come, worth, most = drawn
        wish, sent = crossing.decide(stand, np.array(come), worth=worth, most=most)
        every = [(waited(shown, drawn), shown) for shown in every_sequence(crossing)]
        best = min(cost for cost, _ in every)
        begun_so = min(cost for cost, shown in every if (shown[0] == 0) == (wish == 0))
        planned = foreseen(drawn, sent)
        assert best - 1e-6 <= planned <= NEAR_ENOUGH * best + 1e-6
        assert begun_so <= NEAR_ENOUGH * best + 1e-6

    @given(drawn=junctions(), stage=st.integers(0, 1), rest=st.integers(0, 10))
    def test_nobody_is_sent_off_who_has_not_come_and_nobody_faster_than_the_green_lets_them(
        self,
        drawn: Drawn,
        stage: int,
        rest: int,
    ) -> None:
        crossing, stand, come, worth, most = drawn
        _, sent = crossing.decide(stand, np.array(come), worth=worth, most=most, stage=stage, rest=rest)
        assert (sent >= -1e-9).all()
        assert (sent <= most + 1e-9).all()
        assert (np.cumsum(sent, axis=1) <= np.array(stand)[:, None] + np.cumsum(come, axis=1) + 1e-9).all()
        # Never two that cross in one bin.
        assert (np.minimum(sent[0], sent[1]) <= 1e-9).all()

    @given(drawn=st.one_of(holding(), giving_way()), stage=st.integers(0, 1), rest=st.integers(0, 10), data=st.data())
    def test_whatever_the_last_schedule_was_the_next_is_the_same(
        self,
        drawn: Drawn,
        stage: int,
        rest: int,
        data: st.DataObject,
    ) -> None:
        """It bounds the search: one that is better than any the search finds must not leave it empty-handed."""
        crossing, stand, come, worth, most = drawn
        shown = lists(st.integers(-1, len(crossing.rules().moves) - 1), crossing.bins)
        last = data.draw(st.one_of(shown, st.sampled_from(list(every_sequence(crossing)))))
        given_now = {"stage": stage, "rest": rest, "worth": worth, "most": most}
        wish, sent = crossing.decide(stand, np.array(come), **given_now)
        other_wish, other_sent = crossing.decide(stand, np.array(come), plan=np.array(last), **given_now)
        assert other_wish == wish
        assert (other_sent == sent).all()

    @given(drawn=holding(), rest=st.integers(0, 10))
    def test_it_finds_what_the_programme_finds_without_sums_and_bounds(self, drawn: Drawn, rest: int) -> None:
        crossing, stand, come, worth, most = drawn
        assume(sum(stand[1:]) + np.sum(come[1:]) > 0)
        wish, sent = crossing.decide(stand, np.array(come), rest=rest, worth=worth, most=most)
        found, cost = plainly(drawn, rest)
        planned = foreseen(drawn, sent)
        assert wish in found
        assert planned == pytest.approx(cost, abs=1e-6)

    @pytest.mark.parametrize("come", [(1.4, 0.14, 0.14), (0.9, 0.25, 0.15), (1.0, 0.2, 0.2)])
    @pytest.mark.parametrize("clearance", [3, 4])
    def test_no_stage_is_left_out_again_and_again_beside_a_main_road(
        self, come: tuple[float, float, float], clearance: int
    ) -> None:
        crossing = Crossing((clearance,) * 3, (2,) * 3, staying=5.0 * clearance)
        arriving = np.tile(np.array(come)[:, None], 300 + crossing.bins)
        ended = crossing.begins([0.0, 0.0, 0.0], arriving, most=(4.0, 1.0, 1.0))
        shown = [stage for _, stage, _ in ended]
        assert len(shown) > 20
        assert all(set(shown[place : place + 6]) == {0, 1, 2} for place in range(len(shown) - 6))

    @pytest.mark.parametrize("queue", [8.0, 12.0])
    def test_a_green_goes_on_before_a_longer_queue_where_who_is_left_with_green_waits_less(self, queue: float) -> None:
        # One clearance in any case, and the other road is worth a little more.
        stand, worth = [queue, 20.0], [1.0, 1.05]
        crossing = Crossing(bins=16, staying=60.0)
        assert crossing.decide(stand, worth=worth)[0] == 1
        kept = replace(crossing, kept=0.9)
        assert kept.decide(stand, worth=worth)[0] == 0
        # Green is not as good as that for who waits for gaps in it.
        assert replace(kept, waits={(1, 1): 0.2}).decide(stand, worth=worth)[0] == 1

    def likely(self, *, veh: float, clearance: int) -> tuple[Crossing, Floats]:
        """A junction to whose second stage so many come soon, by chance, and nobody to the first."""
        crossing = Crossing((clearance,) * 2, (1, 1), bins=16)
        come = np.zeros((2, crossing.bins))
        come[1, clearance] = veh
        return crossing, come

    @pytest.mark.parametrize("clearance", [2, 5])
    def test_a_change_for_those_who_may_come_waits_until_not_to_change_has_cost_as_much(self, clearance: int) -> None:
        crossing, come = self.likely(veh=0.1, clearance=clearance)
        assert crossing.decide(0.0, come)[0] == 1
        stays, regret, most = 0, 0.0, NEEDLESS * clearance**2
        while crossing.decide(0.0, come, regret=regret)[0] == 0:
            # Led on in the bin's midst it would hardly have stayed.
            assert crossing.then == 0
            assert regret < crossing.regret < most
            stays, regret = stays + 1, crossing.regret
        # A tenth of one waits a bin longer each time: it stays as long as that is below what it may cost.
        assert stays == np.ceil(most / 0.1) - 1
        assert crossing.regret == 0.0

    @pytest.mark.parametrize("clearance", [2, 5])
    @pytest.mark.parametrize("stand", [(0.0, 1.0), (0.0, 3.0)])
    def test_a_change_for_somebody_who_is_seen_to_wait_comes_at_once(
        self, clearance: int, stand: tuple[float, float]
    ) -> None:
        crossing, come = self.likely(veh=0.1, clearance=clearance)
        assert crossing.decide(stand, come, regret=0.0)[0] == 1

    @pytest.mark.parametrize("clearance", [2, 5])
    def test_a_change_for_somebody_who_will_be_there_when_it_is_over_comes_at_once(self, clearance: int) -> None:
        crossing, come = self.likely(veh=0.1, clearance=clearance)
        come[1, clearance - 1] = 1.0
        assert crossing.decide(0.0, come, regret=0.0)[0] == 1

    def test_what_it_has_cost_to_stay_is_forgotten_with_nobody_left_to_change_for(self) -> None:
        crossing, come = self.likely(veh=0.1, clearance=5)
        crossing.decide(0.0, come, regret=0.0)
        assert crossing.regret > 0
        assert crossing.decide(0.0, 0.001 * come, regret=crossing.regret)[0] == 0
        assert crossing.regret == 0.0

    def test_with_nobody_anywhere_the_present_stage_stays(self) -> None:
        for stage in range(3):
            wish, sent = Crossing((2, 2, 2), (2, 2, 2)).decide(0.0, stage=stage)
            assert wish == stage
            assert not sent.any()

    def test_with_nobody_elsewhere_the_present_stage_stays_even_beyond_its_bound(self) -> None:
        come = np.zeros((2, 25))
        come[0, ::3] = 1.0
        for rest in (0, 5, 25):
            assert Crossing().decide([3.0, 0.0], come, rest=rest)[0] == 0

    def test_a_lone_vehicle_finds_green_when_it_arrives_and_takes_none_from_others_before(self) -> None:
        crossing, arrives = Crossing(least=(1, 1)), 9
        come = np.zeros((2, 60))
        come[0] = 0.2
        come[1, arrives] = 1.0
        (end, stage, _), *_ = crossing.begins([0.0, 0.0], come, most=2.0)
        assert stage == 0
        assert end + crossing.clearance[0] == arrives

    def test_who_stands_alone_before_red_is_let_go_at_once(self) -> None:
        wish, sent = Crossing().decide([0.0, 1.0])
        assert wish == 1
        assert np.flatnonzero(sent[1]).tolist() == [2]

    def test_who_goes_slowly_gets_a_stage_of_their_own_where_that_is_worth_its_clearance(self) -> None:
        def shown(slow: float, stand: float) -> int:
            return replace(Crossing(), slowly={(0, 1): slow}).decide([0.0, stand])[0]

        assert [shown(slow, 8.0) for slow in (0.1, 0.5, 0.9, 1.0)] == [1, 1, 0, 0]
        # A single one does not wait for the clearance either.
        assert [shown(slow, 1.0) for slow in (0.1, 0.5)] == [1, 0]

    def test_green_that_is_held_through_the_clearance_serves(self) -> None:
        crossing = Crossing((3, 3), held={(0, 1): ((1.0, 0.0), (0.5, 0.0), (0.0, 0.0))})
        wish, sent = crossing.decide([1.5, 4.0])
        assert wish == 1
        assert sent[0, :3] == pytest.approx([1.0, 0.5, 0.0])
        assert sent[1, :5] == pytest.approx([0.0, 0.0, 0.0, 1.0, 1.0])
        # Without it they would be served before.
        assert replace(crossing, held={}).decide([1.5, 1.0])[0] == 0
        assert crossing.decide([1.5, 1.0])[0] == 1

    def test_a_stage_whose_traffic_goes_onto_a_full_link_is_passed_over(self) -> None:
        three = Crossing((2, 2, 2), (2, 2, 2))
        assert three.decide([0.0, 9.0, 1.0])[0] == 1
        assert three.decide([0.0, 9.0, 1.0], most=[1.0, BLOCKED_VEH, 1.0])[0] == 2

    def test_who_is_left_at_the_end_is_worth_a_clearance_the_more_the_longer_that_means_to_wait(self) -> None:
        come = np.zeros((2, 25))
        come[0] = 0.5
        come[1, 22] = 8.0

        def left(longer: float) -> float:
            _, sent = Crossing((2, 2), staying=longer).decide([0.0, 0.0], come)
            return float(come.sum() - sent.sum())

        assert left(20.0) < left(0.0)

    def test_of_two_queues_the_one_that_is_worth_more_goes_first(self) -> None:
        three = Crossing((2, 2, 2), (2, 2, 2))
        for heavy in (1, 2):
            worth = np.ones(3)
            worth[heavy] = 1.5
            assert three.decide([0.0, 5.0, 5.0], worth=worth)[0] == heavy

    @pytest.mark.parametrize("rate", [0.0, 0.1, 0.2])
    def test_of_two_queues_alike_each_is_served_until_it_is_gone(self, rate: float) -> None:
        """Exhaustive service is best where queues are alike and switching costs time (Levy, Sidi and Boxma 1990)."""
        come = np.full((2, 70), rate)
        ended = Crossing(bins=40).begins([10.0, 10.0], come)
        assert ended[0][0] >= 10
        for _, stage, queue in ended:
            assert queue[stage] <= 1.0

    @pytest.mark.parametrize("present", range(4))
    def test_in_a_cycle_the_next_stage_comes_next(self, present: int) -> None:
        stand = np.full(4, 1.0)
        stand[present], stand[(present + 2) % 4] = 0.0, 8.0
        four = Crossing((2,) * 4, (2,) * 4)
        assert four.decide(stand, stage=present)[0] == (present + 2) % 4
        assert replace(four, cyclic=True).decide(stand, stage=present)[0] == (present + 1) % 4

    def test_in_a_cycle_an_empty_stage_does_not_keep_those_behind_it_waiting(self) -> None:
        assert Crossing((2,) * 3, (2,) * 3, cyclic=True).decide([0.0, 0.0, 8.0])[0] == 1

    def test_a_green_that_has_reached_its_bound_ends_if_others_wait(self) -> None:
        stand = [20.0, 1.0]
        assert Crossing().decide(stand)[0] == 0
        assert Crossing().decide(stand, rest=0)[0] == 1
        assert Crossing().decide(stand, rest=1)[0] == 0

    @pytest.mark.parametrize("rest", [1, 4, 9])
    def test_no_schedule_goes_beyond_the_bound_where_others_wait(self, rest: int) -> None:
        _, sent = Crossing().decide([20.0, 1.0], rest=rest)
        assert sent[0, :rest] == pytest.approx(1.0)
        assert sent[0, rest : rest + 4] == pytest.approx(0.0)

    def test_who_is_not_free_stays_and_sends_off_what_it_had_planned(self) -> None:
        planned = np.arange(50.0).reshape(2, 25)
        wish, sent = Crossing().decide([0.0, 9.0], free=False, sent=planned)
        assert wish == 0
        assert (sent[:, :-1] == planned[:, 1:]).all()


ODD = (
    odd_nets.plain,
    odd_nets.pedestrians,
    odd_nets.bicycle_lanes,
    odd_nets.joined,
    odd_nets.right_on_red,
    odd_nets.unused_letters,
    odd_nets.slip_lanes,
    odd_nets.shared_letters,
    odd_nets.leading_green,
    odd_nets.green_beside_amber,
    odd_nets.turning_pockets,
    odd_nets.roundabout,
)


class TestStreams:
    def agree(self, network: Network, fraction: Floats) -> None:
        streams, signalled = Streams(network), ~network.unsignalled
        turns = np.flatnonzero(signalled)
        same = (
            (streams.group == network.turn_group[turns, None])
            & (streams.next_link == network.turn_next[turns, None])
            & (network.serves[np.ix_(streams.stage, turns)].T[:, :, None] == streams.serves).all(axis=1)
        )
        # From each lane set that a turn goes from it is in a stream of its own.
        sets = np.array([[turn in each.turns for each in network.lane_sets] for turn in turns])
        from_set = sets[:, streams.lane_set]
        assert (same & from_set).any(axis=1).all()
        assert (same & from_set).any(axis=0).all()
        shares = streams.shares(fraction)
        alike = (same.T.astype(int) @ same) > 0
        assert alike @ shares.of_link == pytest.approx(same.T.astype(float) @ fraction[turns])
        links = np.bincount(network.turn_link[turns], fraction[turns], len(network.links))
        assert np.bincount(streams.link, shares.of_link, len(network.links)) == pytest.approx(links)
        assert shares.of_set * shares.set_of_link[streams.lane_set] == pytest.approx(shares.of_link)
        every = np.bincount(network.set_link, shares.set_of_link, len(network.links))
        assert every == pytest.approx(np.bincount(network.turn_link, fraction, len(network.links)))
        # One junction's after the other's.
        owner = network.link_junction[streams.link]
        for index, (a, b) in enumerate(zip(streams.first[:-1], streams.first[1:], strict=True)):
            assert np.flatnonzero(owner == index).tolist() == list(range(a, b))

    @given(seed=st.integers(0, 10_000))
    def test_every_signalled_turn_is_in_one_stream_and_shares_add_up(self, net: Network, seed: int) -> None:
        fraction = np.random.default_rng(seed).uniform(size=len(net.turns))
        fraction /= np.bincount(net.turn_link, fraction)[net.turn_link]
        self.agree(net, fraction)

    @pytest.mark.parametrize("make", ODD, ids=lambda make: make.__name__)
    def test_they_do_on_odd_nets(self, make: Make, street_of: Callable[[Make], Network]) -> None:
        network = street_of(make)
        self.agree(network, network.fraction)


class TestEnding:
    def test_who_is_left_waits_longer_where_a_cycle_has_longer_clearances(self) -> None:
        first = np.array([0, 2, 4, 7])
        # Bins from each stage to its junction's nth: of the third junction those beside the cycle do not count.
        quick = [[1, 2, 1], [2, 1, 1]]
        slow = [[1, 4, 1], [4, 1, 1]]
        three = [[1, 4, 9], [9, 1, 4], [4, 9, 1]]
        clearance, drives = np.array([*quick, *slow, *three]), np.ones(7, dtype=np.bool_)
        found = staying(lost(first, clearance, drives))
        assert found[0] < found[1] < found[2]
        assert found[2] - found[1] == pytest.approx((12 - 8) * (found[1] - found[0]) / (8 - 4), rel=0.5)

    def test_a_stage_for_people_alone_is_in_no_cycle_but_beside_one_for_cars(self) -> None:
        clearance = np.array([[1, 4, 9], [9, 1, 5], [6, 3, 1]])
        of = [True, True, False], [True, False, False], [True, True, True]
        found = [lost(np.array([0, 3]), clearance, np.array(drives))[0] for drives in of]
        assert found == [4 + 9, 4 + 5 + 6, 4 + 5 + 6]

    def test_of_a_cycle_that_could_be_shorter_only_the_stages_that_all_need_count(self) -> None:
        # Two roads with their left turns apart, and a stage for each arm besides: by four of the eight all have way.
        of_arm = [[0, 4], [1, 5], [2, 6], [3, 7]]
        of_road = [[0, 1], [2, 3], [4, 5], [6, 7]]
        way = np.zeros((8, 8), dtype=np.bool_)
        for stage, streams in enumerate([*of_road, *of_arm]):
            way[stage, streams] = True
        clearance = np.full((8, 8), 3)
        first = np.array([0, 8])
        assert lost(first, clearance, way.any(axis=1)) == [24]
        assert lost_at_least(first, clearance, way) == [12]
        # Of several such cycles it is the quickest: by arms, then by one road and the arms of the other.
        clearance[:4, :4] = 5
        assert lost_at_least(first, clearance, way) == [12]
        clearance[4:, 4:] = 6
        assert lost_at_least(first, clearance, way) == [5 + 3 + 6 + 3]
        # Without the other one's stages there is no choice, and nobody has to have a way who has none anywhere.
        assert lost_at_least(np.array([0, 4]), clearance[:4, :4], way[:4]) == [20]
        assert lost_at_least(np.array([0, 4]), clearance[:4, :4], way[:4, :6]) == [5 + 5 + 5]

    @given(
        way=st.lists(st.lists(st.booleans(), min_size=4, max_size=4), min_size=2, max_size=6),
        seed=st.integers(0, 99),
    )
    def test_it_is_the_quickest_of_those_with_fewest_stages(self, way: list[list[bool]], seed: int) -> None:
        has_way, first = np.array(way), np.array([0, len(way)])
        clearance = np.random.default_rng(seed).integers(1, 10, (len(way), len(way)))
        found = lost_at_least(first, clearance, has_way)[0]
        every, stages = has_way.any(axis=0), range(len(way))
        cycles = [
            cycle
            for count in range(2, len(way) + 1)
            for cycle in combinations(stages, count)
            if (has_way[list(cycle)].any(axis=0) == every).all()
        ]
        fewest = min(map(len, cycles))
        assert found == min(
            sum(clearance[a, b] for a, b in zip(cycle, (*cycle[1:], cycle[0]), strict=True))
            for cycle in cycles
            if len(cycle) == fewest
        )

    def test_a_turn_that_gives_way_in_one_stage_needs_the_one_in_which_it_has_way(
        self, street_of: Callable[[Make], Network]
    ) -> None:
        network = street_of(odd_nets.actuated_left_turns)
        streams = Streams(network)
        way = have_way(network, streams)
        assert (way <= streams.serves).all()
        assert (way.any(axis=0) == streams.serves.any(axis=0)).all()
        # Some have green in a stage in which they give way, and way in another one.
        assert (streams.serves & ~way).any()

    def test_schedules_go_farther_where_the_clearances_of_a_junction_alone_take_long(
        self, utn17: Network, street_of: Callable[[Make], Network]
    ) -> None:
        network = street_of(odd_nets.actuated_left_turns)
        alone = are_alone(network, Streams(network))
        assert alone.all()
        near, some, more, most, endless = (
            ahead_bins(alone, 25, np.array([lost_bins]))[0] for lost_bins in (9, 10, 16, 30, 300)
        )
        assert near == 25 < some < more < most == endless
        # Who wants it farther than any has it so.
        assert ahead_bins(alone, 100, np.array([30])) == [100]
        assert are_far(network, Streams(network)).all()
        assert not are_alone(utn17, Streams(utn17)).any()
        assert (ahead_bins(are_alone(utn17, Streams(utn17)), 25, np.full(8, 30)) == 25).all()

    def test_schedules_go_farther_where_the_roads_ahead_take_what_is_let_go_and_those_beyond_them(
        self, tmp_path: Path
    ) -> None:
        def of(network: Network) -> list[bool]:
            found = are_far(network, Streams(network))
            return [bool(found[[junction.id for junction in network.junctions].index(name)]) for name in "ABCD"]

        net = streets.named(str(odd_nets.row("ABCD", gap_m=400, lanes=2).net(tmp_path, odd_nets.NO_TURNAROUNDS)))
        assert of(net) == [True] * 4
        # Between C and D there is room for a few: B's would stand before C.
        short = tuple(replace(link, storage_veh=4) if link.id in ("C-D", "D-C") else link for link in net.links)
        assert of(replace(net, links=short)) == [True, False, False, False]
        # With a little more room they get on from there, but neither C nor D knows what happens in a minute.
        longer = tuple(replace(link, storage_veh=15) if link.id in ("C-D", "D-C") else link for link in net.links)
        assert of(replace(net, links=longer)) == [True, True, False, False]

    @pytest.mark.parametrize(
        ("names", "gap_m", "layout", "found"),
        [
            ("AB", 400, "incoming", [True, True]),
            ("ABC", 400, "incoming", [True, True, True]),
            # The road between them is full within one green, or a schedule reaches all that there is.
            ("AB", 120, "incoming", [False, False]),
            ("AB", 400, "opposites", [False, False]),
            ("A", 400, "opposites", [True]),
        ],
    )
    def test_long_greens_count_where_many_stages_let_go_what_the_roads_ahead_take(
        self, tmp_path: Path, names: str, gap_m: float, layout: str, found: list[bool]
    ) -> None:
        row = odd_nets.row(names, gap_m=gap_m, lanes=2)
        net = streets.named(str(row.net(tmp_path, odd_nets.NO_TURNAROUNDS, "--tls.layout", layout)))
        streams = Streams(net)
        assert are_apart(net, streams, are_alone(net, streams)).tolist() == found
        if len(names) > 1:
            # Nobody knows how much is to be let go where a queue can reach back onto roads unseen.
            amid = replace(net.links[int(net.link_junction.argmin())], begins_amid=True)
            links = tuple(amid if link.id == amid.id else link for link in net.links)
            hemmed = replace(net, links=links)
            assert are_apart(hemmed, streams, are_alone(hemmed, streams)).tolist() == [False, *found[1:]]

    def test_whoever_needs_a_stage_for_himself_has_others_wait_for_him(self) -> None:
        # A main road of two streams beside a left turn, and a side road.
        serves = np.array([[True, True, False, False], [False, False, True, False], [False, False, False, True]])
        come, most = np.array([1.0, 0.5, 0.2, 0.3]), np.array([4.0, 4.0, 1.0, 2.0])
        # The main road's need least: half a vehicle comes elsewhere, and four of them go in the time of a bin.
        assert needing(serves, come, most) == pytest.approx([0, 0, 1.8 / 1 - 0.5 / 4, 1.7 / 2 - 0.5 / 4])

    def test_in_which_of_two_stages_they_go_is_up_to_the_better_one(self) -> None:
        serves = np.array([[True, True, False], [False, True, True]])
        found = needing(serves, np.array([1.0, 0.1, 0.4]), np.ones(3))
        assert found == pytest.approx([0, 0, 1.0 - 0.4])

    def test_nobody_needs_more_where_all_are_alike_or_nobody_comes(self) -> None:
        assert not needing(np.eye(3, dtype=bool), np.full(3, 0.7), np.full(3, 2.0)).any()
        assert not needing(np.eye(3, dtype=bool), np.zeros(3), np.array([1.0, 2.0, 4.0])).any()

    def test_who_is_never_served_needs_nothing(self) -> None:
        serves = np.array([[True, False, False], [False, False, True]])
        assert needing(serves, np.array([1.0, 5.0, 0.5]), np.ones(3)) == pytest.approx([0, 0, 0.5])
        assert not needing(np.zeros((2, 3), dtype=bool), np.ones(3), np.ones(3)).any()
        assert not needing(np.zeros((2, 0), dtype=bool), np.zeros(0), np.zeros(0)).size

    def test_the_more_the_clearances_take_the_more_it_weighs(self, utn17: Network) -> None:
        streams = Streams(utn17)
        clearance = Moves(utn17, streams, 2, are_alone(utn17, streams)).bins
        come = np.linspace(0.1, 0.4, len(streams.link))
        needed = []
        for times in (0, 1, 2):
            none, nobody = np.zeros(len(come)), np.zeros((len(come), 25))
            lost_bins = lost(streams.first_stage, times * clearance, streams.serves.any(axis=1))
            ending = Ending(streams, lost_bins, np.full(8, 25), np.ones(8, dtype=bool))
            everywhere = np.ones(8, dtype=bool)
            beyond_bins = ending.beyond_bins(everywhere, none, nobody)
            assert not np.any(ending.weights(none, beyond_bins))
            ending.take_up(come, np.ones(len(come)), np.ones(len(come)))
            needed.append(ending.weights(none, beyond_bins)[0])
        assert not needed[0].any()
        assert needed[1].any()
        assert (needed[2][needed[1] > 0] > needed[1][needed[1] > 0]).all()

    def price(
        self, serves: Any, rate: Sequence[float], most: Sequence[float], stand: Sequence[float], *,
        come_veh: float = 0.0, lane_set: Sequence[int] = (),
    ) -> Floats:  # fmt: skip
        """Of a junction whose schedules have ten bins, of which four are clearances."""
        come = np.zeros((len(rate), 12))
        come[:, 9], come[:, 10] = come_veh, 100.0
        stages, streams = np.shape(serves)
        first, first_stage, leaves = np.array([0, streams]), np.array([0, stages]), np.array(most)
        own, lanes = np.array(serves, dtype=bool), np.array(lane_set or range(streams))
        beyond_bins = beyond(
            np.ones(1, dtype=bool), np.array([10]), np.array([4]), first, first_stage, own, lanes, leaves,
            np.array(stand), come,
        )  # fmt: skip
        return np.asarray(prices(beyond_bins, first, first_stage, own, lanes, np.array(rate), leaves))

    def test_where_more_are_there_than_can_go_all_who_come_wait_for_who_is_left(self) -> None:
        # Three lanes and one: five bins of green and ten, nine more than there are; a tenth of the time is spare.
        found = self.price(np.eye(2), [1.5, 0.4], [3.0, 1.0], [15.0, 10.0])
        assert found == pytest.approx([1.9 * 90 / 3, 1.9 * 90])
        # Half of it is.
        found = self.price(np.eye(2), [0.6, 0.3], [3.0, 1.0], [15.0, 10.0])
        assert found == pytest.approx([0.9 * 18 / 3, 0.9 * 18])
        # Not for ever.
        found = self.price(np.eye(2), [0.6, 0.3], [3.0, 1.0], [3000.0, 10.0])
        assert found == pytest.approx([0.9 * 150 / 3, 0.9 * 150])

    def test_nobody_waits_longer_where_all_can_go(self) -> None:
        assert not self.price(np.eye(2), [1.5, 0.4], [3.0, 1.0], [9.0, 3.0]).any()
        assert self.price(np.eye(2), [1.5, 0.4], [3.0, 1.0], [9.0, 3.0], come_veh=0.1).all()

    def test_who_go_together_take_the_time_together(self) -> None:
        found = self.price([[1, 1, 0], [0, 0, 1]], [0.3, 0.1, 0.2], [1.0, 1.0, 1.0], [9.0, 9.0, 9.0])
        assert found[0] + found[1] == pytest.approx(found[2])
        assert found[0] == pytest.approx(3 * found[1])
        # Who is in no stage takes none; of two stages the one counts in which others need more.
        found = self.price([[1, 1, 0, 0], [0, 1, 1, 0]], [0.3, 0.1, 0.1, 0.2], [1.0] * 4, [9.0] * 4)
        assert found == pytest.approx(found[0] * np.array([1, 1 / 3, 2 / 3, 0]))

    def test_who_share_lanes_take_their_time_one_after_the_other(self) -> None:
        alone = self.price(np.eye(2), [0.3, 0.3], [1.0, 1.0], [9.0, 9.0])
        shared = self.price([[1, 1, 0], [0, 0, 1]], [0.2, 0.1, 0.3], [1.0] * 3, [5.0, 4.0, 9.0], lane_set=[7, 7, 2])
        assert shared == pytest.approx(alone[[0, 0, 1]])
        # Nor does it take more of one of them where only he goes.
        parted = self.price(
            [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0.2, 0.1, 0.3], [1.0] * 3, [5.0, 4.0, 9.0], lane_set=[7, 7, 2]
        )
        assert (parted[:2] <= parted[2] + 1e-9).all()

    def test_nobody_is_asked_who_is_not_alone(self, utn17: Network, street_of: Callable[[Make], Network]) -> None:
        for network in (utn17, street_of(odd_nets.actuated_left_turns)):
            streams = Streams(network)
            junctions, count = len(network.junctions), len(streams.link)
            alone = are_alone(network, streams)
            ending = Ending(streams, np.full(junctions, 4), np.full(junctions, 25), alone)
            ending.take_up(np.full(count, 0.2), np.ones(count), np.ones(count))
            few, many, all_ = np.zeros(count), np.full(count, 90.0), np.ones(junctions, dtype=bool)

            def weights(asked: Bools, stand: Floats, ending: Ending = ending) -> tuple[Floats, Floats]:
                come = np.zeros((len(stand), 25))
                return ending.weights(np.zeros(len(stand)), ending.beyond_bins(asked, stand, come))

            quiet, quiet_open = weights(all_, few)
            busy, busy_open = weights(all_, many)
            assert (busy > quiet).any() == alone.any()
            # Not quite as long for who has green at the end, where any wait longer at all.
            assert (quiet_open == quiet).all()
            assert ((busy_open < busy) == (busy > quiet)).all()
            assert (busy_open >= quiet).all()
            others, others_open = weights(~all_, many)
            assert (others == quiet).all()
            assert (others_open == quiet).all()

    @given(st.data())
    def test_the_greens_that_all_need_are_enough_and_least_where_no_two_stages_share(self, data: st.DataObject) -> None:
        stages, streams = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 6))
        serves = np.array([[data.draw(st.booleans()) for _ in range(streams)] for _ in range(stages)])
        needed = np.array([data.draw(st.floats(0, 20)) for _ in range(streams)])
        found = greens(serves, needed)
        served = serves.any(axis=0)
        least = linprog(np.ones(stages), -1.0 * serves.T[served], -needed[served]).fun if served.any() else 0.0
        assert least - 1e-6 <= found <= needed[served].sum() + 1e-6
        if (serves.sum(axis=0) <= 1).all():
            assert found == pytest.approx(least, abs=1e-6)


class TestMoves:
    def test_they_are_the_stages_greens_first(self, net: Network) -> None:
        streams = Streams(net)
        moves = Moves(net, streams, 2, are_alone(net, streams))
        for row, junction in enumerate(net.stage_junction[streams.stage]):
            a, b = streams.first[junction], streams.first[junction + 1]
            assert (moves.share[row, : b - a] == streams.serves[row, a:b]).all()
            assert not moves.share[row, b - a :].any()

    def test_nobody_moves_where_all_lose_green(self, utn17: Network) -> None:
        streams = Streams(utn17)
        moves = Moves(utn17, streams, 2, are_alone(utn17, streams))
        assert (moves.row == -1).all()
        assert len(moves.share) == len(utn17.stages)
        # Three seconds of yellow and two of red, rounded up.
        counts = [len(junction.stages) for junction in utn17.junctions]
        assert (moves.bins == 3).sum() == sum(count * (count - 1) for count in counts)

    @pytest.mark.parametrize("acceleration_m_s2", [2.6, 2.45, 1.4, 0.8, 0.02])
    def test_green_begins_as_much_later_as_queues_that_speed_up_slowly_start(
        self, acceleration_m_s2: float, street_of: Callable[[Make], Network]
    ) -> None:
        cars = street_of(odd_nets.plain)
        slow = replace(cars, acceleration_m_s2=acceleration_m_s2)
        streams = Streams(cars)
        behind_s = 50 / 3.6 / 2 * (1 / acceleration_m_s2 - 1 / 2.6)
        for alone, lost_s in ((True, min(behind_s, 10.0)), (False, min(behind_s / 2, 10.0))):
            usual, late = (Moves(each, streams, 2, np.array([alone])) for each in (cars, slow))
            for row, then in ((0, 1), (1, 0)):
                more, begins = late.bins[row, then] - usual.bins[row, then], late.row[row, then]
                all_red = begins == -1
                rows = late.share[begins + usual.bins[row, then] :][:more] * (not all_red)
                served = streams.serves[streams.stage == cars.junctions[0].stages[then]][0]
                assert 2 * (more - rows[:, served].sum(axis=0)) == pytest.approx(lost_s, abs=0.5)
                # Nobody goes whose green has ended.
                assert not rows[:, ~served].any()

    def test_vehicles_go_on_while_who_walks_is_cleared(self, street_of: Callable[[Make], Network]) -> None:
        network = street_of(odd_nets.pedestrians)
        streams = Streams(network)
        moves = Moves(network, streams, 2, are_alone(network, streams))
        held = [index for index, stage in enumerate(network.stages) if any(stage.held)]
        assert held
        for stage in held:
            row = int(np.flatnonzero(streams.stage == stage)[0])
            stages = network.junctions[network.stages[stage].junction].stages
            then = (stages.index(stage) + 1) % len(stages)
            a = streams.first[network.stages[stage].junction]
            open_s = sum(
                seconds
                for (_, seconds), turns in zip(network.stages[stage].clearance, network.stages[stage].held, strict=True)
                if turns
            )
            rows = moves.share[moves.row[row, then] : moves.row[row, then] + moves.bins[row, then]]
            assert (moves.held[row] >= (rows[0] > 0)).all()
            served = np.flatnonzero(streams.serves[row, a : streams.first[network.stages[stage].junction + 1]])
            assert 2 * rows[:, served].sum(axis=0).max() == pytest.approx(open_s)


class TestLeastGreen:
    def test_it_is_sumo_s_own_where_the_net_names_none(self, net: Network) -> None:
        assert (net.least_green_s == 5).all()
        assert (net.min_green_s == 10).all()

    def test_it_is_the_net_s_own_where_it_names_one(self, street_of: Callable[[Make], Network]) -> None:
        network = street_of(odd_nets.protected_crossings)
        assert (network.least_green_s == odd_nets.CROSSING_LEAST_S).all()

    def test_who_walks_beside_traffic_has_it_too_and_who_walks_alone_the_plan_s(
        self, street_of: Callable[[Make], Network]
    ) -> None:
        network = street_of(odd_nets.pedestrians)
        assert any("G" in stage.state[12:] for stage in network.stages)
        assert (network.least_green_s == 5).all()
        network = street_of(odd_nets.crossing_amid_a_street)
        alone = np.array([not stage.turns for stage in network.stages])
        assert alone.any()
        assert (network.least_green_s == np.where(alone, network.min_green_s, 5)).all()

    def test_the_signal_heads_keep_it_and_no_more(self, utn17: Network) -> None:
        heads = Heads(utn17, lambda index, state: None)
        heads.start(0.0)
        assert not heads.free(4.0).any()
        assert heads.free(5.0).all()
        stage = utn17.junctions[0].stages[1]
        heads.switch(0, stage, 5.0)
        since_s = 5.0 + utn17.clearance_s[utn17.junctions[0].stages[0]]
        assert heads.begin_s[0] == since_s
        assert not heads.free(since_s + 4.0)[0]
        assert heads.free(since_s + 5.0)[0]


def drawn(network: Network, seed: int) -> Scene:
    """A scene with some before every lane group, some junctions free, in any stage."""
    rng = np.random.default_rng(seed)
    near_veh = rng.integers(0, 9, len(network.groups)).astype(float)
    seen_veh = np.bincount(network.group_link, near_veh, len(network.links))
    return replace(
        scene(network, 20.0, np.array([rng.choice(junction.stages) for junction in network.junctions])),
        free=rng.uniform(size=len(network.junctions)) < 0.8,
        set_zone_veh=by_the_line(near_veh),
        x_veh=seen_veh,
        entered_veh=seen_veh,
    )


def next_in_cycle(network: Network) -> Ints:
    after = np.zeros(len(network.stages), dtype=np.int64)
    for junction in network.junctions:
        after[list(junction.stages)] = np.roll(junction.stages, -1)
    return after


class TestSooner:
    """A green that is to end with the bin ends within it, once nobody is close any more whom that would stop."""

    def scenes(self, network: Network, waiting_veh: float) -> tuple[Scene, Scene]:
        """Two by the line before green and so many before all others; and a second later, when they have gone."""
        stages = [junction.stages[0] for junction in network.junctions]
        green = network.serves[stages].any(axis=0)
        line_veh = np.full(len(network.groups), waiting_veh)
        line_veh[network.turn_group[green]] = 2.0
        gone_veh = line_veh.copy()
        gone_veh[network.turn_group[green]] = 0.0
        view = scene(network, 6.0)
        return tuple(
            replace(view, time_s=time_s, set_zone_veh=by_the_line(veh))
            for time_s, veh in ((6.0, line_veh), (7.0, gone_veh))
        )

    def test_it_ends_when_nobody_is_left_by_the_line_and_not_before(self, utn17: Network) -> None:
        view, gone = self.scenes(utn17, 3.0)
        for then, goes in ((replace(view, time_s=7.0), False), (gone, True)):
            execution = Scheduled(utn17)
            assert (execution.wish(view) == view.stage).all()
            assert execution.every_s == 1
            assert ((execution.wish(then) != view.stage) == goes).all()
            # The next decision is when it would have been anyway.
            assert execution.every_s == 1

    @pytest.mark.parametrize("zone", range(len(ZONES_M)))
    @pytest.mark.parametrize("where", ["set_zone_veh", "link_zone_veh"])
    def test_it_waits_for_who_is_within_50_m_on_its_lanes_or_before_they_part(
        self, utn17: Network, zone: int, where: str
    ) -> None:
        view, gone = self.scenes(utn17, 3.0)
        execution = Scheduled(utn17)
        execution.wish(view)
        veh = getattr(gone, where).copy()
        veh[:, zone] += 1
        assert ((execution.wish(replace(gone, **{where: veh})) == view.stage) == (ZONES_M[zone] <= 50)).all()

    def test_it_leads_where_the_schedule_was_to_go(self, utn17: Network) -> None:
        view, gone = self.scenes(utn17, 3.0)
        sooner, later = Scheduled(utn17), Scheduled(utn17)
        for execution in (sooner, later):
            execution.wish(view)
        led = sooner.wish(gone)
        assert (later.wish(replace(view, time_s=7.0)) == view.stage).all()
        assert (led == later.wish(replace(gone, time_s=8.0))).all()

    def test_it_stays_where_a_junction_may_not_go_and_is_not_looked_at_where_nobody_waits(self, utn17: Network) -> None:
        view, gone = self.scenes(utn17, 3.0)
        free = np.arange(len(utn17.junctions)) % 2 == 0
        execution = Scheduled(utn17)
        execution.wish(view)
        assert ((execution.wish(replace(gone, free=free)) != view.stage) == free).all()
        view, _ = self.scenes(utn17, 0.0)
        execution = Scheduled(utn17)
        execution.wish(view)
        assert execution.every_s == 2

    @pytest.mark.parametrize(("stand", "then"), [((1.0, 6.0), 1), ((0.0, 0.0), 0), ((9.0, 1.0), 0)])
    def test_it_is_foreseen_by_the_schedule(self, stand: tuple[float, ...], then: int) -> None:
        crossing = Crossing()
        assert crossing.decide(stand)[0] == 0
        assert crossing.then == then
        crossing.decide(stand, free=False)
        assert crossing.then == 0


class TestExecution:
    def test_on_empty_roads_every_signal_stays(self, net: Network) -> None:
        view = scene(net)
        assert (Scheduled(net).wish(view) == view.stage).all()

    @given(seed=st.integers(0, 10_000))
    def test_it_wishes_for_stages_of_the_junction_and_none_where_it_is_not_free(self, net: Network, seed: int) -> None:
        view = drawn(net, seed)
        for order in ("any", "cycle"):
            wish = Scheduled(net, order=order).wish(view)
            assert (net.stage_junction[wish] == np.arange(len(net.junctions))).all()
            assert (wish == view.stage)[~view.free].all()
            if order == "cycle":
                assert ((wish == view.stage) | (wish == next_in_cycle(net)[view.stage])).all()

    def test_the_same_views_have_the_same_wishes(self, utn17: Network) -> None:
        one, other = Scheduled(utn17), Scheduled(utn17)
        for seed in range(20):
            view = drawn(utn17, seed)
            assert (one.wish(view) == other.wish(view)).all()

    def test_a_bound_is_kept_where_others_wait_and_only_if_it_is_wished_for(self, utn17: Network) -> None:
        plan = utn17.equal_split()
        served = utn17.serves[[junction.stages[0] for junction in utn17.junctions]].any(axis=0)
        near_veh = np.full(len(utn17.groups), 0.5)
        near_veh[utn17.turn_group[served]] = 12.0
        for bounds, leaves in (("none", False), ("plan", True)):
            execution = Scheduled(utn17, bounds=bounds)
            execution.begin(plan, Estimator(utn17, utn17).initial())
            went_veh = np.ones(len(utn17.groups))
            view = replace(scene(utn17, 500.0), set_zone_veh=by_the_line(near_veh), left_veh=went_veh)
            assert (execution.wish(view) != view.stage).all() == leaves
            # It has not been reached yet.
            view = replace(view, time_s=2.0)
            assert (execution.wish(view) == view.stage).all()

    def test_nobody_is_sent_onto_a_link_that_is_full(self, utn17: Network) -> None:
        streams = Streams(utn17)
        stream = int(np.flatnonzero(streams.next_link != EXIT)[0])
        ahead = int(streams.next_link[stream])
        execution = Scheduled(utn17)
        for taken, moves in ((0.0, True), (0.9, False)):
            x_veh = np.zeros(len(utn17.links))
            x_veh[ahead] = taken * utn17.storage_veh[ahead]
            near_veh = np.zeros(len(utn17.groups))
            near_veh[streams.group[stream]] = 8.0
            execution.wish(replace(scene(utn17), set_zone_veh=by_the_line(near_veh), x_veh=x_veh))
            assert (execution._outlook.sent_veh[stream].sum() > 0.1) == moves

    @pytest.mark.parametrize(("share", "moves"), [((1.0, 0.0), False), ((0.0, 1.0), False), ((0.5, 0.5), True)])
    def test_nobody_is_sent_onto_a_link_of_which_one_lane_is_full(
        self, share: tuple[float, float], moves: bool, street_of: Callable[[Make], Network]
    ) -> None:
        # Left turns give way and have the inner lane, all others the outer one.
        street = street_of(odd_nets.shared_letters)
        streams = Streams(street)
        stream = int(np.flatnonzero(streams.next_link != EXIT)[0])
        ahead = int(streams.next_link[stream])
        inner_and_outer = np.flatnonzero(street.set_link == ahead)
        assert [len(street.lane_sets[lane_set].lanes) for lane_set in inner_and_outer] == [1, 1]
        # Nearly as many as fit on one lane are not half as many as fit on the link.
        x_veh = np.zeros(len(street.links))
        x_veh[ahead] = 0.45 * street.storage_veh[ahead]
        near_veh = np.zeros(len(street.lane_sets))
        near_veh[streams.lane_set[stream]] = 8.0
        near_veh[inner_and_outer] = x_veh[ahead] * np.array(share)
        execution = Scheduled(street, full=0.8)
        execution.wish(replace(scene(street), set_zone_veh=by_the_line(near_veh), x_veh=x_veh))
        assert (execution._outlook.sent_veh[stream].sum() > 0.1) == moves

    @pytest.mark.parametrize(("taken", "moves"), [(0.55, True), (0.85, False)])
    def test_a_single_lane_may_be_filled_farther_than_two_that_are_seen_as_one(
        self, taken: float, moves: bool, utn17: Network, street_of: Callable[[Make], Network]
    ) -> None:
        for street, is_single in ((street_of(odd_nets.actuated), True), (utn17, False)):
            streams = Streams(street)
            stream = int(np.flatnonzero(streams.next_link != EXIT)[0])
            ahead = int(streams.next_link[stream])
            assert (street.links[ahead].lanes == 1) == is_single
            x_veh, near_veh = np.zeros(len(street.links)), np.zeros(len(street.lane_sets))
            x_veh[ahead] = taken * street.storage_veh[ahead]
            near_veh[streams.lane_set[stream]] = 8.0
            execution = Scheduled(street)
            execution.wish(replace(scene(street), set_zone_veh=by_the_line(near_veh), x_veh=x_veh))
            assert (execution._outlook.sent_veh[stream].sum() > 0.1) == (moves and is_single)

    @pytest.mark.parametrize(("ahead", "goes"), [(0.3, "3"), (0.6, "2")])
    def test_who_brings_most_onto_a_road_that_fills_up_waits_however_many_of_them_turn_elsewhere(
        self, ahead: float, goes: str, utn17: Network
    ) -> None:
        # Of link 3 four in five go onto link 10, of link 2 two in five, and link 3 has the longer queue by far.
        name = [link.id for link in utn17.links]
        veh = {"2": 2.0, "3": 24.0}
        near_veh = np.array([veh.get(name[link], 0.0) for link in utn17.group_link])
        x_veh = np.zeros(len(utn17.links))
        x_veh[name.index("10")] = ahead * utn17.storage_veh[name.index("10")]
        view = replace(scene(utn17), set_zone_veh=by_the_line(near_veh), x_veh=x_veh)
        junction, execution, chosen = utn17.link_junction[name.index("3")], Scheduled(utn17), []
        for now_s in np.arange(0.0, 400.0, 2.0):
            left_veh = np.full(len(utn17.groups), now_s)
            chosen.append(int(execution.wish(replace(view, time_s=now_s, left_veh=left_veh))[junction]))
        served = [
            [link for link in veh if name.index(link) in utn17.turn_link[utn17.serves[stage]]] for stage in chosen
        ]
        # The road has to have been full for a while.
        assert served[0] == ["3"]
        assert served[-1] == [goes]

    @pytest.mark.parametrize("blocking", [0.0, 4.0])
    @pytest.mark.parametrize("hemmed", ["10", "11"])
    def test_of_two_queues_alike_the_one_that_others_wait_behind_goes_first(
        self, hemmed: str, blocking: float, utn17: Network
    ) -> None:
        name = [link.id for link in utn17.links]
        queued = [name.index("10"), name.index("11")]
        behind = utn17.turn_link[np.isin(utn17.turn_next, name.index(hemmed))]
        near_veh = np.zeros(len(utn17.groups))
        near_veh[np.isin(utn17.group_link, [*queued, *behind])] = 45.0
        junction = utn17.link_junction[name.index(hemmed)]
        execution, chosen = Scheduled(utn17, blocking=blocking), []
        for now_s in np.arange(0.0, 300.0, 2.0):
            went_veh = np.full(len(utn17.groups), now_s)
            view = replace(scene(utn17, now_s), set_zone_veh=by_the_line(near_veh), left_veh=went_veh)
            chosen.append(int(execution.wish(view)[junction]))
        goes = [name.index(hemmed) in utn17.turn_link[utn17.serves[stage]] for stage in chosen]
        assert goes[-1] or not blocking
        # Without it, and as long as it has not lasted, whoever has green already goes on.
        assert chosen[0] == view.stage[junction]
        assert blocking or set(chosen) == {view.stage[junction]}

    @pytest.mark.parametrize("hemmed", ["8", "9"])
    @pytest.mark.parametrize(("amid", "taken"), [(False, 1.0), (True, 1.0), (True, 0.3), (True, 0.15)])
    def test_a_queue_that_reaches_back_onto_roads_unseen_goes_first(
        self, hemmed: str, amid: bool, taken: float, utn17: Network
    ) -> None:
        reaches = amid and taken > 0.2
        name = [link.id for link in utn17.links]
        links = tuple(replace(link, begins_amid=amid and link.id == hemmed) for link in utn17.links)
        queued = [name.index("8"), name.index("9")]
        full = np.isin(np.arange(len(name)), queued)
        near_veh = np.where(full[utn17.group_link], 45.0, 0.0)
        junction = utn17.link_junction[queued[0]]
        execution, chosen = Scheduled(replace(utn17, links=links)), set()
        for now_s in np.arange(0.0, 300.0, 2.0):
            view = replace(
                scene(utn17, now_s),
                set_zone_veh=by_the_line(near_veh),
                x_veh=full * taken * utn17.storage_veh,
                left_veh=np.full(len(utn17.groups), now_s),
            )
            wish = int(execution.wish(view)[junction])
            chosen.add(wish)
        # Of queues alike whoever has green goes on.
        shown = view.stage[junction]
        first = next(
            stage
            for stage in utn17.junctions[junction].stages
            if utn17.serves[stage, utn17.turn_link == name.index(hemmed)].any()
        )
        assert chosen == ({shown, first} if reaches else {shown})
        assert wish == (first if reaches else shown)

    @pytest.mark.parametrize("starving", [0.0, 2.0])
    def test_who_has_waited_behind_a_queue_that_never_ends_is_let_go_some_time(
        self, starving: float, utn17: Network
    ) -> None:
        name = [link.id for link in utn17.links]
        near_veh = np.zeros(len(utn17.groups))
        near_veh[np.isin(utn17.group_link, name.index("9"))] = 12.0
        near_veh[np.isin(utn17.group_link, name.index("8"))] = 11.0
        # Those of link 9 go, are gone for a moment, and as many come again; those of link 8 stand all the time.
        junction = utn17.link_junction[name.index("8")]
        execution, served = Scheduled(utn17, starving=starving, blocking=0.0), False
        for step, now_s in enumerate(np.arange(0.0, 200.0, 2.0)):
            there_veh = near_veh * np.where(utn17.group_link == name.index("9"), step % 10 > 0, 1.0)
            went_veh = np.full(len(utn17.groups), now_s)
            view = replace(scene(utn17, now_s), set_zone_veh=by_the_line(there_veh), left_veh=went_veh)
            if step % 10:
                served = (
                    utn17.turn_link[utn17.serves[int(execution.wish(view)[junction])]].tolist() == [name.index("8")] * 2
                )
            else:
                execution.wish(view)
        assert served == (starving > 0)

    def test_who_is_never_let_go_to_the_last_one_weighs_more_by_the_square_of_how_long(self, utn17: Network) -> None:
        streams = Streams(utn17)
        count, sets = len(streams.link), len(utn17.lane_sets)
        worth = Worth(utn17, streams, crowding=0.0, blocking=0.0, starving=2.0, full=1.0)
        shares, all_of_them = streams.shares(utn17.fraction), np.ones(len(utn17.junctions), dtype=bool)

        def weigh(time_s: float, near_veh: float) -> Floats:
            zones = by_the_line(np.full(sets, near_veh)), np.zeros((len(utn17.links), len(ZONES_M)))
            nobody, none = np.zeros(len(utn17.links)), np.zeros(count, dtype=bool)
            most, held = np.ones(count), np.ones(len(utn17.groups))
            return worth.look(time_s, all_of_them, zones, nobody, shares, most, none, held)[0]

        found = [weigh(time_s, 3.0) for time_s in (0.0, 30.0, 60.0, 120.0, 300.0)]
        assert np.array(found) == pytest.approx(np.array([[1.0], [1.125], [1.5], [3.0], [3.0]]) + np.zeros(count))
        # One moment with nobody there, and all begins anew.
        weigh(302.0, 0.0)
        assert weigh(332.0, 3.0) == pytest.approx(np.full(count, 1.125))

    @pytest.mark.parametrize("is_full", [False, True])
    def test_onto_a_full_ring_whoever_comes_from_outside_is_held_back_and_whoever_is_on_it_is_not(
        self, is_full: bool, street_of: Callable[[Callable[[Path], Path]], Network]
    ) -> None:
        network = street_of(odd_nets.ring)
        streams = Streams(network)
        worth = Worth(network, streams, crowding=0.0, blocking=0.0, starving=0.0, full=1.0)
        shares, all_of_them = streams.shares(network.fraction), np.ones(len(network.junctions), dtype=bool)
        # However long the queues outside are, they are in nobody's way there.
        x_veh = np.where(network.is_source, 0.8, 0.8 * is_full) * network.storage_veh
        zones = np.zeros((len(network.lane_sets), len(ZONES_M))), np.zeros((len(network.links), len(ZONES_M)))
        most, none = np.ones(len(streams.link)), np.zeros(len(streams.link), dtype=bool)
        for now_s in np.arange(0.0, 600.0, 2.0):
            found = worth.look(now_s, all_of_them, zones, x_veh, shares, most, none, np.ones(len(network.groups)))[0]
        outside = network.is_source[streams.link]
        assert (outside.sum(), (~outside).sum()) == (4, 4)
        assert found[~outside] == pytest.approx(1.0)
        assert found[outside] == pytest.approx(0.05 if is_full else 1.0)

    @pytest.mark.parametrize(
        ("goes", "stands", "stays"), [(False, True, False), (True, True, True), (False, False, True)]
    )
    def test_a_queue_that_has_green_and_does_not_go_makes_way_for_others(
        self, goes: bool, stands: bool, stays: bool, utn17: Network
    ) -> None:
        served = utn17.serves[[junction.stages[0] for junction in utn17.junctions]].any(axis=0)
        near_veh = np.full(len(utn17.groups), 1.0 * stands)
        near_veh[utn17.turn_group[served]] = 12.0 * stands
        execution, begin_s = Scheduled(utn17), np.full(len(utn17.junctions), 30.0)

        def stay(now_s: float, begin_s: Floats) -> bool:
            left_veh = np.full(len(utn17.groups), now_s * goes)
            zone_veh = by_the_line(near_veh)
            view = replace(scene(utn17, now_s), set_zone_veh=zone_veh, left_veh=left_veh, begin_s=begin_s)
            return bool((execution.wish(view) == view.stage).all())

        assert all(stay(now_s, begin_s) for now_s in np.arange(30.0, 38.0, 2.0))
        assert stay(38.0, begin_s) == stays
        # A new green has as long again.
        assert stay(40.0, begin_s + 10.0)

    @pytest.mark.parametrize("made", [Scheduled, Recommended])
    @pytest.mark.parametrize(
        "settings",
        [{"horizn_s": 50}, {"horizon_s": 5}, {"order": "random"}, {"bounds": 1}, {"full": 0}, {"blocking": -1}],
    )
    def test_a_wrong_setting_is_refused(
        self, made: Callable[..., object], settings: dict[str, object], utn17: Network
    ) -> None:
        with pytest.raises(ValidationError):
            made(utn17, **settings)

    def test_recommended_is_scheduled_with_its_settings(self, utn17: Network) -> None:
        found = Recommended(utn17, horizon_s=30).execution
        assert isinstance(found, Scheduled)
        assert found.settings == Scheduled.Settings(horizon_s=30)
        assert found.settings.bounds == "none"
