"""Who is held up by a full pocket: nobody is forgotten, and where nothing is full everybody comes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.views import scene
from utn_controllers.scheduled.outlook import Outlook
from utn_controllers.scheduled.pockets import held_up, rooms_veh
from utn_controllers.scheduled.streams import Streams
from utn_sumo import streets
from utn_sumo.contract import ZONES_M, Network

veh = st.floats(0, 40)


@pytest.fixture(scope="module")
def pockets(tmp_path_factory: pytest.TempPathFactory) -> Network:
    return streets.named(str(odd_nets.turning_pockets(tmp_path_factory.mktemp("pockets"))))


@given(own=st.tuples(veh, veh, veh), before=veh, far=veh, cut=st.tuples(st.floats(0.1, 0.4), st.floats(0.1, 0.4)))
def test_whoever_waits_behind_is_weighed_with_those_in_front(
    own: tuple[float, ...], before: float, far: float, cut: tuple[float, float]
) -> None:
    zone, upstream = np.zeros((3, len(ZONES_M))), np.zeros((1, len(ZONES_M)))
    zone[:, 0], upstream[0, 2] = own, before
    share, x = np.array([*cut, 1 - sum(cut)]), np.array([sum(own) + before + far])
    room, link = np.full(3, 10.0), np.zeros(3, dtype=np.int64)
    shut, weight = held_up(zone, upstream, x, share, room, np.array([20.0]), link)
    full = (zone[:, 0] >= 7.5) & (before >= 8.0)
    assert (weight[~full] == 1).all()
    assert (weight >= 1 - 1e-9).all()
    assert (shut == (~full & full.any())).all()
    if full.any():
        waiting_veh = zone[full, 0] + share[full] * (before + far)
        assert weight[full] @ waiting_veh == pytest.approx(zone[full, 0].sum() + before + far)


def test_where_lanes_never_part_nobody_is_held_up(utn17: Network) -> None:
    zone = np.full((len(utn17.groups), len(ZONES_M)), 20.0)
    share, x = utn17.group_shares(utn17.fraction), utn17.storage_veh
    nobody = np.zeros((len(utn17.links), len(ZONES_M)))
    shut, weight = held_up(zone, nobody, x, share, *rooms_veh(utn17), utn17.group_link)
    assert not shut.any()
    assert (weight == 1).all()


def test_the_room_in_sight_is_that_of_its_lanes(pockets: Network) -> None:
    group_m, before_m = pockets.watched_lane_m
    group_veh, before_veh = rooms_veh(pockets)
    assert group_veh == pytest.approx(group_m / 7.5, rel=0.2)
    assert before_veh == pytest.approx(before_m / 7.5, rel=0.2)
    assert before_veh.max() > 5


@pytest.mark.parametrize("full", [False, True])
def test_nobody_is_expected_in_other_lanes_while_a_full_pocket_stands_in_the_way(pockets: Network, full: bool) -> None:
    streams = Streams(pockets)
    group_veh, before_veh = rooms_veh(pockets)
    parting = [link for link in np.flatnonzero(before_veh > 5) if (pockets.group_link == link).sum() > 1]
    link = parting[0]
    groups = np.flatnonzero(pockets.group_link == link)
    pocket = groups[np.argmin(group_veh[groups])]
    zone, upstream = np.zeros((len(group_veh), len(ZONES_M))), np.zeros((len(before_veh), len(ZONES_M)))
    zone[pocket, 0] = group_veh[pocket] * full
    upstream[link, 2] = before_veh[link]
    x = np.bincount(pockets.group_link, zone.sum(axis=1), len(before_veh)) + upstream.sum(axis=1)
    view = replace(scene(pockets), group_zone_veh=zone, link_zone_veh=upstream, x_veh=x)
    outlook = Outlook(pockets, streams, 25, 2.0)
    _, come, weight = outlook.look(view, view.zone_veh(view.free))
    others = (streams.link == link) & (streams.group != pocket)
    assert others.any()
    assert (come[others].sum() > 0) != full
    assert (weight[pocket] > 1) == full
