"""Signal programmes of a net and of additional files, and how they are cut into stages and clearances.

A stage is a phase that shows green and no yellow. What follows it up to the next stage is its clearance, taken from the
net and never optimised: yellow, all-red, red and yellow, and short remnants of the green before, such as the seconds
in which the pedestrians of a crossing have red already and the cars beside them still have green. A phase under five
seconds is a stage only if nobody else lets go whom it does.

What is unsafe in a programme is mended where it can be: who gives way (`yielding`), yellow (`cleared`), greens that
begin too soon (`waiting`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

from utn_sumo.errors import NetworkError
from utn_sumo.xml_files import opened

MIN_GREEN_S = 10.0
"""Usual least green of a stage for which the net names none, if it shows the stage as long itself."""
SHORT_GREEN_S = 5.0
"""The same where greens end by what is to be seen: netconvert's `tls.min-dur`, which SUMO's own signals keep."""
SHORTEST_STAGE_S = 5.0
GREEN, YELLOW, OFF = "Gg", "yYu", "oO"
CLEARING = "yY"
"""Yellow after a green; red and yellow (u) comes before one."""
SWITCHED_OFF = "its programme switches signals off (o, O)"


@dataclass(frozen=True)
class Phase:
    """One phase of a programme."""

    state: str
    duration_s: float
    least_s: float | None = None
    """`minDur`, where the programme has it."""
    leads_elsewhere: bool = False
    """Whether it names its successors (`next`)."""

    @property
    def green(self) -> frozenset[int]:
        """Signals that it opens."""
        return frozenset(signal for signal, letter in enumerate(self.state) if letter in GREEN)

    @property
    def is_plain_green(self) -> bool:
        """Whether it shows green and no yellow."""
        return bool(self.green) and not any(letter in YELLOW for letter in self.state)


@dataclass(frozen=True)
class Block:
    """A stage's phase and its clearance."""

    stage: Phase
    clearance: tuple[Phase, ...]

    def min_green_s(self, usual_s: float) -> float:
        """Least green of a plan: what the net says, else the usual one, but no more than the net itself shows."""
        return float(math.ceil(min(self.least_green_s(usual_s), max(1.0, self.stage.duration_s))))

    def least_green_s(self, usual_s: float) -> float:
        """Least green where greens end early: what the net says, else the usual one, if the net shows as much."""
        wished_s = min(usual_s, self.stage.duration_s) if self.stage.least_s is None else self.stage.least_s
        return float(math.ceil(max(1.0, wished_s)))


