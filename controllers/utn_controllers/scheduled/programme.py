"""The dynamic programme of a junction: which stages to show in the bins ahead, so that least is waited.

Forward over the bins, as COP (Sen and Head 1997). A state is a stage that begins in a bin; of two ways that lead to
it, the one on which less has been waited goes on, with the queues that it leaves. From there the stage may last until
any later bin. Of those who have red nobody leaves, so that what they wait is a difference of sums made once; bin by
bin go only those who have green. A way is left on which more has been waited than on another to its end, at first than
by the schedule of the bin before.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints

NEVER = 1e18
"""Cost of what can't be reached."""
SOME_VEH = 1e-3
"""Fewer than so many are nobody."""
ALIKE = 1e-9
"""Costs that differ by no more are the same: of ways alike the one found first is kept, whatever the rounding."""


@compiled
def schedules(
    stage: Ints,
    free: Bools,
    rest: Ints,
    stages: Ints,
    first_stage: Ints,
    first: Ints,
    follows: Bools,
    serves: Bools,
    clearance: Ints,
    least: Ints,
    stand: Floats,
    come: Floats,
    soon: Floats,
    worth: Floats,
    most: Floats,
    plan: Ints,
    sent: Floats,
) -> Ints:
    """(J,) what each junction that is `free` does in this bin: the stage to lead to, or the present `stage` (J,).

    `rest` (J,) bins that the present one may still go on; `stages` (S,) the network's stage of each row, junctions'
    rows from `first_stage` on, their streams from `first`; `follows` (S, most stages of a junction) whether its
    junction's nth stage may come after a row's. `clearance` and `least` (S,) in bins. `stand` (N,), `come` (N, K)
    vehicles; `soon` (n,) what it costs to show an arriving vehicle red in each bin before its arrival; `worth` (N,)
    weight of a vehicle, `most` (N,) that leave in a bin of green.

    `plan` (J, K) has the schedules of the bin before, `sent` (N, K) what each stream sends off by them: both are given
    those of now. Of a schedule is said which of its junction's stages is shown in each bin, -1 for a clearance; of
    junctions that are not free, what is left of the last one.
    """
    wish = stage.copy()
    for junction in range(len(stage)):
        a, b = first[junction], first[junction + 1]
        low, high = first_stage[junction], first_stage[junction + 1]
        plan[junction, :-1] = plan[junction, 1:]
        if not free[junction] or b == a:
            sent[a:b, :-1] = sent[a:b, 1:]
            continue
        row = low
        while stages[row] != stage[junction]:
            row += 1
        chosen = _schedule(
            row - low,
            rest[junction],
            follows[low:high],
            serves[low:high, a:b],
            clearance[low:high],
            least[low:high],
            stand[a:b],
            come[a:b],
            soon,
            worth[a:b],
            most[a:b],
            plan[junction],
            sent[a:b],
        )
        wish[junction] = stages[low + chosen]
    return wish


@compiled
def _schedule(
    present: int, rest: int, follows: Bools, serves: Bools, clearance: Ints, least: Ints, stand: Floats, come: Floats,
    soon: Floats, worth: Floats, most: Floats, plan: Ints, sent: Floats,
) -> int:  # fmt: skip
    """The stage that one junction leads to in this bin, the `present` one if it stays; all counted within it."""
    chosen = present
    called = _called(present, follows, serves, stand, come)
    if called.any():
        came, grown, paid, slowed = _sums(serves, come, soon, worth)
        # What was best a bin ago is seldom far from what is best now.
        known = _waited(plan, serves, stand, come, slowed, worth, most)
        for limit in (known + ALIKE * (2 + known), NEVER):
            chosen = _search(
                present, rest, called, follows, serves, clearance, least, stand, come, came, grown, paid, worth, most,
                limit, plan,
            )  # fmt: skip
            if chosen >= 0:
                break
    else:
        plan[:] = present
    _send_off(plan, serves, stand, come, most, sent)
    return chosen


