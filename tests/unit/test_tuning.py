"""Tuning: ranges are what the settings allow, the search repeats itself, what it finds can be run."""

from __future__ import annotations

import json
import math
import random
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from utn_sumo import campaign, controllers, tuning
from utn_sumo.errors import SettingError, UtnError
from utn_sumo.scenario import scenario
from utn_sumo.search_space import Choice, Range, space

Delay = Callable[[dict[str, Any]], float]


@pytest.fixture
def plant(monkeypatch: pytest.MonkeyPatch) -> Callable[[Delay], list[dict[str, Any]]]:
    """Puts a function of the settings in the place of SUMO; runs take random times. Returns the runs as they begin."""

    def use(delay: Delay) -> list[dict[str, Any]]:
        begun: list[dict[str, Any]] = []
        clock = random.Random(time.time())

        def run(job: dict[str, Any]) -> dict[str, Any]:
            begun.append(job)
            time.sleep(clock.uniform(0, 0.004))
            found = delay(job)
            if math.isnan(found):
                return {campaign.FAILED: "it broke"}
            return {"total_delay_veh_h": found, "unsafe_signal_s": None, "fallbacks": 1, "teleports": 0}

        @contextmanager
        def started() -> Iterator[Callable[[dict[str, Any]], Future[dict[str, Any]]]]:
            with ThreadPoolExecutor(3) as threads:
                yield lambda job: threads.submit(run, job)

        monkeypatch.setattr(campaign, "started", started)
        return begun

    return use


def valley(job: dict[str, Any]) -> float:
    """Least delay at 20 s; a seed and a demand only scale it."""
    every_s = job["settings"].get("every_s", 5.0)
    return float(job["demand"] * (1 + job["seed"] / 10) * (100 + (every_s - 20) ** 2))


def task(controller: str = "max_wave", over: tuple[str, ...] = (), execution: str | None = None) -> tuning.Task:
    bases = [{"net": "utn17", "demand": demand, "hours": 2.0} for demand in (0.6, 1.3)]
    return tuning.Task(controller, space(controller, over, execution), bases, (1, 2, 3), execution)


def tune(folder: Path, wanted: tuning.Task, trials: int = 20, seed: int = 1) -> dict[str, Any]:
    folder.mkdir()
    return tuning.tune(wanted, trials, seed, folder, lambda: None)


@pytest.mark.parametrize(
    ("controller", "over", "known"),
    [
        ("max_wave", "every_s", Range(1, 60, whole=False)),
        ("max_wave", "every_s=2:30", Range(2.0, 30.0, whole=False)),
        ("max_wave", "every_s=5,10", Choice((5.0, 10.0))),
        ("max_pressure", "per", Choice(("lane", "storage", "none"))),
        ("max_pressure", "per=lane, none", Choice(("lane", "none"))),
        ("actuated", "max_green_s=20:90", Range(20, 90, whole=True)),
        ("delay_based", "detector_range_m", Range(10.0, 10_000, whole=False)),
        ("dmpc", "relaxation", Range(0.002, 1.998, whole=False)),
        ("dmpc", "rho=0.05:1", Range(0.05, 1.0, whole=False)),
        ("dmpc", "rho=null,0.2", Choice((None, 0.2))),
        ("dmpc", "horizon=3:10", Range(3, 10, whole=True)),
    ],
)
def test_where_a_setting_is_searched(controller: str, over: str, known: Range | Choice) -> None:
    name = over.partition("=")[0]
    (found,) = space(controller, [over]).searched.values()
    assert found == known
    model = space(controller, [over]).models[""]
    ends = found.values if isinstance(found, Choice) else (found.low, found.high)
    for value in ends:
        assert getattr(model(**{name: value}), name) == value


def test_without_a_word_all_numbers_with_both_bounds_are_searched() -> None:
    assert set(space("actuated").searched) == {"min_green_s", "max_green_s", "max_gap_s", "detector_gap_s"}
    assert set(space("priced").searched) == {"every_s"}
    assert space("max_pressure").left == ["count", "per"]
    assert space("tuc").searched == {"r": Range(1e-6, 1e3, whole=False)}
    assert space("fixed", execution="actuated").searched == {"execution.gap_s": Range(0.06, 60, whole=False)}
    both = space("dmpc", ("relaxation", "execution.gap_s=1:4"), "actuated")
    assert both.defaults == {"relaxation": 1.6, "execution.gap_s": 2.0}
    assert "horizon" in both.left
    assert both.refusal({"relaxation": 1.5, "execution.gap_s": 3.0}) is None
    assert "'gap_s' is 0" in str(both.refusal({"execution.gap_s": 0.0}))


