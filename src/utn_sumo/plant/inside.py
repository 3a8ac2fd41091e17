"""Who is amid a junction when the green that let it in has ended: turns that give way, and who is behind them.

Those who found no gap in oncoming traffic have a stage of their own then, in the net's own programme. Where that one is
left out, the next road's green finds them in its way, its own turns come to stand beside them, and when those of all
roads wait for each other nobody ever moves again. Who goes straight on from a lane that turns share may be behind one
of them, and is amid the junction, too, when the next road's turns come into it. And where people walk, whoever came in
late is stopped amid the junction, turning or not: by those who step onto the crossing at its exit with the next green,
or behind one who is. So while the lane-area detectors amid it see such vehicles, and others are about to come into
their way, those who would stand in it then have to wait: turns in gaps, and people who walk. All others of the next
green have it meanwhile, they drive on as soon as they can, unless so many stand there that these would stop, too, and
block each other, or those who found no gap have lanes of their own: nobody is behind them, and in red for all they get
out at once. People are about to walk where a button is pressed for a crossing that has green then.

Who stands before a road within the junction has the next green for himself where there are several: those from opposite
sides stand in each other's way, and with others who come in nobody gets out any more.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from utn_sumo.clearances import GIVES_WAY, GREEN, HAS_WAY, YELLOW, following
from utn_sumo.contract import Bools, Junction, Network

MOST_HOLD_S = 7.0
"""Longer nobody has to wait: who is still there does not get away by it."""
MOST_STANDING_VEH = 2.0
"""Who drives on gets past so many who stand amid the junction; of more each may be in the way of the next one."""
BESIDE_VEH = 1.0
"""Who turns from a single lane can do so beside one other, who goes as soon as he has; not from two lanes abreast."""


class Areas(Protocol):
    """What it takes to know who waits (plant.eyes)."""

    def amid_veh(self, turn: int) -> float: ...
    def standing_amid_veh(self, turn: int) -> float: ...
    def is_taken(self, turn: int) -> bool: ...
    def close_veh(self, group: int) -> float: ...
    def pressed(self, junction: int, letters: str) -> bool: ...


@dataclass(frozen=True)
class Turning:
    """A signal letter that gives way to oncoming traffic in some stage."""

    letter: int
    turns: tuple[int, ...]
    groups: tuple[tuple[int, float], ...]
    """Lane groups from which it comes in, and how many others amid the junction its vehicles can turn beside."""
    oncoming: tuple[int, ...]
    """Letters of traffic that it gives way to."""


@dataclass(frozen=True)
class Way:
    """From one stage to another one."""

    left: tuple[int, ...]
    """Turns for whom no gap in oncoming traffic may have come, and whom the next stage does not let out."""
    alone: tuple[int, ...]
    """Those from lanes of their own: the next road's traffic would never let them out, and nobody is behind them."""
    coming: tuple[tuple[int, float], ...]
    """Lane groups of turns of this kind that have green in it, as in `Turning`."""
    behind: tuple[tuple[int, tuple[int, ...]], ...]
    """Turns that one before them may stop who found no gap, each with the lane groups that come into its way."""
    walked: tuple[tuple[int, tuple[int, ...]], ...]
    """Turns that people may stop who walk, as `behind`."""
    becomes: str
    """Letters of the next stage."""
    within: tuple[int, ...]
    """Turns onto roads within the junction that have green in the next stage."""
    outwards: str
    """The letters of that stage with those red that do not lead off such roads, but for who keeps green all along."""
    through: str
    """With those red of turns that give way in some stage, and of people, but for who keeps green all along."""
    ended: tuple[int, ...]
    """Turns that have no green in it, each once: several lanes abreast have a letter each."""


