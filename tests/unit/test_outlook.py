"""Who stands and who comes: everybody on a link is accounted for, when they will arrive, and nobody twice."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.views import Scene, by_the_line, scene
from utn_controllers.scheduled.outlook import Outlook
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import AREA_REACH_M, EXIT, ZONES_M, Floats, Network

BIN_S, BINS = 2.0, 25
A_BIN = 1.0
"""When in a bin somebody came is not known."""


def looked(outlook: Outlook, view: Scene) -> tuple[Floats, Floats]:
    """(N,) who stands and (N, K) who comes."""
    return outlook.look(view, view.zone_veh(view.free), np.zeros(len(view.x_veh)))[:2]


class Road:
    """One link of a network on which vehicles enter at known times, drive freely, and leave or stand at its end."""

    def __init__(self, network: Network, link: int, entered_s: Iterable[float], red: bool = False):
        self.network, self.link, self.red = network, link, red
        self.entered_s = np.sort(np.array(list(entered_s), dtype=float))
        self.free_s = float(network.free_time_s[link])
        self.speed_m_s = network.links[link].free_speed_m_s
        self.streams = Streams(network)
        self.outlook = Outlook(network, self.streams, BINS, BIN_S)
        self.now_s = 0.0
        turns = network.turn_link == link
        share = np.bincount(network.turn_group, network.fraction * turns, len(network.groups))
        self.group_share = share / share.sum()

    def on_it(self) -> int:
        return self._since(0.0) - self._left()

    def look(self) -> tuple[Floats, Floats]:
        """(N,) and (N, K), a bin later."""
        self.now_s += BIN_S
        return looked(self.outlook, self._view())

    def _since(self, after_s: float) -> int:
        return int((self.entered_s + after_s <= self.now_s).sum())

    def _left(self) -> int:
        return 0 if self.red else self._since(self.free_s)

    def _zone_veh(self) -> Floats:
        """(zones,) those who are on it, by the way that they still have."""
        here_s = self.now_s - self.entered_s[(self.entered_s <= self.now_s)]
        to_stop_m = np.maximum(self.free_s - here_s, 0.0) * self.speed_m_s
        if not self.red:
            to_stop_m = to_stop_m[to_stop_m > 0]
        return np.histogram(to_stop_m, [0.0, *ZONES_M])[0].astype(float)

    def _view(self) -> Scene:
        one = np.zeros(len(self.network.links))
        one[self.link] = 1.0
        return replace(
            scene(self.network, self.now_s),
            set_zone_veh=np.outer(self.group_share, self._zone_veh()),
            x_veh=self.on_it() * one,
            entered_veh=self._since(0.0) * one,
        )

    @property
    def own(self) -> Floats:
        """(N,) 1 for its streams."""
        return (self.streams.link == self.link).astype(float)

    @property
    def due_bins(self) -> int:
        """Bins in which whoever is on it now arrives; whoever comes later arrives later."""
        return int(self.free_s / BIN_S - 0.5) + 1


@pytest.fixture(scope="module", params=["long", "short"])
def street(
    request: pytest.FixtureRequest, utn17: Network, street_of: Callable[[Callable[[Path], Path]], Network]
) -> Network:
    """Links that reach back beyond what the detectors see, and links that are in sight as a whole."""
    found = utn17 if request.param == "long" else street_of(odd_nets.plain)
    assert {link.length_m > AREA_REACH_M for link in found.links} == {request.param == "long"}
    assert not found.unsignalled.any()
    return found


@given(gaps_s=st.lists(st.floats(0.5, 30), min_size=1, max_size=30), red=st.booleans(), at=st.integers(0, 100))
def test_everybody_on_a_link_stands_or_comes(street: Network, gaps_s: list[float], red: bool, at: int) -> None:
    road = Road(street, at % len(street.links), np.cumsum(gaps_s), red)
    for _ in range(60):
        stand, come = road.look()
        assert (stand >= 0).all()
        assert (come >= 0).all()
        assert stand.sum() + come[:, : road.due_bins].sum() == pytest.approx(road.on_it(), abs=1e-6)
        assert (stand * (1 - road.own)).sum() + come[road.own == 0].sum() == pytest.approx(0.0)


@pytest.mark.parametrize("entered_s", [0.5, 2.5, 3.9, 11.3])
def test_a_vehicle_arrives_when_free_speed_brings_it_there(street: Network, entered_s: float) -> None:
    road = Road(street, 0, [entered_s])
    borders_s = np.array([0.0, *ZONES_M]) / road.speed_m_s
    looks = 0
    while road.now_s < entered_s + road.free_s - BIN_S:
        stand, come = road.look()
        on_way = come[:, : road.due_bins].sum(axis=0)
        ahead_s = road.free_s - (road.now_s - entered_s)
        if road.now_s < entered_s:
            assert stand.sum() + come.sum() == 0
            continue
        looks += 1
        if ahead_s < borders_s[1]:
            assert stand.sum() == pytest.approx(1.0)
        else:
            # The nearer, the better it is known where it is.
            zone = int(np.searchsorted(borders_s, ahead_s))
            wide_s = borders_s[zone] - borders_s[zone - 1] if zone < len(borders_s) else 2 * A_BIN * BIN_S
            place = float(on_way @ np.arange(road.due_bins)) / on_way.sum()
            assert place == pytest.approx(ahead_s / BIN_S - 0.5, abs=wide_s / 2 / BIN_S + 0.5)
    assert looks > 4


def test_who_is_by_the_line_stands_by_lane_group_as_seen(utn17: Network) -> None:
    streams = Streams(utn17)
    outlook = Outlook(utn17, streams, BINS, BIN_S)
    near_veh = np.arange(len(utn17.groups), dtype=float)
    seen_veh = np.bincount(utn17.group_link, near_veh, len(utn17.links))
    still = replace(scene(utn17), set_zone_veh=by_the_line(near_veh), x_veh=seen_veh, entered_veh=seen_veh)
    for _ in range(30):
        stand, come = looked(outlook, still)
    assert np.bincount(streams.group, stand, len(utn17.groups)) == pytest.approx(near_veh)
    near_bins = int(utn17.free_time_s.min() / BIN_S) - 1
    assert come[:, :near_bins].sum() == pytest.approx(0.0)


def test_a_queue_that_reaches_back_out_of_sight_follows_whom_the_detectors_see(utn17: Network) -> None:
    link, streams = 0, Streams(utn17)
    outlook = Outlook(utn17, streams, BINS, BIN_S)
    road = utn17.links[link]
    storage_veh, ends_m = utn17.storage_veh[link], np.array([0.0, *ZONES_M])
    one = np.zeros(len(utn17.links))
    one[link] = 1.0
    groups = utn17.group_link == link
    zone_veh = np.outer(groups / groups.sum(), storage_veh * np.diff(ends_m) / road.length_m)
    full = replace(scene(utn17), set_zone_veh=zone_veh, x_veh=storage_veh * one, entered_veh=storage_veh * one)
    for _ in range(30):
        stand, come = looked(outlook, full)
    seen_bins = int(AREA_REACH_M / road.free_speed_m_s / BIN_S) + 1
    assert stand.sum() + come[:, :seen_bins].sum() == pytest.approx(storage_veh, rel=0.01)
    assert stand.sum() == pytest.approx(storage_veh * ZONES_M[0] / road.length_m)


@pytest.mark.parametrize("gap_s", [4.0, 8.0])
def test_as_many_more_come_as_have_been_coming(street: Network, gap_s: float) -> None:
    road = Road(street, 0, np.arange(0.5, 900, gap_s))
    seen = []
    for _ in range(400):
        _, come = road.look()
        later = come[:, road.due_bins :].sum(axis=0)
        assert later == pytest.approx(later[0])
        seen.append(later[0])
    assert seen[0] < 0.5 * BIN_S / gap_s
    assert np.mean(seen[350:400]) == pytest.approx(BIN_S / gap_s, rel=0.05)


def test_nobody_is_expected_any_more_once_they_have_stopped_coming(utn17: Network) -> None:
    road = Road(utn17, 0, np.arange(0.5, 600, 4))
    for _ in range(300):
        _, come = road.look()
    assert come[:, road.due_bins :].sum() > 1
    for _ in range(300):
        stand, come = road.look()
    assert stand.sum() + come.sum() < 0.1


def test_whom_a_neighbour_sends_arrives_after_the_way_along_the_link(utn17: Network) -> None:
    streams = Streams(utn17)
    for stream in np.flatnonzero(streams.next_link != EXIT):
        outlook = Outlook(utn17, streams, BINS, BIN_S)
        link, place = streams.next_link[stream], 4
        outlook.sent_veh[stream, place] = 3.0
        stand, come = looked(outlook, scene(utn17))
        assert not stand.any()
        assert come.sum() == pytest.approx(3.0)
        assert come[streams.link == link].sum() == pytest.approx(3.0)
        (found,) = np.flatnonzero(come.sum(axis=0))
        # A bin has gone by since.
        assert found - place + 1 == pytest.approx(utn17.free_time_s[link] / BIN_S, abs=0.5)
        share = streams.shares(utn17.fraction).of_link
        assert come[:, found] == pytest.approx(np.where(streams.link == link, 3.0 * share, 0.0))


def test_who_comes_as_neighbours_said_is_not_expected_from_elsewhere_as_well(utn17: Network) -> None:
    gap_s = 4.0
    streams = Streams(utn17)
    stream = int(np.flatnonzero(streams.next_link != EXIT)[0])
    road = Road(utn17, int(streams.next_link[stream]), np.arange(0.5, 900, gap_s))
    for _ in range(400):
        road.outlook.sent_veh[stream] = BIN_S / gap_s
        _, come = road.look()
    late = come[:, road.due_bins + 1 :].sum(axis=0)
    assert late == pytest.approx(BIN_S / gap_s, rel=0.1)


def test_it_goes_by_the_turning_fractions_that_it_is_told(utn17: Network) -> None:
    first = np.unique(utn17.turn_link, return_index=True)[1]
    fraction = np.zeros(len(utn17.turns))
    fraction[first] = 1.0
    road = Road(utn17, 0, [0.5])
    road.outlook.take_up(fraction)
    _, come = road.look()
    (stream,) = np.flatnonzero(come.sum(axis=1))
    turn = utn17.turns[first[0]]
    assert (road.streams.group[stream], road.streams.next_link[stream]) == (turn.group, turn.next_link)


@pytest.mark.parametrize("length_m", [2.0, 8.0, 13.0])
def test_whom_a_neighbour_sends_onto_a_road_of_a_moment_comes_and_nobody_else(utn17: Network, length_m: float) -> None:
    short = tuple(replace(link, length_m=length_m) for link in utn17.links)
    outlook = Outlook(replace(utn17, links=short), streams := Streams(utn17), BINS, BIN_S)
    stream = int(np.flatnonzero(streams.next_link != EXIT)[0])
    # Those behind it in memory are sent off by others, to other roads.
    outlook.sent_veh[:] = np.where(streams.next_link != streams.next_link[stream], 1000.0, 0.0)[:, None]
    outlook.sent_veh[stream] = 1.0
    _, come = looked(outlook, scene(utn17))
    arrive = come[streams.link == streams.next_link[stream]].sum(axis=0)
    assert arrive == pytest.approx([*np.ones(BINS - 1), arrive[-1]])
    assert 0 <= arrive[-1] <= 1
