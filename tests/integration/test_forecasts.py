"""Forecasts in runs on SUMO: on record, judged by the report, and of disturbances."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from utn_sumo import bridge, recording
from utn_sumo.cli import cli
from utn_sumo.prediction.predictor import ADOPTED_AFTER, LEAST_ROWS, METHODS
from utn_sumo.scenario import scenario

SERVING = LEAST_ROWS + ADOPTED_AFTER


def cycles(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / recording.CYCLES).read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two noisy days of a controller that costs no time."""
    folders = []
    for seed in (51, 52):
        folder = tmp_path_factory.mktemp("runs") / "run"
        bridge.run(scenario(controller="fixed", hours=1.6, demand=0.6, noise=0.5, seed=seed), folder)
        folders.append(folder)
    return folders


@pytest.mark.long
def test_who_served_is_on_record(runs: list[Path]) -> None:
    served = [set(cycle["forecast"]["served"]) - {""} for cycle in cycles(runs[0])]
    assert all(methods == {"profile"} for methods in served[:SERVING])
    assert any("starima" in methods for methods in served[SERVING:])


def test_a_run_foretells_alike_when_it_is_run_again(runs: list[Path], tmp_path: Path) -> None:
    chosen = recording.read_json(runs[0], recording.SETTINGS)["scenario"]
    bridge.run(scenario(**chosen), tmp_path / "again")
    first, again = ([cycle["forecast"] for cycle in cycles(folder)] for folder in (runs[0], tmp_path / "again"))
    assert first == again


@pytest.mark.long
def test_the_report_judges_every_method_at_every_step(runs: list[Path], tmp_path: Path) -> None:
    arguments = ["forecast-report", *map(str, runs), "--horizon", "3", "--out", str(tmp_path / "out"), "--json"]
    answer = CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert answer.exit_code == 0
    report = json.loads(answer.stdout)
    assert set(report["methods"]) == set(METHODS)
    for found in report["methods"].values():
        for key in ("rmse_veh_h", "low_veh_h", "high_veh_h"):
            assert len(found[key]) == 3
        assert len(found["all_steps_by_run_veh_h"]) == 2
    assert report["methods"]["perfect"]["rmse_veh_h"] == [0, 0, 0]
    assert report["methods"]["profile"]["ratio_to_profile"] == 1
    assert report["methods"]["starima"]["all_steps_rmse_veh_h"] < report["methods"]["last"]["all_steps_rmse_veh_h"]
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"forecasts.json", "forecasts.png"}


@pytest.mark.long
def test_too_short_a_run_is_not_judged(tmp_path: Path) -> None:
    folders = []
    for seed in (1, 2):
        folders.append(tmp_path / str(seed))
        bridge.run(scenario(controller="fixed", hours=0.2, seed=seed), folders[-1])
    answer = CliRunner().invoke(cli, ["forecast-report", *map(str, folders), "--out", str(tmp_path / "out")])
    assert answer.exit_code != 0
    assert "'hours' is 0.2" in str(answer.exception)


@pytest.mark.long
def test_vehicles_that_come_amid_links_are_found_and_foretold(tmp_path: Path) -> None:
    told = tmp_path / "told"
    bridge.run(scenario(hours=1.5, demand=0.6, disturbance=120.0, seed=5), told)
    coming_veh = 0.6 * 120.0 / 30
    records = cycles(told)
    found = np.array([record["state"]["disturbance_veh"] for record in records])[15:]
    assert found.mean() == pytest.approx(coming_veh, rel=0.2)
    x, truth = (np.array([record[key]["x_veh"] for record in records]) for key in ("state", "truth"))
    assert np.sqrt(np.mean((x[1:] - truth[:-1]) ** 2)) < 2.5
    ahead = np.array([record["forecast"]["disturbance_veh"] for record in records])
    assert ahead[: SERVING - 1].max() == 0.0
    assert ahead[SERVING:].mean() == pytest.approx(coming_veh, rel=0.25)