class Inside:
    """Knows who may wait amid each junction, and who has to wait for them how long."""

    def __init__(self, network: Network, areas: Areas):
        self._network = network
        self._areas = areas
        self._turnings = [_turnings(network, junction) for junction in network.junctions]
        giving = {turn for own in self._turnings for each in own for turn in each.turns}
        self._behind = _who_share(network, giving)
        """Turns that may stand behind one that found no gap."""
        self._sharing = giving & {
            turn for each in network.lane_sets if self._behind & {*each.turns} for turn in each.turns
        }
        """Turns behind whom these stand."""
        self._known: dict[tuple[int, int, int], Way] = {}
        """By junction and its stages from which and to which they lead."""
        self._ways: dict[int, tuple[Way, float]] = {}
        """On which each junction came to its present stage, and how long anybody has to wait at most."""
        self._cleared: dict[int, str] = {}
        """By junction what is shown at the end of the clearance on the way there, with all yellow over."""
        self._letters: dict[int, str] = {}
        """By junction what has been shown last on the way there."""
        self._walked: dict[int, bool] = {}
        """By junction whether somebody was about to walk with its present stage as it was led to it."""

    def may_hold(self) -> Bools:
        """(J,) junctions in which somebody may be left."""
        network = self._network
        within = set(network.link_junction[network.within].tolist())
        may = enumerate(zip(self._turnings, network.junctions, strict=True))
        return np.array(
            [len(own) > 0 or each.is_walked or index in within for index, (own, each) in may], dtype=np.bool_
        )

    def leads(self, index: int, first: int, then: int, cleared: str, opens_s: float) -> None:
        """A junction goes from its stage `first` to `then`, which is to begin at `opens_s`, after letters `cleared`."""
        if (index, first, then) not in self._known:
            self._known[index, first, then] = self._way(index, first, then, cleared)
        self._ways[index] = self._known[index, first, then], opens_s + MOST_HOLD_S
        self._letters[index] = self._cleared[index] = "".join("r" if shown in YELLOW else shown for shown in cleared)
        self._walked[index] = self._areas.pressed(index, self._network.stages[then].state)

    def _way(self, index: int, first: int, then: int, cleared: str) -> Way:
        network, junction, turnings = self._network, self._network.junctions[index], self._turnings[index]
        becomes = network.stages[then].state
        is_own = then == following(junction, first)
        left = [
            turn
            for each in turnings
            if not any(becomes[letter] in GREEN for letter in (each.letter, *each.oncoming))
            for turn in each.turns
            if turn in self._sharing or not is_own
        ]
        waits = {*junction.crossings, *(each.letter for each in turnings)}
        through = _closed(becomes, cleared, (letter not in waits for letter in range(len(becomes))))
        wait = [each for each in turnings if becomes[each.letter] in GREEN and through[each.letter] not in GREEN]
        late = [
            (turn, letter)
            for letter, turns in enumerate(junction.signal_turns)
            if becomes[letter] not in GREEN
            for turn in turns
        ]
        turning, driving = [each.letter for each in wait], [i for i, shown in enumerate(becomes) if shown in GREEN]
        behind = [(turn, _come(network, junction, letter, turning)) for turn, letter in late if turn in self._behind]
        walked = [(turn, _come(network, junction, letter, driving)) for turn, letter in late if junction.is_walked]
        within, outwards = _outwards(network, junction, becomes, cleared)
        return Way(
            left=tuple(left),
            alone=tuple(turn for turn in left if turn not in self._sharing),
            coming=tuple(group for each in wait for group in each.groups),
            behind=tuple(behind),
            walked=tuple(walked),
            becomes=becomes,
            within=within,
            outwards=outwards,
            through=through,
            ended=tuple(dict.fromkeys(turn for turn, _ in late)),
        )

    def meanwhile(self, index: int) -> str:
        """Letters that are shown while somebody has to wait."""
        way, _ = self._ways[index]
        within, standing_veh = self._stands_within(way), sum(map(self._areas.standing_amid_veh, way.ended))
        if within or (standing_veh <= MOST_STANDING_VEH and not self._found_no_gap(way.alone, way)):
            self._letters[index] = _open(way.outwards if within else way.through, self._letters[index], way.becomes)
        return self._letters[index]

    def _stands_within(self, way: Way) -> bool:
        """Whether somebody stands before a road within the junction whom the next stage lets out."""
        return sum(map(self._areas.standing_amid_veh, way.within)) > BESIDE_VEH

    def _found_no_gap(self, turns: tuple[int, ...], way: Way) -> bool:
        """Whether more of these turns are amid the junction than those who are about to come can turn beside."""
        veh = sum(map(self._areas.amid_veh, turns))
        return any(veh > most and self._areas.close_veh(group) > 0 for group, most in way.coming)

    def holds(self, index: int, now_s: float) -> bool:
        """Whether some of the stage that a junction is led to have to wait for somebody."""
        (way, until_s), areas = self._ways[index], self._areas
        if now_s >= until_s:
            return False
        if self._stands_within(way):
            return True
        if self._found_no_gap(way.left, way):
            return True
        # Whom the road ahead stops does not get away by it.
        return any(
            areas.amid_veh(turn) > 0
            and any(areas.close_veh(group) > 0 for group in groups)
            and (self._walked[index] or not areas.is_taken(turn))
            for turn, groups in (way.walked if self._walked[index] else way.behind)
        )

    def held_s(self, index: int, now_s: float) -> float:
        """For how long now nobody has to wait any more, whoever is amid the junction."""
        return now_s - self._ways[index][1]

    def behind(self, index: int) -> dict[int, bool]:
        """Turns that another may have stopped in the way of others, with whether somebody stands there."""
        (way, _), areas = self._ways[index], self._areas
        return {
            turn: areas.standing_amid_veh(turn) > 0 and not areas.is_taken(turn)
            for turn, groups in way.behind
            if groups
        }

    def shown(self, index: int) -> str:
        """What was shown last while somebody had to wait."""
        return self._letters[index]

    def closing(self, index: int) -> tuple[list[int], str]:
        """Letters that have got green meanwhile, and what is shown without."""
        cleared = self._cleared[index]
        opened = [
            letter
            for letter, (shown, was) in enumerate(zip(self._letters[index], cleared, strict=True))
            if shown in GREEN and was not in GREEN
        ]
        return opened, cleared


