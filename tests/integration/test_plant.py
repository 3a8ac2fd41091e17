"""SUMO as the plant: what it shows is what was planned, what it counts is what drove."""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from utn_sumo import demand
from utn_sumo.contract import Floats, Network, Plan
from utn_sumo.errors import PlantError
from utn_sumo.plant.sumo import SumoPlant

CYCLE_S = 120
NO_TRAFFIC = "<routes/>"


def random_plan(network: Network, rng: np.random.Generator) -> Plan:
    """Whole-second greens from the least to the most that the cycle allows."""
    green_s = np.zeros(len(network.stages))
    for junction, budget_s in zip(network.junctions, network.green_budget_s, strict=True):
        stages = list(junction.stages)
        least_s = network.min_green_s[stages]
        spare_s = int(budget_s - least_s.sum())
        cuts = np.sort(rng.integers(0, spare_s + 1, len(stages) - 1))
        green_s[stages] = least_s + np.diff([0, *cuts, spare_s])
    return Plan(green_s)


def planned_states(network: Network, plans: list[Plan]) -> dict[str, list[str]]:
    """Signal letters of every second, by junction, as the stages and their clearances prescribe."""
    planned: dict[str, list[str]] = {junction.id: [] for junction in network.junctions}
    for plan in plans:
        for junction in network.junctions:
            for stage in junction.stages:
                item = network.stages[stage]
                for state, seconds in [(item.state, plan.green_s[stage]), *item.clearance]:
                    planned[junction.id] += [state] * int(seconds)
    return planned


def shown_states(signals: Path, duration_s: int) -> dict[str, list[str]]:
    """Signal letters of every second, by junction, from SUMO's record of switches."""
    shown: dict[str, list[str]] = {}
    for switch in ET.parse(signals).iter("tlsState"):
        states = shown.setdefault(str(switch.get("id")), [""] * duration_s)
        start_s = int(float(str(switch.get("time"))))
        states[start_s:] = [str(switch.get("state"))] * (duration_s - start_s)
    return shown


def routes_of(network: Network, hours: float) -> Path:
    return demand.route_file(
        network, profile="peak", duration_s=hours * 3600, step_s=CYCLE_S, scale=1.0, noise=0.0, seed=1
    )


def trips_of_a_short_run(network: Network, folder: Path, seed: int = 1, disturb: bool = False) -> str:
    """trips.xml of six cycles without SUMO's header comment, which holds the date and the paths."""
    folder.mkdir()
    routes = routes_of(network, 0.2)
    with SumoPlant(network, routes, folder, seed=seed, duration_s=720) as plant:
        for _ in range(6):
            plant.run(network.equal_split())
            if disturb:
                with (
                    pytest.raises(PlantError, match="already runs"),
                    SumoPlant(network, routes, folder, seed=seed, duration_s=720),
                ):
                    pass
    return re.sub(r"<!--.*?-->", "", (folder / "trips.xml").read_text(encoding="utf-8"), flags=re.DOTALL)


