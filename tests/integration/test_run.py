"""Whole runs through the bridge: what they return, what they leave on disk, and what they survive."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from utn_sumo import bridge, replay
from utn_sumo.bridge import Progress
from utn_sumo.contract import Network
from utn_sumo.scenario import scenario
from utn_sumo.sumo_tools import sumo_binary

RunOf = Callable[..., tuple[dict[str, Any], Path]]

CYCLES = 9
HOURS = CYCLES * 120 / 3600
MEASURES = [
    *("controller", "net", "demand", "seed", "hours", "total_time_spent_veh_h", "total_delay_veh_h"),
    *("mean_travel_time_s", "mean_delay_s", "arrived", "unfinished", "max_queue_veh", "max_vehicles_veh"),
    *("over_storage_veh", "stops", "teleports", "unsafe_signal_s", "fallbacks"),
    *("sumo_time_s", "control_time_s", "access_time_s", "bridge_time_s"),
]
FILES = {"settings.json", "cycles.jsonl", "result.json", "trips.xml", "signals.xml", "routes.rou.xml", "net.net.xml"}


def records(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "cycles.jsonl").read_text(encoding="utf-8").splitlines()]


def reproducible(result: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in result.items() if not key.endswith("_time_s") and key != "out"}


@pytest.fixture(params=["dmpc", "fixed"])
def run(request: pytest.FixtureRequest, run_of: RunOf) -> tuple[dict[str, Any], Path]:
    return run_of(controller=request.param, hours=HOURS)


def test_a_run_returns_every_measure_of_the_spec(run: tuple[dict[str, Any], Path]) -> None:
    result, _ = run
    assert set(MEASURES) <= set(result)
    numbers = [result[name] for name in MEASURES[2:]]
    assert all(np.isfinite(number) and number >= 0 for number in numbers)
    assert result["hours"] == HOURS
    assert result["arrived"] > 0
    assert 0 < result["total_delay_veh_h"] < result["total_time_spent_veh_h"]
    assert 0 < result["max_queue_veh"] <= result["max_vehicles_veh"]
    assert not result["interrupted"]


def test_a_run_shows_no_unsafe_signal_and_needs_no_fallback(run: tuple[dict[str, Any], Path]) -> None:
    result, _ = run
    assert result["unsafe_signal_s"] == 0, result["unsafe_reasons"]
    assert result["fallbacks"] == 0, result["fallback_reasons"]
    assert result["teleports"] == 0


def test_a_run_leaves_its_settings_a_line_per_cycle_and_its_result(run: tuple[dict[str, Any], Path]) -> None:
    result, folder = run
    assert {path.name for path in folder.iterdir()} >= FILES
    settings = json.loads((folder / "settings.json").read_text(encoding="utf-8"))
    assert settings["scenario"]["controller"] == result["controller"]
    assert {"utn_sumo", "sumo", "casadi"} <= set(settings["versions"])
    cycles = records(folder)
    assert [cycle["cycle"] for cycle in cycles] == list(range(CYCLES))
    assert all(set(cycle) == {"cycle", "state", "forecast", "decision", "seen", "truth"} for cycle in cycles)
    on_disk = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert on_disk == {key: round(value, 6) if isinstance(value, float) else value for key, value in result.items()}


def test_every_vehicle_of_the_route_file_is_in_the_result(run: tuple[dict[str, Any], Path]) -> None:
    result, folder = run
    wanted = sum(1 for _ in ET.parse(folder / "routes.rou.xml").iter("vehicle"))
    assert result["arrived"] + result["unfinished"] == wanted


def test_time_spent_is_what_bare_sumo_sums_up_second_by_second(tmp_path: Path) -> None:
    result = bridge.run(scenario(hours=HOURS), tmp_path / "run")
    summary = tmp_path / "summary.xml"
    configuration = replay.write(tmp_path / "run")
    command = [str(sumo_binary("sumo")), "-c", str(configuration), "--summary-output", str(summary)]
    subprocess.run(command, check=True, capture_output=True)
    steps = ET.parse(summary).iter("step")
    spent_veh_s = sum(int(str(step.get("running"))) + int(str(step.get("waiting"))) for step in steps)
    assert result["total_time_spent_veh_h"] == pytest.approx(spent_veh_s / 3600, rel=0.01)


def test_a_run_repeats_itself(run: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    result, folder = run
    again = bridge.run(scenario(controller=result["controller"], hours=HOURS), tmp_path)
    assert reproducible(again) == reproducible(result)
    decided = [[cycle["decision"]["plan"]["green_s"] for cycle in records(where)] for where in (folder, tmp_path)]
    assert decided[0] == decided[1]


def test_the_long_network_runs(tmp_path: Path) -> None:
    result = bridge.run(scenario(net="utn17-long", hours=0.2), tmp_path)
    assert result["fallbacks"] == result["unsafe_signal_s"] == 0
    assert len(records(tmp_path)) == 6
    assert result["arrived"] + result["unfinished"] > 500


OWN = """
import numpy as np
from utn_sumo.contract import Plan

class Own:
    horizon = 2

    def __init__(self, network, lead_s=0):
        self.network = network
        self.lead_s = lead_s

    def plan(self, state, forecast):
        green_s = self.network.equal_split().green_s
        {body}
"""


@pytest.fixture
def own(tmp_path: Path) -> Callable[[str], str]:
    """Writes a user's controller whose `plan` has this body, and returns its name."""

    def write(body: str) -> str:
        path = tmp_path / "own.py"
        path.write_text(OWN.format(body=body.strip().replace("\n", "\n        ")), encoding="utf-8")
        return f"{path}:Own"

    return write


