"""Schedules in SUMO: safe, nobody has to step in, and less delay than signals that end greens by gaps."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from utn_sumo import bridge, monitor
from utn_sumo.contract import Network
from utn_sumo.scenario import scenario

from . import odd_nets

Run = Callable[..., tuple[dict[str, Any], Path]]

SCENARIOS = Path(__file__).parents[3] / "shared" / "scenarios"
LIGHT = {"hours": 0.3, "demand": 0.6}
IN_CYCLE = {
    "controller": "dmpc",
    "execution": "scheduled",
    "settings": {"execution": {"bounds": "plan", "order": "cycle"}},
}


def assert_safe(result: dict[str, Any]) -> None:
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert (result["fallbacks"], result["fallback_reasons"]) == (0, [])
    assert result["longest_red_s"] <= 180


def test_recommended_is_safe_and_delays_less_than_sumo_s_own_actuated_signals(run_of: Run) -> None:
    gaps, result = (run_of(controller=each, **LIGHT)[0] for each in ("actuated", "recommended"))
    assert_safe(result)
    assert result["arrived"] > 600
    assert result["total_delay_veh_h"] < gaps["total_delay_veh_h"]


def test_recommended_is_fixed_time_under_schedules(run_of: Run) -> None:
    own, _ = run_of(controller="recommended", **LIGHT)
    named, _ = run_of(controller="fixed", execution="scheduled", **LIGHT)
    assert own["total_delay_veh_h"] == named["total_delay_veh_h"]


def test_the_result_names_the_execution_as_it_is_registered(run_of: Run) -> None:
    assert run_of(controller="recommended", **LIGHT)[0]["execution"] == "scheduled"


def test_green_no_longer_than_the_plan_s_and_in_its_order_is_safe_too(run_of: Run, utn17: Network) -> None:
    result, folder = run_of(**IN_CYCLE, **LIGHT)
    assert_safe(result)
    assert result["arrived"] > 600
    switches = monitor.read_switches(folder / "signals.xml")
    for junction in utn17.junctions:
        stages = {utn17.stages[stage].state: place for place, stage in enumerate(junction.stages)}
        places = [stages[state] for _, state in switches[junction.id] if state in stages]
        shown = [(before, after) for before, after in pairwise(places) if before != after]
        assert len(shown) > 10
        assert all(after == (before + 1) % len(stages) for before, after in shown)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_cologne_is_delayed_less_than_by_the_best_that_is_published(seed: int, tmp_path: Path) -> None:
    file = SCENARIOS / "cologne8" / "cologne8.sumocfg"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    result = bridge.run(scenario(net=str(file), controller="recommended", seed=seed), tmp_path / "run")
    assert_safe(result)
    assert result["mean_delay_s"] < 17.9


@pytest.mark.long
@pytest.mark.parametrize("make", odd_nets.CASES, ids=lambda make: make.__name__)
def test_it_runs_odd_nets_safely(make: Callable[[Path], Path], tmp_path: Path) -> None:
    result = bridge.run(scenario(net=str(make(tmp_path)), controller="recommended", seed=5), tmp_path / "run")
    assert_safe(result)
    assert result["arrived"] > 0