@dataclass(frozen=True)
class Programme:
    """A signal programme, its phases alike in a row as one."""

    phases: tuple[Phase, ...]
    offset_s: float
    kind: str
    """SUMO's type: static, actuated, NEMA and others."""
    id: str = ""
    """Its `programID`."""
    turned_s: float = 0.0
    """How much of its first phase is written as its last one."""

    @classmethod
    def of(cls, phases: Iterable[Phase], offset_s: float, kind: str, name: str = "") -> Programme:
        """Of the phases as they are written."""
        grouped, turned_s = [list(group) for _, group in groupby(phases, key=lambda phase: phase.state)], 0.0
        if len(grouped) > 1 and grouped[0][0].state == grouped[-1][0].state:
            # A phase that goes on round the cycle is one.
            last = grouped.pop()
            grouped[0] = [*last, *grouped[0]]
            turned_s = sum(phase.duration_s for phase in last)
        return cls(tuple(_merged(group) for group in grouped), offset_s - turned_s, kind, name, turned_s)

    def moved(self, offset_s: float) -> Programme:
        """With another offset, as it is written."""
        return replace(self, offset_s=offset_s - self.turned_s)

    def yielding(self, second: Collection[tuple[int, int]]) -> Programme:
        """With g in place of G for the first of these pairs of letters, in phases in which both have G."""
        phases = []
        for phase in self.phases:
            late = {a for a, b in second if phase.state[a] == phase.state[b] == "G"}
            state = "".join("g" if letter in late else shown for letter, shown in enumerate(phase.state))
            phases.append(replace(phase, state=state))
        return replace(self, phases=tuple(phases))

    def too_soon(self, conflicts: Sequence[Sequence[bool]]) -> set[tuple[int, int]]:
        """(phase, letter) where a letter gets way while one that it meets is being cleared from having had it."""
        found: set[tuple[int, int]] = set()
        for index, phase in enumerate(self.phases):
            for letter, (was, shown) in enumerate(zip(self.phases[index - 1].state, phase.state, strict=True)):
                begins = shown == "G" and (was != "G" or (index - 1, letter) in found)
                if begins and any(foe and self._clears(index, other) for other, foe in enumerate(conflicts[letter])):
                    found.add((index, letter))
        return found

    def waiting(self, too_soon: Collection[tuple[int, int]]) -> Programme:
        """With what they had before in place of these: red, or a green that gives way."""
        phases: list[Phase] = []
        for index, phase in enumerate(self.phases):
            before = (phases or self.phases)[-1].state
            state = "".join(
                ("g" if before[letter] in GREEN else "r") if (index, letter) in too_soon else shown
                for letter, shown in enumerate(phase.state)
            )
            phases.append(replace(phase, state=state))
        return replace(self, phases=tuple(phases))

    def _clears(self, index: int, letter: int) -> bool:
        """Whether a phase has a letter's yellow after a green that had way."""
        shown = [self.phases[index - back].state[letter] for back in range(len(self.phases))]
        before = next((each for each in shown if each not in CLEARING), "")
        return shown[0] in CLEARING and before == "G"

    def without_yellow(self, letters: Collection[int]) -> set[int]:
        """Of these letters those whose green ends in red at once, though the programme knows yellow."""
        if not self._yellow_s:
            return set()
        return {letter for _, ending in self._ending(letters) for letter in ending}

    def cleared(self, letters: Collection[int]) -> Programme:
        """With yellow, as long as it has it elsewhere, at the end of these letters' greens that end in red at once.

        A phase as long as the yellow is all of it for who has green in the one before too. A green that is too short
        for that stays as it is. The cycle is as long as before.
        """
        phases: list[Phase] = []
        for index, (phase, bare) in enumerate(self._ending(letters)):
            left_s = phase.duration_s - self._yellow_s
            ending = bare & self.phases[index - 1].green if left_s < 1 else bare
            if not ending or not self._yellow_s or left_s < 0:
                phases.append(phase)
                continue
            state = "".join("y" if letter in ending else shown for letter, shown in enumerate(phase.state))
            if left_s < 1:
                phases.append(replace(phase, state=state))
                continue
            least_s = None if phase.least_s is None else min(phase.least_s, left_s)
            phases += [
                replace(phase, duration_s=left_s, least_s=least_s),
                replace(phase, state=state, duration_s=self._yellow_s, least_s=None),
            ]
        return replace(self, phases=tuple(phases))

    @property
    def _yellow_s(self) -> float:
        """The longest yellow that any letter has in one phase."""
        return max(
            (phase.duration_s for phase in self.phases if not set(phase.state).isdisjoint(CLEARING)), default=0.0
        )

    def _ending(self, letters: Collection[int]) -> Iterator[tuple[Phase, set[int]]]:
        """Each phase, and which of the letters have green in it and red at once after it."""
        for phase, then in zip(self.phases, [*self.phases[1:], *self.phases[:1]], strict=True):
            yield phase, {letter for letter in phase.green.intersection(letters) if then.state[letter] == "r"}

    @property
    def cycle_s(self) -> float:
        """Its length."""
        return sum(phase.duration_s for phase in self.phases)

    @property
    def opens(self) -> list[int]:
        """Which phases are stages."""
        around = [self.phases[-1:], *([phase] for phase in self.phases[:-1])] if self.phases else []
        stages = [
            index
            for index, (phase, (before,)) in enumerate(zip(self.phases, around, strict=True))
            if phase.is_plain_green and not _is_remnant(phase, before)
        ]
        # However short it is, whom no other one lets go has this one.
        opened = {signal for index in stages for signal in self.phases[index].green}
        for index, phase in enumerate(self.phases):
            if phase.is_plain_green and not phase.green <= opened:
                stages.append(index)
                opened |= phase.green
        return sorted(stages)

    @property
    def begin_s(self) -> float:
        """When in its cycle its first stage begins."""
        return sum(phase.duration_s for phase in self.phases[: self.opens[0]])

    @property
    def blocks(self) -> list[Block]:
        """Its stages with their clearances, from the first stage on round the cycle."""
        first = self.opens[0]
        turned = [*self.phases[first:], *self.phases[:first]]
        starts = [index - first for index in self.opens]
        return [Block(turned[a], tuple(turned[a + 1 : b])) for a, b in pairwise([*starts, len(turned)])]


def _merged(group: Sequence[Phase]) -> Phase:
    least = [phase.least_s for phase in group if phase.least_s is not None]
    return Phase(
        group[0].state,
        sum(phase.duration_s for phase in group),
        sum(least) if least else None,
        any(phase.leads_elsewhere for phase in group),
    )


