"""Edges are chained into links along the main roads; who meets them amid it joins and parts; lanes fall into groups."""

from __future__ import annotations

import subprocess
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import sumolib
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.integration.odd_nets import ARM_M, NO_TURNAROUNDS, TWO_STAGES, Streets, retime, row, tl_logic
from utn_sumo import network
from utn_sumo.contract import EXIT, Link, Network
from utn_sumo.errors import NetworkError
from utn_sumo.network import MOTOR, roads
from utn_sumo.network.lanes import lane_groups
from utn_sumo.sumo_tools import sumo_binary

Make = Callable[[Path], Any]
StreetOf = Callable[[Make], Network]
NetOf = Callable[[Make], Path]


def link(net: Network, name: str) -> Link:
    return net.links[net.link_index(name)]


def fed_by(net: Network, name: str) -> set[str]:
    index = net.link_index(name)
    return {net.links[turn.link].id for turn in net.turns if turn.next_link == index}


def between_signals(*streets: tuple[str, str], nodes: Iterable[tuple[str, float, float]], **more: Any) -> Streets:
    """Two crossroads, A and B, 400 m apart, with these streets instead of the one between them."""
    drawn = row("AB", gap_m=400).without("A-B", "B-A")
    for name, x, y in nodes:
        drawn.node(name, x, y)
    for start, end in streets:
        drawn.one_way(start, end, **more)
    return drawn


def bends(folder: Path) -> Path:
    """Nodes between A and B at which nothing happens but that lanes and speeds change."""
    drawn = between_signals(("m", "n"), nodes=(("m", 100, 0), ("n", 250, 0)))
    drawn.one_way("A", "m", lanes=2)
    drawn.one_way("n", "B", lanes=3, speed=25)
    drawn.one_way("B", "A")
    return drawn.net(folder, NO_TURNAROUNDS, "--geometry.remove", "false")


def test_a_road_is_followed_through_nodes_without_signals(street_of: StreetOf) -> None:
    found = link(street_of(bends), "n-B")
    assert found.edges == ("A-m", "m-n", "n-B")
    assert (found.joining, found.parting) == ((), ())
    assert not found.is_source
    assert fed_by(street_of(bends), "n-B") == {"W-A", "nA-A", "sA-A"}


def test_a_link_adds_up_the_lengths_times_and_lanes_of_its_edges(street_of: StreetOf) -> None:
    net = street_of(bends)
    found = link(net, "n-B")
    length_m = {edge: net.edge_length_m[edge] for edge in found.edges}
    assert found.lanes == 3
    assert found.length_m == pytest.approx(sum(length_m.values()))
    slow_s = (length_m["A-m"] + length_m["m-n"]) / 13.89
    assert found.length_m / found.free_speed_m_s == pytest.approx(slow_s + length_m["n-B"] / 25)
    lane_m = 2 * length_m["A-m"] + length_m["m-n"] + 3 * length_m["n-B"]
    assert found.storage_veh == pytest.approx(lane_m / 7.5)
    # So many vehicles as it stores, standing, fill its length.
    assert found.storage_veh * found.queue_spacing_m == pytest.approx(found.length_m)


def test_side_streets_join_and_part_on_the_lanes_that_they_meet_the_road_by(street_of: StreetOf, net_of: NetOf) -> None:
    found = link(street_of(odd_nets.side_streets), "u-B")
    assert found.edges == ("A-t", "t-u", "u-B")
    via = via_lanes(net_of(odd_nets.side_streets))
    assert found.joining == tuple(sorted(via["st-t", "t-u"] + via["su-u", "u-B"]))
    assert found.parting == tuple(sorted(via["A-t", "t-st"] + via["t-u", "u-su"]))
    last_m, before_m = (street_of(odd_nets.side_streets).edge_length_m[edge] for edge in ("u-B", "t-u"))
    to_line_m = {**dict.fromkeys(via["A-t", "t-st"], last_m + before_m), **dict.fromkeys(via["t-u", "u-su"], last_m)}
    assert dict(zip(found.parting, found.parting_m, strict=True)) == pytest.approx(to_line_m)


def via_lanes(net: Path) -> dict[tuple[str, str], list[str]]:
    """Lanes inside nodes, by the edges that they connect."""
    connections: dict[tuple[str, str], list[str]] = {}
    for edge in sumolib.net.readNet(str(net)).getEdges():
        for ahead, each in edge.getOutgoing().items():
            connections[edge.getID(), ahead.getID()] = [connection.getViaLaneID() for connection in each]
    return connections


def turnaround(folder: Path) -> Path:
    """A street with a node at which vehicles may turn round, and a dead end where they have to."""
    drawn = between_signals(("A", "m"), ("m", "B"), ("B", "m"), ("m", "A"), nodes=(("m", 200, 0),))
    for start, end in (("A", "B"), ("B", "A")):
        drawn.connection(f"{start}-m", f"m-{start}")
        drawn.connection(f"{start}-m", f"m-{end}")
    return drawn.net(folder)