def _closed(state: str, cleared: str, opens: Iterable[bool]) -> str:
    """A state with red for letters that do not open, but for who has had green in the letters before, `cleared`."""
    letters = zip(state, cleared, opens, strict=True)
    return "".join(shown if opens or shown not in GREEN or was in GREEN else "r" for shown, was, opens in letters)


def _open(letters: str, before: str, becomes: str) -> str:
    """Letters with green for who has had it before, and will: without yellow nobody's ends."""
    each = zip(letters, before, becomes, strict=True)
    return "".join(will if was in GREEN and will in GREEN else shown for shown, was, will in each)


def _outwards(network: Network, junction: Junction, state: str, cleared: str) -> tuple[tuple[int, ...], str]:
    """Turns onto roads within a junction off which a state lets, and that state with green for who leaves them alone.

    None where nobody else has green in it.
    """
    leads = [
        {network.turns[turn].link for turn in turns if network.within[network.turns[turn].link]}
        for turns in junction.signal_turns
    ]
    outwards = _closed(state, cleared, map(bool, leads))
    links = {link for shown, off in zip(state, leads, strict=True) if shown in GREEN for link in off}
    turns = tuple(index for index, turn in enumerate(network.turns) if turn.next_link in links)
    return (turns, outwards) if outwards != state else ((), "")


def _who_share(network: Network, giving: set[int]) -> set[int]:
    """Turns that share a lane with some of those that are `giving` way, and are none of them."""
    sets = (lane_set.turns for lane_set in network.lane_sets)
    return {turn for turns in sets if not giving.isdisjoint(turns) for turn in turns} - giving


def _come(network: Network, junction: Junction, letter: int, others: list[int]) -> tuple[int, ...]:
    """Lane groups of other letters' turns that cross or join the streams of a letter."""
    conflicts = junction.conflicts[letter]
    turns = [turn for other in others if conflicts[other] for turn in junction.signal_turns[other]]
    return tuple(sorted({network.turns[turn].group for turn in turns}))


def _lanes(network: Network, group: int, letter: int) -> int:
    """Lanes of a lane group from which somebody goes by a letter of its junction."""
    own = network.lane_sets[slice(*np.searchsorted(network.set_group, (group, group + 1)))]
    return sum(len(each.lanes) for each in own if any(letter in letters for letters in each.letters))


def _turnings(network: Network, junction: Junction) -> list[Turning]:
    """Those of a junction, by letter."""
    traffic = [len(turns) > 0 for turns in junction.signal_turns]
    found = []
    for letter, turns in enumerate(junction.signal_turns):
        states = [network.stages[stage].state for stage in junction.stages]
        giving = [state for state in states if traffic[letter] and state[letter] == GIVES_WAY]
        having = {other for state in giving for other, has in enumerate(state) if has == HAS_WAY}
        oncoming = tuple(sorted(other for other in having if traffic[other] and junction.conflicts[letter][other]))
        if oncoming:
            own = sorted({network.turns[turn].group for turn in turns})
            groups = tuple((group, 0.0 if _lanes(network, group, letter) > 1 else BESIDE_VEH) for group in own)
            found.append(Turning(letter, turns, groups, oncoming))
    return found
