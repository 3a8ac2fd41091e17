"""Who is held up by a full pocket: nobody is forgotten, and where nothing is full everybody comes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.views import scene
from utn_controllers.scheduled.outlook import Outlook
from utn_controllers.scheduled.pockets import HOLDING, held_up, rooms_veh, taken
from utn_controllers.scheduled.streams import Streams
from utn_sumo import streets
from utn_sumo.contract import ZONES_M, Floats, Network

veh = st.floats(0, 40)
ROOM_VEH, BEFORE_VEH = 10.0, 20.0


@pytest.fixture(scope="module")
def pockets(tmp_path_factory: pytest.TempPathFactory) -> Network:
    return streets.named(str(odd_nets.turning_pockets(tmp_path_factory.mktemp("pockets"))))


def held(
    own: tuple[float, ...],
    before: float,
    far: float,
    cut: tuple[float, float] = (0.2, 0.3),
    of_lanes: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> tuple[Floats, Floats]:
    """Of a link of three lane groups, with so many on the `own` lanes of each, `before` they part and out of sight.

    Whose queues take these shares of the lanes before them.
    """
    zone, upstream = np.zeros((3, len(ZONES_M))), np.zeros((1, len(ZONES_M)))
    zone[:, 0], upstream[0, 2] = own, before
    share, x = np.array([*cut, 1 - sum(cut)]), np.array([sum(own) + before + far])
    room, link = np.full(3, ROOM_VEH), np.zeros(3, dtype=np.int64)
    return held_up(zone.sum(axis=1), upstream, x, share, room, np.array([BEFORE_VEH]), np.array(of_lanes), link)


@given(own=st.tuples(veh, veh, veh), before=veh, far=veh, cut=st.tuples(st.floats(0.1, 0.4), st.floats(0.1, 0.4)))
def test_whoever_waits_behind_is_weighed_with_those_in_front(
    own: tuple[float, ...], before: float, far: float, cut: tuple[float, float]
) -> None:
    shut, weight = held(own, before, far, cut)
    filled, dense = np.array(own) / ROOM_VEH, before / BEFORE_VEH
    (own_from, own_to), (before_from, before_to) = HOLDING
    nobody = (filled <= own_from) | (dense <= before_from)
    full = (filled >= own_to) & (dense >= before_to)
    assert weight[nobody] == pytest.approx(1.0)
    assert (weight >= 1 - 1e-9).all()
    assert ((shut >= 0) & (shut <= 1)).all()
    if full.any() and (full | nobody).all():
        share = np.array([*cut, 1 - sum(cut)])
        waiting_veh = np.array(own)[full] + share[full] * (before + far)
        assert weight[full] @ waiting_veh == pytest.approx(np.array(own)[full].sum() + before + far)


def test_others_get_past_the_less_the_longer_the_queues_are() -> None:
    shut = [held((fill * ROOM_VEH, 0.0, 0.0), fill * BEFORE_VEH, 0.0)[0] for fill in np.linspace(0, 1, 21)]
    assert (np.diff(shut, axis=0) >= -1e-9).all()
    assert shut[0] == pytest.approx(0.0)
    assert shut[-1] == pytest.approx([0.0, 1.0, 1.0])


def test_on_lanes_that_no_queue_takes_the_others_go_on() -> None:
    full = ROOM_VEH, 0.0, 0.0
    shut, weight = held(full, BEFORE_VEH, 30.0)
    for of_lanes in (0.5, 1 / 3):
        fewer, less = held(full, BEFORE_VEH, 30.0, of_lanes=(of_lanes, 1.0, 1.0))
        assert fewer == pytest.approx(of_lanes * shut)
        assert 1 < less[0] < weight[0]
        # As if there were fewer behind.
        assert less == pytest.approx(held(full, of_lanes * BEFORE_VEH, 30.0 * of_lanes)[1])
    # A pocket is shut whatever it would take itself.
    assert held((0.0, ROOM_VEH, 0.0), BEFORE_VEH, 30.0, of_lanes=(0.3, 1.0, 1.0))[0] == pytest.approx([1.0, 0.0, 1.0])


def test_a_pocket_takes_one_lane_of_those_before_it(pockets: Network, tmp_path: Path) -> None:
    assert taken(pockets) == pytest.approx(1.0)
    streets_of = odd_nets.row("C", lanes=3).without("W-C")
    streets_of.node("w", -60, 0)
    streets_of.one_way("W", "w", lanes=3)
    streets_of.one_way("w", "C", lanes=4)
    network = streets.named(str(odd_nets.case(streets_of.net(tmp_path, odd_nets.NO_TURNAROUNDS).parent, "")))
    link = next(index for index, each in enumerate(network.links) if each.edges == ("W-w", "w-C"))
    lanes = [sum(len(each.lanes) for each in network.lane_sets if each.group == g) for g in range(len(network.groups))]
    own = network.group_link == link
    assert sorted(np.array(lanes)[own]) == [1, 3]
    assert taken(network)[own] == pytest.approx(np.array(lanes)[own] / 3)
    assert taken(network)[~own] == pytest.approx(np.minimum(np.array(lanes)[~own] / 3, 1))


@given(
    own=st.tuples(veh, veh, veh),
    before=veh,
    far=veh,
    where=st.integers(0, 3),
    cut=st.tuples(st.just(0.2), st.just(0.3)),
)
def test_a_little_more_traffic_changes_no_weight_at_a_stroke(
    own: tuple[float, ...], before: float, far: float, where: int, cut: tuple[float, float]
) -> None:
    """Else what is shown next would change with every vehicle that comes or goes."""
    more = [*own, before]
    more[where] += 0.01
    for now, then in zip(held(own, before, far, cut), held(tuple(more[:3]), more[3], far, cut), strict=True):
        assert then == pytest.approx(now, abs=0.2)


def test_where_lanes_never_part_nobody_is_held_up(utn17: Network) -> None:
    zone = np.full((len(utn17.groups), len(ZONES_M)), 20.0)
    share, x = utn17.group_shares(utn17.fraction), utn17.storage_veh
    nobody = np.zeros((len(utn17.links), len(ZONES_M)))
    shut, weight = held_up(zone.sum(axis=1), nobody, x, share, *rooms_veh(utn17), taken(utn17), utn17.group_link)
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
    view = replace(scene(pockets), set_zone_veh=zone, link_zone_veh=upstream, x_veh=x)
    outlook = Outlook(pockets, streams, 25, 2.0)
    _, come, weight = outlook.look(view, view.zone_veh(view.free), np.zeros(len(view.x_veh)))
    others = (streams.link == link) & (streams.group != pocket)
    assert others.any()
    assert (come[others].sum() > 0) != full
    assert (weight[pocket] > 1) == full
