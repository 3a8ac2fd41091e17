"""A bound on delay: what queues at a bottleneck, counted by hand, and never more than a controller needs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bounding
from utn_sumo import bridge
from utn_sumo.contract import EXIT, Network
from utn_sumo.scenario import scenario

STEP_S = 20.0


def bound(network: Network, demand_veh_h: float, lost: float, hours: float = 0.5) -> float:
    """Under a constant demand at every source."""
    return bounding.least_delay_veh_h(
        network, demand_veh_h * network.is_source[None, :], hours, step_s=STEP_S, lost=lost
    )


def test_who_comes_to_one_junction_too_fast_queues_as_counted_by_hand(utn17: Network) -> None:
    link, hours, lost = int(np.flatnonzero(utn17.is_source)[0]), 0.5, 0.1
    # They all leave the network, so that none comes round again.
    first = int(np.flatnonzero((utn17.turn_link == link) & (utn17.turn_next == EXIT))[0])
    turns = [
        replace(turn, fraction=float(place == first)) if turn.link == link else turn
        for place, turn in enumerate(utn17.turns)
    ]
    utn17 = replace(utn17, turns=tuple(turns))
    capacity_veh_h = 3600 * utn17.saturation_flow_veh_s[link] * (1 - lost)
    rate_veh_h = np.zeros((1, len(utn17.links)))
    rate_veh_h[0, link] = 2 * capacity_veh_h
    least = bounding.least_delay_veh_h(utn17, rate_veh_h, hours, step_s=STEP_S, lost=lost)
    # Twice as many come as can go, and at any time as many drive freely as go in the time of the way.
    assert least == pytest.approx(capacity_veh_h * hours**2 / 2, rel=0.03)


def test_it_is_nothing_in_light_traffic_and_grows_with_demand_and_time_lost(utn17: Network) -> None:
    assert bound(utn17, 200, 0.1) == pytest.approx(0.0, abs=1e-6)
    assert 0 < bound(utn17, 1100, 0.05) < bound(utn17, 1300, 0.05) < bound(utn17, 1300, 0.15)


@pytest.mark.long
def test_a_run_has_more_delay(utn17: Network, tmp_path: Path) -> None:
    chosen = scenario(profile="constant", demand=1.5, hours=0.5)
    result = bridge.run(chosen, tmp_path / "run")
    assert bound(utn17, 1.5 * 800, 0.05) < result["total_delay_veh_h"]
    # Its queues went about as fast as queues should, but for where they could not.
    flowing = bounding.with_flows_of(utn17, tmp_path / "run")
    share = flowing.saturation_flow_veh_s / utn17.saturation_flow_veh_s
    assert 3 < np.count_nonzero(share != 1.0) < len(share)
    assert 0.7 < np.median(share) < share.max() < 1.15
    assert share.min() > 0.1


def test_flows_are_those_of_links_that_had_a_queue(utn17: Network, tmp_path: Path) -> None:
    bridge.run(scenario(demand=0.2, hours=0.2), tmp_path / "run")
    flowing = bounding.with_flows_of(utn17, tmp_path / "run")
    assert (flowing.saturation_flow_veh_s == utn17.saturation_flow_veh_s).all()


def test_who_is_neither_stopped_nor_gives_way_has_less_delay(utn17: Network, tmp_path: Path) -> None:
    chosen = scenario(controller="recommended", profile="constant", demand=0.8, hours=0.2)
    controlled = bridge.run(chosen, tmp_path / "run")
    unhindered_veh_h = bounding.unhindered_delay_veh_h(utn17, chosen)
    assert 0 < unhindered_veh_h < 0.5 * controlled["total_delay_veh_h"]