@compiled
def _called(present: int, follows: Bools, serves: Bools, stand: Floats, come: Floats) -> Bools:
    """(stages,) stages that somebody needs who has no green in the present one; if there are any, that one too.

    In a fixed order the way to them leads through all.
    """
    called = np.zeros(len(serves), np.bool_)
    for stream in range(len(stand)):
        if not serves[present, stream] and stand[stream] + come[stream].sum() >= SOME_VEH:
            for stage in range(len(serves)):
                called[stage] |= serves[stage, stream]
    if called.any():
        called[present] = True
        called |= not follows.all()
    return called


@compiled
def _search(  # noqa: C901, PLR0912 - one search, all in one place for the compiler
    present: int, rest: int, called: Bools, follows: Bools, serves: Bools, clearance: Ints, least: Ints, stand: Floats,
    come: Floats, came: Floats, grown: Floats, paid: Floats, worth: Floats, most: Floats, limit: float, plan: Ints,
) -> int:  # fmt: skip
    """The stage that is led to in the first bin, and into `plan` (K,) that of each; -1 if all costs `limit` or more."""
    (stages, streams), bins, red = serves.shape, len(plan), len(serves)
    # The state: the stage that begins and when; for each the least cost until then, the queues, and whence.
    cost = np.full((bins + 1, stages), NEVER)
    queue = np.empty((bins, stages, streams))
    # Whence: when the stage before began, which it was, when it ended.
    whence = np.zeros((bins + 1, stages, 3), np.int64)
    cost[0, present] = 0.0
    queue[0, present] = stand
    best, last_begin, last_stage = limit, 0 if limit >= NEVER else -1, present
    after = follows[:, :stages] & called & ~np.eye(stages, dtype=np.bool_)
    green, veh = np.empty(streams, np.int64), np.empty(streams)
    for begin in range(bins):
        for stage in range(stages):
            spent = cost[begin, stage]
            if spent >= best - ALIKE:
                continue
            if begin > 0:
                _lead(begin, stage, whence, serves, come, came, most, queue)
            # What the queues weigh that move, and that have red.
            greens, moving, held = 0, 0.0, 0.0
            for stream in range(streams):
                weight = worth[stream] * queue[begin, stage, stream]
                if serves[stage, stream]:
                    green[greens], veh[greens] = stream, queue[begin, stage, stream]
                    greens += 1
                    moving += weight
                else:
                    held += weight
            may_end = begin + least[stage] if begin > 0 else 0
            must_end = rest if begin == 0 else bins
            now = begin
            while now < bins and spent < best - ALIKE:
                if now >= may_end:
                    # It ends here: others begin after its clearance, where that is the best way there.
                    opens = min(now + clearance[stage], bins)
                    until = spent + _held(red, grown, paid, now, opens, held + moving)
                    for other in range(stages):
                        if after[stage, other] and until < cost[opens, other] - ALIKE:
                            cost[opens, other] = until
                            whence[opens, other, 0] = begin
                            whence[opens, other, 1] = stage
                            whence[opens, other, 2] = now
                    if now >= must_end:
                        break
                spent += _held(stage, grown, paid, now, now + 1, held)
                held += grown[stage, now + 1] - grown[stage, now]
                moving = 0.0
                for place in range(greens):
                    stream = green[place]
                    veh[place] = max(veh[place] + come[stream, now] - most[stream], 0.0)
                    moving += worth[stream] * veh[place]
                spent, now = spent + moving, now + 1
            if now == bins and spent < best - ALIKE:
                best, last_begin, last_stage = spent, begin, stage
    for stage in range(stages):
        # Ways that end amid a clearance.
        if cost[bins, stage] < best - ALIKE:
            best, last_begin, last_stage = cost[bins, stage], bins, stage
    return int(_trace(present, last_begin, last_stage, whence, plan)) if last_begin >= 0 else -1


