"""What a .sumocfg says of records: every vehicle is on ours, and nothing of other people is written over."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from tests.integration import odd_nets

from utn_sumo import bridge, case, importing, metrics, replay
from utn_sumo.scenario import scenario
from utn_sumo.sumo_tools import sumo_binary

CONTROLLERS = ("native", "fixed")


@pytest.fixture
def crossroads(tmp_path: Path) -> Path:
    folder = tmp_path / "town"
    folder.mkdir()
    odd_nets.row("C").net(folder, odd_nets.NO_TURNAROUNDS)
    return folder


def ran(file: Path, folder: Path, controller: str) -> dict[str, Any]:
    return bridge.run(scenario(net=str(file), controller=controller, hours=0.05), folder)


def vehicles(result: dict[str, Any]) -> int:
    return int(result["arrived"] + result["unfinished"])


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize(
    ("options", "said"),
    [
        # More than the road takes: the last would be dropped after a while.
        ({"max-depart-delay": "10"}, ""),
        ({"device.tripinfo.probability": "0.1"}, ""),
        ({"device.tripinfo.explicit": "dense.1"}, ""),
        ({}, '<param key="has.tripinfo.device" value="false"/>'),
        ({}, '<param key="device.tripinfo.probability" value="0"/>'),
    ],
)
def test_every_vehicle_is_measured(
    crossroads: Path, tmp_path: Path, options: dict[str, str], said: str, controller: str
) -> None:
    dense = odd_nets.flow("dense", "W-C", "C-E", type="car", period=1, end=150)
    routes = f'<vType id="car">{said}</vType>{dense}'
    result = ran(odd_nets.case(crossroads, routes, options=options), tmp_path / "run", controller)
    assert (vehicles(result), result["left_out_veh"]) == (150, 0)


def test_who_has_other_devices_stays_the_same(crossroads: Path) -> None:
    drawn = {"device.tripinfo.probability": "0.1", "device.rerouting.probability": "0.5"}
    file = odd_nets.case(crossroads, odd_nets.traffic("C"), options=drawn)
    arguments = case.read(file).arguments([])

    def devices(name: str, *words: str) -> dict[str, str]:
        out = crossroads / name
        subprocess.run(
            [
                sumo_binary("sumo"),
                *(*words, "--tripinfo-output", out, "--tripinfo-output.write-unfinished"),
                "--no-step-log",
            ],
            check=True,
            capture_output=True,
        )
        return {trip.attrib["id"]: trip.attrib["devices"] for trip in ET.parse(out).iter("tripinfo")}

    bare, ours = devices("bare.xml", "-c", str(file)), devices("ours.xml", *arguments)
    assert 0 < len(bare) < len(ours)
    assert bare.items() <= ours.items()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_who_is_taken_off_the_road_has_not_arrived(crossroads: Path, tmp_path: Path, controller: str) -> None:
    broken = '<trip id="broken" depart="0" from="W-C" to="C-E"><stop lane="W-C_0" endPos="150" duration="900"/></trip>'
    behind = odd_nets.flow("behind", "W-C", "C-E", begin=1, end=100)
    options = {"time-to-teleport": "20", "time-to-teleport.remove": "true"}
    result = ran(odd_nets.case(crossroads, broken + behind, options=options), tmp_path / "run", controller)
    assert result["teleports"] > 3
    assert (result["arrived"], vehicles(result)) == (0, 8)
    assert result["mean_travel_time_s"] == 0
    assert result["total_delay_veh_h"] > 0


# name: (options, what a type says, additional file)
ASKED: dict[str, tuple[dict[str, str], str, str]] = {
    "states of the net": ({"netstate-dump": "mine.xml", "netstate-dump.precision": "3"}, "", ""),
    "states of the net by another name": ({"netstate": "mine.xml"}, "", ""),
    "sums and trips by other names": ({"summary": "mine.xml", "tripinfo": "mine.xml", "vehroutes": "mine.xml"}, "", ""),
    "states": ({"save-state.times": "50", "save-state.files": "mine.xml"}, "", ""),
    "conflicts": ({"device.ssm.probability": "1", "device.ssm.file": "mine.xml"}, "", ""),
    "conflicts of a type": (
        {},
        '<param key="has.ssm.device" value="true"/><param key="device.ssm.file" value="mine.xml"/>',
        "",
    ),
    "conflicts in no file in particular": ({}, '<param key="has.ssm.device" value="true"/>', ""),
    "a detector, spaced out": (
        {},
        "",
        '<inductionLoop id="own" lane="W-C_0" pos="9" period="60" file = "mine.xml"/>',
    ),
    "a detector, on two lines": (
        {},
        "",
        '<inductionLoop id="own" lane="W-C_0" pos="9" period="60" file\n="mine.xml"/>',
    ),
    "a signal's own detectors": (
        {},
        "",
        '<tlLogic id="C" type="actuated" programID="own" offset="0"><param key="file" value="mine.xml"/>'
        + "".join(
            f'<phase duration="{lasts}" minDur="5" maxDur="50" state="{state}"/>'
            for lasts, state in odd_nets.TWO_STAGES
        )
        + "</tlLogic>",
    ),
}


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("asked", ASKED.values(), ids=ASKED.keys())
def test_files_of_other_people_stay_as_they_are(
    crossroads: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    asked: tuple[dict[str, str], str, str],
    controller: str,
) -> None:
    options, said, added = asked
    monkeypatch.chdir(crossroads)
    routes = f'<vType id="car">{said}</vType>{odd_nets.traffic("C", type="car")}'
    file = odd_nets.case(crossroads, routes, options=options)
    if added:
        # As it is written: a tree has it in one way only.
        (crossroads / "odd.add.xml").write_text(f"<additional>{added}</additional>", encoding="utf-8")
        text = file.read_text(encoding="utf-8")
        file.write_text(text.replace("<begin", '<additional-files value="odd.add.xml"/><begin'), encoding="utf-8")
    (crossroads / "mine.xml").write_text("precious", encoding="utf-8")
    before = {path.name: path.read_bytes() for path in crossroads.iterdir()}
    ran(file, tmp_path / "run", controller)
    configuration = replay.write(tmp_path / "run")
    subprocess.run([sumo_binary("sumo"), "-c", str(configuration)], check=True, capture_output=True)
    (tmp_path / "imported").mkdir()
    importing.write(importing.read(file), tmp_path / "imported")
    assert {path.name: path.read_bytes() for path in crossroads.iterdir()} == before
    written = {path.name for path in (tmp_path / "run").rglob("*")}
    assert not {name for name in written if name == "NUL" or name.startswith("ssm")}


def test_a_net_whose_signals_write_files_is_mended_too(
    crossroads: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(crossroads)
    logic = odd_nets.tl_logic("C", odd_nets.TWO_STAGES)
    logic.set("type", "actuated")
    logic[0].attrib |= {"minDur": "5", "maxDur": "50"}
    logic.insert(0, ET.Element("param", key="file", value="mine.xml"))
    odd_nets.retime(crossroads / odd_nets.NET, logic)
    file = odd_nets.case(crossroads, odd_nets.traffic("C"))
    before = {path.name: path.read_bytes() for path in crossroads.iterdir()}
    ran(file, tmp_path / "run", "native")
    assert {path.name: path.read_bytes() for path in crossroads.iterdir()} == before


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("options", [{"remote-port": "8813", "num-clients": "1"}, {"human-readable-time": "true"}])
def test_options_that_would_stop_a_run_are_left_out_of_it_and_of_its_replay(
    crossroads: Path, tmp_path: Path, options: dict[str, str], controller: str
) -> None:
    plain = odd_nets.case(crossroads, odd_nets.traffic("C"))
    ran(plain, tmp_path / "plain", controller)
    file = odd_nets.case(crossroads, odd_nets.traffic("C"), options=options)
    assert case.read(file).options == ()
    ran(file, tmp_path / "run", controller)
    configuration = replay.write(tmp_path / "run")
    subprocess.run([sumo_binary("sumo"), "-c", str(configuration)], check=True, capture_output=True, timeout=60)
    kept = [
        metrics.trip_measures(path)
        for path in (
            tmp_path / "plain" / "trips.xml",
            tmp_path / "run" / "trips.xml",
            configuration.parent / "trips.xml",
        )
    ]
    assert kept[0] == kept[1] == kept[2]
