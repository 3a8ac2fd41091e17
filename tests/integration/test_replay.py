"""A recorded run, given to SUMO alone, happens again."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from utn_sumo import bridge, replay
from utn_sumo.bridge import Progress
from utn_sumo.errors import ResultError
from utn_sumo.scenario import scenario
from utn_sumo.sumo_tools import sumo_binary


def trips(path: Path) -> dict[str, dict[str, str]]:
    return {str(trip.get("id")): dict(trip.attrib) for trip in ET.parse(path).iter("tripinfo")}


def stopping_after(cycles: int) -> Callable[[Progress], None]:
    def on_cycle(progress: Progress) -> None:
        if progress.time_s >= 120 * cycles:
            raise KeyboardInterrupt

    return on_cycle


@pytest.mark.parametrize("stopped_after", [None, 4], ids=["whole", "stopped early"])
def test_bare_sumo_replays_a_run_vehicle_for_vehicle(tmp_path: Path, stopped_after: int | None) -> None:
    folder = tmp_path / "run"
    result = bridge.run(scenario(hours=0.5), folder, stopping_after(stopped_after) if stopped_after else None)
    assert result["interrupted"] is (stopped_after is not None)

    configuration = replay.write(folder)
    subprocess.run([str(sumo_binary("sumo")), "-c", str(configuration)], check=True, capture_output=True)

    recorded, replayed = trips(folder / "trips.xml"), trips(configuration.with_name("trips.xml"))
    assert len(recorded) > 300
    assert replayed == recorded

    with pytest.raises(ResultError, match="there already"):
        replay.write(folder)


@pytest.mark.parametrize(
    "content",
    [{}, {"settings.json": "{}"}, {"settings.json": "no JSON"}],
    ids=["empty", "settings of something else", "settings that are no JSON"],
)
def test_a_folder_that_is_no_run_is_refused_and_left_alone(tmp_path: Path, content: dict[str, str]) -> None:
    for name, text in content.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(ResultError, match="give a folder that `utn run` wrote") as caught:
        replay.write(tmp_path)
    assert "\n" not in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == set(content)
