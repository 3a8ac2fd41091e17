"""The dynamic programme of a junction: which stages to show in the bins ahead, so that least is waited.

Forward over the bins, as COP (Sen and Head 1997). A state is a stage that begins in a bin; of two ways that lead to
it, one goes on, with the queues that it leaves: that on which less would have been waited at the end, if the stage
stayed until then. What has been waited so far would be in favour of ways that have left somebody out. From there the
stage may last until any later bin. Of those who have red nobody leaves, so that what they wait is a difference of sums
made once; bin by bin go only those who have green, in a stage or for a while in a clearance. A way is left on which
more has been waited, or will be in the next clearance, than on another to its end, at first than by the schedule of the
bin before; and a stage to which nobody comes any more ends at once, or not until somebody does.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.gaps import Gaps, begin_green, clear, let_go
from utn_controllers.scheduled.moves import Rules
from utn_controllers.scheduled.regret import forborne
from utn_controllers.scheduled.rounds import in_turn
from utn_controllers.scheduled.traffic import Traffic
from utn_sumo.compiling import compiled, inlined
from utn_sumo.contract import Bools, Floats, Ints

NEVER = 1e18
"""Cost of what can't be reached."""
SOME_VEH = 0.02
"""Fewer than so many need no stage."""
NOBODY_VEH = 0.002
"""A green in which fewer are there is over: ten times as many have 0.5 % more delay in light traffic."""
ALIKE = 1e-9
"""Costs that differ by no more are the same: of ways alike the one found first is kept, whatever the rounding."""


@compiled
def schedules(
    stage: Ints, free: Bools, rest: Ints, rules: Rules, stand: Floats, come: Floats, worth: Floats, ends: Floats,
    kept: Floats, most: Floats, plan: Ints, sent: Floats, by_turns: Bools, shown_s: Floats, regret: Floats,
) -> tuple[Ints, Ints]:  # fmt: skip
    """(J,) what each junction that is `free` does in this bin: the stage to lead to, or the present `stage` (J,).

    And (J,) the same of the next bin, as far as it is foreseen: not where it would have changed, and stays.

    `rest` (J,) bins that the present one may still go on. `stand` (A,), `come` (A, K) vehicles; `worth` (A,)
    weight of a vehicle in a bin, `ends` (A,) of one that is left at the end, `kept` (A,) of one that has green then
    and waits for no gaps, `most` (A,) that leave in a bin of green.

    Of K bins schedules have as many as the rules say; beyond these `plan` has -1 and `sent` nobody.

    `plan` (J, K) has the schedules of the bin before, `sent` (A, K) what each stream sends off by them: both are given
    those of now. Of a schedule is said which row of the rules' moves each bin has, -1 for red; of junctions that are
    not free, what is left of the last one.

    Junctions that go `by_turns` (J,) show that stage next which was shown longest ago, at `shown_s` (S,).

    `regret` (J,) is what it has cost so far to stay where a schedule began with a change that nobody was seen to need,
    and is kept up to date.
    """
    wish, then = stage.copy(), stage.copy()
    for junction in range(len(stage)):
        a, b = rules.first[junction], rules.first[junction + 1]
        plan[junction, :-1] = plan[junction, 1:]
        if not free[junction] or b == a:
            sent[a:b, :-1] = sent[a:b, 1:]
            continue
        low, present = rules.first_stage[junction], 0
        while rules.stages[low + present] != stage[junction]:
            present += 1
        stages = rules.first_stage[junction + 1] - low
        bins = rules.ahead[junction]
        goes = np.empty((b - a, bins))
        # Two calls: for the compiler None is another type.
        if rules.gaps.some[low : low + stages].any():
            chosen = _schedule(
                present, rest[junction], low, stages, rules, rules.gaps, stand[a:b], come[a:b, :bins].copy(),
                worth[a:b], ends[a:b], kept[a:b], most[a:b], plan[junction, :bins], goes, by_turns[junction],
                shown_s[low : low + stages], regret[junction : junction + 1],
            )  # fmt: skip
        else:
            chosen = _schedule(
                present, rest[junction], low, stages, rules, None, stand[a:b], come[a:b, :bins].copy(), worth[a:b],
                ends[a:b], kept[a:b], most[a:b], plan[junction, :bins], goes, by_turns[junction],
                shown_s[low : low + stages], regret[junction : junction + 1],
            )  # fmt: skip
        sent[a:b, :bins] = goes
        wish[junction] = rules.stages[low + chosen]
        then[junction] = wish[junction]
        if chosen == present and plan[junction, 1] != low + present and regret[junction] == 0:
            for row in plan[junction, 1:]:
                if low <= row < low + stages:
                    then[junction] = rules.stages[row]
                    break
    return wish, then


