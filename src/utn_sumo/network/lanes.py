"""Which lanes before a stop line share turns, and which of these move alike."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from utn_sumo.clearances import GIVES_WAY, GREEN

Ways = Mapping[int, set[int]]
"""The turns that go from some lanes, and the letters of the signals by which they do."""


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
    ways: Mapping[int, Ways], states: Iterable[str], reserved: Collection[int] = ()
) -> list[tuple[tuple[int, ...], Ways]]:
    """The sets into which the lanes of one group part, with their ways, from the ways of each lane.

    All lanes move alike and are one set where in none of the junction's `states` somebody of the group gives way, nor
    one lane goes while who is first in another one may have red. Else a lane from which somebody waits for gaps is
    slower than one without, one behind a red arrow stands, and lanes are a set if they have the same turns by signals
    that always show the same. Lanes `reserved` for buses are never one with others: hardly anybody takes them.
    """
    shown = list(states)
    letters = {letter for own in ways.values() for each in own.values() for letter in each}
    gives_way = any(state[letter] == GIVES_WAY for state in shown for letter in letters)
    together = not gives_way and not any(_some_stand(ways.values(), state) for state in shown)
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


def _some_stand(lanes: Iterable[Ways], state: str) -> bool:
    """Whether who is first in a lane may have red, or has, while all of another lane have green."""
    greens = [{state[letter] in GREEN for letters in own.values() for letter in letters} for own in lanes]
    return {True} in greens and any(False in each for each in greens)
