"""Which recorded runs forecasts are judged over: alike but for their seeds, each once."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

import utn_network
from utn_sumo import recording
from utn_sumo.errors import SettingError
from utn_sumo.forecast_report import check_alike
from utn_sumo.scenario import scenario


def recorded(folder: Path, name: str, net: str = "utn17", **given: Any) -> Path:
    """What a run's folder holds of its scenario and net."""
    (folder / name).mkdir()
    said = {"scenario": scenario(net=net, **given).model_dump()}
    recording.write_json(folder / name / recording.SETTINGS, said)
    shutil.copyfile(utn_network.net_file(net), folder / name / recording.NET)
    return folder / name


def test_runs_that_differ_by_their_seeds_are_judged_together_wherever_they_lie(tmp_path: Path) -> None:
    check_alike([recorded(tmp_path, str(seed), seed=seed, demand=0.3) for seed in (1, 2, 3)])


@pytest.mark.parametrize(
    ("first", "other", "says"),
    [
        ({"seed": 1, "demand": 0.3}, {"seed": 2, "demand": 1.5}, "has demand 1.5, and"),
        ({"seed": 1, "noise": 0.3}, {"seed": 2}, "has noise 0.0, and"),
        ({"seed": 1}, {"seed": 2, "net": "utn17-long"}, "are of two nets"),
        ({"seed": 4}, {"seed": 4}, "have one seed, 4"),
    ],
    ids=["demand", "noise", "net", "seed"],
)
def test_others_are_refused_by_name(tmp_path: Path, first: dict[str, Any], other: dict[str, Any], says: str) -> None:
    runs = [recorded(tmp_path, "a", **first), recorded(tmp_path, "b", **other)]
    with pytest.raises(SettingError, match=says) as caught:
        check_alike(runs)
    assert all(repr(str(run)) in str(caught.value) for run in runs)


def test_one_run_given_twice_is_not_two(tmp_path: Path) -> None:
    run = recorded(tmp_path, "a")
    with pytest.raises(SettingError, match="have one seed"):
        check_alike([run, run])
