"""From any stage to any other: the yellow and the red between them, by the times that the net itself keeps.

To the stage that follows in the net's own programme it is the net's own clearance, to the second. To another one it is
made: who loses green has the yellow that the net gives it; who gains green, or way over others, waits as long after
each conflicting stream as the net has them wait. Where the net never shows the two in turn he waits the longest that
the junction has those who open together wait for the last driver before them, or that it has the next stage wait after
who walks. Where those who walk need longer than all others, these keep their green meanwhile, as the net has cars drive
on while people are cleared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from utn_sumo.contract import Floats, Junction, Network

HAS_WAY, GIVES_WAY = "G", "g"
GREEN, YELLOW = HAS_WAY + GIVES_WAY, "yY"
USUAL_YELLOW_S = 3.0

Phases = tuple[tuple[str, float], ...]
"""(letters, seconds), shown in turn."""


@dataclass(frozen=True)
class Times:
    """What a junction's own programme keeps."""

    yellow_s: Floats
    """(letters,) after each signal's green."""
    between_s: Floats
    """(letters, letters) from the end of one's green to the begin of another's, or to when that one need give way no
    more, if the yellow of the first is over by then."""
    longest_s: Floats
    """(letters,) of who drives the longest that those who open together wait, amid a change of stages, for the last one
    who conflicts; of who walks the longest from the end of his green to the stage after it."""

    @classmethod
    def of(cls, network: Network, junction: Junction) -> Times:
        """Read off its programme with every stage as short as it may be, round the cycle."""
        shown: list[str] = []
        for index in junction.stages:
            stage = network.stages[index]
            for state, seconds in ((stage.state, stage.min_green_s), *stage.clearance):
                shown += [state] * round(seconds)
        letters, seconds = len(shown[0]), len(shown)
        green = np.array([[letter in GREEN for letter in state] for state in shown])
        yellow = np.array([[letter in YELLOW for letter in state] for state in shown])
        changes = zip([shown[-1], *shown[:-1]], shown, strict=True)
        gains = np.array([[_gains(*pair) for pair in zip(*states, strict=True)] for states in changes])
        yellow_s = np.full(letters, np.nan)
        between_s = np.full((letters, letters), np.nan)
        for a in range(letters):
            for end in np.flatnonzero(green[:, a] & ~np.roll(green[:, a], -1)):
                after = np.roll(yellow[:, a], -end - 1)
                own_s = seconds if after.all() else int(np.argmin(after))
                yellow_s[a] = np.fmax(yellow_s[a], own_s)
                # Who gets green while another is being cleared gives way to him.
                gains_s = np.where(np.roll(gains, -end - 1, axis=0)[own_s:].T, np.arange(own_s, seconds), np.inf)
                between_s[a] = np.fmin(between_s[a], gains_s.min(axis=1, initial=np.inf))
        between_s[np.isinf(between_s)] = np.nan
        usual = np.nanmax(yellow_s) if np.isfinite(yellow_s).any() else USUAL_YELLOW_S
        return cls(np.where(np.isnan(yellow_s), usual, yellow_s), between_s, _longest(network, junction, letters))


def _gains(was: str, becomes: str) -> bool:
    """Whether a signal gets green, or need not give way any more."""
    return (becomes in GREEN and was not in GREEN) or (becomes == HAS_WAY != was)


def _longest(network: Network, junction: Junction, letters: int) -> Floats:
    """`Times.longest_s`. Drivers are cleared alike, people as wide as the road is: of them nothing less is known."""
    walks = np.isin(np.arange(letters), junction.crossings)
    waits_s, rests_s = [], {True: [0], False: [0]}
    for index in junction.stages:
        stage, then = network.stages[index], network.stages[following(junction, index)]
        cleared = [state for state, seconds in stage.clearance for _ in range(round(seconds))]
        ended: dict[int, int] = {}
        for second, (was, becomes) in enumerate(pairwise([stage.state, *cleared, then.state])):
            ended |= {a: second for a in range(letters) if was[a] in GREEN and becomes[a] not in GREEN}
            opening = [b for b in range(letters) if _gains(was[b], becomes[b])]
            cleared_s = [
                second - since
                for a, since in ended.items()
                if not walks[a] and becomes[a] not in GREEN + YELLOW and any(junction.conflicts[a][b] for b in opening)
            ]
            if cleared_s:
                waits_s.append(min(cleared_s))
        for a, second in ended.items():
            if stage.state[a] in GREEN and then.state[a] not in GREEN:
                rests_s[bool(walks[a])].append(len(cleared) - second)
    return np.where(walks, max(rests_s[True]), max(waits_s or rests_s[False])).astype(float)


def following(junction: Junction, stage: int) -> int:
    """The stage that follows in the net's own programme."""
    order = junction.stages
    return order[(order.index(stage) + 1) % len(order)]


def between(network: Network, junction: Junction, times: Times, first: int, then: int) -> Phases:
    """What a junction shows from the end of the stage `first` until the stage `then` begins."""
    if following(junction, first) == then:
        return network.stages[first].clearance
    was, becomes = network.stages[first].state, network.stages[then].state
    closing = [a for a, letter in enumerate(was) if letter in GREEN and becomes[a] not in GREEN]
    opening = [b for b, letter in enumerate(becomes) if _gains(was[b], letter)]
    needed_s = {True: 0, False: 0}
    for a in closing:
        # Known gaps are of streams that follow each other; longer ones have other stages in between.
        gaps_s = np.fmin(times.between_s[a], times.longest_s[a])[[b for b in opening if junction.conflicts[a][b]]]
        walks = a in junction.crossings
        needed_s[walks] = math.ceil(max(needed_s[walks], _yellow_s(junction, times, a), gaps_s.max(initial=0.0)))
    seconds = max(needed_s.values())
    drive_on_s = seconds - needed_s[False]

    def letter(signal: int, second: int) -> str:
        if signal in closing:
            since_s = second - drive_on_s * (signal not in junction.crossings)
            return was[signal] if since_s < 0 else "y" if since_s < _yellow_s(junction, times, signal) else "r"
        if was[signal] in GREEN:
            return "G" if was[signal] == becomes[signal] == "G" else "g"
        return "r" if becomes[signal] in GREEN else becomes[signal]

    states = ["".join(letter(signal, second) for signal in range(len(was))) for second in range(seconds)]
    return tuple((state, float(len(list(group)))) for state, group in groupby(states))


def _yellow_s(junction: Junction, times: Times, letter: int) -> float:
    return float(times.yellow_s[letter] * (letter not in junction.without_yellow))