def test_who_turns_round_amid_a_street_parts_from_one_side_and_joins_the_other(
    street_of: StreetOf, net_of: NetOf
) -> None:
    there, back = (link(street_of(turnaround), name) for name in ("m-B", "m-A"))
    via = via_lanes(net_of(turnaround))
    assert there.parting == back.joining == tuple(via["A-m", "m-A"])
    assert back.parting == there.joining == tuple(via["B-m", "m-B"])


def test_a_road_is_not_followed_round_a_dead_end(street_of: StreetOf) -> None:
    net = street_of(turnaround)
    assert link(net, "W-A").edges == ("W-A",)
    assert link(net, "W-A").is_source
    assert not link(net, "W-A").begins_amid
    assert (link(net, "W-A").joining, link(net, "W-A").parting) == ((), ())


def test_a_roundabout_is_the_end_of_the_roads_that_lead_out_of_it(street_of: StreetOf) -> None:
    net = street_of(odd_nets.roundabout)
    assert [link(net, name).edges for name in ("rw-A", "re-B")] == [("rw-A",), ("re-B",)]
    assert all(link(net, name).is_source for name in ("rw-A", "re-B"))
    assert {each.id for each in net.links if each.begins_amid} == {"rw-A", "re-B"}
    onto = {turn.to_edge for turn in net.turns if turn.to_edge in ("A-rw", "B-re")}
    assert onto == {"A-rw", "B-re"}
    assert all(turn.next_link == EXIT for turn in net.turns if turn.to_edge in onto)


def merging(folder: Path) -> Path:
    """Two roads of one lane become one of two lanes; the one that goes straight on is the main road."""
    drawn = between_signals(("A", "m"), ("h", "m"), ("B", "A"), nodes=(("m", 200, 0), ("h", 100, 150)))
    drawn.one_way("m", "B", lanes=2)
    return drawn.net(folder, NO_TURNAROUNDS)


def test_where_roads_merge_the_one_that_goes_straight_on_is_followed(street_of: StreetOf, net_of: NetOf) -> None:
    found = link(street_of(merging), "m-B")
    assert found.edges == ("A-m", "m-B")
    assert found.joining == tuple(sorted(via_lanes(net_of(merging))["h-m", "m-B"]))


def leaving(folder: Path) -> Path:
    """A one-way road whose main course turns aside: to B goes a ramp only."""
    drawn = between_signals(("m", "B"), ("B", "A"), nodes=(("m", 200, -60), ("h", 400, -120)))
    for start, end in (("A", "m"), ("m", "h")):
        drawn.one_way(start, end, lanes=3)
    return drawn.net(folder, NO_TURNAROUNDS)


def test_a_road_that_only_leaves_another_begins_there(street_of: StreetOf) -> None:
    found = link(street_of(leaving), "m-B")
    assert found.edges == ("m-B",)
    assert found.is_source


def uncontrolled_between(folder: Path) -> Path:
    """A signal C between A and B that can't be controlled, as it has one stage."""
    net = row("ACB").net(folder, NO_TURNAROUNDS)
    return retime(net, tl_logic("C", ((60, "GGg" * 4),)), *(tl_logic(name, TWO_STAGES) for name in "AB"))


def test_a_road_is_not_followed_through_a_signal_that_is_left_alone(street_of: StreetOf) -> None:
    net = street_of(uncontrolled_between)
    assert set(net.left_alone) == {"C"}
    for name in ("C-A", "C-B"):
        assert link(net, name).edges == (name,)
        assert link(net, name).is_source


def slip_road(folder: Path) -> Path:
    """Right turns from the north leave before the signal and come onto the street to the west behind it."""
    drawn = row("C").without("C-W", "nC-C")
    drawn.node("a", 0, 60)
    drawn.node("b", -60, 0)
    drawn.node("V", -ARM_M - 200, 0, "traffic_light")
    for arm, y in (("nV", ARM_M), ("sV", -ARM_M)):
        drawn.node(arm, -ARM_M - 200, y)
        drawn.road(arm, "V")
    for start, end in (("nC", "a"), ("a", "C"), ("C", "b"), ("b", "W"), ("W", "V")):
        drawn.one_way(start, end, priority=5)
    drawn.one_way("a", "b", priority=1)
    drawn.one_way("V", "W")
    return drawn.net(folder, NO_TURNAROUNDS)


