"""Who waits on side roads for gaps in what signals let go: which roads these are, what they wait for is learnt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.views import scene
from utn_controllers.scheduled.sides import Sides
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import Network, Turn
from utn_sumo.detectors import ids, write

Make = Callable[[Path], Path]
StreetOf = Callable[[Make], Network]

BIN_S = 2


def behind(network: Network) -> dict[str, dict[tuple[str, str], float]]:
    """By side road the signals that it waits for, with the edges behind them and the time of driving from there."""
    return {
        side.edge: {(network.junctions[junction].id, edge): after_s for junction, edge, after_s in side.behind}
        for side in network.side_roads
    }


def test_side_roads_wait_for_the_signals_on_either_side_of_them(street_of: StreetOf) -> None:
    network = street_of(odd_nets.side_streets)
    length_m, found = network.edge_length_m, behind(network)
    assert found == {
        "st-t": {
            ("A", "A-t"): pytest.approx(length_m["A-t"] / 13.89),
            ("B", "B-u"): pytest.approx((length_m["B-u"] + length_m["u-t"]) / 13.89),
        },
        "su-u": {
            ("A", "A-t"): pytest.approx((length_m["A-t"] + length_m["t-u"]) / 13.89),
            ("B", "B-u"): pytest.approx(length_m["B-u"] / 13.89),
        },
    }


@pytest.mark.parametrize("make", [odd_nets.plain, odd_nets.pedestrians, odd_nets.joined])
def test_roads_to_signals_are_no_side_roads(street_of: StreetOf, make: Make) -> None:
    assert not street_of(make).side_roads


def far_side_street(folder: Path) -> Path:
    """A side street 100 m behind a signal, another one 350 m behind it."""
    streets = odd_nets.row("A").without("A-E", "E-A")
    for name, x in (("t", 100), ("u", 350)):
        streets.node(name, x, 0)
        streets.node(f"s{name}", x, -odd_nets.ARM_M)
        streets.road(f"s{name}", name, priority=1)
    for start, end in (("A", "t"), ("t", "u"), ("u", "E")):
        streets.road(start, end, priority=5)
    return streets.net(folder, odd_nets.NO_TURNAROUNDS)


def test_side_roads_far_behind_a_signal_do_not_wait_for_it(street_of: StreetOf) -> None:
    assert behind(street_of(far_side_street)).keys() == {"st-t"}


def test_the_end_of_each_side_road_is_watched_where_it_is_of_use(street_of: StreetOf, tmp_path: Path) -> None:
    network = street_of(odd_nets.side_streets)
    named = ids(network)
    wanted = {name for names in (*named.side_area, *named.side_line) for name in names}
    # Of each one lane, and two ways on.
    assert len(wanted) == 3 * len(network.side_roads)
    always = {name for names in named.joining for name in names}
    for within_step in (False, True):
        write(network, tmp_path / "own.add.xml", 60, within_step=within_step)
        made = [each.attrib["id"] for each in ET.parse(tmp_path / "own.add.xml").getroot()]
        assert len(set(made)) == len(made)
        assert wanted & set(made) == (wanted if within_step else wanted & always)


@pytest.fixture(scope="module")
def streets(street_of: StreetOf) -> Network:
    """Side streets between two signals, at which nine tenths go straight on."""
    network = street_of(odd_nets.side_streets)

    def is_straight(turn: Turn) -> bool:
        start, end = network.links[turn.link].edges[-1].split("-")[0], turn.to_edge.split("-")[1]
        return (start in along) == (end in along)

    along = {"W", "E", "t", "u"}
    turns = [replace(turn, fraction=0.9 if is_straight(turn) else 0.05) for turn in network.turns]
    return replace(network, turns=tuple(turns))


def went(network: Network, rate: Callable[[bool], float], bins: int = 600) -> tuple[Sides, np.ndarray]:
    """What is seen after so many bins in which two stood on each side road.

    And so many go in a bin, by whether their nearest signal made gaps a while ago. Stages change every 30 s.
    """
    streams = Streams(network)
    sides = Sides(network, streams, BIN_S)
    left, waiting = np.zeros(len(network.side_roads)), np.zeros(len(sides))
    nearest = [min(side.behind, key=lambda each: each[2]) for side in network.side_roads]
    shown: list[list[int]] = []
    rng = np.random.default_rng(3)
    # Each junction by a rhythm of its own.
    offset, first_row = rng.integers(0, 60, len(network.junctions)), streams.first_stage[:-1]
    for time_bin in range(bins):
        rows = first_row + (time_bin + offset + 7 * np.arange(len(offset)) * (time_bin // 40)) // 15 % 2
        shown.append(rows.tolist())
        for road, (junction, _, after_s) in enumerate(nearest):
            then = max(time_bin - math.floor(after_s / BIN_S) - 1, 0)
            main = network.junctions[junction].stages[shown[then][junction] - first_row[junction]]
            left[road] += rng.poisson(rate(not serves_main(network, main)))
        seen = replace(scene(network), side_stand_veh=np.full(len(left), 2.0), side_gone_veh=left.copy())
        waiting = sides.look(seen, rows)
    return sides, waiting


def serves_main(network: Network, stage: int) -> bool:
    """Whether a stage gives green from the west and the east."""
    served = {network.links[network.turns[turn].link].id for turn in network.stages[stage].turns}
    return any(name.startswith(("W-", "t-", "u-", "E-")) for name in served)


def test_whoever_goes_in_the_gaps_of_a_signal_waits_for_it_and_it_alone(streets: Network) -> None:
    sides, waiting = went(streets, lambda in_gaps: 0.4 if in_gaps else 0.05)
    # One is nearest to each: he counts as a half, since there are two signals that he waits for.
    assert sides.junction.tolist() == [0, 1]
    assert waiting == pytest.approx([1.0, 1.0], abs=0.2)


def test_whoever_goes_as_well_without_gaps_waits_for_nothing(streets: Network) -> None:
    _, waiting = went(streets, lambda _: 0.2)
    assert waiting == pytest.approx([0.0, 0.0], abs=0.1)
    _, at_first = went(streets, lambda in_gaps: 0.4 * in_gaps, bins=1)
    assert (at_first == 0).all()


def test_gaps_are_made_by_stages_that_let_few_onto_the_main_road(streets: Network) -> None:
    streams = Streams(streets)
    sides = Sides(streets, streams, BIN_S)
    for stream, junction in enumerate(sides.junction):
        for row in range(*streams.first_stage[junction : junction + 2]):
            assert sides.serves[row, stream] != serves_main(streets, int(streams.stage[row]))