def test_a_users_own_controller_runs_with_its_settings(
    own: Callable[[str], str], utn17: Network, tmp_path: Path
) -> None:
    name = own("""
assert forecast.demand_veh.shape == (2, 17)
for junction in self.network.junctions:
    green_s[list(junction.stages[:2])] += [self.lead_s, -self.lead_s]
return Plan(green_s)
""")
    result = bridge.run(scenario(controller=name, settings={"lead_s": 5}, hours=0.1), tmp_path / "run")
    assert result["fallbacks"] == 0, result["fallback_reasons"]
    expected = utn17.equal_split().green_s
    for junction in utn17.junctions:
        expected[list(junction.stages[:2])] += [5, -5]
    for cycle in records(tmp_path / "run"):
        np.testing.assert_array_equal(cycle["decision"]["plan"]["green_s"], expected)


GARBAGE = {
    "raises": 'raise RuntimeError("no idea")',
    "nothing": "return None",
    "text": 'return Plan("long")',
    "NaN": "return Plan(green_s * np.nan)",
    "infinite": "return Plan(green_s * np.inf)",
    "negative": "return Plan(-green_s)",
    "all green to one": "green_s[:3] = [105, 0, 0]\nreturn Plan(green_s)",
    "over the cycle": "return Plan(2 * green_s)",
    "too few": "return Plan(green_s[1:])",
    "a matrix": "return Plan(np.stack([green_s, green_s]))",
}


@pytest.mark.parametrize("body", GARBAGE.values(), ids=GARBAGE.keys())
def test_a_controller_that_fails_is_carried_by_the_backup_plan(
    own: Callable[[str], str], utn17: Network, tmp_path: Path, body: str
) -> None:
    result = bridge.run(scenario(controller=own(body), hours=0.1), tmp_path / "run")
    assert result["fallbacks"] == 3
    assert len(result["fallback_reasons"]) == 3
    assert result["unsafe_signal_s"] == 0
    for reason, cycle in zip(result["fallback_reasons"], records(tmp_path / "run"), strict=True):
        assert cycle["decision"]["rung"] == "backup"
        assert cycle["decision"]["reason"] in reason
        assert len(cycle["decision"]["reason"]) > 5
        np.testing.assert_array_equal(cycle["decision"]["plan"]["green_s"], utn17.equal_split().green_s)
    if "raise" in body:
        assert "RuntimeError: no idea" in result["fallback_reasons"][0]


UNFIT = {
    "a foresight that is none": "return Plan(green_s, ahead_s=5)",
    "facts that JSON lacks": "return Plan(green_s, facts={'solver': object()})",
    "facts that are no numbers": "return Plan(green_s, facts={'cost': float('nan')})",
}


@pytest.mark.parametrize("body", UNFIT.values(), ids=UNFIT.keys())
def test_what_a_controller_adds_to_its_plan_can_not_bring_the_run_down(
    own: Callable[[str], str], tmp_path: Path, body: str
) -> None:
    def refuse(word: str) -> None:
        pytest.fail(f"{word} is no JSON")

    result = bridge.run(scenario(controller=own(body), hours=0.1), tmp_path / "run")
    assert result["unsafe_signal_s"] == 0
    lines = (tmp_path / "run" / "cycles.jsonl").read_text(encoding="utf-8").splitlines()
    assert len([json.loads(line, parse_constant=refuse) for line in lines]) == 3


def test_a_controller_that_fails_later_is_followed_by_what_it_foresaw(
    own: Callable[[str], str], utn17: Network, tmp_path: Path
) -> None:
    name = own("""
if state.cycle > 0:
    raise TimeoutError("too slow")
ahead_s = green_s.copy()
ahead_s[3:5] += [7, -7]
return Plan(green_s, ahead_s=np.stack([ahead_s]))
""")
    result = bridge.run(scenario(controller=name, hours=0.1), tmp_path / "run")
    assert [cycle["decision"]["rung"] for cycle in records(tmp_path / "run")] == ["solved", "shifted", "backup"]
    assert result["fallbacks"] == 2
    assert all("too slow" in reason for reason in result["fallback_reasons"])
    shifted = records(tmp_path / "run")[1]["decision"]["plan"]["green_s"]
    np.testing.assert_array_equal(np.array(shifted) - utn17.equal_split().green_s, [0] * 3 + [7, -7] + [0] * 12)


@pytest.mark.parametrize("cycles", [1, 3])
def test_a_stopped_run_leaves_a_readable_result_of_what_was_run(tmp_path: Path, cycles: int) -> None:
    def stop(progress: Progress) -> None:
        if progress.time_s >= 120 * cycles:
            raise KeyboardInterrupt

    result = bridge.run(scenario(hours=HOURS), tmp_path, stop)
    assert result["interrupted"] is True
    assert result["hours"] == pytest.approx(120 * cycles / 3600)
    assert len(records(tmp_path)) == cycles
    assert json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))["interrupted"] is True
    vehicles = ET.parse(tmp_path / "routes.rou.xml").iter("vehicle")
    due = sum(float(str(vehicle.get("depart"))) <= 120 * cycles for vehicle in vehicles)
    assert result["arrived"] + result["unfinished"] == pytest.approx(due, abs=8)


def test_a_run_stopped_before_its_first_second_leaves_a_readable_result(
    own: Callable[[str], str], tmp_path: Path
) -> None:
    result = bridge.run(scenario(controller=own("raise KeyboardInterrupt"), hours=0.1), tmp_path / "run")
    assert result["interrupted"] is True
    assert result["hours"] == result["arrived"] == 0
    assert json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))["interrupted"] is True
