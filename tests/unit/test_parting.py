"""Who turns off amid a link is not waited for at its stop line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.views import scene
from utn_controllers.scheduled.outlook import Outlook
from utn_controllers.scheduled.parting import Parting
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import AREA_REACH_M, ZONES_M, Bools, Floats, Network

BIN_S, BINS = 2.0, 25


@pytest.fixture(scope="module")
def sides(street_of: Callable[[Callable[[Path], Path]], Network]) -> Network:
    """A street of 400 m between two signals, with two T nodes amid it."""
    return street_of(odd_nets.side_streets)


def with_one_place(network: Network, link: int, place_m: float) -> Network:
    """The network with that link's traffic parting at one place, so far before the stop line, and no other's."""
    links = [replace(each, joining=(), parting=(), parting_m=()) for each in network.links]
    links[link] = replace(links[link], parting=(":n_0_0", ":n_1_0"), parting_m=(place_m, place_m))
    return replace(network, links=tuple(links))


def of(network: Network, link: int) -> Bools:
    """(Z,) that link alone."""
    return np.arange(len(network.links)) == link


def after(parting: Parting, one: Bools, came_veh: float, off_veh: float, looks: int = 200) -> Floats:
    """(zones + 1,) of `one` link (Z,) who goes on, when so many have come onto it in each bin and turned off."""
    for look in range(1, looks + 1):
        parting.look(look * came_veh * one, look * off_veh * one)
    return parting.onward[one][0]


@given(st.floats(0, 3), st.floats(0, 1), st.floats(5, 500), st.integers(0, 30))
def test_fewer_go_on_the_farther_from_the_line_and_never_fewer_than_did(
    sides: Network, came_veh: float, share: float, place_m: float, looks: int
) -> None:
    link = sides.link_index("u-B")
    parting = Parting(with_one_place(sides, link, place_m), BIN_S)
    onward = after(parting, of(sides, link), came_veh, share * came_veh, looks)
    assert (onward <= 1).all()
    assert (onward >= 1 - share - 1e-9).all()
    assert (np.diff(onward) <= 1e-9).all()


def test_whoever_is_past_the_place_comes_and_of_those_before_it_as_many_as_did_of_late(sides: Network) -> None:
    link = sides.link_index("u-B")
    near, amid = ZONES_M[1], (ZONES_M[1] + ZONES_M[2]) / 2
    for place_m, of_zones in ((near, [0, 0, 1, 1, 1, 1]), (amid, [0, 0, 0.5, 1, 1, 1])):
        parting = Parting(with_one_place(sides, link, place_m), BIN_S)
        onward = after(parting, of(sides, link), 1.0, 0.4)
        assert 1 - onward == pytest.approx(0.4 * np.array(of_zones), rel=0.03)
        # Nobody turns off elsewhere.
        assert (np.delete(parting.onward, link, axis=0) == 1).all()


def test_where_others_come_onto_the_link_amid_it_they_come_instead(sides: Network) -> None:
    link = sides.link_index("u-B")
    assert sides.links[link].joining
    assert sides.links[link].parting_m
    assert (after(Parting(sides, BIN_S), of(sides, link), 1.0, 0.4) == 1).all()


def test_it_is_learnt_anew_where_others_come_to_turn_off(sides: Network) -> None:
    link = sides.link_index("u-B")
    parting, came = Parting(with_one_place(sides, link, 50.0), BIN_S), of(sides, link)
    shares, off = [], 0.0
    for look in range(1, 601):
        off += 0.8 if look > 300 else 0.2
        parting.look(1.0 * look * came, off * came)
        shares.append(1 - parting.onward[link, -1])
    assert shares[299] == pytest.approx(0.2, abs=0.02)
    assert shares[599] == pytest.approx(0.8, abs=0.1)


def test_who_has_turned_off_of_late_is_expected_neither_in_sight_nor_farther_off(sides: Network) -> None:
    link = sides.link_index("u-B")
    network = with_one_place(sides, link, 30.0)
    streams, one = Streams(network), of(network, link)
    assert network.links[link].length_m > AREA_REACH_M
    seen = []
    for off_veh in (0.0, 0.5):
        outlook = Outlook(network, streams, BINS, BIN_S)
        feeding = int(np.flatnonzero(streams.next_link == link)[0])
        for look in range(1, 201):
            outlook.sent_veh[feeding, 2] = 1.0
            zone_veh = np.zeros((len(network.links), len(ZONES_M)))
            zone_veh[link] = 1.0
            counted = replace(
                scene(network),
                link_zone_veh=zone_veh,
                x_veh=8.0 * one,
                entered_veh=1.0 * look * one,
                parted_veh=off_veh * look * one,
            )
            stand, come, _ = outlook.look(counted, counted.zone_veh(counted.free), np.zeros(len(network.links)))
        seen.append((stand.sum(), come.sum(axis=0), outlook.come_veh.sum()))
    (stand, come, rate), (stand_then, come_then, rate_then) = seen
    assert stand_then == pytest.approx(stand)
    # The next zone lies on both sides of the place, those beyond it before it.
    next_bins = int(ZONES_M[1] / network.links[link].free_speed_m_s / BIN_S) + 1
    assert come_then[next_bins:] == pytest.approx(0.5 * come[next_bins:], rel=0.03)
    assert 0.5 * come[:next_bins].sum() < come_then[:next_bins].sum() < come[:next_bins].sum()
    assert rate_then == pytest.approx(0.5 * rate, rel=0.03)