def test_settings_that_do_nothing_beside_the_defaults_are_searched_only_where_they_are_named() -> None:
    searched = space("cmpc").searched
    assert {"crowding", "terminal"} <= set(searched)
    assert not {"q", "r"} & set(searched)
    named = space("cmpc", ("q=0.01:1", "cost"))
    assert named.refusal({"q": 0.5, "cost": "paper"}) is None
    assert "q does nothing where cost is 'tts'" in str(named.refusal({"q": 0.5, "cost": "tts"}))


def test_where_no_number_has_both_bounds_all_choices_are_searched() -> None:
    assert space("cyclic_max_pressure").searched == {
        "count": Choice(("queue", "vehicles")),
        "per": Choice(("lane", "storage", "none")),
    }


@pytest.mark.parametrize(
    ("controller", "over", "named"),
    [
        ("max_wav", (), "did you mean 'max_wave'"),
        ("native", (), "controller 'native' takes no settings"),
        ("actuated", ("max_gap_s=1:2", "max_gap_s=2:3"), "--over 'max_gap_s=2:3': 'max_gap_s' is there already"),
        ("fixed", (), "has no settings that say what they may be"),
        ("dmpc", ("execution.gap_s=1:3",), "has no setting 'execution.gap_s'"),
        ("max_wave", ("evry_s=1:2",), "did you mean 'every_s'"),
        ("max_wave", ("every_s=0:2",), "greater than or equal to 1"),
        ("max_wave", ("every_s=9:2",), "low:high"),
        ("max_wave", ("every_s=5:",), "valid number"),
        ("priced", ("horizon_s=5:Infinity",), "low:high"),
        ("max_pressure", ("count=near:waiting",), "take choices"),
        ("max_pressure", ("count=nearer",), "'waiting' or 'near'"),
        ("priced", ("crowding",), "crowding=low:high"),
        ("dmpc", ("horizon=1.5:3",), "integer"),
    ],
)
def test_a_range_that_can_not_be_searched_is_one_line(controller: str, over: tuple[str, ...], named: str) -> None:
    with pytest.raises(UtnError) as caught:
        space(controller, over)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_bounds_the_settings_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    unbounded = space("priced").models[""]
    monkeypatch.delitem(unbounded.model_fields, "every_s")
    with pytest.raises(SettingError, match=r"horizon_s, crowding, full.*--over horizon_s=1:10"):
        space("priced")


def test_the_search_finds_the_valley_and_repeats_itself_whatever_the_runs_take(
    tmp_path: Path, plant: Callable[[Delay], list[dict[str, Any]]]
) -> None:
    plant(valley)
    first, again, other = (tune(tmp_path / name, task(), seed=seed) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    assert first["trials"] == again["trials"]
    assert first["trials"] != other["trials"]
    assert abs(first["best"]["settings"]["every_s"] - 20) < 5
    known = valley({"demand": 1, "seed": 0, "settings": first["best"]["settings"]}) / 325
    assert first["best"]["ratio"] == pytest.approx(known)
    assert first["best"]["low"] == pytest.approx(known)
    assert first["best"]["alarms"] == 6
    lines = (tmp_path / "a" / tuning.TRIALS).read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines] == first["trials"]
    table = (tmp_path / "a" / tuning.TABLE).read_text(encoding="utf-8").splitlines()
    assert table[0] == "trial,ratio,every_s,alarms,state"
    assert table[1].startswith(f"{first['best']['trial']},")
    assert len(table) == 22


def test_poor_trials_are_cut_after_their_first_seed(
    tmp_path: Path, plant: Callable[[Delay], list[dict[str, Any]]]
) -> None:
    begun = plant(valley)
    found = tune(tmp_path / "out", task())
    cut = [trial for trial in found["trials"] if trial["state"] == tuning.CUT]
    assert cut
    assert len(begun) == 2 * (3 * len(found["trials"]) - 2 * len(cut))
    assert all(list(trial["ratio_by_seed"]) == ["1"] for trial in cut)
    assert min(trial["ratio"] for trial in cut) > found["best"]["ratio"]


