"""Demand of SPEC 7: the profile, its noise, and the trips that are drawn from it once per seed."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from utn_sumo import demand
from utn_sumo.contract import EXIT, Network
from utn_sumo.errors import NetworkError

STEP_S = 120.0
HOURS = 2
Trips = list[tuple[float, list[str]]]


def draw(net: Network, cache: Path, **changed: Any) -> Path:
    settings = {"profile": "peak", "duration_s": HOURS * 3600.0, "step_s": STEP_S, "scale": 1.0, "noise": 0.0}
    return demand.route_file(net, cache=cache, **{**settings, "seed": 1, **changed})


def read(path: Path) -> Trips:
    vehicles = ET.parse(path).getroot().findall("vehicle")
    return [(float(vehicle.get("depart", "nan")), vehicle[0].get("edges", "").split()) for vehicle in vehicles]


@pytest.fixture(scope="module")
def trips(utn17: Network, tmp_path_factory: pytest.TempPathFactory) -> Trips:
    return read(draw(utn17, tmp_path_factory.mktemp("cache")))


def test_the_peak_rises_from_300_to_800_and_falls_back(utn17: Network) -> None:
    profile = demand.mean_profile_veh_h(utn17, "peak", 121, 1.0)[:, 0]
    assert profile[[0, -1]] == pytest.approx(300, rel=0.03)
    assert profile.max() == profile[60] == pytest.approx(800)
    assert (np.diff(profile[:61]) > 0).all()
    assert profile == pytest.approx(profile[::-1])


def test_demand_comes_from_sources_alone(utn17: Network) -> None:
    profile = demand.mean_profile_veh_h(utn17, "constant", 3, 1.0)
    assert (profile == np.where(utn17.is_source, 800, 0)).all()


@pytest.mark.parametrize("profile", demand.PROFILES)
def test_the_scale_multiplies_every_profile(utn17: Network, profile: str) -> None:
    once, more = (demand.drawn_rates_veh_h(utn17, profile, 30, scale=scale, noise=0.2, seed=4) for scale in (1.0, 1.3))
    assert more == pytest.approx(1.3 * once)


def test_without_noise_the_rates_are_the_mean_profile(utn17: Network) -> None:
    rates = demand.drawn_rates_veh_h(utn17, "peak", 60, scale=1.1, noise=0.0, seed=3)
    assert (rates == demand.mean_profile_veh_h(utn17, "peak", 60, 1.1)).all()


def test_the_papers_rates_are_drawn_around_550_between_300_and_800(utn17: Network) -> None:
    rates = demand.drawn_rates_veh_h(utn17, "paper", 200, scale=1.0, noise=0.0, seed=3)[:, utn17.is_source]
    assert rates.min() >= 300
    assert rates.max() <= 800
    assert rates.mean() == pytest.approx(550, rel=0.02)
    assert np.unique(rates).size == rates.size


def test_noise_has_its_size_and_lasts_over_steps_and_sources(utn17: Network) -> None:
    rates = demand.drawn_rates_veh_h(utn17, "constant", 20_000, scale=1.0, noise=0.2, seed=5)[:, utn17.is_source]
    level = rates / 800 - 1
    assert level.mean() == pytest.approx(0, abs=0.02)
    assert level.std() == pytest.approx(0.2, rel=0.05)
    assert np.corrcoef(level[1:, 0], level[:-1, 0])[0, 1] == pytest.approx(demand.NOISE_PERSISTENCE, abs=0.05)
    assert np.corrcoef(level[:, 0], level[:, 1])[0, 1] == pytest.approx(demand.NOISE_SHARED, abs=0.05)


def test_strong_noise_never_makes_demand_negative(utn17: Network) -> None:
    assert demand.drawn_rates_veh_h(utn17, "peak", 500, scale=1.0, noise=2.0, seed=5).min() == 0


def test_the_same_seed_gives_the_same_file_byte_for_byte(utn17: Network, tmp_path: Path) -> None:
    first, second = (draw(utn17, tmp_path / folder, noise=0.1) for folder in "ab")
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("changed", [{"seed": 2}, {"scale": 1.1}, {"noise": 0.1}, {"profile": "paper"}])
def test_any_other_setting_gives_another_file(utn17: Network, tmp_path: Path, changed: dict[str, Any]) -> None:
    usual, other = draw(utn17, tmp_path), draw(utn17, tmp_path, **changed)
    assert usual != other
    assert read(usual) != read(other)


def test_a_file_that_is_there_is_not_drawn_again(utn17: Network, tmp_path: Path) -> None:
    path = draw(utn17, tmp_path)
    written_ns = path.stat().st_mtime_ns
    assert draw(utn17, tmp_path) == path
    assert path.stat().st_mtime_ns == written_ns
    assert list(tmp_path.iterdir()) == [path]


def test_the_cache_stands_where_utn_cache_says(utn17: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UTN_CACHE", str(tmp_path / "here"))
    path = demand.route_file(utn17, profile="peak", duration_s=600, step_s=STEP_S, scale=1.0, noise=0.0, seed=1)
    assert path.parent == tmp_path / "here"


def test_each_source_sends_about_what_the_profile_says(utn17: Network, trips: Trips) -> None:
    profile_veh = demand.mean_profile_veh_h(utn17, "peak", 60, 1.0) * STEP_S / 3600
    counts = Counter(edges[0] for _, edges in trips)
    assert set(counts) == {link.id for link in utn17.links if link.is_source}
    for index in np.flatnonzero(utn17.is_source):
        expected = profile_veh[:, index].sum()
        assert abs(counts[utn17.links[index].id] - expected) < 4 * np.sqrt(expected)


def test_the_middle_of_the_peak_is_busier_than_its_ends(trips: Trips) -> None:
    quarters = np.bincount([int(depart_s // (HOURS * 900)) for depart_s, _ in trips], minlength=4)
    assert quarters[[1, 2]].min() > 1.3 * quarters[[0, 3]].max()


def test_departures_are_in_order_and_within_the_run(trips: Trips) -> None:
    departs_s = [depart_s for depart_s, _ in trips]
    assert departs_s == sorted(departs_s)
    assert departs_s[0] >= 0
    assert departs_s[-1] <= HOURS * 3600


def test_a_run_that_ends_within_a_step_has_no_later_departure(utn17: Network, tmp_path: Path) -> None:
    assert max(depart_s for depart_s, _ in read(draw(utn17, tmp_path, duration_s=300.0))) <= 300


def test_routes_follow_turns_of_the_network_from_a_source_to_an_exit(utn17: Network, trips: Trips) -> None:
    turns = {(utn17.links[turn.link].id, turn.to_edge) for turn in utn17.turns}
    exits = {turn.to_edge for turn in utn17.turns if turn.next_link == EXIT}
    assert all(step in turns for _, edges in trips for step in pairwise(edges))
    assert all(edges[-1] in exits for _, edges in trips)


def test_routes_turn_as_often_as_the_fractions_say(utn17: Network, trips: Trips) -> None:
    made = Counter(step for _, edges in trips for step in pairwise(edges))
    passed = Counter(edge for _, edges in trips for edge in edges[:-1])
    for turn in utn17.turns:
        link = utn17.links[turn.link].id
        spread = np.sqrt(turn.fraction * (1 - turn.fraction) / passed[link])
        assert made[link, turn.to_edge] / passed[link] == pytest.approx(turn.fraction, abs=4 * spread)


def test_no_demand_gives_an_empty_file_that_sumo_can_read(utn17: Network, tmp_path: Path) -> None:
    root = ET.parse(draw(utn17, tmp_path, scale=0.0)).getroot()
    assert root.tag == "routes"
    assert len(root) == 0


def test_a_disturbance_adds_vehicles_amid_every_link_and_changes_no_other(
    utn17: Network, trips: Trips, tmp_path: Path
) -> None:
    vehicles = ET.parse(draw(utn17, tmp_path, disturbance_veh_h=90.0, scale=1.0)).getroot().findall("vehicle")
    amid = [vehicle for vehicle in vehicles if vehicle.get("departPos")]
    others = [vehicle for vehicle in vehicles if not vehicle.get("departPos")]
    assert [vehicle[0].get("edges", "").split() for vehicle in others] == [edges for _, edges in trips]
    counts = Counter(vehicle[0].get("edges", "").split()[0] for vehicle in amid)
    assert set(counts) == {link.edges[0] for link in utn17.links}
    # Poisson: within five standard deviations on every link.
    assert all(abs(count - 90 * HOURS) < 5 * np.sqrt(90 * HOURS) for count in counts.values())
    for vehicle in amid:
        edge = vehicle[0].get("edges", "").split()[0]
        assert 0 < float(vehicle.get("departPos", "nan")) < utn17.edge_length_m[edge]
    departures = [float(vehicle.get("depart", "nan")) for vehicle in vehicles]
    assert departures == sorted(departures)


def test_turning_fractions_that_never_lead_out_are_refused_before_anything_is_drawn(
    utn17: Network, tmp_path: Path
) -> None:
    """All drive round and round: nobody turns onto a way out."""
    turns = [replace(turn, fraction=float(turn.next_link != EXIT)) for turn in utn17.turns]
    with pytest.raises(NetworkError, match=r"link '\d+' leads nowhere out of net 'utn17'.*: give") as caught:
        draw(replace(utn17, turns=tuple(turns)), tmp_path)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_link_without_a_way_out_matters_only_where_somebody_comes_to_it(utn17: Network, tmp_path: Path) -> None:
    """Link 9 gets none, from upstream neither: its turns go back to itself."""
    lost = 8
    turns = []
    for turn in utn17.turns:
        if turn.link == lost:
            turns.append(replace(turn, next_link=lost))
        elif turn.next_link == lost:
            turns.append(replace(turn, fraction=0.0))
        else:
            turns.append(turn)
    links = tuple(replace(link, is_source=link.is_source and index != lost) for index, link in enumerate(utn17.links))
    net = replace(utn17, turns=tuple(turns), links=links)
    assert read(draw(net, tmp_path, duration_s=STEP_S))
    with pytest.raises(NetworkError, match="link '9' leads nowhere out"):
        draw(net, tmp_path, duration_s=STEP_S, disturbance_veh_h=10.0)