def test_a_thousand_random_plans_are_shown_to_the_second(utn17: Network, tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    plans = [random_plan(utn17, rng) for _ in range(125)]
    assert len(plans) * len(utn17.junctions) >= 1000
    duration_s = CYCLE_S * len(plans)
    routes = tmp_path / "none.rou.xml"
    routes.write_text(NO_TRAFFIC, encoding="utf-8")
    with SumoPlant(utn17, routes, tmp_path, seed=1, duration_s=duration_s) as plant:
        for plan in plans:
            plant.run(plan)

    planned = planned_states(utn17, plans)
    shown = shown_states(tmp_path / "signals.xml", duration_s)
    assert shown.keys() == planned.keys()
    for junction, states in planned.items():
        differing = [second for second, state in enumerate(states) if shown[junction][second] != state]
        assert not differing, f"{junction} differs in {len(differing)} s, first at {differing[0]} s"


def test_a_second_plant_is_refused_and_the_first_goes_on_unharmed(utn17: Network, tmp_path: Path) -> None:
    undisturbed = trips_of_a_short_run(utn17, tmp_path / "alone")
    assert trips_of_a_short_run(utn17, tmp_path / "disturbed", disturb=True) == undisturbed


def test_the_same_seed_gives_the_same_trips_to_the_byte_and_another_seed_others(utn17: Network, tmp_path: Path) -> None:
    first = trips_of_a_short_run(utn17, tmp_path / "first")
    assert "<tripinfo " in first
    assert trips_of_a_short_run(utn17, tmp_path / "again") == first
    assert trips_of_a_short_run(utn17, tmp_path / "other", seed=2) != first


BAD_EDGE = '<routes><vehicle id="a" depart="0"><route edges="1 nowhere"/></vehicle></routes>'


@pytest.mark.parametrize(
    ("content", "reason"),
    [("", "invalid document"), ("no XML", "invalid document"), (BAD_EDGE, "nowhere"), (None, "not accessible")],
    ids=["empty", "no XML", "unknown edge", "missing"],
)
def test_a_broken_route_file_is_one_line_and_the_next_plant_opens(
    utn17: Network, tmp_path: Path, content: str | None, reason: str
) -> None:
    routes = tmp_path / "routes.rou.xml"
    if content is not None:
        routes.write_text(content, encoding="utf-8")
    with pytest.raises(PlantError, match=reason) as caught, SumoPlant(utn17, routes, tmp_path, seed=1, duration_s=120):
        pass
    assert "\n" not in str(caught.value)

    routes.write_text(NO_TRAFFIC, encoding="utf-8")
    with SumoPlant(utn17, routes, tmp_path, seed=1, duration_s=120) as plant:
        assert plant.run(utn17.equal_split()).time_s == 120


def test_routes_that_break_under_way_say_when_and_the_next_plant_opens(utn17: Network, tmp_path: Path) -> None:
    vehicles = [(0, "1 W1"), (400, "1 W1"), (800, "1 nowhere")]
    routes = tmp_path / "routes.rou.xml"
    routes.write_text(
        "<routes>"
        + "".join(f'<vehicle id="v{at}" depart="{at}"><route edges="{edges}"/></vehicle>' for at, edges in vehicles)
        + "</routes>",
        encoding="utf-8",
    )

    def run() -> None:
        with SumoPlant(utn17, routes, tmp_path, seed=1, duration_s=1200) as plant:
            for _ in range(10):
                plant.run(utn17.equal_split())

    with pytest.raises(PlantError, match=r"broke off at \d+ s .*nowhere") as caught:
        run()
    assert "\n" not in str(caught.value)

    routes.write_text(NO_TRAFFIC, encoding="utf-8")
    with SumoPlant(utn17, routes, tmp_path, seed=1, duration_s=120) as plant:
        assert plant.run(utn17.equal_split()).time_s == 120


def test_loops_count_the_vehicles_that_drove(utn17: Network, tmp_path: Path) -> None:
    routes = routes_of(utn17, 0.5)
    ways = [str(route.get("edges")).split() for route in ET.parse(routes).iter("route")]
    driven = Counter(edge for way in ways for edge in way)
    made = Counter(turn for way in ways for turn in pairwise(way))
    entered, turned = np.zeros(len(utn17.links)), np.zeros(len(utn17.turns))
    imbalance: list[Floats] = []
    with SumoPlant(utn17, routes, tmp_path, seed=1, duration_s=7200) as plant:
        while plant.truth is None or plant.time_s < 1800 or plant.truth.in_network_veh:
            seen = plant.run(utn17.equal_split())
            entered, turned = entered + seen.entered_veh.sum(axis=0), turned + seen.turned_veh
            assert plant.truth is not None
            imbalance.append(entered - np.bincount(utn17.turn_link, turned) - plant.truth.x_veh)

    by_link = np.array([driven[link.edges[0]] for link in utn17.links])
    np.testing.assert_array_equal(entered, by_link)
    np.testing.assert_array_equal(turned, [made[utn17.links[turn.link].id, turn.to_edge] for turn in utn17.turns])
    assert np.abs(imbalance).max() <= 2


def test_a_run_that_ends_amid_a_cycle_counts_up_to_its_end(utn17: Network, tmp_path: Path) -> None:
    with SumoPlant(utn17, routes_of(utn17, 0.5), tmp_path, seed=1, duration_s=900) as plant:
        steps = [plant.run(utn17.equal_split()) for _ in range(8)]
        assert plant.truth is not None
        present = plant.truth.x_veh
    turned = np.sum([step.turned_veh for step in steps], axis=0)
    balance = sum(step.entered_veh.sum(axis=0) for step in steps) - np.bincount(utn17.turn_link, turned)
    assert steps[-1].time_s == 900
    assert np.abs(balance - present).max() <= 2
