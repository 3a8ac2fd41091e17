"""Model against microsimulation, through the commands: what is recorded with a calibration must not get worse."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from utn_sumo import bridge, calibration, floor, mismatch, recording
from utn_sumo.cli import cli
from utn_sumo.contract import Network
from utn_sumo.mismatch import rmse
from utn_sumo.recording import Log
from utn_sumo.scenario import scenario


def one_step_rmse_veh(network: Network, folder: Path, step_s: float = 10.0) -> tuple[float, float]:
    """RMSE of the model and of persistence, one control step ahead."""
    log = recording.read_log(folder)
    found = mismatch.errors(calibration.for_model(network, None), log, step_s, 1)
    return float(np.sqrt(np.mean(found.x_veh**2))), float(np.sqrt(np.mean(found.persistence_veh**2)))


def test_the_mismatch_is_what_was_recorded_with_the_calibration(utn17: Network, tmp_path: Path) -> None:
    recorded = json.loads(calibration.beside_net(utn17).read_text(encoding="utf-8"))
    made = recorded["made_from"]
    position = made["demands"].index(0.9) * len(made["seeds"])
    item = scenario(demand=0.9, seed=made["seeds"][0], hours=made["hours"], calibration="none")
    bridge.run(item, tmp_path / "run")
    now, persistence = one_step_rmse_veh(utn17, tmp_path / "run")
    assert now <= 1.1 * recorded["one_step_rmse_veh"][position]
    assert now <= 0.6 * persistence


def test_on_a_day_that_it_was_not_fitted_to_the_model_beats_persistence(utn17: Network, tmp_path: Path) -> None:
    bridge.run(scenario(demand=1.05, seed=77, hours=1), tmp_path / "run")
    model, persistence = one_step_rmse_veh(utn17, tmp_path / "run")
    assert model <= 0.6 * persistence


def test_the_floor_is_the_spread_after_the_cut(utn17: Network, tmp_path: Path) -> None:
    bridge.run(scenario(demand=0.8, seed=5, hours=0.3), tmp_path / "run")
    spread = floor.spread(utn17, tmp_path / "run", [2, 5], 2, 4)
    assert spread.shape == (4, 17)
    assert np.isfinite(spread).all()
    assert (spread.mean(axis=1) > 0.2).all()
    log = recording.read_log(tmp_path / "run")
    stacked = Log.stack([log, log])
    assert rmse(stacked.x_veh).shape == (9, 17)


@pytest.mark.long
def test_mismatch_and_calibrate_work_from_the_command_line(tmp_path: Path) -> None:
    runner = CliRunner()
    common = ["--demand", "0.8", "--hours", "0.4"]
    done = runner.invoke(cli, ["calibrate", *common, "--seeds", "11", "--out", str(tmp_path / "calibrated")])
    assert done.exit_code == 0, done.output
    fitted = tmp_path / "calibrated" / "calibration.json"
    options = ["--seeds", "2", "--horizon", "3", "--no-floor", "--calibration", str(fitted), "--json"]
    done = runner.invoke(cli, ["mismatch", *common, *options, "--out", str(tmp_path / "mismatch")])
    assert done.exit_code == 0, done.output
    (result,) = json.loads(done.stdout)
    for key in ("rmse_veh", "bias_veh", "rmse_over_persistence", "rmse_over_history"):
        assert len(result[key]) == 3
        assert len(result["links"]["17"][key]) == 3
    plots = sorted(path.name for path in (tmp_path / "mismatch").glob("*.png"))
    assert plots == ["demand0.8-horizon.png", "demand0.8-links.png", "demand0.8-scatter.png"]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--step", "7"], "'step_s' is 7"),
        (["--step", "0"], "'step_s' is 0"),
        (["--inputs", "guessed"], "'inputs' is 'guessed'"),
        (["--turning", "guessed"], "'turning' is 'guessed'"),
        (["--horizon", "0"], "'horizon' is '0'"),
        (["--seeds", "two"], "'seeds' is 'two'"),
        (["--demand", "much"], "'demand' is 'much'"),
    ],
)
def test_a_mistake_of_a_study_names_the_setting(tmp_path: Path, options: list[str], complaint: str) -> None:
    done = CliRunner().invoke(cli, ["mismatch", "--hours", "0.4", *options, "--out", str(tmp_path / "out")])
    assert complaint in str(done.exception)
    assert not (tmp_path / "out").exists()
