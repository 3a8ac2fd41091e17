"""An independent conflict monitor: what the signals really showed, second by second, against the net's own rules.

It reads SUMO's record of every signal switch, knows nothing of plans, and shares no code with `signals`: the
part of a signal cabinet that would switch to flashing yellow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from utn_sumo.contract import Junction, Network, Stage
from utn_sumo.errors import ResultError

LETTERS = frozenset("GgyYrsu")
"""What a working signal shows; SUMO's o and O are signals switched off."""
GREEN, YELLOW = "Gg", "yY"
LONG_AGO_S = -1e9
HUNDREDTH_S = 0.01
MILLISECOND_S = 0.001
"""SUMO's clock has no finer times."""


@dataclass
class Verdict:
    """Unsafe seconds, counted once for each junction and second, and why."""

    seconds: set[tuple[str, int]] = field(default_factory=set)
    reasons: list[str] = field(default_factory=list)

    @property
    def unsafe_signal_s(self) -> int:
        """Seconds in which some junction's signals were unsafe, summed over junctions."""
        return len(self.seconds)

    def flag(self, junction: str, time_s: float, reason: str) -> None:
        """Count the second that a time is in; the reason is kept once."""
        second = math.floor(time_s)
        if (junction, second) not in self.seconds:
            self.seconds.add((junction, second))
            self.reasons.append(f"{junction} at {second} s: {reason}")


def watch(
    network: Network, switches: Path, duration_s: float, begin_s: float = 0.0, *, in_order: bool = True
) -> Verdict:
    """Judge a run that began at `begin_s` by its record of signal switches (SUMO's SaveTLSSwitchStates).

    Stages are to come in the net's own order, or else in any: then a green need last for one stage only, and between
    two streams no more than the junction's longest clearance.

    Unsafe is: two conflicting streams with a protected green, or one with it while another's is still being cleared; a
    green that ends without its full yellow; a conflicting green before the clearance that the net prescribes between
    the two has run; a green shorter than the least; letters that no signal has; nothing shown at all.
    """
    shown = read_switches(switches, begin_s)
    verdict = Verdict()
    for junction in network.junctions:
        rules = _Rules.of(network, junction) if in_order else _Rules.in_any_order(network, junction)
        _Guard(network, junction, rules, verdict).judge(_stretches(shown.get(junction.id, []), duration_s))
    return verdict


def read_switches(path: Path, begin_s: float = 0.0) -> dict[str, list[tuple[float, str]]]:
    """(time since the run began at `begin_s`, to the millisecond, letters) of every switch, by junction."""
    from defusedxml import ElementTree  # noqa: PLC0415

    shown: dict[str, list[tuple[float, str]]] = {}
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag == "tlsState":
                time_s = round(float(element.get("time")) - begin_s, 3)
                # Where steps are of hundredths SUMO writes no thousandths, though the begin may have some.
                time_s = 0.0 if abs(time_s) < HUNDREDTH_S else time_s
                shown.setdefault(element.get("id"), []).append((time_s, element.get("state")))
    except (OSError, ElementTree.ParseError) as error:
        raise ResultError(f"signal record {str(path)!r} can't be read ({error})") from error
    return shown


def _stretches(switches: list[tuple[float, str]], duration_s: float) -> list[_Stretch]:
    """What was shown, without a gap from 0 to the end; "" where nothing was."""
    starts = [(0.0, ""), *switches, (round(duration_s, 3), "")]
    last_s = starts[-1][0]
    return [
        _Stretch(state, start_s, min(end_s, last_s))
        for (start_s, state), (end_s, _) in pairwise(starts)
        if start_s < min(end_s, last_s)
    ]


