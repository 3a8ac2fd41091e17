"""SUMO's own signals as peers: run as the bare `sumo` runs them, within the net's own rules."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from utn_sumo import bridge, controllers, monitor, replay, sumo_tools
from utn_sumo.contract import Network
from utn_sumo.errors import ControllerError, PlantError, SettingError, UtnError
from utn_sumo.recording import PROGRAMMES
from utn_sumo.scenario import scenario
from utn_sumo.sumo_signals import PEERS
from utn_sumo.sumo_tools import sumo_binary

from . import odd_nets

SCENARIOS = Path(__file__).parents[3] / "shared" / "scenarios"
Run = Callable[..., tuple[dict[str, Any], Path]]


def trips(path: Path) -> dict[str, dict[str, str]]:
    return {str(trip.get("id")): dict(trip.attrib) for trip in ET.parse(path).iter("tripinfo")}


def greens_s(net: Network, folder: Path) -> dict[str, list[float]]:
    """How long each stage was shown, by its letters, but for the first and the last time at each junction."""
    shown: dict[str, list[float]] = {}
    for junction in net.junctions:
        states = {net.stages[index].state for index in junction.stages}
        switches = monitor.read_switches(folder / "signals.xml")[junction.id]
        for (start, state), (end, _) in list(pairwise(switches))[1:]:
            if state in states:
                shown.setdefault(f"{junction.id} {state}", []).append(end - start)
    return shown


def cycles_s(folder: Path) -> dict[str, float]:
    return {
        logic.attrib["id"]: sum(float(phase.attrib["duration"]) for phase in logic.iter("phase"))
        for logic in ET.parse(folder / PROGRAMMES).iter("tlLogic")
    }


def complaint(kind: type[UtnError], folder: Path, **settings: Any) -> str:
    with pytest.raises(kind) as caught:
        bridge.run(scenario(**settings), folder / "refused")
    line = str(caught.value)
    assert "\n" not in line
    assert not (folder / "refused").exists()
    return line


def test_they_are_registered_with_their_settings() -> None:
    points = controllers.registered()
    assert {name: points[name].load() for name in PEERS} == PEERS
    assert "max_gap_s" in controllers.settings_of(PEERS["actuated"])


@pytest.mark.long
@pytest.mark.parametrize("controller", PEERS)
def test_trips_are_those_of_the_bare_sumo_with_the_same_additional_file(
    town: Path, tmp_path: Path, controller: str
) -> None:
    result = bridge.run(scenario(net=str(town), controller=controller, seed=9), tmp_path / "run")
    arguments = ["-c", town, "--seed", "9", "--tripinfo-output", tmp_path / "bare.xml", "--no-step-log"]
    arguments += ["--additional-files", tmp_path / "run" / PROGRAMMES]
    arguments += ["--tripinfo-output.write-unfinished", "--tripinfo-output.write-undeparted"]
    subprocess.run([sumo_binary("sumo"), *arguments], check=True, capture_output=True)
    bare = trips(tmp_path / "bare.xml")
    assert len(bare) > 300
    assert trips(tmp_path / "run" / "trips.xml") == bare
    assert (result["controller"], result["unsafe_signal_s"], result["fallbacks"]) == (controller, 0, 0)
    assert (result["left_alone"], result["hours"]) == ({}, 0.25)


@pytest.mark.parametrize("controller", PEERS)
def test_a_shipped_net_runs_safely_and_is_measured_as_under_any_controller(run_of: Run, controller: str) -> None:
    result, _ = run_of(controller=controller, hours=0.5, demand=0.4)
    fixed, _ = run_of(controller="fixed", hours=0.5, demand=0.4)
    assert set(result) == set(fixed)
    assert (result["unsafe_signal_s"], result["unsafe_reasons"], result["teleports"]) == (0, [], 0)
    assert result["arrived"] + result["unfinished"] == fixed["arrived"] + fixed["unfinished"]


@pytest.mark.parametrize("controller", ["actuated", "delay_based"])
def test_light_traffic_has_short_greens_but_none_under_its_least(utn17: Network, run_of: Run, controller: str) -> None:
    light, folder = run_of(controller=controller, hours=0.5, demand=0.4)
    fixed, _ = run_of(controller="fixed", hours=0.5, demand=0.4)
    found = greens_s(utn17, folder)
    every = np.concatenate(list(found.values()))
    assert len(found) == 17
    assert every.min() == 5
    assert every.max() <= 50
    assert every.mean() < 0.5 * utn17.equal_split().green_s.mean()
    assert light["mean_delay_s"] < 0.8 * fixed["mean_delay_s"]


@pytest.mark.parametrize(
    ("controller", "changed", "longer"),
    [
        ("actuated", {"max_gap_s": 6}, True),
        ("actuated", {"detector_gap_s": 1}, True),
        ("actuated", {"min_green_s": 12}, True),
        ("delay_based", {"detector_range_m": 30}, True),
        ("delay_based", {"min_time_loss_s": 20}, False),
    ],
)
def test_their_settings_reach_sumo(
    utn17: Network, run_of: Run, controller: str, changed: dict[str, float], longer: bool
) -> None:
    _, usual = run_of(controller=controller, hours=0.5, demand=0.4)
    result, folder = run_of(controller=controller, hours=0.5, demand=0.4, settings=changed)
    before_s, after_s = (np.concatenate(list(greens_s(utn17, each).values())).mean() for each in (usual, folder))
    assert after_s > before_s if longer else after_s < before_s
    assert result["unsafe_signal_s"] == 0


@pytest.mark.parametrize("controller", ["actuated", "delay_based"])
def test_greens_whose_least_is_over_their_most_are_refused(controller: str, tmp_path: Path) -> None:
    bounds = {"min_green_s": 30, "max_green_s": 20}
    line = complaint(SettingError, tmp_path, controller=controller, settings=bounds)
    assert "min_green_s is 30, over max_green_s 20: make it less" in line


def test_no_green_is_over_its_most(utn17: Network, run_of: Run) -> None:
    _, folder = run_of(controller="actuated", hours=0.5, demand=1.3, settings={"max_green_s": 20})
    assert max(map(max, greens_s(utn17, folder).values())) == 20


def test_least_greens_and_clearances_that_the_net_names_are_kept(town: Path, tmp_path: Path) -> None:
    phases = (
        '<phase duration="30" minDur="14" state="GGGrrr"/><phase duration="4" state="yyyrrr"/>'
        '<phase duration="1" state="rrrrrr"/><phase duration="30" state="rrrGGG"/><phase duration="5" state="rrryyy"/>'
    )
    added = f'<additional><tlLogic id="J2" programID="b" type="static" offset="0">{phases}</tlLogic></additional>'
    town.with_name("own.add.xml").write_text(added, encoding="utf-8")
    text = town.read_text(encoding="utf-8").replace("</input>", '<additional-files value="own.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")
    result = bridge.run(scenario(net=str(town), controller="actuated", demand=0.3), tmp_path / "run")
    switches = monitor.read_switches(tmp_path / "run" / "signals.xml")["J2"]
    lasts_s: dict[str, set[float]] = {}
    for (start, state), (end, _) in list(pairwise(switches))[1:]:
        lasts_s.setdefault(state, set()).add(end - start)
    assert result["unsafe_signal_s"] == 0
    assert (min(lasts_s["GGGrrr"]), min(lasts_s["rrrGGG"])) == (14, 5)
    assert lasts_s["yyyrrr"] == {4}
    assert lasts_s["rrryyy"] == {5}


def test_webster_gives_busy_junctions_longer_cycles_within_its_bounds(run_of: Run) -> None:
    (_, light), (_, heavy) = (run_of(controller="webster", hours=0.5, demand=demand) for demand in (0.4, 1.3))
    assert all(49 <= cycle_s <= 123 for cycle_s in [*cycles_s(light).values(), *cycles_s(heavy).values()])
    assert sum(cycles_s(heavy).values()) > sum(cycles_s(light).values()) + 40
    _, bounded = run_of(controller="webster", hours=0.5, demand=0.4, settings={"min_cycle_s": 90})
    assert min(cycles_s(bounded).values()) >= 85


def test_the_bounds_of_webster_s_cycles_hold_where_cars_go_on_while_who_walks_is_cleared(tmp_path: Path) -> None:
    file = odd_nets.pedestrians(tmp_path)
    for least_s, most_s in ((50, 120), (90, 120)):
        folder, bounds = tmp_path / str(least_s), {"min_cycle_s": least_s, "max_cycle_s": most_s}
        result = bridge.run(scenario(net=str(file), controller="webster", settings=bounds), folder)
        assert result["unsafe_signal_s"] == 0
        assert min(cycles_s(folder).values()) >= least_s - 5


@pytest.mark.parametrize("controller", ["actuated", "delay_based"])
def test_a_least_green_that_the_net_names_is_kept_though_its_programme_shows_less(
    controller: str, tmp_path: Path
) -> None:
    file = odd_nets.case(tmp_path, odd_nets.traffic("C", period=60))
    net = odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    logic = odd_nets.tl_logic("C", odd_nets.TWO_STAGES)
    for phase in logic:
        if "G" in phase.attrib["state"]:
            phase.attrib.update(duration="6", minDur="11")
    odd_nets.retime(net, logic)
    result = bridge.run(scenario(net=str(file), controller=controller), tmp_path / "run")
    assert result["unsafe_signal_s"] == 0
    switches = list(pairwise(monitor.read_switches(tmp_path / "run" / "signals.xml")["C"]))[1:]
    assert min(end - start for (start, state), (end, _) in switches if "G" in state) == 11


def test_coordinated_junctions_have_one_cycle_and_offsets_of_their_own(run_of: Run) -> None:
    _, folder = run_of(controller="webster+offsets", hours=0.5, demand=0.4)
    assert len(set(cycles_s(folder).values())) == 1
    offsets = {logic.attrib["offset"] for logic in ET.parse(folder / PROGRAMMES).iter("tlLogic")}
    assert len(offsets) > 4


def test_webster_takes_trips_without_routes_and_scales_them(town: Path, tmp_path: Path) -> None:
    tree = ET.parse(town.with_name("town.rou.xml"))
    for vehicle in tree.getroot().iter("vehicle"):
        (route,) = vehicle.findall("route")
        edges = route.attrib["edges"].split()
        vehicle.remove(route)
        vehicle.tag = "trip"
        vehicle.attrib.update({"from": edges[0], "to": edges[-1]})
    tree.write(town.with_name("town.rou.xml"))
    results = [
        bridge.run(scenario(net=str(town), controller="webster", demand=demand), tmp_path / str(demand))
        for demand in (0.5, 1.5)
    ]
    assert [result["unsafe_signal_s"] for result in results] == [0, 0]
    assert sum(cycles_s(tmp_path / "0.5").values()) < sum(cycles_s(tmp_path / "1.5").values())


def test_a_signal_that_nobody_passes_keeps_its_programme_under_webster(town: Path, tmp_path: Path) -> None:
    tree = ET.parse(town.with_name("town.rou.xml"))
    root = tree.getroot()
    first = next(iter(root.iter("vehicle")))[0].attrib["edges"]
    for vehicle in list(root.iter("vehicle")):
        if vehicle[0].attrib["edges"] != first:
            root.remove(vehicle)
    tree.write(town.with_name("town.rou.xml"))
    result = bridge.run(scenario(net=str(town), controller="webster"), tmp_path / "run")
    assert result["left_alone"]
    assert all("nobody passes it" in reason for reason in result["left_alone"].values())
    assert not set(result["left_alone"]) & set(cycles_s(tmp_path / "run"))
    assert result["unsafe_signal_s"] == 0


@pytest.mark.parametrize("controller", ["actuated", "webster"])
def test_their_runs_of_a_shipped_net_are_replayed(tmp_path: Path, controller: str) -> None:
    bridge.run(scenario(controller=controller, hours=0.25, demand=0.6), tmp_path / "run")
    configuration = replay.write(tmp_path / "run")
    subprocess.run([sumo_binary("sumo"), "-c", configuration], check=True, capture_output=True)
    assert trips(configuration.with_name("trips.xml")) == trips(tmp_path / "run" / "trips.xml")


def test_what_is_wrong_is_said_in_one_line_before_a_folder_is_made(town: Path, tmp_path: Path) -> None:
    assert "did you mean 'max_gap_s'?" in complaint(
        SettingError, tmp_path, controller="actuated", settings={"max_gap": 3}
    )
    assert "'max_green_s' is 0" in complaint(
        SettingError, tmp_path, controller="delay_based", settings={"max_green_s": 0}
    )
    assert "min_cycle_s is 130, over max_cycle_s 120: make it less" in complaint(
        SettingError, tmp_path, controller="webster", settings={"min_cycle_s": 130}
    )
    assert "did you mean 'webster+offsets'?" in complaint(ControllerError, tmp_path, controller="webster+offset")
    assert "no vehicles" in complaint(PlantError, tmp_path, controller="webster", demand=0)


def test_without_sumo_s_tools_or_with_a_tool_that_breaks_off_there_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sumo_tools, "_homes", lambda: iter(()))
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("SUMO_HOME", raising=False)
    line = complaint(PlantError, tmp_path, controller="webster", hours=0.1)
    assert "isn't installed: run pip install 'utn-sumo[sumo]'" in line
    with pytest.raises(PlantError, match=r"'tlsCoordinator.py' isn't installed: run pip install"):
        sumo_tools.run_tool("tlsCoordinator.py", [])
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools" / "bad.py").write_text("print(1)\nraise IndexError('too\\nshort')\n", encoding="utf-8")
    monkeypatch.setenv("SUMO_HOME", str(tmp_path))
    with pytest.raises(PlantError, match=r"SUMO's bad.py broke off \(.*short\): .*use another controller") as caught:
        sumo_tools.run_tool("bad.py", [])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "controller", "delay_s", "spread_s"),
    [("cologne8", "actuated", 42.5, 6.0), ("ingolstadt7", "actuated", 33.3, 1.5), ("cologne8", "delay_based", 60, 8)],
)
def test_published_delays_of_sumo_s_own_signals_are_found_again(
    name: str, controller: str, delay_s: float, spread_s: float, tmp_path: Path
) -> None:
    file = SCENARIOS / name / f"{name}.sumocfg"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    result = bridge.run(scenario(net=str(file), controller=controller), tmp_path / "run")
    assert result["mean_delay_s"] == pytest.approx(delay_s, abs=spread_s)
    assert result["unsafe_signal_s"] == 0
