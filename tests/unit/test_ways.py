"""Trips are turned where SUMO would send them: along the fastest way on empty roads."""

from __future__ import annotations

import subprocess
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest
import sumolib

from tests.integration.odd_nets import NO_TURNAROUNDS, row
from utn_sumo.network import ways
from utn_sumo.network.ways import turned_veh
from utn_sumo.sumo_tools import sumo_binary

Turned = dict[tuple[str, str], float]
NetOf = Callable[[Callable[[Path], Any]], Path]
PAIRS = 60


def town(folder: Path) -> None:
    """Streets at random, with and without signals, with turnarounds at dead ends."""
    command = [str(sumo_binary("netgenerate")), "--rand", "--rand.iterations", "60", "--seed", "5", "--tls.guess"]
    command += ["--random-priority", "--random-lanenumber", "-o", str(folder / "town.net.xml")]
    subprocess.run(command, check=True, capture_output=True)


@pytest.fixture(scope="module")
def net(net_of: NetOf) -> Any:
    return sumolib.net.readNet(str(net_of(town)), withInternal=False)


@pytest.fixture(scope="module")
def pairs(net: Any) -> list[tuple[str, str]]:
    names, rng = [edge.getID() for edge in net.getEdges(withInternal=False)], np.random.default_rng(2)
    return [tuple(rng.choice(names, 2, replace=False).tolist()) for _ in range(PAIRS)]


@pytest.fixture(scope="module")
def sumo(net_of: NetOf) -> Iterator[Any]:
    libsumo.start(["sumo", "-n", str(net_of(town)), "--no-step-log"])
    yield libsumo.simulation
    libsumo.close()


def times_s(net: Any) -> dict[str, dict[str, float]]:
    """From each edge's end to the end of those ahead."""
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for edge in net.getEdges(withInternal=False):
        for ahead, each in edge.getOutgoing().items():
            turns = all(connection.getDirection() == "t" for connection in each)
            yields = all(connection.getState() in "m=" for connection in each)
            found[edge.getID()][ahead.getID()] = ahead.getLength() / ahead.getSpeed() + 5 * turns + 1.5 * yields
    return found


def fastest_s(times: dict[str, dict[str, float]], origin: str) -> dict[str, float]:
    """To every edge's end, by trying over and over (Bellman and Ford)."""
    reached, changed = {origin: 0.0}, True
    while changed:
        changed = False
        for edge, so_far_s in list(reached.items()):
            for ahead, more_s in times[edge].items():
                if so_far_s + more_s < reached.get(ahead, np.inf) - 1e-9:
                    reached[ahead], changed = so_far_s + more_s, True
    return reached


def along(turned: Turned, here: str) -> list[str]:
    """The edges of one vehicle's turns, in order."""
    ahead = dict(turned.keys())
    way = [here]
    while way[-1] in ahead:
        way.append(ahead[way[-1]])
    return way


def test_every_way_is_as_fast_as_any(net: Any, pairs: list[tuple[str, str]]) -> None:
    times = times_s(net)
    for here, there in pairs[:20]:
        turned, best = turned_veh(net, {(here, there): 3.0}), fastest_s(times, here)
        if there not in best:
            assert not turned
            continue
        assert set(turned.values()) == {3.0}
        way = along(turned, here)
        assert (way[0], way[-1]) == (here, there)
        assert sum(times[a][b] for a, b in pairwise(way)) == pytest.approx(best[there])


def test_nearly_every_way_is_the_one_that_sumo_finds(net: Any, pairs: list[tuple[str, str]], sumo: Any) -> None:
    """Where two are within the seconds that the lanes inside nodes take, SUMO may choose the other."""
    times, same = times_s(net), 0
    for here, there in pairs:
        theirs = list(sumo.findRoute(here, there).edges)
        way = along(turned_veh(net, {(here, there): 1.0}), here)
        if not theirs:
            assert way == [here]
            same += 1
            continue
        assert (way[0], way[-1]) == (here, there)
        same += way == theirs
        ours_s, theirs_s = (sum(times[a][b] for a, b in pairwise(each)) for each in (way, theirs))
        assert theirs_s <= 1.2 * ours_s + 5
    assert same >= 0.9 * PAIRS


def test_trips_add_up_over_the_turns_that_they_share(net: Any, pairs: list[tuple[str, str]]) -> None:
    trips = {pair: float(number) for number, pair in enumerate(pairs, 1)}
    expected: Turned = defaultdict(float)
    for pair, veh in trips.items():
        for turn, each in turned_veh(net, {pair: veh}).items():
            expected[turn] += each
    assert turned_veh(net, trips) == pytest.approx(expected)


@pytest.mark.parametrize("at_once", [1, 7])
def test_how_many_trees_are_held_at_once_makes_no_difference(
    net: Any, pairs: list[tuple[str, str]], at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    trips = dict.fromkeys(pairs, 1.0)
    usual = turned_veh(net, trips)
    monkeypatch.setattr(ways, "AT_ONCE", at_once)
    assert turned_veh(net, trips) == usual


def lone(folder: Path) -> Path:
    return row("AB").net(folder, NO_TURNAROUNDS)


@pytest.fixture(scope="module")
def street(net_of: NetOf) -> Any:
    return sumolib.net.readNet(str(net_of(lone)), withInternal=False)


@pytest.mark.parametrize(
    ("stops", "turns"),
    [
        (("W-A", "B-E"), [("W-A", "A-B"), ("A-B", "B-E")]),
        (("W-A", "A-B", "B-nB"), [("W-A", "A-B"), ("A-B", "B-nB")]),
        (("W-A",), []),
        ((), []),
        (("W-A", "W-A"), []),
        (("B-E", "W-A"), []),
        (("W-A", "nowhere"), []),
        (("W-A", "A-nA", "B-E"), [("W-A", "A-nA")]),
    ],
    ids=["straight", "via", "one edge", "none", "there already", "no way back", "unknown", "no way on"],
)
def test_a_trip_turns_as_far_as_it_has_a_way(street: Any, stops: tuple[str, ...], turns: list[Any]) -> None:
    assert turned_veh(street, {stops: 2.0}) == dict.fromkeys(turns, 2.0)


def test_nobody_turns_where_nobody_drives(street: Any) -> None:
    assert turned_veh(street, {}) == {}
