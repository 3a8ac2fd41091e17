"""An independent conflict monitor: what the signals really showed, second by second, against the net's own rules.

It reads SUMO's record of every signal switch, knows nothing of plans, and shares no code with `signals`: the
part of a signal cabinet that would switch to flashing yellow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from utn_sumo.contract import Junction, Network
from utn_sumo.errors import ResultError

LETTERS = frozenset("GgyrsuoO")


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


def watch(network: Network, switches: Path, duration_s: float) -> Verdict:
    """Judge a run by its record of signal switches (SUMO's SaveTLSSwitchStates).

    Unsafe is: two conflicting streams with a protected green or with green against yellow; a green that ends
    without its full yellow; a conflicting green before the clearance that the net prescribes has run; a green
    shorter than the least; letters that no signal has; nothing shown at all.
    """
    shown = read_switches(switches)
    verdict = Verdict()
    for junction in network.junctions:
        states = _by_second(shown.get(junction.id, []), int(duration_s))
        clearance_s = min(network.stages[stage].clearance_s for stage in junction.stages)
        yellow_s = min(
            sum(seconds for state, seconds in network.stages[stage].clearance if "y" in state)
            for stage in junction.stages
        )
        _judge(junction, states, yellow_s, clearance_s, verdict)
    return verdict


def read_switches(path: Path) -> dict[str, list[tuple[int, str]]]:
    """(second, letters) of every switch, by junction."""
    from defusedxml import ElementTree  # noqa: PLC0415

    shown: dict[str, list[tuple[int, str]]] = {}
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag == "tlsState":
                shown.setdefault(element.get("id"), []).append(
                    (int(float(element.get("time"))), element.get("state"))
                )
    except (OSError, ElementTree.ParseError) as error:
        raise ResultError(f"signal record {str(path)!r} can't be read ({error})") from error
    return shown


def _by_second(switches: list[tuple[int, str]], duration_s: int) -> list[str]:
    states: list[str] = []
    for position, (start, state) in enumerate(switches):
        end = switches[position + 1][0] if position + 1 < len(switches) else duration_s
        states += [""] * (start - len(states)) + [state] * (min(end, duration_s) - start)
    return states + [""] * (duration_s - len(states))


def _judge(junction: Junction, states: list[str], yellow_s: float, clearance_s: float, verdict: Verdict) -> None:
    signals = range(len(junction.conflicts))
    foes = [[b for b in signals if junction.conflicts[a][b]] for a in signals]
    green_since = dict.fromkeys(signals, 0)
    yellow_since = dict.fromkeys(signals, 0)
    last_green = dict.fromkeys(signals, -(10**9))
    previous = ""
    for second, state in enumerate(states):
        if state == previous and len(state) == len(signals):
            if second > 0 and (junction.id, second - 1) in verdict.seconds and _clash(state, foes):
                verdict.flag(junction.id, second, "conflicting streams are still open")
            for signal in signals:
                if state[signal] in "Gg":
                    last_green[signal] = second
            continue
        if len(state) != len(signals) or not LETTERS.issuperset(state):
            verdict.flag(junction.id, second, f"shows {state!r}")
            previous = ""
            continue
        clash = _clash(state, foes)
        if clash:
            verdict.flag(junction.id, second, f"signals {clash[0]} and {clash[1]} conflict and are open together")
        for signal in signals:
            was, now = (previous[signal] if previous else "r"), state[signal]
            if now in "Gg":
                if was not in "Gg":
                    green_since[signal] = second
                    for foe in foes[signal]:
                        if now == "G" and state[foe] == "r" and second - last_green[foe] - 1 < clearance_s:
                            verdict.flag(junction.id, second, f"signal {signal} turns green too soon after {foe}")
                last_green[signal] = second
            elif was in "Gg":
                if second - green_since[signal] < junction.min_green_s:
                    verdict.flag(junction.id, second, f"signal {signal} was green for less than its least")
                if now == "y":
                    yellow_since[signal] = second
                else:
                    verdict.flag(junction.id, second, f"signal {signal} goes from green to {now!r} without yellow")
            elif was == "y" and now != "y" and second - yellow_since[signal] < yellow_s:
                verdict.flag(junction.id, second, f"signal {signal} had too little yellow")
        previous = state


def _clash(state: str, foes: list[list[int]]) -> tuple[int, int] | None:
    """A pair of conflicting streams that are open at once: both protected, or one while the other clears."""
    for signal, letter in enumerate(state):
        if letter == "G":
            for foe in foes[signal]:
                if state[foe] in "Gy":
                    return signal, foe
    return None
