"""What drives in other people's scenarios: counted as SUMO itself would send it."""

from __future__ import annotations

import gzip
import math
import subprocess
from collections import Counter
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo import case, routes
from utn_sumo.case import Case
from utn_sumo.contract import CAR_ACCELERATION_M_S2, Network
from utn_sumo.errors import SettingError
from utn_sumo.routes import Traffic
from utn_sumo.sumo_tools import sumo_binary

SCENARIOS = Path(__file__).parents[3] / "shared" / "scenarios"
OWN = '<route edges="a b c"/>'


def traffic(
    folder: Path,
    content: str,
    *,
    begin_s: float = 0.0,
    end_s: float | None = 100.0,
    net_file: Path = Path("no.net.xml"),
) -> Traffic:
    file = folder / "some.rou.xml"
    file.write_text(f"<routes>{content}</routes>", encoding="utf-8")
    return routes.read(Case(folder / "some.sumocfg", net_file, (file,), (), begin_s, end_s, 300.0, ()))


@pytest.fixture(scope="session")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for tests that write the same file over and over."""
    return tmp_path_factory.mktemp("routes")


@pytest.mark.parametrize(
    ("content", "turned_veh"),
    [
        (f'<vehicle id="v" depart="5">{OWN}</vehicle>', {"ab": 1, "bc": 1}),
        (f'<vehicle id="v" depart="5">{OWN}</vehicle><vehicle id="w" depart="0:00:07">{OWN}</vehicle>', {"ab": 2}),
        ('<route id="r" edges="a b"/><vehicle id="v" depart="5" route="r"/>', {"ab": 1}),
        ('<vehicle id="v" depart="5" route="r"/><route id="r" edges="a b"/>', {"ab": 1}),
        ('<vehicle id="v" depart="5"><route edges="a b" repeat="2"/></vehicle>', {"ab": 3, "ba": 2}),
        ('<vehicle id="v" depart="triggered"><route edges="a b"/></vehicle>', {"ab": 1}),
        (
            (
                '<routeDistribution id="d"><route edges="a b" probability="3"/><route edges="a c"/></routeDistribution>'
                '<flow id="f" number="8" begin="0" end="100" route="d"/>'
            ),
            {"ab": 6, "ac": 2},
        ),
        (
            (
                '<route id="p" edges="a b"/><route id="q" edges="a c"/>'
                '<routeDistribution id="d" routes="p q" probabilities="0.1 0.3"/><vehicle id="v" depart="1" route="d"/>'
            ),
            {"ab": 0.25, "ac": 0.75},
        ),
        (
            (
                '<route id="p" edges="a b"/><vehicle id="v" depart="1"><routeDistribution><route refId="p"/>'
                '<route edges="a c" probability="3"/></routeDistribution></vehicle>'
            ),
            {"ab": 0.25, "ac": 0.75},
        ),
    ],
)
def test_vehicles_are_counted_by_turn(content: str, turned_veh: dict[str, float], tmp_path: Path) -> None:
    found = traffic(tmp_path, content).turned_veh
    assert {turn: found[turn[0], turn[1]] for turn in turned_veh} == pytest.approx(turned_veh)
    assert not {"".join(turn) for turn in found} - {"ab", "bc", *turned_veh}


@pytest.mark.parametrize(
    ("flow", "vehicles"),
    [
        ('begin="0" end="100" number="40"', 40),
        ('begin="50" end="150" number="40"', 20),
        ('number="40"', 40),
        ('begin="10" period="5"', 18),
        ('begin="10" end="60" period="5"', 10),
        ('begin="10" number="4" period="5"', 4),
        ('vehsPerHour="360"', 10),
        ('perHour="360"', 10),
        ('probability="0.25"', 25),
        ('period="exp(0.25)"', 25),
        ('begin="100" number="4" end="200"', 0),
        ('begin="0" end="0" number="4"', 0),
        ('begin="0" end="1000" number="4"', 1),
        ('begin="40" period="45"', 2),
        ('vehsPerHour="0"', 0),
    ],
)
def test_flows_count_by_what_departs_within_the_window(flow: str, vehicles: float, tmp_path: Path) -> None:
    found = traffic(tmp_path, f'<flow id="f" {flow}>{OWN}</flow>')
    assert found.turned_veh.get(("a", "b"), 0) == pytest.approx(vehicles)
    assert sum(found.by_class_veh.values()) == pytest.approx(vehicles)


def test_without_any_end_a_flow_lasts_a_day_as_in_sumo(tmp_path: Path) -> None:
    found = traffic(tmp_path, f'<flow id="f" begin="100" period="100">{OWN}</flow>', end_s=None)
    assert found.turned_veh["a", "b"] == pytest.approx(864)


@given(cut_s=st.floats(0, 1000), begin_s=st.floats(0, 900), lasts_s=st.floats(0.1, 900), number=st.integers(0, 1000))
def test_windows_side_by_side_hold_what_the_whole_holds(
    scratch: Path, cut_s: float, begin_s: float, lasts_s: float, number: int
) -> None:
    content = (
        f'<flow id="f" begin="{begin_s}" end="{begin_s + lasts_s}" number="{number}">{OWN}</flow>'
        f'<flow id="g" begin="{begin_s}" end="{begin_s + lasts_s}" period="7">{OWN}</flow>'
        f'<vehicle id="v" depart="{begin_s}">{OWN}</vehicle>'
    )
    whole, before, after = (
        sum(traffic(scratch, content, begin_s=start, end_s=end).by_class_veh.values())
        for start, end in ((0.0, 2000.0), (0.0, cut_s), (cut_s, 2000.0))
    )
    assert before + after == pytest.approx(whole)
    assert whole == pytest.approx(number + math.ceil(lasts_s / 7) + 1, abs=1.001)


@pytest.mark.parametrize("content", [f'<vehicle id="v" depart="{at}">{OWN}</vehicle>' for at in (99, 200, 250)])
def test_departures_outside_the_window_weigh_nothing(content: str, tmp_path: Path) -> None:
    found = traffic(tmp_path, content, begin_s=100.0, end_s=200.0)
    assert (found.turned_veh, found.by_class_veh, found.named_by) == ({}, {}, {})
    assert (found.space_m, found.shortest_m, found.acceleration_m_s2) == (7.5, 5.0, 2.6)


def test_what_sumo_scales_is_scaled(tmp_path: Path) -> None:
    (tmp_path / "a.rou.xml").write_text(
        f'<routes><vehicle id="v" depart="1">{OWN}</vehicle></routes>', encoding="utf-8"
    )
    options = (("scale", "2.5"),)
    found = routes.read(Case(tmp_path, tmp_path, (tmp_path / "a.rou.xml",), (), 0.0, None, 300.0, options))
    assert found.turned_veh["a", "b"] == found.by_class_veh["passenger"] == 2.5


def test_those_whose_way_sumo_finds_are_counted_apart(tmp_path: Path) -> None:
    found = traffic(
        tmp_path,
        '<trip id="t" depart="1" from="a" via="b" to="c"/><flow id="f" number="9" from="a" to="d"/>'
        f'<vehicle id="v" depart="1">{OWN}</vehicle><person id="p" depart="1"/>',
    )
    assert (found.without_route_veh, found.without_ends_veh) == (10, 0)
    assert sum(found.by_class_veh.values()) == 11
    assert found.turned_veh == {("a", "b"): 1, ("b", "c"): 1}
    assert set(found.named_by) == {"a", "b", "c", "d"}
    assert found.named_by["d"].startswith("flow 'f' of ")


def test_trips_between_districts_are_told_apart(tmp_path: Path) -> None:
    found = traffic(
        tmp_path, '<flow id="f" number="9" fromTaz="a" toTaz="d"/><trip id="t" depart="1" from="a" to="b"/>'
    )
    assert (found.without_route_veh, found.without_ends_veh) == (10, 9)


def test_who_stops_on_the_way_is_sent_by_there(tmp_path: Path) -> None:
    found = traffic(
        tmp_path,
        '<busStop id="s" lane="e_x_0"/><trip id="t" depart="1" from="a" via="b" to="d">'
        '<stop lane="c_1" duration="5"/><stop lane="c_0" duration="5"/><stop busStop="s" duration="5"/></trip>'
        '<flow id="f" number="9" from="a" to="d"><stop edge="a"/><stop parkingArea="nowhere" duration="5"/></flow>',
    )
    assert found.trips_veh == {("a", "b", "c", "e_x", "d"): 1, ("a", "a", "d"): 9}


def test_a_flow_of_more_than_anybody_means_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"flow 'f' of .* vehicles a second: give fewer"):
        traffic(tmp_path, '<flow id="f" period="1e-320" end="9" from="a" to="d"/>')


def test_room_is_the_mean_of_what_drives(tmp_path: Path) -> None:
    found = traffic(
        tmp_path,
        '<vType id="long" vClass="bus" length="18"/><vType id="close" minGap="1"/>'
        '<vTypeDistribution id="mix"><vType id="m" vClass="truck" probability="0.25"/>'
        '<vType id="n" probability="0.75"/></vTypeDistribution>'
        '<vTypeDistribution id="listed" vTypes="m close" probabilities="1 1"/>'
        f'<vehicle id="1" depart="0" type="long">{OWN}</vehicle><vehicle id="2" depart="0">{OWN}</vehicle>'
        '<flow id="3" number="4" type="mix" from="a" to="b"/><flow id="4" number="2" type="listed" from="a" to="b"/>'
        f'<vehicle id="5" depart="0" type="DEFAULT_BIKETYPE">{OWN}</vehicle>',
    )
    assert found.by_class_veh == pytest.approx({"bus": 1, "passenger": 5, "truck": 2, "bicycle": 1})
    # The bicycle takes no room on the cars' lanes.
    metres = 20.5 + 7.5 + (9.6 + 3 * 7.5) + (9.6 + 6.0)
    assert found.space_m == pytest.approx(metres / 8)
    assert found.shortest_m <= 5.0


def test_queues_speed_up_as_the_slowest_at_their_head(tmp_path: Path) -> None:
    cars = f'<flow id="a" number="3" type="car">{OWN}</flow><flow id="b" number="1" type="slow">{OWN}</flow>'
    types = '<vType id="car"/><vType id="slow" accel="0.8"/><vType id="tram" vClass="tram"/>'
    found = traffic(tmp_path, types + cars + f'<vehicle id="t" depart="0" type="tram">{OWN}</vehicle>')
    of_one, of_all = 1 - 0.75**3, 0.75**3
    assert 1 / found.acceleration_m_s2 == pytest.approx(of_one / 0.8 + of_all / 2.6)
    alike = traffic(tmp_path, f'<vType id="car" accel="1.5"/><flow id="a" number="3" type="car">{OWN}</flow>')
    assert alike.acceleration_m_s2 == pytest.approx(1.5)


def test_lengths_gaps_and_accelerations_are_sumo_s_own(utn17: Network, tmp_path: Path) -> None:
    import libsumo

    assert routes.ACCELERATION_M_S2.keys() <= routes.LENGTH_AND_GAP_M.keys()
    classes = [*routes.LENGTH_AND_GAP_M, "passenger", "taxi", "hov", "evehicle", "ignoring", "custom1"]
    types = "".join(f'<vType id="{vclass}" vClass="{vclass}"/>' for vclass in classes)
    (tmp_path / "types.add.xml").write_text(f"<additional>{types}</additional>", encoding="utf-8")
    libsumo.start(["sumo", "-n", str(utn17.net_file), "-a", str(tmp_path / "types.add.xml"), "--no-warnings"])
    try:
        ask = libsumo.vehicletype
        theirs = {vclass: (ask.getLength(vclass), ask.getMinGap(vclass)) for vclass in classes}
        acceleration_m_s2 = {vclass: ask.getAccel(vclass) for vclass in classes}
        built_in = {name: ask.getVehicleClass(name) for name in ask.getIDList() if name.startswith("DEFAULT_")}
    finally:
        libsumo.close()
    assert theirs == {vclass: routes.LENGTH_AND_GAP_M.get(vclass, routes.CAR_M) for vclass in classes}
    usual = CAR_ACCELERATION_M_S2
    assert acceleration_m_s2 == {vclass: routes.ACCELERATION_M_S2.get(vclass, usual) for vclass in classes}
    assert built_in == routes.BUILT_IN


@pytest.mark.parametrize(
    "content",
    [
        """
    <route id="r" edges="1 10"/>
    <flow id="f" begin="0" period="30" route="r"/>
    <flow id="g" begin="0" end="900" number="9"><route edges="1 W1"/></flow>
    <flow id="h" begin="60" period="60" number="5"><route edges="2 10"/></flow>
    <vehicle id="v" depart="300"><route edges="2 N1"/></vehicle><vehicle id="w" depart="900" route="r"/>
    """,
        """
    <vType id="half" scale="0.5"/><vType id="double" scale="2"/>
    <flow id="f" type="half" begin="100" end="600" number="40"><route edges="1 10"/></flow>
    <flow id="g" type="double" begin="100" end="600" number="10"><route edges="2 10"/></flow>
    <vehicle id="v" type="double" depart="300"><route edges="2 N1"/></vehicle>
    """,
    ],
    ids=["each once", "types with a scale"],
)
def test_turns_are_those_of_the_vehicles_that_sumo_sends(utn17: Network, tmp_path: Path, content: str) -> None:
    found = traffic(tmp_path, content, begin_s=100.0, end_s=600.0)
    out = tmp_path / "routes.xml"
    subprocess.run(
        [
            *(sumo_binary("sumo"), "-n", utn17.net_file, "-r", tmp_path / "some.rou.xml", "-b", "100", "-e", "600"),
            *("--vehroute-output", out, "--vehroute-output.write-unfinished", "--no-warnings", "--no-step-log"),
        ],
        check=True,
        capture_output=True,
    )
    sent = Counter(turn for route in ET.parse(out).iter("route") for turn in pairwise(route.attrib["edges"].split()))
    assert found.turned_veh == pytest.approx(dict(sent))


def test_of_a_type_with_a_scale_so_many_drive(tmp_path: Path) -> None:
    """They take as much room, and are as many of their class."""
    types = '<vType id="bus" vClass="bus" scale="0.5"/><vType id="car"/>'
    mixed = '<vTypeDistribution id="some" vTypes="bus car" probabilities="0.5 0.5"/>'
    found = traffic(tmp_path, f'{types}{mixed}<flow id="f" type="some" number="8" begin="0" end="100">{OWN}</flow>')
    assert found.by_class_veh == {"bus": 2, "passenger": 4}
    assert found.turned_veh["a", "b"] == 6
    assert found.space_m == pytest.approx((2 * 14.5 + 4 * 7.5) / 6)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (f'<vehicle id="v" depart="soon">{OWN}</vehicle>', "vehicle 'v' .* has depart 'soon': give a time in seconds"),
        (f'<vehicle id="v">{OWN}</vehicle>', "vehicle 'v' .* has depart '': give a time"),
        (f'<flow id="f" number="few">{OWN}</flow>', "flow 'f' .* has number 'few': give a number from 0 on"),
        (f'<flow id="f" number="-3">{OWN}</flow>', "has number '-3': give a number from 0 on"),
        (f'<flow id="f" probability="nan">{OWN}</flow>', "has probability 'nan': give a number"),
        (f'<flow id="f" period="0">{OWN}</flow>', "has period '0': give more than 0 s"),
        (f'<flow id="f" period="exp(x)">{OWN}</flow>', r"has period 'x': give a number"),
        (f'<flow id="f" vehsPerHour="x">{OWN}</flow>', "has vehsPerHour 'x'"),
        ('<vType id="v" accel="0"/>', "vType 'v' of .* has accel 0: give it more"),
        (f'<flow id="f">{OWN}</flow>', "flow 'f' .* neither number nor period"),
        ('<vType id="t" length="long"/>', "vType 't' .* has length 'long'"),
        ('<route id="r"/>', "route 'r' .* has no edges"),
        ('<route id="r" edges="a" repeat="x"/>', "route 'r' .* has repeat 'x'"),
        ('<vehicle id="v" depart="1" route="r"/>', "vehicle 'v' .* refers to 'r'.*: define it"),
        (f'<vehicle id="v" depart="1" type="t">{OWN}</vehicle>', "vehicle 'v' .* refers to 't'.*: define it"),
        ('<routeDistribution id="d" routes="r"/>', "routeDistribution 'd' .* refers to 'r'"),
        ('<routeDistribution id="d"/>', "routeDistribution 'd' .* no probabilities above 0"),
        (
            '<route id="r" edges="a"/><routeDistribution id="d" routes="r r" probabilities="1"/>',
            "1 probabilities for 2",
        ),
    ],
)
def test_what_can_not_be_counted_is_named_in_one_line(content: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=says) as caught:
        traffic(tmp_path, content)
    assert "some.rou.xml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_may_be_compressed_and_may_include_others(tmp_path: Path) -> None:
    (tmp_path / "types.xml").write_text('<routes><vType id="t" vClass="bus"/></routes>', encoding="utf-8")
    content = f'<routes><include href="types.xml"/><vehicle id="v" type="t" depart="1">{OWN}</vehicle></routes>'
    with gzip.open(tmp_path / "some.rou.xml.gz", "wt", encoding="utf-8") as file:
        file.write(content)
    found = routes.read(
        Case(tmp_path / "a.sumocfg", tmp_path, (tmp_path / "some.rou.xml.gz",), (), 0.0, None, 300.0, ())
    )
    assert found.by_class_veh == {"bus": 1}


def test_a_file_that_includes_itself_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="includes itself"):
        traffic(tmp_path, '<include href="some.rou.xml"/>')


def test_an_edge_that_the_net_has_not_is_named_unless_sumo_is_to_ignore_it(utn17: Network, tmp_path: Path) -> None:
    file = tmp_path / "some.rou.xml"
    file.write_text('<routes><vehicle id="v" depart="1"><route edges="1 W9"/></vehicle></routes>', encoding="utf-8")
    chosen = Case(tmp_path / "a.sumocfg", utn17.net_file, (file,), (), 0.0, None, 300.0, ())
    with pytest.raises(SettingError, match=r"vehicle 'v' .*some.rou.xml.* drives on edge 'W9', which net .*utn17"):
        routes.check(chosen, routes.read(chosen))
    tolerant = Case(
        tmp_path / "a.sumocfg", utn17.net_file, (file,), (), 0.0, None, 300.0, (("ignore-route-errors", "true"),)
    )
    routes.check(tolerant, routes.read(tolerant))


def test_bologna_is_cars_and_buses_that_all_know_their_way() -> None:
    file = SCENARIOS / "bologna_acosta" / "run.sumocfg"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    found = routes.read(case.read(file))
    assert (sum(found.by_class_veh.values()), found.by_class_veh["bus"]) == (pytest.approx(8779), 157)
    assert found.without_route_veh == 0
    assert 6 < found.space_m < 7