class _Stretch(NamedTuple):
    """Letters, and when they were shown."""

    state: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class _Rules:
    """What the net's own programme shows between greens, with every stage as short as it may be."""

    green_s: list[float]
    """Least green of each signal."""
    yellow_s: list[float]
    """Least yellow after it."""
    between_s: list[list[float]]
    """Least time from the end of one signal's green to the begin of another's, or of the time when it has way."""

    @classmethod
    def of(cls, network: Network, junction: Junction, *, executed: bool = False) -> _Rules:
        """Read off the second and third of three cycles on end: what goes round the cycle is then seen whole.

        Stages that are `executed` may be shorter than those of a plan.
        """
        phases: list[tuple[str, float]] = []
        for index in junction.stages:
            stage = network.stages[index]
            phases += [(stage.state, stage.least_green_s if executed else stage.min_green_s), *stage.clearance]
        cycle_s = sum(seconds for _, seconds in phases)
        size = len(junction.conflicts)
        green, yellow = [math.inf] * size, [math.inf] * size
        between = [[math.inf] * size for _ in range(size)]
        lit, amber, ended = [0.0] * size, [0.0] * size, [-math.inf] * size
        now_s, before = 0.0, "r" * size
        for state, seconds in 3 * phases:
            seen = now_s >= cycle_s
            for signal, (was, now) in enumerate(zip(before, state, strict=True)):
                if was in GREEN and now not in GREEN:
                    ended[signal] = now_s
                    if seen:
                        green[signal] = min(green[signal], lit[signal])
                if seen and was in YELLOW and now not in YELLOW:
                    yellow[signal] = min(yellow[signal], amber[signal])
                lit[signal] = (lit[signal] if was in GREEN else 0.0) + seconds if now in GREEN else 0.0
                amber[signal] = (amber[signal] if was in YELLOW else 0.0) + seconds if now in YELLOW else 0.0
            # Who gets green beside a yellow gives way to whom it clears.
            red = [foe for foe in range(size) if state[foe] not in GREEN + YELLOW]
            for signal in range(size):
                if seen and _opens(before[signal], state[signal]):
                    for foe in red:
                        between[foe][signal] = min(between[foe][signal], now_s - ended[foe])
            now_s, before = now_s + seconds, state
        # What the programme never shows it asks nothing of.
        shown = [[0.0 if math.isinf(least_s) else least_s for least_s in row] for row in (green, yellow, *between)]
        return cls(shown[0], shown[1], shown[2:])

    @classmethod
    def in_any_order(cls, network: Network, junction: Junction) -> _Rules:
        """The same for stages in any order: what the programme has beyond one stage, or one clearance, need not be.

        Not longer after a walker's green than it has the next stage wait after one. Nor after a driver's than it has
        those who open together wait for the last driver before them.
        """
        own = cls.of(network, junction, executed=True)
        stages = [network.stages[index] for index in junction.stages]
        green = [
            min([least_s, *(stage.least_green_s for stage in stages if stage.state[signal] in GREEN)])
            for signal, least_s in enumerate(own.green_s)
        ]
        longest_s = _longest_s(junction, stages)
        between = [
            [min(least_s, longest_s[signal in junction.crossings]) for least_s in row]
            for signal, row in enumerate(own.between_s)
        ]
        return cls(green, own.yellow_s, between)


def _longest_s(junction: Junction, stages: list[Stage]) -> dict[bool, float]:
    """The longest wait after a green of who walks (True) or drives (False) amid a change of stages."""
    rests_s: dict[bool, list[float]] = {True: [0.0], False: [0.0]}
    waits_s = []
    for stage, then in zip(stages, [*stages[1:], stages[0]], strict=True):
        ended_s = [0.0 if letter in GREEN else math.inf for letter in stage.state]
        for (state, seconds), (next_state, _) in pairwise([(stage.state, 0.0), *stage.clearance, (then.state, 0.0)]):
            ended_s = [0.0 if letter in GREEN else s + seconds for letter, s in zip(state, ended_s, strict=True)]
            foes = {
                foe
                for signal, letters in enumerate(zip(state, next_state, strict=True))
                for foe, conflicts in enumerate(junction.conflicts[signal])
                if conflicts and _opens(*letters) and next_state[foe] not in GREEN + YELLOW
            }
            wait_s = min((ended_s[foe] for foe in foes.difference(junction.crossings)), default=math.inf)
            waits_s += [wait_s] if wait_s < math.inf else []
        for signal, (was, becomes) in enumerate(zip(stage.state, then.state, strict=True)):
            if was in GREEN and becomes not in GREEN:
                rests_s[signal in junction.crossings].append(ended_s[signal])
    return {True: max(rests_s[True]), False: max(waits_s or rests_s[False])}