@compiled
def _sums(serves: Bools, come: Floats, soon: Floats, worth: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """What the costs of red are made of, all but the last of it up to each bin and no further.

    (N, K + 1) who has come. For each stage, and last for clearances, (stages + 1, K + 1) what those weigh who have red
    in it and have come, and what they have waited, if nobody had stood before. (N, K) what those lose in a bin of red
    who come soon.
    """
    stages, (streams, bins) = len(serves), come.shape
    came, slowed = np.zeros((streams, bins + 1)), np.zeros((streams, bins))
    grown, paid = np.zeros((stages + 1, bins + 1)), np.zeros((stages + 1, bins + 1))
    for stream in range(streams):
        for place in range(bins):
            came[stream, place + 1] = came[stream, place] + come[stream, place]
        for ahead in range(min(len(soon), bins)):
            for place in range(bins - 1 - ahead):
                slowed[stream, place] += soon[ahead] * come[stream, place + 1 + ahead]
        for stage in range(stages + 1):
            if stage == stages or not serves[stage, stream]:
                for place in range(bins):
                    grown[stage, place + 1] += worth[stream] * came[stream, place + 1]
                    paid[stage, place + 1] += worth[stream] * (came[stream, place + 1] + slowed[stream, place])
    for stage in range(stages + 1):
        for place in range(bins):
            paid[stage, place + 1] += paid[stage, place]
    return came, grown, paid, slowed


@compiled
def _held(stage: int, grown: Floats, paid: Floats, since: int, until: int, weight: float) -> float:
    """What those wait in some bins who have red in a stage, and of whom so much stood before."""
    return float(paid[stage, until] - paid[stage, since] + (until - since) * (weight - grown[stage, since]))


@compiled
def _lead(
    begin: int, stage: int, whence: Ints, serves: Bools, come: Floats, came: Floats, most: Floats, queue: Floats
) -> None:
    """Fills in the queues when a stage begins, by those when the stage before it did."""
    before, was, end = whence[begin, stage, 0], whence[begin, stage, 1], whence[begin, stage, 2]
    for stream in range(len(most)):
        veh, since = queue[before, was, stream], before
        if serves[was, stream]:
            for place in range(before, end):
                veh = max(veh + come[stream, place] - most[stream], 0.0)
            since = end
        queue[begin, stage, stream] = veh + came[stream, begin] - came[stream, since]


@compiled
def _waited(
    plan: Ints, serves: Bools, stand: Floats, come: Floats, slowed: Floats, worth: Floats, most: Floats
) -> float:
    """What is waited by a `plan`."""
    total = 0.0
    for stream in range(len(stand)):
        veh, waited = stand[stream], 0.0
        for place in range(len(plan)):
            veh += come[stream, place]
            if plan[place] >= 0 and serves[plan[place], stream]:
                veh = max(veh - most[stream], 0.0)
            else:
                waited += slowed[stream, place]
            waited += veh
        total += worth[stream] * waited
    return total


@compiled
def _trace(present: int, begin: int, stage: int, whence: Ints, plan: Ints) -> int:
    """The stage that is led to in the first bin of the way whose last stage began at `begin`, and into `plan` all."""
    now, chosen = len(plan), present
    while True:
        plan[begin:now] = stage
        if begin == 0:
            return chosen
        before, was, now = whence[begin, stage]
        plan[now:begin] = -1
        if now == 0:
            chosen = stage
        begin, stage = before, was


@compiled
def _send_off(plan: Ints, serves: Bools, stand: Floats, come: Floats, most: Floats, sent: Floats) -> None:
    """Fills `sent` with what leaves by a `plan`."""
    for stream in range(len(stand)):
        veh = stand[stream]
        for place, stage in enumerate(plan):
            veh += come[stream, place]
            leaves = min(veh, most[stream]) if stage >= 0 and serves[stage, stream] else 0.0
            sent[stream, place] = leaves
            veh -= leaves