@pytest.mark.parametrize("controller", ["max_pressure", "dmpc", "actuated"])
def test_the_best_can_be_run(tmp_path: Path, plant: Any, controller: str) -> None:
    over = {"max_pressure": ("per", "every_s"), "dmpc": ("rho=null,0.3", "horizon=2:9", "agents=here")}
    plant(lambda job: 50.0 if job["settings"] else 100.0)
    found = tune(tmp_path / "out", task(controller, over.get(controller, ())), trials=4)
    read = scenario(tmp_path / "out" / tuning.BEST)
    assert read.controller == controller
    assert read.settings == {name: value for name, value in found["best"]["settings"].items() if value is not None}
    space(controller).models[""](**read.settings)


def test_an_execution_and_its_settings_go_with_every_run_and_into_the_best(tmp_path: Path, plant: Any) -> None:
    begun = plant(lambda job: 50.0 if job["settings"] else 100.0)
    over = ("rho=0.1:1", "execution.gap_s=1:4")
    found = tune(tmp_path / "out", task("dmpc", over, "actuated"), trials=3)
    assert found["controller"] == "dmpc/actuated"
    assert {job["execution"] for job in begun} == {"actuated"}
    assert all(job["settings"].keys() in ({"rho", "execution"}, set()) for job in begun)
    read = scenario(tmp_path / "out" / tuning.BEST)
    assert (read.controller, read.execution) == ("dmpc", "actuated")
    assert read.controller_settings == {"rho": found["best"]["settings"]["rho"]}
    assert read.execution_settings == {"gap_s": found["best"]["settings"]["execution.gap_s"]}


def test_where_nothing_is_better_the_defaults_are_the_best(tmp_path: Path, plant: Any) -> None:
    plant(lambda job: 200.0 if job["settings"] else 100.0)
    found = tune(tmp_path / "out", task(), trials=3)
    assert found["best"]["settings"] == {}
    assert found["best"]["ratio"] == 1
    assert scenario(tmp_path / "out" / tuning.BEST).settings == {}


def test_settings_that_fail_or_do_not_go_together_are_told_and_the_search_goes_on(tmp_path: Path, plant: Any) -> None:
    plant(lambda job: math.nan if job["settings"].get("horizon", 7) > 8 else 100.0)
    found = tune(tmp_path / "out", task("dmpc", ("horizon=5:10", "control_horizon=4:8")), trials=20)
    states = {trial["state"] for trial in found["trials"]}
    assert "it broke" in states
    assert any("is beyond horizon" in state for state in states)
    assert found["best"]["state"] == tuning.WHOLE


def test_defaults_that_fail_end_it_with_their_reason(tmp_path: Path, plant: Any) -> None:
    plant(lambda _: math.nan)
    with pytest.raises(UtnError, match="max_wave fails with its defaults: it broke"):
        tune(tmp_path / "out", task())


def test_one_that_is_stopped_keeps_what_it_found(tmp_path: Path, plant: Any) -> None:
    plant(valley)
    (tmp_path / "out").mkdir()
    ticks = []

    def tick() -> None:
        ticks.append(1)
        if len(ticks) == 6:
            raise KeyboardInterrupt

    found = tuning.tune(task(), 20, 1, tmp_path / "out", tick)
    assert found["interrupted"]
    assert len(found["trials"]) == 6
    assert scenario(tmp_path / "out" / tuning.BEST).settings == found["best"]["settings"]


def test_without_optuna_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(SettingError, match=r"pip install 'utn-sumo\[tune\]'"):
        tuning.library()


@pytest.mark.parametrize("name", [name for name in controllers.registered() if name != "fixed"])
def test_every_registered_controller_can_be_tuned_as_it_is_or_as_its_refusal_says(name: str) -> None:
    try:
        found = space(name)
    except SettingError as error:
        found = space(name, [str(error).rpartition("--over ")[2]])
    assert found.distributions


def test_every_registered_execution_can_be_tuned() -> None:
    assert all(space("fixed", (), name).distributions for name in controllers.registered(controllers.EXECUTION))
