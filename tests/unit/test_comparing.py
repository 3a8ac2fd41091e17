"""Controllers against each other: intervals that mean what they say, and a record that a benchmark goes on from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

import comparing
import showing
from tests.integration import odd_nets
from utn_sumo import campaign, recording
from utn_sumo.errors import ResultError, SettingError, UtnError

DELAYS = st.lists(st.tuples(st.floats(10, 1000), st.floats(10, 1000)), min_size=3, max_size=10)


def result(delay: float, **more: Any) -> dict[str, Any]:
    usual = {
        "total_delay_veh_h": delay,
        "mean_delay_s": delay / 2,
        "total_time_spent_veh_h": delay + 100,
        "gridlock": False,
        "unsafe_signal_s": 0,
        "fallbacks": 0,
        "teleports": 0,
        "sumo_time_s": 2.0,
        "control_time_s": 0.5,
        "unfinished": 3,
        "left_alone": {},
        "fallback_reasons": [],
    }
    return {**usual, **more}


def runs(net: str = "utn17", **delays: list[Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Jobs and results of controllers at demand 1, a delay or a whole result for each seed."""
    pairs = [
        (
            {"net": net, "demand": 1.0, "controller": name, "seed": seed},
            each if isinstance(each, dict) else result(each),
        )
        for name, values in delays.items()
        for seed, each in enumerate(values, 1)
    ]
    return [job for job, _ in pairs], [found for _, found in pairs]


@given(DELAYS)
def test_the_interval_of_a_mean_is_student_s(pairs: list[tuple[float, float]]) -> None:
    values = [mine for mine, _ in pairs]
    assume(np.std(values) > 1e-6)
    mean, low, high = comparing.interval(values)
    known = stats.ttest_1samp(values, 0).confidence_interval(0.95)
    assert (mean, low, high) == pytest.approx((np.mean(values), known.low, known.high))


@given(DELAYS)
def test_a_ratio_lies_in_its_interval_as_long_as_the_runs_do_not_refute_it(pairs: list[tuple[float, float]]) -> None:
    mine, others = np.array(pairs).T
    assume(np.std(mine) > 1e-3)
    assume(np.std(others) > 1e-3)
    value, low, high = comparing.ratio(mine, others)
    refuted = stats.ttest_1samp(others, 0).pvalue < 0.05
    if low is None:
        assert not refuted
        return
    assert refuted
    assert low <= value <= high
    for end in (low, high):
        assume(np.std(mine - end * others) > 1e-3)
        assert stats.ttest_1samp(mine - end * others, 0).pvalue == pytest.approx(0.05, rel=1e-3)


def test_what_differs_from_seed_to_seed_alike_does_not_widen_the_interval_of_a_ratio() -> None:
    day = np.array([1.0, 2.0, 1.5, 3.0])
    assert comparing.ratio(60 * day, 80 * day) == pytest.approx((0.75, 0.75, 0.75))


def test_one_seed_has_no_interval_and_nothing_has_no_ratio() -> None:
    assert comparing.interval([5.0]) == (5.0, None, None)
    assert comparing.interval([]) == (None, None, None)
    assert comparing.ratio([5.0], [10.0]) == (0.5, None, None)
    assert comparing.ratio([5.0, 6.0], [0.0, 0.0]) == (None, None, None)


def test_the_first_controller_is_held_against_the_best_of_the_others() -> None:
    rows = comparing.figures(*runs(mine=[10, 12], slow=[40, 41], good=[20, 24]))
    assert [row["controller"] for row in rows] == ["mine", "slow", "good"]
    assert rows[0]["best_other"] == "good"
    assert rows[0]["ratio"] == pytest.approx(0.5)
    assert (rows[0]["mean"], rows[0]["median"], rows[0]["spent_mean"]) == (11, 11, 111)
    assert rows[0]["control_over_sumo"] == 0.25
    assert "ratio" not in rows[1]