def test_a_slip_road_parts_before_the_signal_and_joins_behind_it(street_of: StreetOf, net_of: NetOf) -> None:
    net, via = street_of(slip_road), via_lanes(net_of(slip_road))
    assert link(net, "a-C").edges == ("nC-a", "a-C")
    assert link(net, "a-C").parting == tuple(via["nC-a", "a-b"])
    assert link(net, "W-V").edges == ("C-b", "b-W", "W-V")
    assert link(net, "W-V").joining == tuple(via["a-b", "b-W"])
    assert fed_by(net, "W-V") == {"E-C", "sC-C", "a-C"}


def without_inner_lanes(folder: Path) -> Path:
    """T nodes, in a net whose nodes have no lanes of their own: nobody could count there."""
    made = odd_nets.side_streets(folder).with_name(odd_nets.NET)
    text = made.read_text(encoding="utf-8")
    made.write_text(text.replace(' via=":t_', ' was=":t_').replace(' via=":u_', ' was=":u_'), encoding="utf-8")
    return made


def test_where_side_streets_can_not_be_watched_a_link_begins(street_of: StreetOf) -> None:
    assert link(street_of(without_inner_lanes), "u-B").edges == ("u-B",)


def random_town(seed: int) -> Make:
    def make(folder: Path) -> None:
        file = str(folder / "random.net.xml")
        command = [str(sumo_binary("netgenerate")), "--rand", "--rand.iterations", "60", "--seed", str(seed)]
        command += ["--tls.guess", "--tls.guess.threshold", "60", "--rand.max-distance", "200", "-o", file]
        subprocess.run([*command, "--turn-lanes", "1" if seed % 2 else "0"], check=True, capture_output=True)

    return make


TOWNS = [random_town(seed) for seed in range(1, 5)]
every_town = pytest.mark.parametrize("town", TOWNS, ids=range(1, 5))


@every_town
def test_no_edge_is_in_two_links_and_a_links_edges_follow_each_other(
    town: Make, street_of: StreetOf, net_of: NetOf
) -> None:
    net, drawn = street_of(town), sumolib.net.readNet(str(net_of(town)))
    assert max(len(each.edges) for each in net.links) > 1
    assert set(Counter(edge for each in net.links for edge in each.edges).values()) == {1}
    for each in net.links:
        for before, after in pairwise(each.edges):
            assert drawn.getEdge(after) in drawn.getEdge(before).getOutgoing()
            assert drawn.getEdge(before).getToNode().getType() != "traffic_light"


@every_town
def test_who_is_counted_at_inner_nodes_is_everybody_who_does_not_go_along(
    town: Make, street_of: StreetOf, net_of: NetOf
) -> None:
    net, via = street_of(town), via_lanes(net_of(town))
    for each in net.links:
        along = set(pairwise(each.edges))
        joins = [
            lane
            for (start, end), lanes in via.items()
            if end in each.edges[1:] and (start, end) not in along
            for lane in lanes
        ]
        parts = [
            lane
            for (start, end), lanes in via.items()
            if start in each.edges[:-1] and (start, end) not in along
            for lane in lanes
        ]
        assert list(each.joining) == sorted(joins)
        assert list(each.parting) == sorted(parts)


@every_town
def test_turns_lead_onto_first_edges_or_out(town: Make, street_of: StreetOf) -> None:
    net = street_of(town)
    first = {each.edges[0]: index for index, each in enumerate(net.links)}
    amid = {edge for each in net.links for edge in each.edges[1:]}
    for turn in net.turns:
        assert turn.to_edge not in amid
        assert turn.next_link == first.get(turn.to_edge, EXIT)
    assert np.bincount(net.turn_link, net.fraction) == pytest.approx(1)


@every_town
def test_lane_groups_share_out_the_lanes_that_lead_on(town: Make, street_of: StreetOf, net_of: NetOf) -> None:
    net, drawn = street_of(town), sumolib.net.readNet(str(net_of(town)))
    assert sorted(net.group_link) == list(net.group_link)
    for index, each in enumerate(net.links):
        ahead = drawn.getEdge(each.id).getOutgoing()
        groups = [group for group in net.groups if group.link == index]
        lanes = [lane for group in groups for lane in group.lanes]
        leading = {c.getFromLane().getIndex() for cs in ahead.values() for c in cs}
        assert sorted(lanes) == sorted(leading)
        for turn in (turn for turn in net.turns if turn.link == index):
            used = {
                c.getFromLane().getIndex() for c in drawn.getEdge(each.id).getOutgoing()[drawn.getEdge(turn.to_edge)]
            }
            assert used <= set(net.groups[turn.group].lanes)
    by_link = np.bincount(net.group_link, net.group_saturation_flow_veh_s)
    assert (by_link <= net.saturation_flow_veh_s + 1e-9).all()


USED = st.dictionaries(st.sampled_from("abcdefgh"), st.sets(st.integers(0, 7), min_size=1, max_size=4), min_size=1)