def _is_remnant(phase: Phase, before: Phase) -> bool:
    """Whether a phase is too short for a stage, or short and gives no signal more than it had in the one before."""
    had = {"G": "G", "g": GREEN}
    more = any(letter in had and was not in had[letter] for letter, was in zip(phase.state, before.state, strict=False))
    return phase.duration_s < SHORTEST_STAGE_S or (phase.duration_s < MIN_GREEN_S and not more)


def own(tls: Any) -> Programme | None:
    """The net's own programme of a signal (a sumolib TLS), if it has one."""
    name, program = next(iter(tls.getPrograms().items()), ("", None))
    if program is None or not program.getPhases():
        return None
    phases = (
        Phase(phase.state, float(phase.duration), float(phase.minDur) if phase.minDur >= 0 else None, bool(phase.next))
        for phase in program.getPhases()
    )
    return Programme.of(phases, float(program.getOffset()), program.getType(), name)


def added(files: Sequence[Path], of_net: Mapping[str, Programme | None]) -> dict[str, Programme | None]:
    """Programmes by signal: those `of_net`, or of those in additional files the last one read, as in SUMO.

    One without phases, as tlsCoordinator writes them, gives that of the same `programID` another offset.
    """
    found = dict(of_net)
    for file in files:
        for logic in _elements(file, "tlLogic"):
            signal, name, before = logic.get("id"), logic.get("programID", ""), found.get(logic.get("id"))
            try:
                offset_s, shown = float(logic.get("offset", "0")), [_phase(each) for each in logic.iter("phase")]
                if shown:
                    found[signal] = Programme.of(shown, offset_s, logic.get("type", ""), name)
                elif before is not None and before.id == name:
                    found[signal] = before.moved(offset_s)
            except ValueError as error:
                raise NetworkError(
                    f"additional file {str(file)!r}: the programme of {logic.get('id')!r} has times that are no numbers"
                    f" ({error}): give seconds"
                ) from error
    return found


def switched_elsewhere(files: Sequence[Path]) -> dict[str, str]:
    """Signals that additional files have SUMO itself switch from programme to programme, or off, and how."""
    found = {}
    for file in files:
        for logic in _elements(file, "tlLogic"):
            if logic.get("programID") == "off":
                found[logic.get("id")] = SWITCHED_OFF
            else:
                found.pop(logic.get("id"), None)
    for file in files:
        for member in _elements(file, "wautJunction"):
            found[member.get("junctionID")] = "a WAUT switches its programmes by the clock"
    return found


def _elements(file: Path, tag: str) -> Iterator[Any]:
    """Of an additional file, those of files that it includes where these stand."""
    from defusedxml import ElementTree  # noqa: PLC0415

    with opened(file) as content:
        every = ElementTree.parse(content)
    for element in every.iter():
        if element.tag == "include":
            yield from _elements(file.parent / element.get("href", ""), tag)
        elif element.tag == tag:
            yield element


def _phase(element: Any) -> Phase:
    least, elsewhere = element.get("minDur"), bool((element.get("next") or "").strip())
    duration_s = float(element.get("duration", ""))
    if not math.isfinite(duration_s):
        raise ValueError(element.get("duration"))
    return Phase(element.get("state", ""), duration_s, None if least is None else float(least), elsewhere)


def why_left_alone(programme: Programme | None, signals: int, motor: Collection[int]) -> str:
    """Why a signal with so many letters in use, some of `motor` traffic, can't be controlled; empty if it can."""
    if programme is None:
        return "it has no signal programme, as rail signals have none"
    states = [phase.state for phase in programme.phases]
    if any(letter in OFF for state in states for letter in state):
        return SWITCHED_OFF
    if programme.kind == "NEMA" or any(phase.leads_elsewhere for phase in programme.phases):
        why = "it is of type NEMA" if programme.kind == "NEMA" else "its phases name their successors (next)"
        return f"{why}: there is no one cycle"
    stages = len(programme.opens)
    if stages < 2:  # noqa: PLR2004 - what can be shared out
        few = "one stage: there is nothing to share out", "no phase that shows green without yellow"
        return f"its programme has {few[stages == 0]}"
    if any(len(state) != len(states[0]) or len(state) < signals for state in states):
        return f"its programme's states have not a letter for each of its {signals} signals"
    ever = frozenset[int]().union(*(phase.green for phase in programme.phases))
    amid = ever.intersection(motor).difference(*(programme.phases[index].green for index in programme.opens))
    return f"signal {min(amid)} has green amid clearances only" if amid else ""
