"""The shipped networks are SPEC 1's, and a net that can't be used is refused in one line."""

from __future__ import annotations

import dataclasses
import gzip
import shutil
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest

import utn_network
from utn_sumo import network, signals
from utn_sumo.contract import EXIT, Network
from utn_sumo.errors import NetworkError

# SPEC 1's table: link -> (origin, junction that it enters, turns).
TABLE: dict[str, tuple[str, str, dict[str, float]]] = {
    "1": ("source", "J1", {"10": 0.70, "W1": 0.30}),
    "2": ("J2", "J1", {"W1": 0.40, "10": 0.40, "N1": 0.20}),
    "3": ("source", "J1", {"10": 0.80, "N1": 0.20}),
    "4": ("J3", "J2", {"2": 0.60, "N2": 0.40}),
    "5": ("J6", "J2", {"N2": 0.50, "2": 0.50}),
    "6": ("source", "J3", {"4": 0.70, "N3": 0.30}),
    "7": ("J7", "J3", {"N3": 0.50, "4": 0.50}),
    "8": ("source", "J4", {"11": 0.70, "N4": 0.30}),
    "9": ("source", "J4", {"N4": 0.50, "11": 0.50}),
    "10": ("J1", "J5", {"12": 0.50, "S5": 0.50}),
    "11": ("J4", "J5", {"12": 0.60, "S5": 0.40}),
    "12": ("J5", "J6", {"14": 0.50, "5": 0.50}),
    "13": ("J8", "J6", {"5": 0.60, "14": 0.40}),
    "14": ("J6", "J7", {"E7": 0.60, "7": 0.40}),
    "15": ("source", "J7", {"7": 0.60, "E7": 0.40}),
    "16": ("source", "J8", {"13": 0.70, "E8": 0.30}),
    "17": ("source", "J8", {"E8": 0.50, "13": 0.50}),
}
CIRCUITS = (("5", "2", "10", "12", "5"), ("7", "4", "2", "10", "12", "14", "7"))


@pytest.fixture(params=["utn17", "utn17-long"])
def net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network) -> Network:
    return utn17 if request.param == "utn17" else utn17_long


def turns_by_link(net: Network) -> dict[str, dict[str, float]]:
    turns: dict[str, dict[str, float]] = {link.id: {} for link in net.links}
    for turn in net.turns:
        turns[net.links[turn.link].id][turn.to_edge] = turn.fraction
    return turns


def test_links_and_junctions_are_those_of_the_table(net: Network) -> None:
    assert [junction.id for junction in net.junctions] == [f"J{number}" for number in range(1, 9)]
    assert {link.id: net.junctions[link.junction].id for link in net.links} == {
        link: junction for link, (_, junction, _) in TABLE.items()
    }


def test_turning_fractions_are_those_of_the_table(net: Network) -> None:
    found = turns_by_link(net)
    assert {link: set(turns) for link, turns in found.items()} == {link: set(row[2]) for link, row in TABLE.items()}
    for link, (_, _, turns) in TABLE.items():
        assert found[link] == pytest.approx(turns)


def test_traffic_from_outside_enters_at_the_eight_sources_alone(net: Network) -> None:
    assert {link.id for link in net.links if link.is_source} == {"1", "3", "6", "8", "9", "15", "16", "17"}


def test_traffic_leaves_by_the_eight_exits_alone(net: Network) -> None:
    exits = {turn.to_edge for turn in net.turns if turn.next_link == EXIT}
    assert exits == {"W1", "N1", "N2", "N3", "N4", "S5", "E7", "E8"}
    assert all(net.links[turn.next_link].id == turn.to_edge for turn in net.turns if turn.next_link != EXIT)


def test_every_inner_link_is_fed_by_links_that_enter_its_origin(net: Network) -> None:
    for link, (origin, _, _) in TABLE.items():
        feeders = {net.links[turn.link].id for turn in net.turns if turn.to_edge == link}
        expected = {other for other, (_, junction, turns) in TABLE.items() if junction == origin and link in turns}
        assert feeders == expected
        assert bool(feeders) == (origin != "source")


def test_there_are_nine_interactions_between_neighbours_and_two_circuits(net: Network) -> None:
    assert sum(not link.is_source for link in net.links) == 9
    turns = turns_by_link(net)
    assert all(after in turns[before] for circuit in CIRCUITS for before, after in pairwise(circuit))