@compiled
def _schedule(
    present: int, rest: int, low: int, stages: int, rules: Rules, gaps: Gaps | None, stand: Floats, come: Floats,
    worth: Floats, ends: Floats, kept: Floats, most: Floats, plan: Ints, sent: Floats, by_turns: bool, shown_s: Floats,
    regret: Floats,
) -> int:  # fmt: skip
    """The stage that one junction leads to in this bin, the `present` one if it stays, by rows from `low` on.

    `gaps` None says that nobody waits for any: the machine code for that is another, and quicker.
    """
    chosen = present
    # For the compiler a number that is written out is a type of its own, with machine code of its own.
    at_once, later = np.int64(0), np.int64(1)
    before, regret[0] = regret[0], 0.0
    called = _called(present, low, stages, rules, stand, come)
    if called.any():
        after = rules.follows[low : low + stages, :stages] & called & ~np.eye(stages, dtype=np.bool_)
        if by_turns:
            after &= in_turn(called, present, shown_s)
        traffic = _sums(rules.moves[low : low + stages], stand, come, worth, ends, kept, most)
        # What was best a bin ago is seldom far from what is best now.
        known = _leads_to(plan, low, stages, rules, gaps, traffic, sent)
        for limit in (known + ALIKE * (2 + known), NEVER):
            chosen = _search(present, rest, low, after, rules, gaps, traffic, limit, plan, at_once)
            if chosen >= 0:
                break
        if chosen != present and rest > 0:
            row = low + present
            gives_way, clearance = rules.gaps.waiting[row], rules.clearance[row, chosen]
            may_cost = forborne(stand, traffic.came, worth, rules.moves[row], gives_way, clearance) - before
            if may_cost > 0:
                known = _leads_to(plan, low, stages, rules, gaps, traffic, sent)
                staying = plan.copy()
                limit = known + may_cost
                if _search(present, rest, low, after, rules, gaps, traffic, limit, staying, later) == present:
                    chosen, plan[:] = present, staying
                    waited = _leads_to(plan, low, stages, rules, gaps, traffic, sent)
                    regret[0] = before + max(waited - known, ALIKE)
    else:
        plan[:] = low + present
    _send_off(plan, rules, gaps, stand, come, most, sent)
    return chosen


@compiled
def _called(present: int, low: int, stages: int, rules: Rules, stand: Floats, come: Floats) -> Bools:
    """(s,) stages that somebody needs who goes slower or not at all in the present one; if there are any, that one too.

    In a fixed order the way to them leads through all.
    """
    called = np.zeros(stages, np.bool_)
    for stream in range(len(stand)):
        now = rules.moves[low + present, stream]
        if now < 1 and stand[stream] + come[stream].sum() >= SOME_VEH:
            for stage in range(stages):
                called[stage] |= rules.moves[low + stage, stream] > now
    if called.any():
        called[present] = True
        called |= not rules.follows[low : low + stages, :stages].all()
    return called


