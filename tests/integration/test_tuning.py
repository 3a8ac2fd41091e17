"""`utn tune` from the command line: what it finds is what a run with it measures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from utn_sumo import campaign, cli
from utn_sumo.scenario import scenario


@pytest.mark.long
def test_a_short_search_finds_settings_that_are_worth_what_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tuned"
    where = ("--demands", "1.0", "--hours", "0.2", "--seeds", "4", "--trials", "2", "--over", "every_s=2:30")
    cli.main(["tune", "max_wave", *where, "--out", str(out)])
    printed = capsys.readouterr().out
    assert f"run it with  utn run --scenario {out / 'best.toml'}" in printed
    trials = [json.loads(line) for line in (out / "trials.jsonl").read_text(encoding="utf-8").splitlines()]
    assert len(trials) == 3
    best = scenario(out / "best.toml", hours=0.2, seed=4)
    least = min(trials, key=lambda trial: trial["ratio"])
    assert best.settings == least["settings"]
    again = {"hours": 0.2, "seed": 4, "controller": "max_wave"}
    tuned, usual = (campaign.measures({**again, "settings": settings}) for settings in (best.settings, {}))
    assert tuned["total_delay_veh_h"] / usual["total_delay_veh_h"] == pytest.approx(least["ratio"])
