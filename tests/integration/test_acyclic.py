"""Rules that may show any stage every few seconds: safe on every net, patient, and as good as they ought to be."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from tests.integration import odd_nets

from utn_sumo import bridge, replay
from utn_sumo.errors import SettingError
from utn_sumo.scenario import scenario
from utn_sumo.sumo_tools import sumo_binary

RULES = ("max_wave", "max_pressure", "priced")


@pytest.mark.parametrize("make", odd_nets.CASES, ids=lambda make: make.__name__)
def test_it_runs_odd_nets_safely(make: Callable[[Path], Path], tmp_path: Path) -> None:
    result = bridge.run(scenario(net=str(make(tmp_path)), controller="priced", seed=5), tmp_path / "run")
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert (result["fallbacks"], result["fallback_reasons"]) == (0, [])
    assert result["arrived"] > 0


@pytest.fixture(scope="module")
def delay_veh_h(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., float]:
    """Total delay of an hour of `utn17`."""
    found: dict[tuple[str, float], float] = {}

    def measure(controller: str, demand: float) -> float:
        if (controller, demand) not in found:
            chosen = scenario(controller=controller, demand=demand, hours=1, seed=11)
            found[controller, demand] = bridge.run(chosen, tmp_path_factory.mktemp("run") / "out")["total_delay_veh_h"]
        return found[controller, demand]

    return measure


@pytest.mark.parametrize("rule", RULES)
def test_in_light_traffic_every_rule_halves_the_delay_of_fixed_times(
    rule: str, delay_veh_h: Callable[..., float]
) -> None:
    assert delay_veh_h(rule, 0.5) < 0.6 * delay_veh_h("fixed", 0.5)


def test_prices_keep_a_crowded_network_moving(delay_veh_h: Callable[..., float]) -> None:
    assert delay_veh_h("priced", 1.3) < 0.5 * min(delay_veh_h(each, 1.3) for each in ("max_wave", "fixed"))


def test_nobody_waits_for_ever(tmp_path: Path) -> None:
    result = bridge.run(scenario(controller="max_wave", demand=1.3, hours=1, seed=3), tmp_path / "run")
    # The rule alone would let somebody wait longer than the signal heads have patience for.
    assert 150 < result["longest_red_s"] <= 180


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
