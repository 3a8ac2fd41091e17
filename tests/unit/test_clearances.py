"""From any stage to any other: nobody meets, and the net's own times are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.integration.odd_nets import DARK, NO_TURNAROUNDS, retime, row, tl_logic
from utn_sumo import clearances, monitor, streets
from utn_sumo.clearances import Times, between
from utn_sumo.contract import Junction, Network
from utn_sumo.plant.heads import Heads

StreetOf = Callable[[Callable[[Path], Path]], Network]


def ways(network: Network, junction: Junction) -> dict[tuple[int, int], clearances.Phases]:
    times = Times.of(network, junction)
    return {pair: between(network, junction, times, *pair) for pair in permutations(junction.stages, 2)}


def test_to_the_stage_that_follows_it_is_the_nets_own(utn17: Network) -> None:
    for junction in utn17.junctions:
        found = ways(utn17, junction)
        for first, then in zip(junction.stages, (*junction.stages[1:], junction.stages[0]), strict=True):
            assert found[first, then] == utn17.stages[first].clearance


def test_to_another_stage_everybody_has_the_same_yellow_and_all_red(utn17: Network) -> None:
    junction = utn17.junctions[0]
    first, _, last = junction.stages
    (yellow, yellow_s), (red, red_s) = between(utn17, junction, Times.of(utn17, junction), first, last)
    assert (yellow_s, red_s) == (3, 2)
    assert yellow == utn17.stages[first].state.replace("G", "y")
    assert set(red) == {"r"}


def test_who_has_green_in_both_stages_keeps_it(utn17: Network) -> None:
    junction = utn17.junctions[0]
    first, _, last = junction.stages
    state = utn17.stages[last].state
    kept = utn17.stages[first].state.index("G")
    both = replace(utn17.stages[last], state=state[:kept] + "G" + state[kept + 1 :])
    net = replace(utn17, stages=tuple(both if i == last else each for i, each in enumerate(utn17.stages)))
    for shown, _ in between(net, junction, Times.of(net, junction), first, last):
        assert shown[kept] == "G"


def shown_by(network: Network, seed: int, duration_s: int) -> list[tuple[int, str, str]]:
    """(second, junction, letters) of every change under wishes drawn at random."""
    rng, seen = np.random.default_rng(seed), []
    now = 0
    heads = Heads(network, lambda index, state: seen.append((now, network.junctions[index].id, state)))
    heads.start(0.0)
    for now in range(duration_s):
        heads.advance(now)
        for index in np.flatnonzero(heads.free(now)):
            wish = int(rng.choice(network.junctions[index].stages))
            if wish != heads.stage[index] and rng.uniform() < 0.3:
                heads.switch(int(index), wish, now)
    return seen


def recorded(network: Network, folder: Path, seed: int) -> Path:
    """SUMO's record of that, of many changes."""
    changes = shown_by(network, seed, 1200)
    assert len(changes) > 100
    return written(folder, changes)


def written(folder: Path, changes: Iterable[tuple[float, str, str]]) -> Path:
    """(second, junction, letters) of every change, as SUMO records them."""
    lines = [
        f'<tlsState time="{second:.2f}" id="{name}" programID="x" phase="0" state="{state}"/>'
        for second, name, state in changes
    ]
    (folder / "signals.xml").write_text(f"<tlsStates>{''.join(lines)}</tlsStates>", encoding="utf-8")
    return folder / "signals.xml"


@pytest.mark.parametrize("seed", range(5))
def test_the_monitor_has_nothing_to_say_against_any_order_of_stages(utn17: Network, tmp_path: Path, seed: int) -> None:
    verdict = monitor.watch(utn17, recorded(utn17, tmp_path, seed), 1200, in_order=False)
    assert verdict.reasons == []


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Network:
    """Crossroads with a stage for left turns after each road's own, and people who walk beside it."""
    options = (odd_nets.NO_TURNAROUNDS, "--sidewalks.guess", "--crossings.guess")
    net = streets.named(str(odd_nets.pockets().net(tmp_path_factory.mktemp("walked"), *options)))
    assert [len(junction.stages) for junction in net.junctions] == [4]
    return net


def test_cars_drive_on_while_who_walks_is_cleared_also_to_a_stage_that_does_not_follow(walked: Network) -> None:
    junction = walked.junctions[0]
    first, _, third, _ = junction.stages
    own = walked.stages[first].clearance
    (driving, cleared_s), (_, yellow_s) = own
    made = ways(walked, junction)[first, third]
    # As the net itself does it, but for left turns, which the stage that follows would let go on.
    assert made[0] == (driving, cleared_s)
    assert sum(seconds for _, seconds in made) == cleared_s + yellow_s
    assert all(letter in "yr" for letter in made[1][0])
    for walker in junction.crossings:
        assert driving[walker] == "r"


