"""`utn inspect`: what the bench makes of a net, as a table, as a picture, for programs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from utn_sumo import inspection
from utn_sumo.cli import cli
from utn_sumo.contract import Network

SCENARIOS = Path(__file__).parents[3] / "shared" / "scenarios"


def test_every_link_and_junction_is_told_with_its_numbers(utn17: Network) -> None:
    found = inspection.inspect(utn17)
    assert [each["id"] for each in found["junctions"]] == [f"J{n}" for n in range(1, 9)]
    assert [link for each in found["junctions"] for link in each["links"]] == [link.id for link in utn17.links]
    assert not any(each["refused"] for each in found["junctions"])
    assert found["left_alone"] == {}
    first = found["links"][0]
    assert first["is_source"]
    assert first["storage_veh"] == pytest.approx(104, abs=1)
    assert first["turns"] == {
        "10": {"next_link": "10", "fraction": pytest.approx(0.7)},
        "W1": {"next_link": None, "fraction": pytest.approx(0.3)},
    }


def test_who_never_has_green_is_told(utn17: Network) -> None:
    """As in programmes of joined nodes that somebody edited by hand."""
    first = utn17.junctions[0]
    letter = first.signal_turns.index(next(turns for turns in first.signal_turns if turns))

    def closed(state: str) -> str:
        return f"{state[:letter]}r{state[letter + 1 :]}"

    stages = [
        replace(stage, state=closed(stage.state), clearance=tuple((closed(each), s) for each, s in stage.clearance))
        if index in first.stages
        else stage
        for index, stage in enumerate(utn17.stages)
    ]
    found = inspection.inspect(replace(utn17, stages=tuple(stages)))["junctions"]
    assert [each["never_green"] for each in found] == [[letter], *[[]] * 7]


def test_the_command_prints_one_object_and_draws_a_map(tmp_path: Path) -> None:
    answer = CliRunner().invoke(cli, ["inspect", "utn17", "--out", str(tmp_path / "out"), "--json"])
    assert answer.exit_code == 0
    assert len(json.loads(answer.stdout)["links"]) == 17
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"inspection.json", "map.png"}
    assert (tmp_path / "out" / "map.png").read_bytes().startswith(b"\x89PNG")


def test_the_table_names_links_and_junctions(tmp_path: Path) -> None:
    answer = CliRunner().invoke(cli, ["inspect", "utn17", "--out", str(tmp_path / "out")])
    assert answer.exit_code == 0
    assert "J8" in answer.stdout
    assert "exit W1: 0.30" in answer.stdout


@pytest.mark.parametrize(
    ("net", "junctions", "refused"),
    [("cologne8/cologne8", 8, set()), ("ingolstadt7/ingolstadt7", 7, set())],
)
def test_other_people_s_nets_are_shown_too(net: str, junctions: int, refused: set[str], tmp_path: Path) -> None:
    path = SCENARIOS / f"{net}.net.xml"
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    answer = CliRunner().invoke(cli, ["inspect", str(path), "--out", str(tmp_path / "out"), "--json"])
    found = json.loads(answer.stdout)
    assert len(found["junctions"]) == junctions
    # Two lanes of one road that turn into one lane do not conflict.
    assert {each["id"] for each in found["junctions"] if each["refused"]} == refused