@compiled
def _search(  # noqa: C901, PLR0912, PLR0915 - one search, all in one place for the compiler
    present: int, rest: int, low: int, after: Bools, rules: Rules, gaps: Gaps | None, traffic: Traffic, limit: float,
    plan: Ints, soonest: int,
) -> int:  # fmt: skip
    """The stage that is led to in the first bin, and into `plan` (K,) each row; -1 if all costs `limit` or more.

    `after` (s, s) has which stage may come after each; the present one ends in the bin `soonest` or later.
    """
    come, grown, paid, worth, most = traffic.come, traffic.grown, traffic.paid, traffic.worth, traffic.most
    ends, due, red = traffic.ends, traffic.due, traffic.red
    moves, going, clearing, clearance = rules.moves, rules.going, rules.clearing, rules.clearance
    came, least = traffic.came, rules.least
    (streams, bins), stages = come.shape, len(after)
    # The state: the stage that begins and when; for each the cost until then, by what it won, the queues, and whence.
    cost, rank = np.full((bins + 1, stages), NEVER), np.full((bins + 1, stages), NEVER)
    queue = np.empty((bins, stages, streams))
    # Whence: when the stage before began, which it was, when it ended.
    whence = np.zeros((bins + 1, stages, 3), np.int64)
    cost[0, present] = 0.0
    queue[0, present] = traffic.stand
    best, last_begin, last_stage = limit, 0 if limit >= NEVER else -1, present
    others, veh = np.empty(stages, np.int64), np.empty(streams)
    # Of the streams that move in a stage what their queues would weigh in red, and of those that move in a clearance
    # how many more stood at its end if they had red.
    waits, stays_on, fewer = np.empty((3, streams))
    pace, free, want, queued, to_come, amid = np.ones((6, streams))
    stood, left = np.empty((2, stages + 1))
    for begin in range(bins):
        for stage in range(stages):
            spent = cost[begin, stage]
            if spent >= best - ALIKE:
                continue
            row = low + stage
            # What the queues weigh that move, and that have red: these in `veh` as they stood when it began.
            moving, greens = 0.0, 0
            veh[:] = queue[begin, stage]
            while going[row, greens] >= 0:
                moving += worth[going[row, greens]] * veh[going[row, greens]]
                greens += 1
            _stood(stage, begin, veh, red, came, worth, ends, stood, left)
            held = stood[stages] + grown[stage, begin]
            nexts, lose = 0, bins
            for other in range(stages):
                if after[stage, other]:
                    others[nexts], nexts = other, nexts + 1
                    lose = 0 if clearing[row, other] >= 0 else min(lose, clearance[row, other])
            may_end, must_end = (begin + least[row], bins) if begin > 0 else (soonest, rest)
            now, goes = begin, True
            if gaps is not None:
                begin_green(row, gaps, begin == 0, pace, free, to_come)
            while now < bins:
                if spent + _held(stage, grown, paid, now, min(now + lose, bins), held) >= best - ALIKE:
                    break
                # Where nobody has gone in the bin before it could as well have ended then.
                if now >= may_end and (goes or now == may_end):
                    # It ends here: others begin after their clearance, where that is the best way there.
                    won, won_in = 0.0, -1
                    stays = held + moving
                    if gaps is not None:
                        clear(row, veh, most, going, gaps, pace, to_come, amid)
                        for place in range(greens):
                            stays -= worth[going[row, place]] * amid[going[row, place]]
                    for nth in range(greens):
                        stream = going[row, nth]
                        before = veh[stream] - came[stream, now]
                        waits[nth], stays_on[nth] = worth[stream] * before, ends[stream] * before
                    for place in range(nexts):
                        other = others[place]
                        opens = min(now + clearance[row, other], bins)
                        if spent >= rank[opens, other] - ALIKE:
                            continue
                        until = spent + _held(stages, grown, paid, now, opens, stays)
                        if opens == bins:
                            until += left[stages] + due[stages, bins]
                            for nth in range(greens):
                                until += stays_on[nth]
                        if clearing[row, other] >= 0:
                            if clearing[row, other] != won_in:
                                won_in = clearing[row, other]
                                won = _won(
                                    won_in, begin, stage, now, opens, veh, moves, going, come, came, worth, ends, most,
                                    red, fewer,
                                )  # fmt: skip
                            until -= won
                        if until >= min(rank[opens, other], best) - ALIKE:
                            continue
                        behind = 0.0
                        if opens < bins:
                            # As `stood` and `left`, with those who had green and will not have it then.
                            still, then = stood[other], left[other]
                            for nth in range(greens):
                                has_red = red[going[row, nth], other]
                                still += has_red * waits[nth]
                                then += has_red * stays_on[nth]
                            rest_bins = bins - opens
                            behind = rest_bins * (grown[other, opens] + still) + due[other, opens] + then
                            if clearing[row, other] >= 0:
                                nth = 0
                                while going[won_in, nth] >= 0:
                                    stream = going[won_in, nth]
                                    each = rest_bins * worth[stream] + ends[stream]
                                    behind -= red[stream, other] * each * fewer[nth]
                                    nth += 1
                        if until + behind < rank[opens, other] - ALIKE:
                            cost[opens, other], rank[opens, other] = until, until + behind
                            whence[opens, other, 0] = begin
                            whence[opens, other, 1] = stage
                            whence[opens, other, 2] = now
                            if opens < bins:
                                _lead(
                                    begin, now, opens, row, clearing[row, other], moves, going, come, came, most, veh,
                                    queue[opens, other],
                                )  # fmt: skip
                    if gaps is not None:
                        for place in range(greens):
                            veh[going[row, place]] += amid[going[row, place]]
                if now >= must_end:
                    break
                spent += _held(stage, grown, paid, now, now + 1, held)
                held += grown[stage, now + 1] - grown[stage, now]
                moving, goes = 0.0, False
                for place in range(greens):
                    goes |= veh[going[row, place]] + come[going[row, place], now] >= NOBODY_VEH
                if gaps is None:
                    for place in range(greens):
                        stream = going[row, place]
                        leaves = moves[row, stream] * most[stream]
                        veh[stream] = max(veh[stream] + come[stream, now] - leaves, 0.0)
                        moving += worth[stream] * veh[stream]
                else:
                    let_go(row, now, veh, come, most, moves, going, gaps, pace, free, to_come, want, queued)
                    for place in range(greens):
                        moving += worth[going[row, place]] * veh[going[row, place]]
                now += 1
                spent += moving
            if now == bins:
                spent += left[stages] + due[stages, bins]
                for place in range(greens):
                    stream = going[row, place]
                    each = traffic.kept[stream] if gaps is None or gaps.waiting[row, stream] == 0 else ends[stream]
                    spent += each * veh[stream] - ends[stream] * came[stream, bins]
                if spent < best - ALIKE:
                    best, last_begin, last_stage = spent, begin, stage
    for stage in range(stages):
        # Ways that end amid a clearance.
        if cost[bins, stage] < best - ALIKE:
            best, last_begin, last_stage = cost[bins, stage], bins, stage
    return int(_trace(present, last_begin, last_stage, low, whence, rules.clearing, plan)) if last_begin >= 0 else -1