def test_a_vehicle_s_delay_counts_in_somebody_s_own_scenario() -> None:
    (row,) = comparing.figures(*runs("town.sumocfg", mine=[10, 12]))
    assert (row["measure"], row["mean"]) == ("mean_delay_s", 5.5)


def test_a_failure_is_told_and_its_controller_is_no_rival() -> None:
    jobs, found = runs(mine=[10, 12], broken=[5, {campaign.FAILED: "no licence"}], slow=[40, 41])
    rows = comparing.figures(jobs, found)
    assert rows[0]["best_other"] == "slow"
    assert rows[1]["failed"] == {2: "no licence"}
    assert rows[1]["seeds"] == [1]
    assert showing.remarks(rows) == ["utn17, demand 1, broken: seeds 2 failed: no licence"]


def test_one_of_which_every_run_failed_leaves_the_others_their_tables_and_picture(tmp_path: Path) -> None:
    rows = comparing.figures(*runs(mine=[{campaign.FAILED: "x"}] * 2, other=[3, 4]))
    ((_, heads, cells),) = showing.tables(rows)
    assert all(len(row) == len(heads) for row in cells)
    assert "failed" in cells[0]
    (path,) = showing.draw(rows, tmp_path)
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "names", [("a/town.sumocfg", "b/a/town.net.xml", "a/town.sumocfg.net.xml"), ("a$_$b", "c$^$d")]
)
def test_every_net_has_a_picture_of_its_own_whatever_it_is_called(tmp_path: Path, names: tuple[str, ...]) -> None:
    rows = [row for name in names for row in comparing.figures(*runs(name, mine=[10, 12], other=[3, 4]))]
    pictures = showing.draw(rows, tmp_path)
    assert len(set(pictures)) == len(list(tmp_path.iterdir())) == len(names)


def test_alarms_are_added_up_and_what_is_not_known_is_not_zero() -> None:
    locked = result(10, gridlock=True, fallbacks=2, teleports=1, longest_red_s=70.0)
    alone = result(12, gridlock=None, unsafe_signal_s=None)
    jobs, found = runs(mine=[locked, result(11, gridlock=True, longest_red_s=90.0)], native=[alone, alone])
    mine, native = comparing.figures(jobs, found)
    assert (mine["gridlocked"], mine["fallbacks"], mine["teleports"], mine["longest_red_s"]) == (2, 2, 1, 90)
    assert native["gridlocked"] is None
    assert native["unsafe_signal_s"] is None
    assert "longest_red_s" not in native


def test_demands_and_hours_have_their_defaults_by_net_and_settings_may_come_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "best.toml"
    file.write_text('controller = "max_wave"\n[settings]\nevery_s = 7.0\n', encoding="utf-8")
    jobs = comparing.jobs(["utn17"], None, ["fixed", str(file)], [1, 2], None)
    assert [(job["controller"], job["seed"]) for job in jobs] == [
        ("fixed", 1),
        ("fixed", 2),
        ("max_wave", 1),
        ("max_wave", 2),
    ]
    assert {(job["demand"], job["hours"]) for job in jobs} == {(1.3, 2.0)}
    assert comparing.label(jobs[2]) == "max_wave (every_s=7.0)"


@pytest.mark.parametrize(
    ("name", "controller", "execution"),
    [
        ("dmpc", "dmpc", None),
        ("dmpc/actuated", "dmpc", "actuated"),
        ("fixed/exact", "fixed", "exact"),
        ("webster+offsets", "webster+offsets", None),
        ("FILE:Own", "FILE:Own", None),
        ("FILE:Own/priced", "FILE:Own", "priced"),
        ("fixed/FILE:Own", "fixed", "FILE:Own"),
        ("FILE:Own/FILE:Own", "FILE:Own", "FILE:Own"),
    ],
)
def test_a_controller_may_be_followed_by_its_execution(
    tmp_path: Path, name: str, controller: str, execution: str | None
) -> None:
    file = tmp_path / "own.py"
    file.write_text("class Own:\n    pass\n", encoding="utf-8")
    name, controller, known = (str(each).replace("FILE", str(file)) for each in (name, controller, execution))
    (job,) = comparing.jobs(["utn17"], None, [name], [1], None)
    assert (job["controller"], str(job.get("execution"))) == (controller, known)
    assert comparing.label(job) == name


