"""The nets that settings are found on: the same traffic every time, controlled as any other, none made twice."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

import tuning_nets
from utn_sumo import bridge, cli
from utn_sumo.errors import ResultError
from utn_sumo.scenario import scenario


@pytest.fixture(scope="module")
def walkers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tuning_nets.write("walkers", tmp_path_factory.mktemp("nets") / "walkers")


def test_the_traffic_is_the_same_every_time(walkers: Path, tmp_path: Path) -> None:
    again = tuning_nets.write("walkers", tmp_path / "again")
    trips = [file.with_name("walkers.trips.xml").read_bytes() for file in (walkers, again)]
    assert trips[0] == trips[1]
    assert trips[0].count(b"<trip ") > 1000
    assert trips[0].count(b"<person ") > 200


def test_every_signal_is_controlled(walkers: Path, tmp_path: Path) -> None:
    said = CliRunner().invoke(cli.cli, ["inspect", str(walkers), "--out", str(tmp_path / "seen")])
    assert said.exit_code == 0, said.output
    assert "yes" in said.output
    result = bridge.run(scenario(net=str(walkers), controller="recommended", hours=0.1, seed=1), tmp_path / "run")
    assert result["left_alone"] == {}
    assert (result["unsafe_signal_s"], result["fallbacks"]) == (0, 0)
    assert result["arrived"] > 20


def test_the_street_is_written_for_netconvert(tmp_path: Path) -> None:
    assert tuning_nets.write("street", tmp_path / "street").read_text(encoding="utf-8").count("street.rou.xml") == 1


def test_nothing_is_overwritten(walkers: Path) -> None:
    with pytest.raises(ResultError):
        tuning_nets.write("walkers", walkers.parent)