@compiled
def _sums(
    serves: Floats, stand: Floats, come: Floats, worth: Floats, ends: Floats, kept: Floats, most: Floats
) -> Traffic:  # fmt: skip
    """The traffic with what the costs of red are made of."""
    stages, (streams, bins) = len(serves), come.shape
    came = np.zeros((streams, bins + 1))
    grown, paid, due = np.zeros((3, stages + 1, bins + 1))
    red = np.ones((streams, stages + 1))
    for stream in range(streams):
        for place in range(bins):
            came[stream, place + 1] = came[stream, place] + come[stream, place]
        for stage in range(stages + 1):
            if stage < stages and serves[stage, stream] > 0:
                red[stream, stage] = 0.0
            else:
                for place in range(1, bins + 1):
                    grown[stage, place] += worth[stream] * came[stream, place]
                    due[stage, place] += ends[stream] * came[stream, place]
    for stage in range(stages + 1):
        for place in range(bins):
            paid[stage, place + 1] = paid[stage, place] + grown[stage, place + 1]
    return Traffic(stand, come, came, red, grown, paid, due, worth, ends, kept, most)


@inlined
def _held(stage: int, grown: Floats, paid: Floats, since: int, until: int, weight: float) -> float:
    """What those wait in some bins who have red in a stage, and of whom so much stood before."""
    return float(paid[stage, until] - paid[stage, since] + (until - since) * (weight - grown[stage, since]))


@inlined
def _stood(
    stage: int, begin: int, veh: Floats, red: Floats, came: Floats, worth: Floats, ends: Floats, stood: Floats,
    left: Floats,
) -> None:  # fmt: skip
    """What those weigh, in a bin and if `left`, who have red in a stage and in each (s + 1), last in none.

    By the vehicles `veh` (n,) as it begins, less those who have come by then: with the sums of `Traffic` up to a bin
    it is what they weigh in that.
    """
    stood[:], left[:] = 0.0, 0.0
    for stream in range(len(veh)):
        if red[stream, stage] > 0:
            before = veh[stream] - came[stream, begin]
            for other in range(len(stood)):
                stood[other] += red[stream, other] * (worth[stream] * before)
                left[other] += red[stream, other] * (ends[stream] * before)


@inlined
def _won(
    clearing: int, begin: int, stage: int, end: int, until: int, veh: Floats, moves: Floats, going: Ints, come: Floats,
    came: Floats, worth: Floats, ends: Floats, most: Floats, red: Floats, fewer: Floats,
) -> float:  # fmt: skip
    """What is waited less in a clearance than if all had red; `veh` of who had red already as the stage began.

    And into `fewer`, of those that move in it one after the other, how many less stand at its end.
    """
    won, place = 0.0, 0
    while going[clearing, place] >= 0:
        stream = going[clearing, place]
        queue = veh[stream] + red[stream, stage] * (came[stream, end] - came[stream, begin])
        stands, less = queue, 0.0
        for now in range(end, until):
            stands += come[stream, now]
            queue = max(queue + come[stream, now] - moves[clearing + now - end, stream] * most[stream], 0.0)
            less += stands - queue
        fewer[place] = stands - queue
        won += worth[stream] * less
        if until == come.shape[1]:
            won += ends[stream] * fewer[place]
        place += 1
    return won


