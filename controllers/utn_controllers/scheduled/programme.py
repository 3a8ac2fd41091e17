"""The dynamic programme of a junction: which stages to show in the bins ahead, so that least is waited.

Forward over the bins, as COP (Sen and Head 1997). A state is a stage that begins in a bin; of two ways that lead to
it, the one on which less has been waited goes on, with the queues that it leaves. From there the stage may last until
any later bin.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints

NEVER = 1e18
"""Cost of what can't be reached."""
SOME_VEH = 1e-3
"""Fewer than so many are nobody."""


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
    sent: Floats,
) -> Ints:
    """(J,) what each junction that is `free` does in this bin: the stage to lead to, or the present `stage` (J,).

    `rest` (J,) bins that the present one may still go on; `stages` (S,) the network's stage of each row, junctions'
    rows from `first_stage` on, their streams from `first`; `follows` (S, most stages of a junction) whether its
    junction's nth stage may come after a row's. `clearance` and `least` (S,) in bins. `stand` (N,), `come` (N, K)
    vehicles; `soon` (n,) what it costs to show an arriving vehicle red in each bin before its arrival; `worth` (N,)
    weight of a vehicle, `most` (N,) that leave in a bin of green. `sent` (N, K) is given what each stream sends off in
    each bin; of junctions that are not free, what is left of their last schedule.
    """
    streams, bins = sent.shape
    slowed = np.zeros((streams, bins))
    for stream in range(streams):
        for place in range(bins - 1):
            sent[stream, place] = sent[stream, place + 1]
        for place in range(bins):
            for ahead in range(min(len(soon), bins - 1 - place)):
                slowed[stream, place] += soon[ahead] * come[stream, place + 1 + ahead]
    wish = stage.copy()
    for junction in range(len(stage)):
        a, b = first[junction], first[junction + 1]
        low, high = first_stage[junction], first_stage[junction + 1]
        if not free[junction] or b == a:
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
            slowed[a:b],
            worth[a:b],
            most[a:b],
            sent[a:b],
        )
        wish[junction] = stages[low + chosen]
    return wish


@compiled
def _schedule(  # noqa: C901 - one search, all in one place for the compiler
    present: int,
    rest: int,
    follows: Bools,
    serves: Bools,
    clearance: Ints,
    least: Ints,
    stand: Floats,
    come: Floats,
    slowed: Floats,
    worth: Floats,
    most: Floats,
    sent: Floats,
) -> int:
    """The stage that one junction leads to in this bin, the `present` one if it stays; all counted within it."""
    bins = come.shape[1]
    called = _called(present, follows, serves, stand, come)
    anybody = called.any()
    # The state: the stage that begins and when; for each the least cost until then, the queues, and whence.
    cost = np.full((bins + 1, len(serves)), NEVER)
    queue = np.zeros((bins + 1, *serves.shape))
    # Whence: when the stage before began, which it was, when it ended.
    whence = np.zeros((bins + 1, len(serves), 3), np.int64)
    cost[0, present] = 0.0
    queue[0, present] = stand
    served, cleared, red = np.zeros(len(stand)), np.zeros(len(stand)), np.zeros(len(stand), np.bool_)
    best, last_begin, last_stage = NEVER, 0, present
    for begin in range(bins):
        for stage in range(len(serves)):
            if cost[begin, stage] >= NEVER:
                continue
            is_first = begin == 0 and stage == present
            may_end = 0 if is_first else begin + least[stage]
            spent, now = cost[begin, stage], begin
            served[:] = queue[begin, stage]
            while now < bins:
                if anybody and now >= may_end:
                    # It ends here: others begin after its clearance, where that is the best way there.
                    until, opens = spent, min(now + clearance[stage], bins)
                    cleared[:] = served
                    for place in range(now, opens):
                        until += _bin(red, place, cleared, come, slowed, worth, most)
                    for other in range(len(serves)):
                        if other != stage and called[other] and follows[stage, other] and until < cost[opens, other]:
                            cost[opens, other] = until
                            queue[opens, other] = cleared
                            whence[opens, other, 0] = begin
                            whence[opens, other, 1] = stage
                            whence[opens, other, 2] = now
                    if is_first and now >= rest:
                        break
                spent += _bin(serves[stage], now, served, come, slowed, worth, most)
                now += 1
            if now == bins and spent < best:
                best, last_begin, last_stage = spent, begin, stage
    for stage in range(len(serves)):
        # Ways that end amid a clearance.
        if cost[bins, stage] < best:
            best, last_begin, last_stage = cost[bins, stage], bins, stage
    shown, chosen = _shown(present, last_begin, last_stage, whence)
    _send_off(shown, serves, stand, come, slowed, worth, most, sent)
    return int(chosen)


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
def _shown(present: int, begin: int, stage: int, whence: Ints) -> tuple[Ints, int]:
    """(K,) stage shown in each bin on the way to the last one, which began at `begin`, -1 for clearance; the one that
    is led to in the first bin.
    """
    bins = len(whence) - 1
    shown = np.full(bins, -1)
    now, chosen = bins, present
    while True:
        shown[begin:now] = stage
        if begin == 0:
            return shown, chosen
        before, was, now = whence[begin, stage]
        if now == 0:
            chosen = stage
        begin, stage = before, was


@compiled
def _send_off(
    shown: Ints,
    serves: Bools,
    stand: Floats,
    come: Floats,
    slowed: Floats,
    worth: Floats,
    most: Floats,
    sent: Floats,
) -> None:
    """Fills `sent` with what leaves under the stages `shown`."""
    queue, red = stand.copy(), np.zeros(len(stand), np.bool_)
    for place in range(len(shown)):
        before = queue + come[:, place]
        _bin(serves[shown[place]] if shown[place] >= 0 else red, place, queue, come, slowed, worth, most)
        sent[:, place] = before - queue


@compiled
def _bin(green: Bools, place: int, queue: Floats, come: Floats, slowed: Floats, worth: Floats, most: Floats) -> float:
    """What is waited in a bin in which the streams of `green` move; `queue` becomes that behind it."""
    waited = 0.0
    for stream in range(len(queue)):
        veh = queue[stream] + come[stream, place]
        if green[stream]:
            veh -= min(veh, most[stream])
        else:
            waited += worth[stream] * slowed[stream, place]
        queue[stream] = veh
        waited += worth[stream] * veh
    return waited
