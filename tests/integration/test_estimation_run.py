"""The estimate that controllers work from, against SUMO's own count, over whole runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from utn_sumo import calibration, network
from utn_sumo.contract import Floats, Measurement, Network, State
from utn_sumo.estimation import Estimator

RunOf = Callable[..., tuple[dict[str, Any], Path]]
CYCLES_AN_HOUR = 30
LOOP_ERROR = 0.02
OVERALL_RMSE_VEH, LINK_RMSE_VEH, DRIFT_RMSE_VEH = 2.0, 3.0, 1.0


def records(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "cycles.jsonl").read_text(encoding="utf-8").splitlines()]


def estimate_and_truth(folder: Path, estimate: str, truth: str) -> tuple[Floats, Floats]:
    """(cycles, Z) each: a state is estimated at the end of the cycle before it, where its truth is recorded."""
    cycles = records(folder)
    return (
        np.array([cycle["state"][estimate] for cycle in cycles[1:]]),
        np.array([cycle["truth"][truth] for cycle in cycles[:-1]]),
    )


def estimated_again(folder: Path, loop_error: float) -> list[State]:
    """What an estimator that takes its loops to be so good makes of the run's recorded measurements."""
    scenario = json.loads((folder / "settings.json").read_text(encoding="utf-8"))["scenario"]
    net = network.load(scenario["net"])
    estimator = Estimator(net, calibration.for_model(net, scenario["calibration"]), loop_error)
    states = []
    for cycle in records(folder):
        counts = {name: np.array(value) for name, value in cycle["seen"].items() if name != "time_s"}
        seen = Measurement(time_s=cycle["seen"]["time_s"], **counts)
        states.append(estimator.update(seen, np.array(cycle["forecast"]["demand_veh"][0])))
    return states


def error_of_plain_counting(folder: Path) -> Floats:
    _, true = estimate_and_truth(folder, "x_veh", "x_veh")
    return np.array([state.x_veh for state in estimated_again(folder, 0.0)[: len(true)]]) - true


def rmse(error: Floats, axis: int | None = None) -> Any:
    return np.sqrt(np.mean(error**2, axis=axis))


def error_of(folder: Path) -> Floats:
    estimated, true = estimate_and_truth(folder, "x_veh", "x_veh")
    return estimated - true


def report(record_property: Callable[[str, object], None], error: Floats) -> None:
    record_property("overall_rmse_veh", float(rmse(error)))
    record_property("worst_link_rmse_veh", float(rmse(error, 0).max()))


def test_vehicles_are_estimated_within_two_over_half_an_hour(
    run_of: RunOf, record_property: Callable[[str, object], None]
) -> None:
    error = error_of(run_of(hours=0.5)[1])
    report(record_property, error)
    assert rmse(error) <= OVERALL_RMSE_VEH
    assert rmse(error, 0).max() <= LINK_RMSE_VEH


@pytest.mark.long
class TestFourHours:
    def test_vehicles_are_estimated_within_two_over_all_links_and_cycles(
        self, run_of: RunOf, record_property: Callable[[str, object], None]
    ) -> None:
        error = error_of(run_of(hours=4)[1])
        report(record_property, error)
        assert rmse(error) <= OVERALL_RMSE_VEH

    def test_no_link_is_estimated_worse_than_within_three(self, run_of: RunOf, utn17: Network) -> None:
        by_link = rmse(error_of(run_of(hours=4)[1]), 0)
        worst = int(by_link.argmax())
        assert by_link[worst] <= LINK_RMSE_VEH, f"link {utn17.links[worst].id}"

    def test_the_last_hour_is_estimated_no_worse_than_the_first(self, run_of: RunOf) -> None:
        error = error_of(run_of(hours=4)[1])
        assert rmse(error[-CYCLES_AN_HOUR:]) <= max(rmse(error[:CYCLES_AN_HOUR]), DRIFT_RMSE_VEH)


