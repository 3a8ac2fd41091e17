"""The paper's comparison: the table and the figures come out, violations are counted, and the reason shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from utn_sumo import controllers, paper
from utn_sumo.cli import main
from utn_sumo.contract import Network

SHORT = ("paper", "--no-sumo", "--hours", "0.2", "--demand", "1.0")


def measured(network: Network, **given: Any) -> dict[str, dict[str, Any]]:
    runs = paper.runs([given.pop("demand", 1.0)], in_sumo=False, **given)
    return {run.variant.name: paper.on_model(network, run.scenario)[0] for run in runs}


def test_a_controller_without_constraints_loses_and_the_same_with_them_does_not(utn17_long: Network) -> None:
    found = measured(utn17_long, hours=1.5, seed=2)
    dropped, scaled, kept, distributed = (
        found[name]["total_time_spent_veh_h"] for name in ("cmpc-dropped", "cmpc-scaled", "cmpc", "dmpc")
    )
    assert dropped > 1.04 * distributed
    assert kept < 1.003 * distributed
    # What it loses by is the green that it leaves unused.
    assert scaled < 1.005 * distributed


def test_what_cannot_be_shown_is_counted(utn17_long: Network) -> None:
    found = measured(utn17_long, hours=0.2, seed=1)
    assert [found[name]["unfit_cycles"] for name in ("cmpc-dropped", "cmpc-scaled", "cmpc", "dmpc")] == [6, 0, 0, 0]
    assert found["cmpc-dropped"]["unfilled_junction_cycles"] == 6 * 8
    assert found["dmpc"]["short_green_junction_cycles"] == 0


def test_a_run_of_the_model_adds_up(utn17_long: Network) -> None:
    (run,) = (each for each in paper.runs([1.3], in_sumo=False, hours=0.99, seed=3) if each.variant.name == "dmpc")
    result, log = paper.on_model(utn17_long, run.scenario)
    assert result["hours"] == 1.0
    assert log.true_x_veh.shape == (30, 1, 17)
    inside = (log.true_x_veh + log.true_waiting_veh)[-1].sum()
    assert result["unfinished"] == pytest.approx(inside)
    assert result["arrived"] + inside == pytest.approx(log.entered_veh[:, 0, utn17_long.is_source].sum())
    assert result["max_vehicles_veh"] >= log.true_x_veh.max()
    assert log.x_veh[1:] == pytest.approx(log.true_x_veh[:-1])


def test_who_waits_to_enter_counts_as_on_the_link(utn17_long: Network) -> None:
    (run,) = (each for each in paper.runs([1.0], in_sumo=False, hours=0.2) if each.variant.name == "dmpc")
    _, log = paper.on_model(utn17_long, run.scenario)
    log.true_x_veh[2:, 0, 3] = 900.0
    log.true_waiting_veh[4:, 0, 3] = 200.0
    loads = paper.loads(utn17_long, log)
    assert loads == {
        "max_vehicles_and_waiting_veh": 1100.0,
        "over_capacity_link_cycles": 2,
        "over_capacity_links": ["4"],
    }


def test_every_variant_is_one_that_the_registered_controllers_take(utn17_long: Network) -> None:
    for run in paper.runs([1.0], in_sumo=True):
        controller = controllers.build(run.scenario.controller, utn17_long, run.scenario.settings)
        assert controller.horizon == 7


@pytest.mark.long
def test_the_command_prints_the_papers_table_beside_ours_and_draws_the_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([*SHORT, "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert [word for word in ("paper's CMPC", "437 (-15.1%)", "1852.0", "3509.1", "5, 11") if word not in printed] == []
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"paper.json", *(f"macroscopic-demand1-{variant.name}.png" for variant in paper.VARIANTS)}


def test_json_is_one_list_of_objects_with_the_names_of_the_measures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([*SHORT, "--seed", "7", "--json", "--out", str(tmp_path / "out")])
    printed = json.loads(capsys.readouterr().out)
    assert [each["plant"] for each in printed] == ["paper"] * 2 + ["macroscopic"] * 4
    assert [each["variant"] for each in printed[2:]] == [variant.name for variant in paper.VARIANTS]
    for each in printed[2:]:
        assert (each["net"], each["demand"], each["seed"], each["hours"]) == ("utn17-long", 1.0, 7, 0.2)
        assert each["over_capacity_link_cycles"] == 0
    shared = set.intersection(*(set(each) for each in printed))
    assert {"max_queue_veh", "max_vehicles_veh", "total_time_spent_veh_h", "control_time_s", "controller"} <= shared
    assert json.loads((tmp_path / "out" / "paper.json").read_text(encoding="utf-8")) == {"results": printed}


def test_the_papers_changes_follow_from_its_figures() -> None:
    central, distributed = paper.PUBLISHED
    change = {
        key: distributed[key] / central[key] - 1
        for key in ("max_queue_veh", "max_vehicles_veh", "total_time_spent_veh_h", "control_time_s")
    }
    # 1497 to 815 is -45.56 %; the paper cuts it to -45.5.
    assert list(change.values()) == pytest.approx([-0.151, -0.4556, -0.143, -0.6], abs=5e-4)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--hours", "0"), "'hours' is '0'"),
        (("--seed", "abc"), "'seed' is 'abc'"),
        (("--demand", "1.0,much"), "'demand' is '1.0,much'"),
        (("--demand", "-1"), "'demand' is -1.0"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing_behind(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    line: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["paper", *arguments])
    told = capsys.readouterr()
    assert ended.value.code == 2
    assert told.out == ""
    assert line in told.err
    assert told.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_results_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "paper.json").write_text("precious", encoding="utf-8")
    with pytest.raises(SystemExit):
        main([*SHORT, "--out", str(tmp_path)])
    assert "name another" in capsys.readouterr().err
    assert (tmp_path / "paper.json").read_text(encoding="utf-8") == "precious"
