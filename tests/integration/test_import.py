"""`utn import`: somebody else's scenario as a folder that anybody can run, wherever it lies."""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from click.testing import CliRunner
from tests.integration import odd_nets

from utn_sumo import bridge, case, importing, network
from utn_sumo.cli import cli
from utn_sumo.contract import Network
from utn_sumo.scenario import scenario
from utn_sumo.sumo_tools import sumo_binary

SCENARIOS = Path(__file__).parents[3] / "shared" / "scenarios"
LOOP = '<e1Detector id="mine" lane="10_0" pos="5" freq="60" file="counts.xml"/>'


@pytest.fixture
def scattered(town: Path, utn17: Network) -> Path:
    """The town with its files all over the place: a compressed net, two route files of one name, an include, a
    detector that writes a file, and an additional file under a name of ours.
    """
    folder = town.parent
    for name in ("nets", "cars", "buses", "more"):
        (folder / name).mkdir()
    with gzip.open(folder / "nets" / "town.net.xml.gz", "wb") as file:
        file.write(utn17.net_file.read_bytes())
    shutil.move(folder / "town.rou.xml", folder / "cars" / "routes.rou.xml")
    (folder / "more" / "types.xml").write_text('<routes><vType id="bus" vClass="bus"/></routes>', encoding="utf-8")
    (folder / "buses" / "routes.rou.xml").write_text(
        '<routes><include href="../more/types.xml"/>'
        '<flow id="bus" type="bus" begin="21600" end="22500" period="90"><route edges="1 W1"/></flow></routes>',
        encoding="utf-8",
    )
    (folder / "more" / "detectors.add.xml").write_text(f"<additional>{LOOP}</additional>", encoding="utf-8")
    text = town.read_text(encoding="utf-8")
    text = text.replace("town.rou.xml", "cars/routes.rou.xml,buses/routes.rou.xml")
    text = text.replace(str(utn17.net_file), "nets/town.net.xml.gz")
    text = text.replace("</input>", '<additional-files value="more/detectors.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")
    return town


def trips(path: Path) -> dict[str, dict[str, str]]:
    return {trip.attrib["id"]: dict(trip.attrib) for trip in ET.parse(path).iter("tripinfo")}


def imported(file: Path, out: Path, *more: str) -> dict[str, Any]:
    answer = CliRunner().invoke(cli, ["import", str(file), "--out", str(out), "--json", *more], catch_exceptions=False)
    assert answer.exit_code == 0, answer.output
    return dict(json.loads(answer.stdout))


def same_trips(original: Path, copy: Path, tmp_path: Path, controller: str, **settings: Any) -> None:
    for file, name in ((original, "original"), (copy, "copy")):
        bridge.run(scenario(net=str(file), controller=controller, **settings), tmp_path / name)
    assert trips(tmp_path / "copy" / "trips.xml") == trips(tmp_path / "original" / "trips.xml")


@pytest.mark.long
@pytest.mark.parametrize("controller", ["native", "fixed", "dmpc"])
def test_the_import_gives_the_trips_of_the_original_vehicle_for_vehicle(
    scattered: Path, tmp_path: Path, controller: str
) -> None:
    imported(scattered, tmp_path / "own")
    files = {path.name for path in (tmp_path / "own").iterdir()}
    same_trips(scattered, tmp_path / "own" / "scenario.sumocfg", tmp_path, controller, hours=0.1)
    # Runs leave it as it was: what its detectors count is not written.
    assert {path.name for path in (tmp_path / "own").iterdir()} == files


def test_it_needs_nothing_that_lies_outside_of_it(scattered: Path, tmp_path: Path) -> None:
    result = imported(scattered, tmp_path / "own")
    elsewhere = tmp_path / "else" / "where"
    shutil.copytree(tmp_path / "own", elsewhere)
    shutil.rmtree(tmp_path / "own")
    for name in ("nets", "cars", "buses", "more"):
        shutil.rmtree(tmp_path / name)
    assert sorted(result["files"].values()) == [
        *("detectors-2.add.xml", "routes-2.rou.xml", "routes.rou.xml", "town.net.xml.gz", "types.xml"),
    ]
    bridge.run(scenario(net=str(elsewhere / "scenario.sumocfg"), controller="dmpc", hours=0.1), tmp_path / "run")
    # SUMO alone runs it as well, with our detectors if they are asked for.
    for more in ([], ["--additional-files", str(elsewhere / "detectors.add.xml")]):
        command = [sumo_binary("sumo"), "-c", str(elsewhere / "scenario.sumocfg"), "--no-step-log", *more]
        subprocess.run(command, check=True, capture_output=True)


def test_window_step_teleport_and_options_are_kept_and_outputs_left_out(scattered: Path, tmp_path: Path) -> None:
    text = scattered.read_text(encoding="utf-8")
    scattered.write_text(text.replace("</configuration>", '<seed value="42"/></configuration>'), encoding="utf-8")
    imported(scattered, tmp_path / "own")
    kept, original = case.read(tmp_path / "own" / "scenario.sumocfg"), case.read(scattered)
    for name in ("begin_s", "end_s", "step_s", "teleport_s"):
        assert getattr(kept, name) == getattr(original, name)
    assert sorted(kept.options) == sorted(original.options)
    # The seed is for the bare SUMO: a run of ours has its own.
    assert kept.seeds == original.seeds == (("seed", "42"),)
    assert "theirs.xml" not in (tmp_path / "own" / "scenario.sumocfg").read_text(encoding="utf-8")


def test_turning_fractions_are_those_of_the_routes(scattered: Path, utn17: Network, tmp_path: Path) -> None:
    result = imported(scattered, tmp_path / "own")
    assert result["turns"].endswith("town.turns.xml")
    net = network.load(str(tmp_path / "own" / "town.net.xml.gz"))
    # The town's traffic is drawn from the shipped fractions; a hundred and more vehicles on a link are near to them.
    ours, theirs = ({(turn.link, turn.to_edge): turn.fraction for turn in each.turns} for each in (net, utn17))
    difference = np.array([ours[turn] - theirs[turn] for turn in theirs])
    assert 0 < np.abs(difference).mean() < 0.06


def test_what_lies_beside_the_net_comes_with_it(town: Path, utn17: Network, tmp_path: Path) -> None:
    result = imported(town, tmp_path / "own")
    for name in ("utn17.turns.xml", "utn17.calibration.json"):
        assert (tmp_path / "own" / name).read_bytes() == utn17.net_file.with_name(name).read_bytes()
    assert result["calibration"].endswith("utn17.calibration.json")
    same_trips(town, tmp_path / "own" / "scenario.sumocfg", tmp_path, "dmpc", hours=0.1)


def test_what_is_imported_has_no_section_that_sumo_takes_for_an_option(tmp_path: Path) -> None:
    odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    imported(odd_nets.case(tmp_path, odd_nets.traffic("C")), tmp_path / "own")
    command = [sumo_binary("sumo"), "-c", str(tmp_path / "own" / "scenario.sumocfg"), "--no-step-log", "--end", "1"]
    assert "Error" not in subprocess.run(command, check=True, capture_output=True, text=True).stderr


def test_a_state_and_weights_that_options_name_are_copied_too(town: Path, tmp_path: Path) -> None:
    state = tmp_path / "states" / "before.xml"
    state.parent.mkdir()
    command = [sumo_binary("sumo"), "-c", str(town), "--no-step-log", "--no-warnings", "--tripinfo-output", "NUL"]
    save = ["--save-state.times", "21700", "--save-state.files", str(state), "--end", "21701"]
    subprocess.run([*command, *save], check=True, capture_output=True)
    text = town.read_text(encoding="utf-8").replace("</input>", '<load-state value="states/before.xml"/></input>')
    town.write_text(text.replace("6:00:00", "21700"), encoding="utf-8")
    result = imported(town, tmp_path / "own")
    assert result["empty_at_begin"] is False
    assert (tmp_path / "own" / "before.xml").read_bytes() == state.read_bytes()
    same_trips(town, tmp_path / "own" / "scenario.sumocfg", tmp_path, "native")


def test_the_table_says_what_was_found_and_how_to_run_it(town: Path, tmp_path: Path) -> None:
    with (tmp_path / "town.rou.xml").open("r+", encoding="utf-8") as file:
        text = file.read()
        file.seek(0)
        file.write(text.replace("</routes>", '<trip id="t" depart="22499" from="1" to="10"/></routes>'))
    clash = '<phase duration="60" state="GGGGGG"/><phase duration="3" state="yyyyyy"/>'
    more = '<phase duration="50" state="rrrGGG"/><phase duration="7" state="rrryyy"/>'
    added = f'<additional><tlLogic id="J2" programID="b" type="static" offset="0">{clash}{more}</tlLogic></additional>'
    town.with_name("own.add.xml").write_text(added, encoding="utf-8")
    text = town.read_text(encoding="utf-8").replace("</input>", '<additional-files value="own.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")
    answer = CliRunner().invoke(cli, ["import", str(town), "--out", str(tmp_path / "own")])
    assert answer.exit_code == 0
    for words in (
        "from 21600 s to 22500 s, step 0.5 s, teleport after 120 s",
        "the roads are empty",
        "7: J1, J3",
        "left alone: J2",
        "conflict",
        "passenger",
        "without a route",
        "1: taken to go the fastest way",
        f"utn run {tmp_path / 'own' / 'scenario.sumocfg'}",
    ):
        assert words in answer.stdout, words
    assert json.loads((tmp_path / "own" / "model.json").read_text(encoding="utf-8"))["left_alone"].keys() == {"J2"}
    assert (tmp_path / "own" / "map.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize("name", ["cologne8/cologne8", "ingolstadt7/ingolstadt7", "bologna_acosta/run"])
def test_other_people_s_scenarios_run_as_they_did(name: str, tmp_path: Path) -> None:
    file = SCENARIOS / f"{name}.sumocfg"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    # What SUMO is told to write is written beside the scenario: not where others read it.
    shutil.copytree(file.parent, tmp_path / "theirs")
    file = tmp_path / "theirs" / file.name
    imported(file, tmp_path / "own")
    same_trips(file, tmp_path / "own" / "scenario.sumocfg", tmp_path, "fixed", hours=0.1)


@pytest.mark.long
def test_a_calibration_is_made_and_taken_without_asking(scattered: Path, tmp_path: Path) -> None:
    result = imported(scattered, tmp_path / "own", "--calibrate", "--seeds", "201")
    path = Path(result["calibration"])
    assert path == (tmp_path / "own" / "town.calibration.json").resolve()
    fitted = json.loads(path.read_text(encoding="utf-8"))
    assert set(fitted["links"]) == {str(link) for link in range(1, 18)}
    assert fitted["made_from"]["hours"] == pytest.approx(0.25, abs=0.04)
    assert importing.SCENARIO in fitted["made_from"]["net"]
    bridge.run(scenario(net=result["scenario"], controller="dmpc"), tmp_path / "run")
