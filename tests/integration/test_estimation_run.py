"""The estimate that controllers work from, against SUMO's own count, over whole runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from utn_sumo.contract import Floats, Network

RunOf = Callable[..., tuple[dict[str, Any], Path]]
CYCLES_AN_HOUR = 30
OVERALL_RMSE_VEH, LINK_RMSE_VEH, DRIFT_RMSE_VEH = 2.0, 3.0, 1.0


def estimate_and_truth(folder: Path, estimate: str, truth: str) -> tuple[Floats, Floats]:
    """(cycles, Z) each: a state is estimated at the end of the cycle before it, where its truth is recorded."""
    cycles = [json.loads(line) for line in (folder / "cycles.jsonl").read_text(encoding="utf-8").splitlines()]
    return (
        np.array([cycle["state"][estimate] for cycle in cycles[1:]]),
        np.array([cycle["truth"][truth] for cycle in cycles[:-1]]),
    )


def rmse(error: Floats, axis: int | None = None) -> Any:
    return np.sqrt(np.mean(error**2, axis=axis))


def error_of(folder: Path) -> Floats:
    estimated, true = estimate_and_truth(folder, "x_veh", "x_veh")
    return estimated - true


def report(record_property: Callable[[str, object], None], error: Floats) -> None:
    record_property("overall_rmse_veh", rmse(error))
    record_property("worst_link_rmse_veh", rmse(error, 0).max())


def test_vehicles_are_estimated_within_two_over_half_an_hour(
    run_of: RunOf, record_property: Callable[[str, object], None]
) -> None:
    error = error_of(run_of(hours=0.5)[1])
    report(record_property, error)
    assert rmse(error) <= OVERALL_RMSE_VEH
    assert rmse(error, 0).max() <= LINK_RMSE_VEH


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
class TestFourHours:
    def test_vehicles_are_estimated_within_two_over_all_links_and_cycles(
        self, run_of: RunOf, seed: int, record_property: Callable[[str, object], None]
    ) -> None:
        error = error_of(run_of(hours=4, seed=seed)[1])
        report(record_property, error)
        assert rmse(error) <= OVERALL_RMSE_VEH

    def test_no_link_is_estimated_worse_than_within_three(self, run_of: RunOf, utn17: Network, seed: int) -> None:
        by_link = rmse(error_of(run_of(hours=4, seed=seed)[1]), 0)
        worst = int(by_link.argmax())
        assert by_link[worst] <= LINK_RMSE_VEH, f"link {utn17.links[worst].id}"

    def test_the_last_hour_is_estimated_no_worse_than_the_first(self, run_of: RunOf, seed: int) -> None:
        error = error_of(run_of(hours=4, seed=seed)[1])
        assert rmse(error[-CYCLES_AN_HOUR:]) <= max(rmse(error[:CYCLES_AN_HOUR]), DRIFT_RMSE_VEH)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_queues_outside_a_crowded_network_are_estimated(run_of: RunOf, utn17: Network, seed: int) -> None:
    estimated, waiting = estimate_and_truth(
        run_of(hours=2, demand=1.3, seed=seed)[1], "source_queue_veh", "waiting_veh"
    )
    assert waiting.sum(axis=1).max() > 100, "nobody had to wait: the run tests nothing"
    assert not estimated[:, ~utn17.is_source].any()
    assert rmse(estimated - waiting) <= 10
    assert rmse(estimated.sum(axis=1) - waiting.sum(axis=1)) <= 0.1 * waiting.sum(axis=1).max()
