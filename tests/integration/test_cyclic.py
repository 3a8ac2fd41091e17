"""Splits once a cycle: safe in SUMO, and better than equal ones where these have not enough."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from utn_sumo import bridge
from utn_sumo.scenario import scenario

from . import odd_nets
from .odd_nets import Make

PEERS = ("tuc", "proportional", "cyclic_max_pressure")
every_peer = pytest.mark.parametrize("controller", PEERS)


@pytest.mark.long
@every_peer
def test_it_is_safe_needs_nobody_to_step_in_and_delays_less_than_equal_splits(
    controller: str, run_of: Callable[..., Any]
) -> None:
    settings: dict[str, Any] = {"hours": 0.5, "seed": 3, "profile": "constant"}
    equal, result = (run_of(controller=each, **settings)[0] for each in ("fixed", controller))
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert (result["fallbacks"], result["fallback_reasons"]) == (0, [])
    assert result["arrived"] > 800
    assert result["total_delay_veh_h"] < equal["total_delay_veh_h"]


# Every net under one of them: what differs is how much green each stage gets, not how it is shown.
ODD_NETS = [
    pytest.param(make, PEERS[place % len(PEERS)], id=f"{make.__name__}-{PEERS[place % len(PEERS)]}")
    for place, make in enumerate(odd_nets.CASES)
]


@pytest.mark.long
@pytest.mark.parametrize(("make", "controller"), ODD_NETS)
def test_it_runs_odd_nets_safely(make: Make, controller: str, made: Callable[[Make], Path], tmp_path: Path) -> None:
    result = bridge.run(scenario(net=str(made(make)), controller=controller, seed=5), tmp_path / "run")
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert (result["fallbacks"], result["fallback_reasons"]) == (0, [])
    assert result["arrived"] > 0