def test_who_walks_and_who_drives_is_cleared_as_long_as_the_net_has_it_at_most(walked: Network) -> None:
    junction = walked.junctions[0]
    longest_s = Times.of(walked, junction).longest_s
    walks = np.isin(np.arange(len(longest_s)), junction.crossings)
    cleared_s, yellow_s = (seconds for _, seconds in walked.stages[junction.stages[0]].clearance)
    assert set(longest_s[walks]) == {cleared_s + yellow_s}
    assert set(longest_s[~walks]) == {yellow_s}


@pytest.mark.parametrize("seed", range(3))
def test_the_monitor_has_nothing_to_say_where_people_walk(walked: Network, tmp_path: Path, seed: int) -> None:
    verdict = monitor.watch(walked, recorded(walked, tmp_path, seed), 1200, in_order=False)
    assert verdict.reasons == []


@pytest.mark.parametrize("phase", [0, 1])
def test_the_monitor_sees_a_second_too_few_for_who_walks_or_who_drives(
    walked: Network, tmp_path: Path, phase: int
) -> None:
    junction = walked.junctions[0]
    first, _, third, _ = junction.stages
    made = ways(walked, junction)[first, third]
    for missing in (0, 1):
        shown, now_s = [], 0.0
        for number, (state, seconds) in enumerate(
            [(walked.stages[first].state, 20.0), *made, (walked.stages[third].state, 20.0)]
        ):
            shown.append((now_s, junction.id, state))
            now_s += seconds - missing * (number == phase + 1)
        verdict = monitor.watch(walked, written(tmp_path, shown), round(now_s), in_order=False)
        assert (len(verdict.reasons) > 0) == (missing > 0)


def retimed(*phases: tuple[float, str]) -> Callable[[Path], Path]:
    """A crossroads of single lanes with this programme; of an arm its letters are right turn, ahead, left turn."""
    return lambda folder: retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", phases))


LEFT_LAST = retimed(
    *((25, "GGgrrrGGgrrr"), (3, "yygrrryygrrr"), (4, "rrGrrrrrGrrr"), (3, "rryrrrrryrrr"), (2, DARK)),
    *((20, "rrrGGGrrrrrr"), (3, "rrryyyrrrrrr"), (2, DARK)),
    *((20, "rrrrrrrrrGGG"), (3, "rrrrrrrrryyy"), (2, DARK)),
)
"""Left turns from north and south have way for 4 s when those ahead are cleared; the east and the west come in turn."""
LEFT_GOES_ON = retimed(
    *((25, "GGrrrrGGrrrr"), (3, "GGgrrryyyrrr"), (20, "GGGrrrrrrrrr"), (3, "yyyrrrrrrrrr"), (2, DARK)),
    *((20, "rrrGGgrrrGGg"), (3, "rrryyyrrryyy"), (2, DARK)),
)
"""The north's left turns may go, giving way, as soon as the south is being cleared, and have way when it is."""


def test_who_never_follows_another_waits_as_others_wait_for_the_last_before_them(street_of: StreetOf) -> None:
    net = street_of(LEFT_LAST)
    (junction,) = net.junctions
    first, east, west = junction.stages
    assert sum(seconds for _, seconds in net.stages[first].clearance) == 12
    # In these 12 s the next ones wait for the left turns, that go until 5 before the end.
    assert set(Times.of(net, junction).longest_s) == {5}
    found = ways(net, junction)
    for pair in ((first, west), (east, first), (west, east)):
        assert [seconds for _, seconds in found[pair]] == [3, 2]


def test_who_may_go_giving_way_while_another_is_cleared_has_way_when_he_is(street_of: StreetOf) -> None:
    net = street_of(LEFT_GOES_ON)
    (junction,) = net.junctions
    times = Times.of(net, junction)
    north_left, south, east = 2, 7, 4
    assert times.between_s[south, north_left] == 3
    assert times.between_s[south, east] == 3 + 10 + 3 + 2
    assert set(times.longest_s) == {5}


@pytest.mark.parametrize("make", [LEFT_LAST, LEFT_GOES_ON], ids=["left turns last", "left turns go on"])
@pytest.mark.parametrize("seed", range(3))
def test_the_monitor_has_nothing_to_say_where_clearances_are_staggered(
    street_of: StreetOf, tmp_path: Path, make: Callable[[Path], Path], seed: int
) -> None:
    net = street_of(make)
    assert monitor.watch(net, recorded(net, tmp_path, seed), 1200, in_order=False).reasons == []


def test_the_monitor_sees_a_second_too_few_before_who_gets_way_and_had_a_green_that_gives_way(
    street_of: StreetOf, tmp_path: Path
) -> None:
    net = street_of(LEFT_GOES_ON)
    (junction,) = net.junctions
    for yellow_s in (3, 2):
        shown = [(0, "GGrrrrGGrrrr"), (20, "GGgrrryyyrrr"), (20 + yellow_s, "GGGrrrrrrrrr")]
        record = written(tmp_path, [(second, junction.id, state) for second, state in shown])
        verdict = monitor.watch(net, record, 40, in_order=False)
        assert bool([reason for reason in verdict.reasons if "has way too soon" in reason]) == (yellow_s < 3)
