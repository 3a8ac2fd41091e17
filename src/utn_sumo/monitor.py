"""An independent conflict monitor: what the signals really showed, second by second, against the net's own rules.

It reads SUMO's record of every signal switch, knows nothing of plans, and shares no code with `signals`: the
part of a signal cabinet that would switch to flashing yellow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from utn_sumo.contract import Junction, Network
from utn_sumo.errors import ResultError

LETTERS = frozenset("Ggyrsu")
"""What a working signal shows; SUMO's o and O are signals switched off."""
GREEN = "Gg"
LONG_AGO_S = -(10**9)


@dataclass
class Verdict:
    """Unsafe seconds, counted once for each junction and second, and why."""

    seconds: set[tuple[str, int]] = field(default_factory=set)
    reasons: list[str] = field(default_factory=list)

    @property
    def unsafe_signal_s(self) -> int:
        """Seconds in which some junction's signals were unsafe, summed over junctions."""
        return len(self.seconds)

    def flag(self, junction: str, second: int, reason: str) -> None:
        """Count a second; the reason is kept once."""
        if (junction, second) not in self.seconds:
            self.seconds.add((junction, second))
            self.reasons.append(f"{junction} at {second} s: {reason}")


def watch(network: Network, switches: Path, duration_s: float, begin_s: float = 0.0) -> Verdict:
    """Judge a run that began at `begin_s` by its record of signal switches (SUMO's SaveTLSSwitchStates).

    Unsafe is: two conflicting streams with a protected green or with green against yellow; a green that ends
    without its full yellow; a conflicting green before the clearance that the net prescribes has run; a green
    shorter than the least; letters that no signal has; nothing shown at all.
    """
    shown = read_switches(switches)
    verdict = Verdict()
    for junction in network.junctions:
        switched = [(second - int(begin_s), state) for second, state in shown.get(junction.id, [])]
        _Guard(network, junction, verdict, begin_s).judge(_stretches(switched, int(duration_s)))
    return verdict


def read_switches(path: Path) -> dict[str, list[tuple[int, str]]]:
    """(second, letters) of every switch, by junction."""
    from defusedxml import ElementTree  # noqa: PLC0415

    shown: dict[str, list[tuple[int, str]]] = {}
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag == "tlsState":
                shown.setdefault(element.get("id"), []).append((int(float(element.get("time"))), element.get("state")))
    except (OSError, ElementTree.ParseError) as error:
        raise ResultError(f"signal record {str(path)!r} can't be read ({error})") from error
    return shown


def _stretches(switches: list[tuple[int, str]], duration_s: int) -> list[tuple[str, range]]:
    """(letters, seconds in which they were shown), without a gap from 0 to the end; "" where nothing was shown."""
    starts = [(0, ""), *switches, (duration_s, "")]
    return [(state, range(start, min(end, duration_s))) for (start, state), (end, _) in pairwise(starts) if end > start]


class _Guard:
    """Follows the signals of one junction through the seconds of a run."""

    def __init__(self, network: Network, junction: Junction, verdict: Verdict, begin_s: float) -> None:
        clearances = [network.stages[stage].clearance for stage in junction.stages]
        self.junction = junction
        self.verdict = verdict
        self.under_way = (junction.offset_s - begin_s) % junction.cycle_s > 0
        """Whether a cycle is under way when the run begins: how long its green has lasted nobody saw."""
        self.clearance_s = min(sum(seconds for _, seconds in clearance) for clearance in clearances)
        self.yellow_s = min(sum(seconds for state, seconds in clearance if "y" in state) for clearance in clearances)
        size = len(junction.conflicts)
        self.foes = [[b for b in range(size) if junction.conflicts[a][b]] for a in range(size)]
        self.green_since = [0] * size
        self.yellow_since = [0] * size
        self.last_green = [LONG_AGO_S] * size

    def judge(self, stretches: list[tuple[str, range]]) -> None:
        """Look at every second in turn; signals change only where a stretch begins."""
        dark = "r" * len(self.foes)
        previous = dark
        for state, seconds in stretches:
            if len(state) != len(self.foes) or not LETTERS.issuperset(state):
                self._flag_all(seconds, f"shows {state!r}")
                previous = dark
                continue
            if clash := _clash(state, self.foes):
                self._flag_all(seconds, "signals {} and {} conflict and are open together".format(*clash))
            for signal, (was, now) in enumerate(zip(previous, state, strict=True)):
                if reason := self._change(signal, was, now, seconds.start, state):
                    self.verdict.flag(self.junction.id, seconds.start, f"signal {signal} {reason}")
            for signal, letter in enumerate(state):
                if letter in GREEN:
                    self.last_green[signal] = seconds[-1]
            previous = state

    def _flag_all(self, seconds: range, reason: str) -> None:
        for second in seconds:
            self.verdict.flag(self.junction.id, second, reason)

    def _change(self, signal: int, was: str, now: str, second: int, state: str) -> str:
        """What is wrong with one signal's change at this second; empty if nothing is."""
        if now in GREEN and was not in GREEN:
            self.green_since[signal] = LONG_AGO_S if second == 0 and self.under_way else second
            for foe in self.foes[signal]:
                if now == "G" and state[foe] == "r" and second - self.last_green[foe] - 1 < self.clearance_s:
                    return f"turns green too soon after signal {foe}"
        elif was in GREEN and now not in GREEN:
            self.yellow_since[signal] = second
            if now != "y":
                return f"goes from green to {now!r} without yellow"
            if second - self.green_since[signal] < self.junction.min_green_s:
                return "was green for less than its least"
        if was == "y" and now != "y" and second - self.yellow_since[signal] < self.yellow_s:
            return "had too little yellow"
        return ""


def _clash(state: str, foes: list[list[int]]) -> tuple[int, int] | None:
    """A pair of conflicting streams that are open at once: both protected, or one while the other clears."""
    for signal, letter in enumerate(state):
        if letter == "G":
            for foe in foes[signal]:
                if state[foe] in "Gy":
                    return signal, foe
    return None