@inlined
def _lead(
    begin: int, end: int, opens: int, row: int, clearing: int, moves: Floats, going: Ints, come: Floats,
    came: Floats, most: Floats, veh: Floats, queue: Floats,
) -> None:  # fmt: skip
    """Fills in the `queue` (n,) when the next stage opens, by `veh` when one ends, of who had red as at its begin."""
    for stream in range(len(veh)):
        queue[stream] = veh[stream] + came[stream, opens] - came[stream, begin]
    place = 0
    while going[row, place] >= 0:
        stream = going[row, place]
        queue[stream] = veh[stream] + came[stream, opens] - came[stream, end]
        place += 1
    place = 0
    while clearing >= 0 and going[clearing, place] >= 0:
        stream = going[clearing, place]
        queue[stream] -= came[stream, opens] - came[stream, end]
        for now in range(end, opens):
            leaves = moves[clearing + now - end, stream] * most[stream]
            queue[stream] = max(queue[stream] + come[stream, now] - leaves, 0.0)
        place += 1


@compiled
def _leads_to(
    plan: Ints, low: int, stages: int, rules: Rules, gaps: Gaps | None, traffic: Traffic, sent: Floats
) -> float:  # fmt: skip
    """What is waited by a `plan`, and into `sent` (n, K) what it sends off."""
    _send_off(plan, rules, gaps, traffic.stand, traffic.come, traffic.most, sent)
    last = plan[-1]
    total, green = 0.0, low <= last < low + stages
    for stream in range(len(sent)):
        veh, waited = traffic.stand[stream], 0.0
        for place in range(sent.shape[1]):
            veh += traffic.come[stream, place] - sent[stream, place]
            waited += veh
        goes_on = green and rules.moves[last, stream] > 0 and rules.gaps.waiting[last, stream] == 0
        total += traffic.worth[stream] * waited + (traffic.kept[stream] if goes_on else traffic.ends[stream]) * veh
    return total


@compiled
def _trace(present: int, begin: int, stage: int, low: int, whence: Ints, clearing: Ints, plan: Ints) -> int:
    """The stage that is led to in the first bin of the way whose last stage began at `begin`, and into `plan` all."""
    now, chosen = len(plan), present
    while True:
        plan[begin:now] = low + stage
        if begin == 0:
            return chosen
        before, was, now = whence[begin, stage]
        row = clearing[low + was, stage]
        for place in range(now, begin):
            plan[place] = row + place - now if row >= 0 else -1
        if now == 0:
            chosen = stage
        begin, stage = before, was


@compiled
def _send_off(
    plan: Ints, rules: Rules, gaps: Gaps | None, stand: Floats, come: Floats, most: Floats, sent: Floats
) -> None:
    """Fills `sent` (n, K) with what leaves by a `plan`."""
    if gaps is None:
        for stream in range(len(stand)):
            queue = stand[stream]
            for place, row in enumerate(plan):
                queue += come[stream, place]
                leaves = min(queue, rules.moves[row, stream] * most[stream]) if row >= 0 else 0.0
                sent[stream, place] = leaves
                queue -= leaves
    else:
        _let_all_go(plan, rules, gaps, stand.copy(), come, most, sent)


@compiled
def _let_all_go(plan: Ints, rules: Rules, gaps: Gaps, veh: Floats, come: Floats, most: Floats, sent: Floats) -> None:
    """Fills `sent` (n, K) as `_send_off` where somebody waits for gaps: bin by bin, from the vehicles `veh` (n,) on."""
    pace, free, want, queued, to_come, amid = np.ones((6, len(veh)))
    before = -1
    for place, row in enumerate(plan):
        sent[:, place] = veh + come[:, place]
        green = 0 <= row < len(gaps.some)
        if row != before:
            if 0 <= before < len(gaps.some):
                clear(before, veh, most, rules.going, gaps, pace, to_come, amid)
            if green:
                begin_green(row, gaps, place == 0, pace, free, to_come)
        for stream in range(len(veh)):
            share = rules.moves[row, stream] if row >= 0 else 0.0
            if not (green and share > 0):
                veh[stream] = max(veh[stream] + come[stream, place] - share * most[stream], 0.0)
        if green:
            let_go(row, place, veh, come, most, rules.moves, rules.going, gaps, pace, free, to_come, want, queued)
        sent[:, place] -= veh
        before = row