def test_every_incoming_link_has_one_stage_of_its_own(net: Network) -> None:
    assert [len(junction.stages) for junction in net.junctions] == [3, 2, 2, 2, 2, 2, 2, 2]
    served = [{net.turns[turn].link for turn in stage.turns} for stage in net.stages]
    assert sorted(link for links in served for link in links) == list(range(17))
    assert all(len(links) == 1 for links in served)
    assert net.serves.sum(axis=0).tolist() == [1] * len(net.turns)


def test_every_stage_is_cleared_by_three_seconds_of_yellow_and_two_of_red(net: Network) -> None:
    for stage in net.stages:
        yellow = "".join("y" if letter in "Gg" else "r" for letter in stage.state)
        assert stage.clearance == ((yellow, 3.0), ("r" * len(yellow), 2.0))
        assert stage.clearance_s == 5


def test_cycles_last_two_minutes_and_leave_what_the_clearances_do_not_take(net: Network) -> None:
    assert net.cycle_s.tolist() == [120] * 8
    assert net.green_budget_s.tolist() == [105] + [110] * 7
    assert net.min_green_s.tolist() == [10] * 17
    assert net.control_step_s == 120


def test_no_stage_opens_two_conflicting_streams(net: Network) -> None:
    for stage in net.stages:
        conflicts = np.array(net.junctions[stage.junction].conflicts)
        green = [signal for signal, letter in enumerate(stage.state) if letter in "Gg"]
        assert not conflicts[np.ix_(green, green)].any()


def test_conflicts_are_mutual_and_nobody_conflicts_with_itself(net: Network) -> None:
    for junction in net.junctions:
        conflicts = np.array(junction.conflicts)
        assert conflicts.shape == (len(junction.signal_turns),) * 2
        assert (conflicts == conflicts.T).all()
        assert not conflicts.diagonal().any()


def test_any_two_links_of_a_junction_have_streams_that_cross(net: Network) -> None:
    for position, junction in enumerate(net.junctions):
        signal_link = np.array([net.turns[turn].link for (turn,) in junction.signal_turns])
        conflicts = np.array(junction.conflicts)
        for a, b in combinations(np.flatnonzero(net.link_junction == position), 2):
            assert conflicts[np.ix_(signal_link == a, signal_link == b)].any()


def test_links_of_utn17_hold_about_106_vehicles(utn17: Network) -> None:
    assert all(379 <= link.length_m <= 396 for link in utn17.links)
    assert utn17.storage_veh == pytest.approx(106, rel=0.05)


def test_links_of_utn17_long_hold_about_1000_vehicles(utn17_long: Network) -> None:
    assert utn17_long.storage_veh == pytest.approx(1000, rel=0.01)
    assert utn17_long.free_time_s == pytest.approx(337, rel=0.01)


def test_links_have_two_lanes_and_a_free_speed_of_40_km_h(net: Network) -> None:
    assert {link.lanes for link in net.links} == {2}
    assert all(link.free_speed_m_s == pytest.approx(40 / 3.6, abs=0.01) for link in net.links)


@pytest.mark.parametrize("junction", range(8))
def test_a_part_keeps_its_links_turns_and_stages_together(net: Network, junction: int) -> None:
    part, whole = net.part(junction), net.junctions[junction]
    own = [link.id for link in net.links if link.junction == junction]
    assert [link.id for link in part.links] == own
    assert turns_by_link(part) == {link: turns_by_link(net)[link] for link in own}
    assert part.junctions[0].id == whole.id
    assert part.green_budget_s.tolist() == [net.green_budget_s[junction]]
    for inside, outside in zip(part.stages, whole.stages, strict=True):
        assert inside.state == net.stages[outside].state
        assert inside.clearance == net.stages[outside].clearance
        assert names_of_turns(part, inside.turns) == names_of_turns(net, net.stages[outside].turns)
    assert names_of_turns(part, sum(part.junctions[0].signal_turns, ())) == names_of_turns(
        net, sum(whole.signal_turns, ())
    )
    assert part.turn_next.tolist() == [EXIT] * len(part.turns)


def names_of_turns(net: Network, turns: tuple[int, ...]) -> list[tuple[str, str]]:
    return [(net.links[net.turns[turn].link].id, net.turns[turn].to_edge) for turn in turns]


def test_the_backup_plan_shares_each_cycle_equally_in_whole_seconds(net: Network) -> None:
    assert net.equal_split().green_s.tolist() == [35] * 3 + [55] * 14


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """A copy of utn17's net without its turning fractions."""
    return Path(shutil.copyfile(utn_network.net_file("utn17"), tmp_path / "town.net.xml"))