def test_what_is_named_twice_is_run_and_counted_once() -> None:
    jobs = comparing.jobs(["utn17"], ["1", "1.0"], ["dmpc", "fixed", "dmpc"], [1, 2], None)
    assert [(job["controller"], job["seed"]) for job in jobs] == [("dmpc", 1), ("dmpc", 2), ("fixed", 1), ("fixed", 2)]


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("[settings]\n", "is the same as 'dmpc': name one of them"),
        ('forecast = "last"\n', "has forecast = 'last': .* takes controller, execution, settings alone, leave it out"),
        ("loop_error = 0.2\n[settings]\nrho = 0.3\n", "has loop_error = 0.2: .* leave it out"),
    ],
)
def test_no_controller_of_a_file_is_lost_or_run_as_another(tmp_path: Path, more: str, says: str) -> None:
    file = tmp_path / "only.toml"
    file.write_text('controller = "dmpc"\n' + more, encoding="utf-8")
    with pytest.raises(SettingError, match=says) as caught:
        comparing.jobs(["utn17"], None, ["dmpc", str(file)], [1], None)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_s_execution_and_its_settings_are_kept_and_told(tmp_path: Path) -> None:
    file = tmp_path / "best.toml"
    lines = ['controller = "dmpc"', 'execution = "actuated"', "[settings]", "rho = 0.3", "execution.gap_s = 3.0"]
    file.write_text("\n".join(lines), encoding="utf-8")
    (job,) = comparing.jobs(["utn17"], None, [str(file)], [1], None)
    assert job["settings"] == {"rho": 0.3, "execution": {"gap_s": 3.0}}
    assert comparing.label(job) == "dmpc/actuated (rho=0.3, execution.gap_s=3.0)"


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"names": ["fxed"]}, "'fxed'"),
        ({"names": ["fxed/actuated"]}, "controller 'fxed'"),
        ({"names": ["fixed/actuatd"]}, "execution 'actuatd'"),
        ({"names": ["fixed/"]}, "execution ''"),
        ({"names": ["native/actuated"]}, "leave it out"),
        ({"nets": ["utn71"]}, "'utn71'"),
        ({"demands": ["much"]}, "'much'"),
        ({"hours": 0.0}, "'hours' is 0.0"),
    ],
)
def test_what_can_not_be_run_is_named_before_anything_is(given: dict[str, Any], named: str) -> None:
    usual: dict[str, Any] = {"nets": ["utn17"], "demands": None, "names": ["fixed"], "seeds": [1], "hours": None}
    with pytest.raises(UtnError, match=named):
        comparing.jobs(**usual | given)


def recorded(jobs: list[dict[str, Any]], found: list[dict[str, Any]]) -> list[str]:
    """The lines of a record."""
    return [json.dumps({**line, "result": each}) for line, each in zip(comparing.opened(jobs), found, strict=True)]


def test_what_a_record_holds_is_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs, found = runs(mine=[10, 12], other=[20, 24])
    record = tmp_path / "runs.jsonl"
    lines = recorded(jobs, found)
    record.write_text("\n".join(reversed(lines)) + "\n", encoding="utf-8")
    monkeypatch.setattr(campaign, "_alone", lambda _: pytest.fail("nothing is left to run"))
    assert comparing.results(jobs, 1, record, lambda: None) == found
    assert len(record.read_text(encoding="utf-8").splitlines()) == 4