def _opens(was: str, now: str) -> bool:
    """Whether a signal turns green, or gets the way over others that it had not."""
    return (now in GREEN and was not in GREEN) or now == "G" != was


class _Guard:
    """Follows the signals of one junction through the seconds of a run."""

    def __init__(self, network: Network, junction: Junction, rules: _Rules, verdict: Verdict) -> None:
        self.junction = junction
        self.verdict = verdict
        self.rules = rules
        self.under_way = junction.offset_s % junction.cycle_s > 0
        """Whether a cycle is under way when the run begins: how long its green or yellow has lasted nobody saw."""
        last = network.stages[junction.stages[-1]]
        self.ends = last.clearance[-1][0] if last.clearance else last.state
        """What a cycle ends with: nor did anybody see how long a green has lasted that goes on round it."""
        size = len(junction.conflicts)
        self.foes = [[b for b in range(size) if junction.conflicts[a][b]] for a in range(size)]
        self.green_since_s = [0.0] * size
        self.yellow_since_s = [LONG_AGO_S if self.under_way else 0.0] * size
        self.green_until_s = [LONG_AGO_S] * size
        self.protected = [False] * size
        """Whether a signal has its protected green, or the yellow that clears it."""

    def judge(self, stretches: list[_Stretch]) -> None:
        """Look at every stretch in turn: signals change only where one begins."""
        dark = "r" * len(self.foes)
        previous = dark
        for stretch in stretches:
            state = stretch.state
            if len(state) != len(self.foes) or not LETTERS.issuperset(state):
                self._flag_all(stretch, f"shows {state!r}")
                previous = dark
                continue
            for signal, letter in enumerate(state):
                self.protected[signal] = letter == "G" or (letter in YELLOW and self.protected[signal])
            if clash := self._clash(state):
                self._flag_all(stretch, "signals {} and {} conflict and are open together".format(*clash))
            for signal, (was, now) in enumerate(zip(previous, state, strict=True)):
                if reason := self._change(signal, was, now, stretch):
                    self.verdict.flag(self.junction.id, stretch.start_s, f"signal {signal} {reason}")
            for signal, letter in enumerate(state):
                if letter in GREEN:
                    self.green_until_s[signal] = stretch.end_s
            previous = state

    def _flag_all(self, stretch: _Stretch, reason: str) -> None:
        for second in range(math.floor(stretch.start_s), math.ceil(stretch.end_s)):
            self.verdict.flag(self.junction.id, second, reason)

    def _change(self, signal: int, was: str, now: str, stretch: _Stretch) -> str:
        """What is wrong with one signal's change as a stretch begins; empty if nothing is."""
        rules, now_s = self.rules, stretch.start_s
        if now in GREEN and was not in GREEN:
            lasts = self.under_way or self.ends[signal] in GREEN
            self.green_since_s[signal] = LONG_AGO_S if now_s == 0 and lasts else now_s
        if now == "G" != was:
            for foe in self.foes[signal]:
                between_s = now_s - self.green_until_s[foe]
                if stretch.state[foe] not in GREEN and _less(between_s, rules.between_s[foe][signal]):
                    return f"has way too soon after signal {foe}"
        elif was in GREEN and now not in GREEN:
            self.yellow_since_s[signal] = now_s
            if now == "r" and signal not in self.junction.without_yellow:
                return f"goes from green to {now!r} without yellow"
            if _less(now_s - self.green_since_s[signal], rules.green_s[signal]):
                return "was green for less than its least"
        if was in YELLOW and now not in YELLOW and _less(now_s - self.yellow_since_s[signal], rules.yellow_s[signal]):
            return "had too little yellow"
        return ""

    def _clash(self, state: str) -> tuple[int, int] | None:
        """A pair of conflicting streams, one with a protected green, one with that or still being cleared from it."""
        for signal, letter in enumerate(state):
            if letter == "G":
                for foe in self.foes[signal]:
                    if self.protected[foe]:
                        return signal, foe
        return None


def _less(lasted_s: float, least_s: float) -> bool:
    """Whether something lasted less than its least, but for what sums of milliseconds are off by."""
    return lasted_s < least_s - MILLISECOND_S / 2