def test_a_net_of_the_users_own_is_read_like_a_shipped_one(town: Path, utn17: Network) -> None:
    shutil.copyfile(utn_network.turns_file("utn17"), town.with_name("town.turns.xml"))
    found = network.load(str(town))
    assert found.name == "town"
    assert (found.links, found.turns, found.stages) == (utn17.links, utn17.turns, utn17.stages)


def test_a_compressed_net_is_read_like_a_plain_one(town: Path, utn17: Network) -> None:
    shutil.copyfile(utn_network.turns_file("utn17"), town.with_name("town.turns.xml"))
    packed = town.with_name("town.net.xml.gz")
    packed.write_bytes(gzip.compress(town.read_bytes()))
    assert network.load(str(packed)).turns == utn17.turns


def test_without_a_turns_file_lanes_share_the_traffic(town: Path) -> None:
    turns = turns_by_link(network.load(str(town)))
    assert turns["1"] == pytest.approx({"10": 2 / 3, "W1": 1 / 3})
    assert all(sum(fractions.values()) == pytest.approx(1) for fractions in turns.values())


def one_line_of(name: str) -> str:
    with pytest.raises(NetworkError) as caught:
        network.load(name)
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_an_unknown_net_is_answered_with_the_nearest_known_one(tmp_path: Path) -> None:
    assert "did you mean 'utn17'" in one_line_of("utn71")
    assert "nowhere.net.xml" in one_line_of(str(tmp_path / "nowhere.net.xml"))
    assert str(tmp_path) in one_line_of(str(tmp_path))


@pytest.mark.parametrize("content", ["", "no XML at all", "<net><edge", '<net version="1.20"></edge>'])
def test_an_unreadable_net_is_refused_in_one_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "bad.net.xml"
    path.write_text(content, encoding="utf-8")
    assert str(path) in one_line_of(str(path))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_cut_off_net_is_refused_in_one_line(town: Path, share: float) -> None:
    content = town.read_bytes()
    town.write_bytes(content[: int(share * len(content))])
    assert str(town) in one_line_of(str(town))


def test_a_net_without_traffic_lights_or_roads_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "dark.net.xml"
    ends = "".join(f'<junction id="{end}" type="dead_end" x="0" y="{end}" incLanes="" intLanes=""/>' for end in "01")
    lane = '<lane id="road_0" index="0" speed="13" length="9" shape="0,0 0,1"/>'
    road = f'<edge id="road" from="0" to="1" priority="1">{lane}</edge>'
    for content, complaint in (
        ("", "holds no roads"),
        (road + ends, "no traffic lights"),
        ((road + ends).replace('speed="13"', 'speed="0"'), "lane 'road_0' has a speed of 0"),
    ):
        path.write_text(f'<net version="1.20">{content}</net>', encoding="utf-8")
        assert complaint in one_line_of(str(path))


def edited(town: Path, *changes: tuple[str, str]) -> Path:
    """The net with a piece of its text replaced, once each."""
    content = town.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in content
        content = content.replace(old, new, 1)
    town.write_text(content, encoding="utf-8")
    return town


def programme(net: Network, junction: str) -> str:
    """The text of a junction's programme in the shipped file."""
    text = utn_network.net_file("utn17").read_text(encoding="utf-8")
    start = text.index(f'<tlLogic id="{junction}"')
    return text[start : text.index("</tlLogic>", start)]


def test_a_programme_that_opens_with_its_clearance_has_the_same_stages_later_in_its_cycle(
    town: Path, utn17: Network
) -> None:
    text = programme(utn17, "J2")
    head, *phases = text.splitlines()
    body = [line for line in phases if "<phase" in line]
    turned = "\n".join([head.replace('offset="0"', 'offset="7"'), *body[1:], body[0], ""])
    found = network.load(str(edited(town, (text, turned))))
    junction, whole = found.junctions[1], utn17.junctions[1]
    states = [[found.stages[stage].state for stage in junction.stages], [utn17.stages[s].state for s in whole.stages]]
    # The first green is now the second stage's, 5 s of clearance after the programme's start.
    assert states[0] == states[1][::-1]
    assert junction.offset_s == 7 + 5
    assert junction.cycle_s == whole.cycle_s
    assert [found.stages[s].clearance for s in junction.stages] == [utn17.stages[s].clearance for s in whole.stages][
        ::-1
    ]