def test_a_line_that_was_cut_short_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs, found = runs(mine=[10, 12])
    record = tmp_path / "runs.jsonl"
    lines = recorded(jobs, found)
    record.write_text(lines[0] + "\n" + lines[1][:30], encoding="utf-8")
    started: list[Any] = []
    monkeypatch.setattr(campaign, "_alone", lambda job: started.append(job) or result(12))
    assert comparing.results(jobs, 1, record, lambda: None) == found
    assert started == [jobs[1]]
    assert record.read_text(encoding="utf-8").splitlines() == lines


@pytest.mark.parametrize("changed", ["odd.sumocfg", "odd.rou.xml", "net.net.xml", "net.turns.xml", "own.py"])
def test_what_was_made_from_files_that_have_changed_is_run_again_and_stays_on_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    odd_nets.case(tmp_path, odd_nets.traffic("C"))
    own = tmp_path / "own.py"
    own.write_text("class Mine:\n    pass\n", encoding="utf-8")
    job = {"net": str(tmp_path / "odd.sumocfg"), "demand": 1.0, "controller": f"{own}:Mine", "seed": 1}
    utn17 = {"net": "utn17", "demand": 1.0, "controller": "fixed", "seed": 1}
    record, started = tmp_path / "runs.jsonl", []
    monkeypatch.setattr(campaign, "_alone", lambda job: started.append(job) or result(10 * len(started)))

    def delays() -> list[float]:
        found = comparing.results([utn17, job], 1, record, lambda: None)
        return [each["total_delay_veh_h"] for each in found]

    assert delays() == delays() == [10, 20]
    file = tmp_path / changed
    before = file.read_bytes() if file.exists() else None
    file.write_bytes((before or b"<edgeRelations/>") + b"\n")
    assert delays() == delays() == [10, 30]
    assert started == [utn17, job, job]
    if before is not None:
        file.write_bytes(before)
        assert delays() == [10, 20]


def test_what_other_code_has_run_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs, _ = runs(mine=[10])
    started: list[Any] = []
    monkeypatch.setattr(campaign, "_alone", lambda job: started.append(job) or result(10))
    monkeypatch.setattr(recording, "versions", lambda _: {"libsumo": "1.27.0"})
    comparing.results(jobs, 1, tmp_path / "runs.jsonl", lambda: None)
    monkeypatch.undo()
    monkeypatch.setattr(campaign, "_alone", lambda job: started.append(job) or result(10))
    for _ in range(2):
        comparing.results(jobs, 1, tmp_path / "runs.jsonl", lambda: None)
    assert len(started) == 2


def test_a_line_that_does_not_tell_its_files_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs, found = runs(mine=[10])
    record = tmp_path / "runs.jsonl"
    line = json.dumps({"job": jobs[0], "result": found[0]})
    record.write_text(line + "\n", encoding="utf-8")
    monkeypatch.setattr(campaign, "_alone", lambda _: result(12))
    assert comparing.results(jobs, 1, record, lambda: None) == [result(12)]
    assert record.read_text(encoding="utf-8").splitlines()[0] == line


@pytest.mark.parametrize("content", ["precious", "precious\n", '{"a": 1}\n', "[]\n", "\xff\xfe"])
def test_a_file_of_something_else_is_refused_and_stays(tmp_path: Path, content: str) -> None:
    record = tmp_path / "mine.txt"
    record.write_bytes(content.encode("latin-1"))
    with pytest.raises(ResultError, match="name another with --out"):
        comparing.read(record)
    assert record.read_bytes() == content.encode("latin-1")


@pytest.mark.parametrize(
    ("text", "known"), [("1-3,7", [1, 2, 3, 7]), ("5", [5]), ("2,1", [2, 1]), (" 1 - 2 , 2-3", [1, 2, 3])]
)
def test_seeds_are_numbers_and_ranges(text: str, known: list[int]) -> None:
    assert campaign.seeds(text) == known


@pytest.mark.parametrize("text", ["", "3-1", "a", "1,", "-1", "1.5", "1-"])
def test_other_seeds_are_refused_by_name(text: str) -> None:
    with pytest.raises(UtnError, match="'seeds' is"):
        campaign.seeds(text)
