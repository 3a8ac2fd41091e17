"""A scenario is checked once: what is wrong is named with its value and what would be right, in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from utn_sumo.errors import SettingError
from utn_sumo.scenario import Scenario, flat, nested, scenario


def complaint(file: Path | None = None, **given: Any) -> str:
    with pytest.raises(SettingError) as caught:
        scenario(file, **given)
    line = str(caught.value)
    assert "\n" not in line
    return line


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("hours", 0, "greater than"),
        ("hours", -1, "greater than"),
        ("hours", 241, "less than or equal to 240"),
        ("hours", float("nan"), "240"),
        ("hours", "long", "a valid number"),
        ("demand", -0.1, "greater than or equal to 0"),
        ("demand", 11, "less than or equal to 10"),
        ("profile", "flat", "'peak', 'paper' or 'constant'"),
        ("noise", -1, "greater than or equal to 0"),
        ("noise", 3, "less than or equal to 2"),
        ("seed", -1, "greater than or equal to 0"),
        ("seed", 1.5, "a valid integer"),
        ("seed", 2**31, "less than or equal to 2147483647"),
        ("seed", "first", "a valid integer"),
        ("net", 17, "a valid string"),
        ("controller", None, "a valid string"),
    ],
)
def test_a_bad_value_is_named_with_its_setting_and_the_remedy(name: str, value: Any, remedy: str) -> None:
    line = complaint(**{name: value})
    assert f"setting {name!r} is {value!r}: it must be " in line
    assert remedy in line


def test_an_unknown_setting_is_answered_with_the_nearest_known_one() -> None:
    line = complaint(demnad=2)
    assert "'demnad' is unknown" in line
    assert "did you mean 'demand'?" in line


def test_a_run_too_short_to_last_a_second_is_refused() -> None:
    assert "hours" in complaint(hours=1e-4)


def test_settings_of_an_execution_are_a_table_of_their_own_or_named_as_its() -> None:
    table = {"rho": 0.3, "execution.gap_s": 3.0}
    chosen = scenario(execution="actuated", settings=nested(table))
    assert chosen.controller_settings == {"rho": 0.3}
    assert chosen.execution_settings == {"gap_s": 3.0}
    assert flat(chosen.settings) == table
    assert nested({"rho": 0.3}) == {"rho": 0.3}


def test_numbers_may_come_as_text_from_a_command_line() -> None:
    assert scenario(hours="0.5", demand="1.3", seed="7") == scenario(hours=0.5, demand=1.3, seed=7)


def test_hours_are_turned_into_seconds() -> None:
    assert scenario(hours=0.25).duration_s == 900


def test_nothing_given_means_the_papers_four_hours_of_the_distributed_mpc() -> None:
    default = scenario()
    assert (default.net, default.controller, default.hours, default.demand) == ("utn17", "dmpc", 4, 1)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "scenario.toml"
    path.write_text(
        'net = "utn17-long"\nhours = 2\ndemand = 1.3\nprofile = "paper"\nnoise = 0.1\nseed = 5\n'
        '[settings]\nhorizon = 5\ncost = "paper"\n',
        encoding="utf-8",
    )
    return path


KEYWORDS: dict[str, Any] = {
    "net": "utn17-long",
    "hours": 2,
    "demand": 1.3,
    "profile": "paper",
    "noise": 0.1,
    "seed": 5,
    "settings": {"horizon": 5, "cost": "paper"},
}


def test_a_file_and_keywords_say_the_same(file: Path) -> None:
    assert scenario(file) == scenario(**KEYWORDS) == Scenario(**KEYWORDS)


def test_what_is_given_beside_a_file_wins(file: Path) -> None:
    assert scenario(file, hours=1, settings={"horizon": 9}) == scenario(
        **{**KEYWORDS, "hours": 1, "settings": {"horizon": 9, "cost": "paper"}}
    )


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"hours = \n", "line 1"),
        (b"hours = 0\n", "'hours' is 0"),
        (b"huors = 1\n", "did you mean 'hours'?"),
        (b"\xff\xfe", "utf-8"),
        (b"settings = 3\n", "settings"),
        (b'settings = "horizon=5"\n', "settings"),
    ],
    ids=["not TOML", "bad value", "unknown setting", "not text", "settings are a number", "settings are a word"],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, content: bytes, word: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    assert word in complaint(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "none.toml" in complaint(tmp_path / "none.toml")
    assert str(tmp_path) in complaint(tmp_path)


def test_an_executions_settings_are_a_table_in_the_settings_and_flags_win(tmp_path: Path) -> None:
    file = tmp_path / "scenario.toml"
    file.write_text(
        'execution = "actuated"\n[settings]\nhorizon = 5\n[settings.execution]\ngap_s = 2\nother = 1\n',
        encoding="utf-8",
    )
    chosen = scenario(file, settings={"execution": {"gap_s": 4}, "cost": "paper"})
    assert chosen.execution == "actuated"
    assert chosen.execution_settings == {"gap_s": 4, "other": 1}
    assert chosen.controller_settings == {"horizon": 5, "cost": "paper"}
    assert scenario(file).execution_settings == {"gap_s": 2, "other": 1}


@pytest.mark.parametrize("name", ["hours", "demand", "seed", "refit_steps"])
def test_a_truth_is_no_number(name: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f"{name} = true", encoding="utf-8")
    with pytest.raises(SettingError, match=f"setting '{name}' is True: it must be a number"):
        scenario(file)