def test_a_signal_that_can_not_be_controlled_is_named_and_left_alone(town: Path, utn17: Network) -> None:
    text = programme(utn17, "J4")
    lone = text.splitlines()[0] + '\n<phase duration="90" state="GGGGGG"/>\n'
    found = network.load(str(edited(town, (text, lone))))
    assert [junction.id for junction in found.junctions] == [f"J{n}" for n in (1, 2, 3, 5, 6, 7, 8)]
    assert set(found.left_alone) == {"J4"}
    assert "one stage" in found.left_alone["J4"]
    # Its approaches are no links; what they fed is now fed from outside.
    assert not {"8", "9"} & {link.id for link in found.links}
    assert next(link for link in found.links if link.edges[-1] == "11").is_source


def test_of_two_signals_that_stop_one_road_the_one_that_stops_less_is_left_alone(town: Path, utn17: Network) -> None:
    text, content = programme(utn17, "J4"), town.read_text(encoding="utf-8")
    turn = next(line for line in content.splitlines() if 'tl="J4" linkIndex="0"' in line)
    phases = "".join(f'<phase duration="{d}" state="{s}"/>' for d, s in ((57, "Gr"), (3, "yr"), (57, "rG"), (3, "ry")))
    arrow = f'<tlLogic id="arrow" type="static" programID="0" offset="0">{phases}</tlLogic>\n'
    moved = turn.replace('tl="J4" linkIndex="0"', 'tl="arrow" linkIndex="0"')
    found = network.load(str(edited(town, (text, arrow + text), (turn, moved))))
    assert set(found.left_alone) == {"arrow"}
    assert "'J4'" in found.left_alone["arrow"]
    assert [junction.id for junction in found.junctions] == [junction.id for junction in utn17.junctions]
    assert signals.refused(found) == {}


def test_a_signal_whose_programme_has_no_phases_is_left_alone(town: Path, utn17: Network) -> None:
    text = programme(utn17, "J4")
    found = network.load(str(edited(town, (text, text.splitlines()[0] + "\n"))))
    assert "no signal programme" in found.left_alone["J4"]


def test_a_net_with_no_signal_to_control_is_refused_with_the_reasons(town: Path, utn17: Network) -> None:
    texts = [programme(utn17, junction.id) for junction in utn17.junctions]
    dull = [(text, text.splitlines()[0] + '\n<phase duration="90" state="rr"/>\n') for text in texts]
    line = one_line_of(str(edited(town, *dull)))
    assert "no signals that can be controlled" in line
    assert f"({', '.join(junction.id for junction in utn17.junctions)}: its programme has no phase" in line


@pytest.mark.parametrize("packed", [False, True])
def test_a_net_that_declares_entities_is_refused_before_they_are_read(town: Path, packed: bool) -> None:
    lol = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10}">' for n in range(1, 10))
    content = f'<?xml version="1.0"?><!DOCTYPE net [<!ENTITY l0 "lol">{lol}]><net version="1.20">&l9;</net>'
    path = town.with_name("bomb.net.xml.gz" if packed else "bomb.net.xml")
    path.write_bytes(gzip.compress(content.encode()) if packed else content.encode())
    assert "document type" in one_line_of(str(path))


@pytest.mark.parametrize(
    "relations",
    [
        '<edgeRelation from="1" to="10" probability="most"/>',
        '<edgeRelation from="1" to="10"/>',
        '<edgeRelation from="1" to="10" probability="0"/>',
        '<edgeRelation from="1" to="10" probability="nan"/>',
        '<edgeRelation from="1" to="10" probability="inf"/>',
        '<edgeRelation from="1" to="10" probability="-0.5"/><edgeRelation from="1" to="W1" probability="1.5"/>',
        "<edgeRelation",
    ],
    ids=["a word", "nothing", "zero in all", "not a number", "infinite", "negative", "cut off"],
)
def test_a_bad_turns_file_beside_a_net_is_refused_in_one_line(town: Path, relations: str) -> None:
    content = f"<data><interval>{relations}</interval></data>"
    town.with_name("town.turns.xml").write_text(content, encoding="utf-8")
    assert "turning fractions" in one_line_of(str(town))


def test_many_cycles_without_a_common_one_are_planned_for_in_steps_of_the_longest(utn17: Network) -> None:
    # Their least common multiple is below 0 in 64 bits.
    junctions = tuple(dataclasses.replace(utn17.junctions[0], cycle_s=float(cycle_s)) for cycle_s in range(75, 99, 2))
    assert dataclasses.replace(utn17, junctions=junctions).control_step_s == 97


def test_a_net_that_does_not_say_who_gives_way_to_whom_is_refused_in_one_line(town: Path) -> None:
    lines = town.read_text(encoding="utf-8").splitlines(keepends=True)
    town.write_text("".join(line for line in lines if "<request" not in line), encoding="utf-8")
    assert "no right of way of stream" in one_line_of(str(town))
