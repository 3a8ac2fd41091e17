"""Rules that may show any stage every few seconds: safe on every net, patient, and as good as they ought to be."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from utn_sumo import bridge, replay
from utn_sumo.errors import SettingError
from utn_sumo.scenario import scenario
from utn_sumo.sumo_tools import sumo_binary

from . import odd_nets
from .odd_nets import Make

RULES = ("max_wave", "max_pressure", "priced")


@pytest.mark.parametrize("make", odd_nets.CASES, ids=lambda make: make.__name__)
def test_it_runs_odd_nets_safely(make: Make, made: Callable[[Make], Path], tmp_path: Path) -> None:
    result = bridge.run(scenario(net=str(made(make)), controller="priced", seed=5), tmp_path / "run")
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert (result["fallbacks"], result["fallback_reasons"]) == (0, [])
    assert result["arrived"] > 0


@pytest.fixture
def hour_of(run_of: Callable[..., tuple[dict[str, Any], Path]]) -> Callable[[str, float], dict[str, Any]]:
    """Measures of an hour of `utn17` under a controller, at a demand."""
    return lambda controller, demand: run_of(controller=controller, demand=demand, hours=1, seed=11)[0]


@pytest.mark.parametrize("rule", RULES)
def test_in_light_traffic_every_rule_halves_the_delay_of_fixed_times(
    rule: str, run_of: Callable[..., tuple[dict[str, Any], Path]]
) -> None:
    settings: dict[str, Any] = {"demand": 0.5, "hours": 0.5, "seed": 11}
    ruled, fixed = (run_of(controller=each, **settings)[0]["total_delay_veh_h"] for each in (rule, "fixed"))
    assert ruled < 0.6 * fixed


@pytest.mark.long
def test_prices_keep_a_crowded_network_moving(hour_of: Callable[[str, float], dict[str, Any]]) -> None:
    priced, rule, fixed = (hour_of(each, 1.3)["total_delay_veh_h"] for each in ("priced", "max_wave", "fixed"))
    assert priced < 0.5 * min(rule, fixed)


@pytest.mark.long
def test_nobody_waits_for_ever(hour_of: Callable[[str, float], dict[str, Any]]) -> None:
    # The rule alone would let somebody wait longer than the signal heads have patience for.
    assert 150 < hour_of("max_wave", 1.3)["longest_red_s"] <= 180


@pytest.mark.parametrize("rule", ["priced"])
def test_bare_sumo_replays_its_runs_vehicle_for_vehicle(rule: str, tmp_path: Path) -> None:
    bridge.run(scenario(controller=rule, hours=0.25), tmp_path / "run")
    configuration = replay.write(tmp_path / "run")
    subprocess.run([str(sumo_binary("sumo")), "-c", str(configuration)], check=True, capture_output=True)
    recorded, replayed = (
        {trip.attrib["id"]: dict(trip.attrib) for trip in ET.parse(path).iter("tripinfo")}
        for path in (tmp_path / "run" / "trips.xml", configuration.with_name("trips.xml"))
    )
    assert len(recorded) > 150
    assert replayed == recorded


@pytest.mark.parametrize(
    ("settings", "complaint"), [({"every_s": 0}, "every_s"), ({"often": 1}, "often"), ({"full": -1}, "full")]
)
def test_a_wrong_setting_is_named(settings: dict[str, Any], complaint: str, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=complaint):
        bridge.run(scenario(controller="priced", settings=settings), tmp_path / "run")