class TestMiscountingLoops:
    """Loops that miss or double one vehicle in fifty; plain counting is the estimate that believes them."""

    @pytest.fixture
    def folder(self, run_of: RunOf) -> Path:
        return run_of(hours=1.5, demand=0.8, loop_error=LOOP_ERROR)[1]

    def test_vehicles_are_estimated_far_better_than_by_plain_counting(
        self, folder: Path, record_property: Callable[[str, object], None]
    ) -> None:
        error, plain = error_of(folder), error_of_plain_counting(folder)
        report(record_property, error)
        record_property("plain_counting_rmse_veh", float(rmse(plain)))
        assert rmse(plain) > 2 * OVERALL_RMSE_VEH, "the loops miscount too little: the run tests nothing"
        assert rmse(error) <= OVERALL_RMSE_VEH
        assert rmse(error) <= rmse(plain) / 4

    def test_the_error_does_not_grow_while_that_of_plain_counting_does(self, folder: Path) -> None:
        half_hour = CYCLES_AN_HOUR // 2
        error, plain = error_of(folder), error_of_plain_counting(folder)
        assert rmse(plain[-half_hour:]) > 2 * rmse(plain[:half_hour])
        assert rmse(error[-half_hour:]) <= max(rmse(error[:half_hour]), DRIFT_RMSE_VEH)

    def test_nobody_is_taken_to_wait_outside_where_nobody_does(self, folder: Path) -> None:
        estimated, waiting = estimate_and_truth(folder, "source_queue_veh", "waiting_veh")
        assert np.where(waiting > 0, 0.0, estimated).max() <= 5

    def test_the_record_holds_what_the_estimate_was_made_from(self, folder: Path) -> None:
        again = estimated_again(folder, LOOP_ERROR)
        for cycle, state in zip(records(folder)[1:], again, strict=False):
            for name in ("x_veh", "q_veh", "source_queue_veh", "fraction"):
                # The record rounds to six digits, an occupancy too, of which the source queues are hundreds of times.
                assert cycle["state"][name] == pytest.approx(getattr(state, name), abs=1e-2)

    @pytest.mark.long
    @pytest.mark.parametrize("seed", [2, 3, 4])
    def test_vehicles_are_estimated_far_better_whatever_loop_errs(self, run_of: RunOf, seed: int) -> None:
        folder = run_of(hours=1.5, demand=0.8, loop_error=LOOP_ERROR, seed=seed)[1]
        error = error_of(folder)
        assert rmse(error) <= min(OVERALL_RMSE_VEH, rmse(error_of_plain_counting(folder)) / 4)

    @pytest.mark.long
    def test_a_long_steady_demand_brings_no_drift(
        self, run_of: RunOf, record_property: Callable[[str, object], None]
    ) -> None:
        folder = run_of(hours=4, demand=0.8, loop_error=LOOP_ERROR, profile="constant")[1]
        error = error_of(folder)
        report(record_property, error)
        assert rmse(error) <= rmse(error_of_plain_counting(folder)) / 4
        assert rmse(error[-CYCLES_AN_HOUR:]) <= max(rmse(error[:CYCLES_AN_HOUR]), OVERALL_RMSE_VEH)

    @pytest.mark.long
    def test_a_crowded_network_is_estimated_better_than_by_plain_counting(
        self, run_of: RunOf, record_property: Callable[[str, object], None]
    ) -> None:
        folder = run_of(hours=2, demand=1.3, loop_error=LOOP_ERROR)[1]
        error = error_of(folder)
        report(record_property, error)
        assert rmse(error) <= rmse(error_of_plain_counting(folder)) / 2

    @pytest.mark.long
    def test_long_links_are_estimated_far_better_than_by_plain_counting(
        self, run_of: RunOf, record_property: Callable[[str, object], None]
    ) -> None:
        folder = run_of(net="utn17-long", hours=2.5, demand=0.8, loop_error=LOOP_ERROR)[1]
        error = error_of(folder)
        report(record_property, error)
        assert rmse(error) <= rmse(error_of_plain_counting(folder)) / 3


CROWD = {"controller": "fixed", "hours": 0.5, "demand": 1.5, "profile": "constant", "seed": 2}
"""Traffic that changes lanes while it stands on the entry loops."""


@pytest.mark.long
def test_nobody_enters_backwards(run_of: RunOf) -> None:
    entered = np.array([cycle["seen"]["entered_veh"] for cycle in records(run_of(**CROWD)[1])])
    assert entered.sum() > 1000
    assert entered.min() >= 0


@pytest.mark.long
def test_a_crowd_on_miscounting_loops_does_not_bring_the_run_down(run_of: RunOf) -> None:
    result, folder = run_of(**CROWD, loop_error=LOOP_ERROR)
    assert result["hours"] == CROWD["hours"]
    assert np.array([cycle["seen"]["entered_veh"] for cycle in records(folder)]).min() >= 0


def foreseeable_queue(folder: Path, net: Network) -> Floats:
    """(cycles, Z) who waits outside as far as anybody can tell who knows in which cycles somebody waits on which link,
    but of the demand only its mean: what is left between this and the truth is the Poisson draw.
    """
    queue = np.zeros(len(net.links))
    queues = []
    for cycle in records(folder)[:-1]:
        missing = np.array(cycle["forecast"]["demand_veh"][0]) - np.sum(cycle["seen"]["entered_veh"], axis=0)
        waits = np.array(cycle["truth"]["waiting_veh"]) > 0
        queue = np.where(waits & net.is_source, np.maximum(queue + missing, 0.0), 0.0)
        queues.append(queue)
    return np.array(queues)


@pytest.mark.long
class TestSourceQueues:
    @pytest.fixture
    def folder(self, run_of: RunOf) -> Path:
        return run_of(hours=2, demand=1.3)[1]

    def test_queues_outside_a_crowded_network_are_estimated(
        self, folder: Path, utn17: Network, record_property: Callable[[str, object], None]
    ) -> None:
        estimated, waiting = estimate_and_truth(folder, "source_queue_veh", "waiting_veh")
        total = estimated.sum(axis=1) - waiting.sum(axis=1)
        record_property("rmse_veh", float(rmse(estimated - waiting)))
        record_property("total_rmse_share", float(rmse(total) / waiting.sum(axis=1).max()))
        assert waiting.sum(axis=1).max() > 100, "nobody had to wait: the run tests nothing"
        assert not estimated[:, ~utn17.is_source].any()
        assert rmse(estimated - waiting) <= 10
        assert rmse(total) <= 0.1 * waiting.sum(axis=1).max()

    def test_they_are_estimated_hardly_worse_than_the_draw_of_the_demand_lets_anybody(
        self, folder: Path, utn17: Network, record_property: Callable[[str, object], None]
    ) -> None:
        estimated, waiting = estimate_and_truth(folder, "source_queue_veh", "waiting_veh")
        unforeseen = rmse(foreseeable_queue(folder, utn17) - waiting)
        record_property("unforeseen_rmse_veh", float(unforeseen))
        assert rmse(estimated - waiting) <= unforeseen + 2