def connected(used: dict[str, set[int]]) -> set[tuple[tuple[int, ...], tuple[str, ...]]]:
    """Groups by flooding: from each turn over its lanes to the turns that use these too."""
    found = set()
    for start in used:
        names = {start}
        while True:
            lanes = {lane for name in names for lane in used[name]}
            reached = {name for name, own in used.items() if own & lanes}
            if reached == names:
                break
            names = reached
        found.add((tuple(sorted(lanes)), tuple(sorted(names))))
    return found


@given(used=USED)
def test_lane_groups_are_what_lanes_and_turns_connect(used: dict[str, set[int]]) -> None:
    found = lane_groups(used.items())
    assert len(found) == len(set(found))
    assert set(found) == connected(used)
    assert found == sorted(found)
    assert sorted(name for _, names in found for name in names) == sorted(used)


def kinds_of_lanes(folder: Path) -> Path:
    """Lanes for some only, on both sides of the road."""
    drawn = row("C", lanes=2).without("W-C")
    only = {0: "bicycle", 1: "bus", 3: "pedestrian"}
    drawn.one_way("W", "C", lanes=4, only=only)
    return drawn.net(folder, NO_TURNAROUNDS)


def test_lanes_for_motors_are_those_that_any_motor_vehicle_may_use(street_of: StreetOf, net_of: NetOf) -> None:
    edge = sumolib.net.readNet(str(net_of(kinds_of_lanes))).getEdge("W-C")
    assert roads.motor_lanes(edge) == (1, 2)
    assert link(street_of(kinds_of_lanes), "W-C").lanes == 2


def test_a_link_is_as_fast_as_its_leftmost_lane_for_motors(net_of: NetOf, tmp_path: Path) -> None:
    tree = ET.parse(net_of(kinds_of_lanes))
    for number, speed_m_s in enumerate((4.0, 8.0, 10.0, 1.5)):
        tree.find(f".//lane[@id='W-C_{number}']").set("speed", f"{speed_m_s}")  # type: ignore[union-attr]
    tree.write(tmp_path / "speeds.net.xml")
    assert link(network.load(str(tmp_path / "speeds.net.xml")), "W-C").free_speed_m_s == pytest.approx(10)


@pytest.mark.parametrize("users", MOTOR)
def test_a_lane_for_one_kind_of_motor_vehicle_is_a_motor_lane(users: str) -> None:
    class Lane:
        def allows(self, kind: str) -> bool:
            return kind == users

        def getIndex(self) -> int:  # noqa: N802 - sumolib's name
            return 0

    class Edge:
        def getLanes(self) -> list[Lane]:  # noqa: N802 - sumolib's name
            return [Lane()]

    assert roads.motor_lanes(Edge()) == (0,)


def test_a_pocket_is_a_group_of_its_own_and_so_is_the_lane_beside_it(street_of: StreetOf) -> None:
    net = street_of(odd_nets.turning_pockets)
    index = net.link_index("pW-C")
    assert [group.lanes for group in net.groups if group.link == index] == [(0,), (1,)]
    group = {turn.to_edge: turn.group for turn in net.turns if turn.link == index}
    assert group["C-E"] == group["C-sC"] != group["C-nC"]
    assert net.group_saturation_flow_veh_s[list(set(group.values()))] == pytest.approx(
        net.saturation_flow_veh_s[index] / 2
    )


@pytest.mark.parametrize("length", ["long", "nan", "-1", ""])
def test_a_net_whose_lanes_inside_nodes_have_no_length_is_refused_in_one_line(length: str, tmp_path: Path) -> None:
    tree = ET.parse(file := row("C").net(tmp_path, NO_TURNAROUNDS))
    lane = next(each for each in tree.iter("lane") if each.get("id", "").startswith(":C"))
    lane.set("length", length)
    tree.write(file)
    with pytest.raises(NetworkError, match=f"lane '{lane.get('id')}' is '{length}' m long: give a .net.xml") as refused:
        network.load(str(file))
    assert "\n" not in str(refused.value)


def test_lanes_inside_a_node_that_lead_round_are_read_to_their_end(tmp_path: Path) -> None:
    tree = ET.parse(file := row("C").net(tmp_path, NO_TURNAROUNDS))
    amid = [each for each in tree.iter("connection") if each.get("from", "").startswith(":C") and each.get("via")]
    for each in amid:
        edge, lane = each.get("via", "").rsplit("_", 1)
        back = {"from": edge, "fromLane": lane, "via": f"{each.get('from')}_{each.get('fromLane')}"}
        tree.getroot().append(ET.Element("connection", {**each.attrib, **back}))
    assert amid
    tree.write(file)
    assert all(0 < turn.crossing_m < 100 for turn in network.load(str(file)).turns)
