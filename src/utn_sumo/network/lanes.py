"""Which lanes before a stop line share turns, and which of these move alike."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from itertools import combinations

from utn_sumo.clearances import GIVES_WAY, GREEN

Ways = Mapping[int, set[int]]
"""The turns that go from some lanes, and the letters of the signals by which they do."""

UNEVEN = 1.2
"""So many times the mean of its group is a lane to have of the traffic for each lane to be a queue of its own."""
MANY_STAGES = 4
"""A junction of so many is late to let go who is left of one lane, and by him alone a long green is drawn out."""


def lane_groups(turns: Iterable[tuple[str, Iterable[int]]]) -> list[tuple[tuple[int, ...], tuple[str, ...]]]:
    """Lanes that share turns, with those turns, from (turn, its lanes): in the order of the lanes."""
    groups: list[tuple[set[int], set[str]]] = []
    for turn, lanes in turns:
        own, names = set(lanes), {turn}
        apart = []
        for other, others in groups:
            if other & own:
                own |= other
                names |= others
            else:
                apart.append((other, others))
        groups = [*apart, (own, names)]
    return sorted((tuple(sorted(lanes)), tuple(sorted(names))) for lanes, names in groups)


def lane_sets(
    ways: Mapping[int, Ways], states: Iterable[str], share: Mapping[int, float], reserved: Collection[int] = ()
) -> list[tuple[tuple[int, ...], Ways]]:
    """The sets into which the lanes of one group part, with their ways, from the ways of each lane.

    Lanes are a set if they have the same turns by signals that always show the same. All of them move alike and are
    one set if in none of the junction's `states`, each of a stage, somebody of the group gives way, nor one lane goes
    while who is first in another one may have red: else a lane from which somebody waits for gaps is slower than one
    without, and one behind a red arrow stands. Nor may some have much more to let go than others, by the `share` of
    the link's traffic that each turn has, nor the junction have MANY_STAGES. Lanes `reserved` for buses are never one
    with others: hardly anybody takes them.
    """
    shown = list(states)
    letters = {letter for own in ways.values() for each in own.values() for letter in each}
    gives_way = any(state[letter] == GIVES_WAY for state in shown for letter in letters)
    usual = {lane: own for lane, own in ways.items() if lane not in reserved}
    together = not (
        gives_way
        or len(shown) >= MANY_STAGES
        or any(_some_stand(ways.values(), state) for state in shown)
        or unevenness(usual, share) > UNEVEN
    )
    found: dict[str, list[int]] = {}
    for lane, own in ways.items():
        moves = [(turn, sorted({"".join(state[each] for state in shown) for each in own[turn]})) for turn in own]
        found.setdefault(f"{lane in reserved}{'' if together else moves}", []).append(lane)
    sets: list[tuple[tuple[int, ...], Ways]] = []
    for lanes in found.values():
        whole: dict[int, set[int]] = {}
        for lane in lanes:
            for turn, own_letters in ways[lane].items():
                whole.setdefault(turn, set()).update(own_letters)
        sets.append((tuple(lanes), dict(sorted(whole.items()))))
    return sets


def unevenness(ways: Mapping[int, Ways], share: Mapping[int, float]) -> float:
    """How much more than the mean those lanes have to let go that have most, if who has the choice takes the others.

    Lanes side by side have at least the traffic that none but they can take, by the `share` that each turn has; and
    the fullest have no more than that where each turn's lanes are side by side.
    """
    lanes = sorted(ways)
    of_turn: dict[int, set[int]] = {}
    for lane in lanes:
        for turn in ways[lane]:
            of_turn.setdefault(turn, set()).add(lane)
    spans = [set(lanes[begin:end]) for begin, end in combinations(range(len(lanes) + 1), 2)]
    confined = (sum(share[turn] for turn, own in of_turn.items() if own <= span) / len(span) for span in spans)
    most = max(confined, default=0.0)
    mean = sum(share[turn] for turn in of_turn) / max(len(lanes), 1)
    return most / mean if mean > 0 else 1.0


def _some_stand(lanes: Iterable[Ways], state: str) -> bool:
    """Whether who is first in a lane may have red, or has, while all of another lane have green."""
    greens = [{state[letter] in GREEN for letters in own.values() for letter in letters} for own in lanes]
    return {True} in greens and any(False in each for each in greens)
