"""Other people's scenarios under their own signals: measured by us as by the bare `sumo`."""

from __future__ import annotations

import gzip
import json
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner
from tests.integration import odd_nets

from utn_sumo import bridge, case, forecast_report, replay, streets, traffic
from utn_sumo.cli import cli
from utn_sumo.contract import Network
from utn_sumo.errors import PlantError, ResultError, SettingError
from utn_sumo.scenario import scenario
from utn_sumo.sumo_tools import sumo_binary

SCENARIOS = Path(__file__).parents[3] / "shared" / "scenarios"


def trips(path: Path) -> dict[str, tuple[str, ...]]:
    kept = ("depart", "departDelay", "duration", "timeLoss", "waitingCount", "arrival")
    return {trip.attrib["id"]: tuple(trip.attrib[key] for key in kept) for trip in ET.parse(path).iter("tripinfo")}


def by_bare_sumo(file: Path, folder: Path, seed: int) -> dict[str, tuple[str, ...]]:
    out = folder / "bare.xml"
    subprocess.run(
        [
            sumo_binary("sumo"),
            *("-c", str(file), "--seed", str(seed), "--no-step-log", "--no-warnings", "--tripinfo-output", str(out)),
            *("--tripinfo-output.write-unfinished", "--tripinfo-output.write-undeparted"),
        ],
        check=True,
        capture_output=True,
    )
    return trips(out)


def test_trips_are_those_of_the_bare_sumo_vehicle_for_vehicle(town: Path, tmp_path: Path) -> None:
    result = bridge.run(scenario(net=str(town), controller="native", seed=9), tmp_path / "run")
    bare = by_bare_sumo(town, tmp_path, 9)
    assert trips(tmp_path / "run" / "trips.xml") == bare
    delays = [float(departure) + float(loss) for _, departure, _, loss, _, _ in bare.values()]
    assert result["mean_delay_s"] == pytest.approx(sum(delays) / len(delays), rel=1e-6)
    assert result["hours"] == 0.25
    assert result["arrived"] + result["unfinished"] == len(bare)
    # Its own outputs are not written where its files are.
    assert not town.with_name("theirs.xml").exists()


def test_what_its_configuration_says_is_honoured_and_shown(town: Path, tmp_path: Path) -> None:
    found = case.read(town)
    assert (found.begin_s, found.end_s, found.teleport_s) == (21600, 22500, 120)
    assert ("step-length", "0.5") in found.options
    bridge.run(scenario(net=str(town), controller="native", hours=0.1), tmp_path / "run")
    shown = json.loads((tmp_path / "run" / "settings.json").read_text(encoding="utf-8"))["case"]
    assert (shown["begin_s"], shown["end_s"], shown["teleport_s"]) == (21600, 21960, 120)


def test_demand_scales_its_traffic(town: Path, tmp_path: Path) -> None:
    once, half = (
        bridge.run(scenario(net=str(town), controller="native", demand=scale), tmp_path / str(scale))
        for scale in (1.0, 0.5)
    )
    vehicles = [result["arrived"] + result["unfinished"] for result in (once, half)]
    assert vehicles[1] == pytest.approx(vehicles[0] / 2, rel=0.02)


def test_without_an_end_it_runs_until_everybody_has_arrived(town: Path, tmp_path: Path) -> None:
    town.write_text(town.read_text(encoding="utf-8").replace('<end value="22500"/>', ""), encoding="utf-8")
    result = bridge.run(scenario(net=str(town), controller="native"), tmp_path / "run")
    assert result["unfinished"] == 0
    assert result["hours"] > 0.25


@pytest.mark.long
def test_without_an_end_controllers_run_until_everybody_has_arrived_too(tmp_path: Path) -> None:
    odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    file = odd_nets.case(tmp_path, odd_nets.flow("rare", "W-C", "C-E", period=600, end=15600), end=None)
    for controller in ("recommended", "fixed"):
        result = bridge.run(scenario(net=str(file), controller=controller), tmp_path / controller)
        assert (result["arrived"], result["unfinished"]) == (26, 0)
        assert result["hours"] > 4


@pytest.mark.parametrize("word", ["true", "True", "1", "x", "on"])
def test_options_are_on_by_any_of_sumo_s_words(tmp_path: Path, word: str) -> None:
    odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    chosen = case.read(odd_nets.case(tmp_path, odd_nets.traffic("C"), options={"mesosim": word}))
    with pytest.raises(SettingError, match="mesosim"):
        streets.controllable(chosen)
    off = case.read(odd_nets.case(tmp_path, odd_nets.traffic("C"), options={"mesosim": "False"}))
    assert streets.controllable(off).links


def test_files_that_options_name_lie_where_the_scenario_does(tmp_path: Path) -> None:
    odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    names = {"device.fcd-replay.files": "seen.xml", "astar.all-distances": "table.txt"}
    (tmp_path / "seen.xml").write_text("<fcd-export/>", encoding="utf-8")
    (tmp_path / "table.txt").write_text("no XML", encoding="utf-8")
    chosen = case.read(odd_nets.case(tmp_path, odd_nets.traffic("C"), options=names))
    assert dict(chosen.options) | {name: str(tmp_path / said) for name, said in names.items()} == dict(chosen.options)
    assert {tmp_path / said for said in names.values()} <= set(chosen.files)


def test_a_saved_state_is_gone_on_from_by_the_net_s_own_signals_alone(tmp_path: Path) -> None:
    net = odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    file = odd_nets.case(tmp_path, odd_nets.traffic("C"))
    save = ["--save-state.times", "100", "--save-state.files", str(tmp_path / "state.xml.gz"), "--end", "101"]
    command = [sumo_binary("sumo"), "-n", str(net), "-r", str(tmp_path / "odd.rou.xml"), "--no-step-log"]
    subprocess.run([*command, *save], check=True, capture_output=True)
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("<end", '<load-state value="state.xml.gz"/><end'), encoding="utf-8")
    result = bridge.run(scenario(net=str(file), controller="native"), tmp_path / "native")
    # SUMO's clock goes on from where it was, whatever the window says.
    assert result["hours"] == pytest.approx(200 / 3600)
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    for controller in ("fixed", "recommended", "actuated", "webster"):
        with pytest.raises(SettingError, match=r"load-state, .*: leave it out .* or use --controller native"):
            bridge.run(scenario(net=str(file), controller=controller), tmp_path / controller)
        assert not (tmp_path / controller).exists()
    (tmp_path / "state.xml.gz").write_bytes(gzip.compress(b"<routes/>"))
    with pytest.raises(SettingError, match=r"state.xml.gz' as load-state, which is none"):
        case.read(file)


@pytest.mark.parametrize("step_s", ["2", "0.9", "0.4", "0.2"])
def test_steps_with_which_signals_can_not_be_switched_to_the_second_are_refused_but_for_the_net_s_own_signals(
    step_s: str, tmp_path: Path
) -> None:
    odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    file = odd_nets.case(tmp_path, odd_nets.traffic("C"), options={"step-length": step_s})
    whole_part = step_s == "0.2"
    for controller in ("fixed", "dmpc", "recommended", "max_wave", "actuated"):
        if whole_part:
            result = bridge.run(scenario(net=str(file), controller=controller), tmp_path / controller)
            assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
            continue
        with pytest.raises(SettingError, match=rf"step-length of {step_s} s: .*, make it 1 s or a whole part of it"):
            bridge.run(scenario(net=str(file), controller=controller), tmp_path / controller)
        assert not (tmp_path / controller).exists()
    native = bridge.run(scenario(net=str(file), controller="native"), tmp_path / "native")
    # What nobody can hold to the second is not judged by it either.
    assert native["unsafe_signal_s"] == (0 if whole_part else None)


def test_a_shipped_net_runs_under_its_own_signals_too(tmp_path: Path) -> None:
    native = bridge.run(scenario(controller="native", hours=0.5, demand=0.6, seed=3), tmp_path / "native")
    fixed = bridge.run(scenario(controller="fixed", hours=0.5, demand=0.6, seed=3), tmp_path / "fixed")
    # The shipped programme is the equal split.
    assert native["total_delay_veh_h"] == pytest.approx(fixed["total_delay_veh_h"], rel=1e-6)
    assert native["total_time_spent_veh_h"] == pytest.approx(fixed["total_time_spent_veh_h"], rel=1e-6)


@pytest.mark.parametrize(
    ("change", "names", "remedy"),
    [
        (("town.rou.xml", "away.rou.xml"), "away.rou.xml", "no such file"),
        (('value="22500"', 'value="noon"'), "end is 'noon'", "no time"),
        (("<net-file", "<gnat-file"), "net-file", "whole .sumocfg"),
        (("<configuration>", '<!DOCTYPE a [<!ENTITY b "c">]><configuration>'), "town.sumocfg", "give a .sumocfg"),
        (("</configuration>", ""), "town.sumocfg", "give a .sumocfg"),
    ],
)
def test_a_scenario_that_can_not_be_used_is_refused_in_one_line(
    town: Path, change: tuple[str, str], names: str, remedy: str
) -> None:
    town.write_text(town.read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    with pytest.raises(SettingError, match=remedy) as caught:
        case.read(town)
    assert names in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "routes", ["<routes><vehicle", '<!DOCTYPE a [<!ENTITY b "c">]><routes>&b;</routes>'], ids=["cut off", "entities"]
)
def test_files_of_a_scenario_are_looked_at_before_sumo_reads_them(town: Path, routes: str) -> None:
    town.with_name("town.rou.xml").write_text(routes, encoding="utf-8")
    with pytest.raises(SettingError, match=r"route-files .*town.rou.xml.* can't be read") as caught:
        case.read(town)
    assert "\n" not in str(caught.value)


def test_routes_of_another_net_are_refused_in_one_line(town: Path, tmp_path: Path) -> None:
    lost = '<routes><vehicle id="a" depart="21600"><route edges="nowhere"/></vehicle></routes>'
    town.with_name("town.rou.xml").write_text(lost, encoding="utf-8")
    with pytest.raises(SettingError, match=r"vehicle 'a' .* edge 'nowhere', .*: give routes of that net") as caught:
        bridge.run(scenario(net=str(town), controller="native"), tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("chosen", "remedy"), [({"forecast": "perfect"}, "drawn demand"), ({"noise": 0.2}, "leave it out")]
)
def test_what_other_people_s_demand_does_not_take_is_refused(
    town: Path, tmp_path: Path, chosen: dict[str, Any], remedy: str
) -> None:
    with pytest.raises(SettingError, match=remedy):
        bridge.run(scenario(net=str(town), controller="fixed", **chosen), tmp_path / "run")
    assert not (tmp_path / "run" / "result.json").exists()


@pytest.mark.long
@pytest.mark.parametrize("controller", ["fixed", "dmpc", "cmpc"])
def test_controllers_run_it_within_its_window(town: Path, tmp_path: Path, controller: str) -> None:
    result = bridge.run(scenario(net=str(town), controller=controller, seed=9), tmp_path / "run")
    assert (result["unsafe_signal_s"], result["fallbacks"], result["hours"]) == (0, 0, 0.25)
    assert set(trips(tmp_path / "run" / "trips.xml")) == set(by_bare_sumo(town, tmp_path, 9))


def test_a_scenario_with_the_demand_that_is_drawn_here_gives_the_same_run(utn17: Network, tmp_path: Path) -> None:
    chosen = scenario(controller="fixed", hours=0.5, demand=0.6, seed=3)
    ours = bridge.run(chosen, tmp_path / "ours")
    (tmp_path / "theirs.sumocfg").write_text(
        f"""<configuration><input><net-file value="{utn17.net_file}"/><route-files value="ours/routes.rou.xml"/></input>
        <time><begin value="0"/><end value="1800"/></time>
        <processing><time-to-teleport value="-1"/></processing></configuration>""",
        encoding="utf-8",
    )
    theirs = bridge.run(scenario(net=str(tmp_path / "theirs.sumocfg"), controller="fixed", seed=3), tmp_path / "theirs")
    for name in ("total_delay_veh_h", "arrived", "unfinished", "stops", "max_queue_veh"):
        assert theirs[name] == ours[name], name


def test_programmes_in_additional_files_stand_for_the_nets(town: Path, tmp_path: Path) -> None:
    phases = "".join(
        f'<phase duration="{seconds}" state="{state}"/>'
        for seconds, state in (
            (20, "GGGrrr"),
            (10, "GGGrrr"),
            (3, "yyyrrr"),
            (2, "rrrrrr"),
            (30, "rrrGGG"),
            (5, "rrryyy"),
        )
    )
    added = f'<additional><tlLogic id="J2" programID="b" type="static" offset="4">{phases}</tlLogic></additional>'
    town.with_name("own.add.xml").write_text(added, encoding="utf-8")
    text = town.read_text(encoding="utf-8").replace("</input>", '<additional-files value="own.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")
    net = streets.controllable(case.read(town))
    junction = net.junctions[1]
    # Offset 4 of SUMO's clock, which the window begins at 6:00 of.
    assert (junction.cycle_s, junction.offset_s, len(junction.stages)) == (70, (4 - 21600) % 70, 2)
    # 70 s and 120 s have no common multiple that is worth waiting for: the longest cycle is the step.
    assert net.control_step_s == 120
    result = bridge.run(scenario(net=str(town), controller="dmpc"), tmp_path / "run")
    assert (result["unsafe_signal_s"], result["fallbacks"]) == (0, 0)


def test_a_junction_whose_own_stages_conflict_is_left_alone_and_named(town: Path, tmp_path: Path) -> None:
    clash = '<phase duration="60" state="GGGGGG"/><phase duration="3" state="yyyyyy"/>'
    more = '<phase duration="50" state="rrrGGG"/><phase duration="7" state="rrryyy"/>'
    added = f'<additional><tlLogic id="J2" programID="b" type="static" offset="0">{clash}{more}</tlLogic></additional>'
    town.with_name("own.add.xml").write_text(added, encoding="utf-8")
    text = town.read_text(encoding="utf-8").replace("</input>", '<additional-files value="own.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")
    result = bridge.run(scenario(net=str(town), controller="fixed"), tmp_path / "run")
    assert set(result["left_alone"]) == {"J2"}
    assert "conflict" in result["left_alone"]["J2"]
    assert (result["unsafe_signal_s"], result["fallbacks"]) == (0, 0)


@pytest.mark.parametrize("controller", ["recommended", "dmpc", "actuated", "native"])
def test_left_turns_that_meet_are_controlled_and_one_of_them_gives_way(tmp_path: Path, controller: str) -> None:
    folder = tmp_path / "case"
    folder.mkdir()
    file = odd_nets.lefts_that_meet(folder)
    result = bridge.run(scenario(net=str(file), controller=controller), tmp_path / "run")
    assert result["left_alone"] == {}
    if controller == "native":
        # Its own programme protects both.
        assert result["unsafe_signal_s"] > 0
        assert "signals 2 and 8 conflict and are open together" in result["unsafe_reasons"][0]
    else:
        assert (result["unsafe_signal_s"], result["fallbacks"], result["teleports"]) == (0, 0, 0)


CLASH = [(60, "GGGGGG"), (3, "yyyyyy"), (50, "rrrGGG"), (7, "rrryyy")]


@pytest.mark.long
@pytest.mark.parametrize("stopped_after", [None, 4], ids=["whole", "stopped early"])
@pytest.mark.parametrize("controller", ["native", "fixed", "actuated"])
def test_bare_sumo_replays_its_runs_vehicle_for_vehicle(
    town: Path, tmp_path: Path, controller: str, stopped_after: int | None
) -> None:
    # J2 can't be controlled: its own programme goes on beside what is replayed.
    phases = "".join(f'<phase duration="{lasts}" state="{state}"/>' for lasts, state in CLASH)
    added = f'<additional><tlLogic id="J2" programID="b" type="static" offset="0">{phases}</tlLogic></additional>'
    town.with_name("own.add.xml").write_text(added, encoding="utf-8")
    text = town.read_text(encoding="utf-8").replace("</input>", '<additional-files value="own.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")

    def stop(progress: bridge.Progress) -> None:
        if stopped_after and progress.time_s >= 120 * stopped_after:
            raise KeyboardInterrupt

    result = bridge.run(scenario(net=str(town), controller=controller, demand=0.9), tmp_path / "run", stop)
    assert result["interrupted"] is bool(stopped_after)
    configuration = replay.write(tmp_path / "run")
    subprocess.run([sumo_binary("sumo"), "-c", str(configuration)], check=True, capture_output=True)
    recorded = trips(tmp_path / "run" / "trips.xml")
    assert len(recorded) > 300
    assert trips(configuration.with_name("trips.xml")) == recorded
    text = configuration.with_name("signals.add.xml").read_text(encoding="utf-8")
    assert ('"J1"' in text, '"J2"' in text) == (controller == "fixed", False)


@pytest.mark.parametrize("step_s", ["1", "0.2"])
@pytest.mark.parametrize("controller", ["fixed", "recommended"])
def test_a_run_that_begins_amid_a_second_is_replayed_too(
    town: Path, tmp_path: Path, controller: str, step_s: str
) -> None:
    text = town.read_text(encoding="utf-8").replace('"6:00:00"', '"21600.5"').replace('"0.5"', f'"{step_s}"')
    town.write_text(text, encoding="utf-8")
    result = bridge.run(scenario(net=str(town), controller=controller, hours=0.1), tmp_path / "run")
    assert result["unsafe_reasons"] == []
    configuration = replay.write(tmp_path / "run")
    subprocess.run([sumo_binary("sumo"), "-c", str(configuration)], check=True, capture_output=True)
    recorded = trips(tmp_path / "run" / "trips.xml")
    assert len(recorded) > 100
    assert trips(configuration.with_name("trips.xml")) == recorded


@pytest.mark.parametrize(("change", "says"), [("move", "is gone from there"), ("edit", "has changed since")])
def test_a_run_whose_files_are_not_what_they_were_is_not_replayed(
    town: Path, tmp_path: Path, change: str, says: str
) -> None:
    bridge.run(scenario(net=str(town), controller="native", hours=0.05), tmp_path / "run")
    routes = town.with_name("town.rou.xml")
    if change == "move":
        routes.rename(town.with_name("moved.rou.xml"))
    else:
        routes.write_text("<routes/>", encoding="utf-8")
    with pytest.raises(ResultError, match=f"town.rou.xml.*{says}"):
        replay.write(tmp_path / "run")
    assert not (tmp_path / "run" / "replay").exists()


def test_forecasts_of_its_runs_are_not_judged(town: Path, tmp_path: Path) -> None:
    bridge.run(scenario(net=str(town), controller="fixed", hours=0.1), tmp_path / "run")
    with pytest.raises(SettingError, match="drawn"):
        forecast_report.rmse_veh_h(tmp_path / "run", 7, 15)


@pytest.mark.parametrize("controller", ["native", "fixed"])
def test_settings_of_a_run_tell_its_window_its_options_and_its_files(
    town: Path, tmp_path: Path, controller: str
) -> None:
    bridge.run(scenario(net=str(town), controller=controller, hours=0.1), tmp_path / "run")
    kept = json.loads((tmp_path / "run" / "settings.json").read_text(encoding="utf-8"))["case"]
    assert (kept["begin_s"], kept["end_s"], kept["step_s"], kept["teleport_s"]) == (21600, 21960, 0.5, 120)
    assert kept["options"] == {"step-length": "0.5", "time-to-teleport": "120"}
    assert kept["route_files"] == [str(town.with_name("town.rou.xml"))]


def test_demand_scales_on_top_of_a_scale_of_its_own(town: Path, tmp_path: Path) -> None:
    text = town.read_text(encoding="utf-8").replace("</processing>", '<scale value="0.5"/></processing>')
    town.write_text(text, encoding="utf-8")
    chosen = scenario(net=str(town), controller="native", demand=0.5)
    assert dict(traffic.given(chosen).options)["scale"] == "0.25"


def test_what_it_says_of_outputs_is_left_out_in_whatever_section_it_stands(town: Path) -> None:
    more = '<no-warnings value="true"/><fcd-output value="big.xml"/><fcd-output.geo value="true"/></processing>'
    town.write_text(town.read_text(encoding="utf-8").replace("</processing>", more), encoding="utf-8")
    assert dict(case.read(town).options) == {"step-length": "0.5", "time-to-teleport": "120"}


def test_the_command_takes_it_by_its_name_and_inspect_shows_its_net(town: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke(cli, ["run", str(town), "--controller", "native", "--out", str(tmp_path / "a")])
    assert run.exit_code == 0
    assert "not known" in run.stdout
    assert "from 21600 s to 22500 s, step 0.5 s, teleport after 120 s" in run.stdout
    assert "nobody departed" not in run.stdout
    shown = CliRunner().invoke(cli, ["inspect", str(town), "--out", str(tmp_path / "b"), "--json"])
    assert len(json.loads(shown.stdout)["links"]) == 17


@pytest.mark.parametrize("controller", ["native", "fixed"])
def test_why_sumo_does_not_start_is_its_own_to_say(
    town: Path, tmp_path: Path, controller: str, capfd: pytest.CaptureFixture[str]
) -> None:
    loop = '<inductionLoop id="mine" lane="nowhere_0" pos="1" period="60" file="NUL"/>'
    town.with_name("own.add.xml").write_text(f"<additional>{loop}</additional>", encoding="utf-8")
    text = town.read_text(encoding="utf-8").replace("</input>", '<additional-files value="own.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")
    with pytest.raises(PlantError, match=r"SUMO did not start \(see above\)"):
        bridge.run(scenario(net=str(town), controller=controller), tmp_path / "run")
    assert "nowhere_0" in capfd.readouterr().err


@pytest.mark.parametrize("controller", ["native", "fixed"])
def test_a_run_in_which_nobody_departs_says_so(town: Path, tmp_path: Path, controller: str) -> None:
    # Its traffic is of another time of the day: zeros alone would look like a run without delay.
    text = town.read_text(encoding="utf-8").replace('"6:00:00"', '"600"').replace('"22500"', '"900"')
    town.write_text(text, encoding="utf-8")
    run = CliRunner().invoke(cli, ["run", str(town), "--controller", controller, "--out", str(tmp_path / "a")])
    assert run.exit_code == 0
    assert "nobody departed" in run.stdout


@pytest.mark.parametrize(("name", "delay_s", "spread_s"), [("cologne8", 49.1, 1.0), ("ingolstadt7", 84.5, 8.0)])
def test_published_delays_of_own_programmes_are_found_again(
    name: str, delay_s: float, spread_s: float, tmp_path: Path
) -> None:
    file = SCENARIOS / name / f"{name}.sumocfg"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    result = bridge.run(scenario(net=str(file), controller="native", seed=1), tmp_path / "run")
    assert result["mean_delay_s"] == pytest.approx(delay_s, abs=spread_s)


def test_what_its_additional_files_would_write_goes_nowhere(town: Path, tmp_path: Path) -> None:
    loop = '<inductionLoop id="{}" lane="1_0" pos="10" period="60" file="{}"/>'
    inner, outer = loop.format("inner", "in.xml"), loop.format("outer", "out.xml")
    town.with_name("inner.add.xml").write_text(f"<additional>{inner}</additional>", encoding="utf-8")
    added = f'<additional><include href="inner.add.xml"/>{outer}</additional>'
    town.with_name("outer.add.xml").write_text(added, encoding="utf-8")
    text = town.read_text(encoding="utf-8").replace("</input>", '<additional-files value="outer.add.xml"/></input>')
    town.write_text(text, encoding="utf-8")
    before = {path.name for path in tmp_path.iterdir()}
    for controller in ("native", "fixed"):
        bridge.run(scenario(net=str(town), controller=controller, seed=9), tmp_path / controller)
        before.add(controller)
        assert {path.name for path in tmp_path.iterdir()} == before
    assert trips(tmp_path / "native" / "trips.xml") == by_bare_sumo(town, tmp_path, 9)


@pytest.mark.parametrize("controller", ["native", "fixed"])
@pytest.mark.parametrize("begin_s", [0, 7200])
def test_who_was_never_called_for_is_not_late_but_who_was_and_finds_no_room_is(
    controller: str, begin_s: int, tmp_path: Path
) -> None:
    odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    calls_s, end_s = begin_s + 150, begin_s + 200
    way = '<route edges="{} {}"/>'
    ours = {"taxi": ("W-C", "C-E"), "rank": ("sC-C", "C-nC"), "rank2": ("sC-C", "C-nC")}
    cars = "".join(
        f'<vehicle id="{name}" depart="triggered">{way.format(*edges)}</vehicle>' for name, edges in ours.items()
    )
    ride = f'<person id="rider" depart="{calls_s}"><ride from="W-C" to="C-E" lines="taxi"/></person>'
    # So many that the taxi is called onto a road without room.
    jam = odd_nets.flow("jam", "W-C", "C-E", period=0.5, begin=begin_s, end=end_s)
    (tmp_path / "own.add.xml").write_text(f"<additional>{cars}{ride}</additional>", encoding="utf-8")
    options = {"additional-files": "own.add.xml", "scale": "2"}
    file = odd_nets.case(tmp_path, jam, options=options, begin=str(begin_s), end=str(end_s))
    result = bridge.run(scenario(net=str(file), controller=controller), tmp_path / "run")
    recorded = trips(tmp_path / "run" / "trips.xml")
    assert {"rank", "rank.1", "rank2", "rank2.1"} < set(recorded)
    assert recorded["taxi"][:2] == ("-1", "50.00")
    late = [trip for name, trip in recorded.items() if not name.startswith("rank") and name != "taxi.1"]
    assert result["arrived"] + result["unfinished"] == len(late)
    delay_s = sum(float(departure) + float(loss) for _, departure, _, loss, _, _ in late)
    assert result["total_delay_veh_h"] == pytest.approx(delay_s / 3600)


@pytest.mark.parametrize("controller", ["native", "fixed"])
def test_who_never_has_green_is_named_at_the_end_of_a_run(controller: str, tmp_path: Path) -> None:
    net = odd_nets.row("C").net(tmp_path, odd_nets.NO_TURNAROUNDS)
    odd_nets.retime(net, odd_nets.tl_logic("C", [(seconds, f"r{shown[1:]}") for seconds, shown in odd_nets.TWO_STAGES]))
    chosen, out = odd_nets.case(tmp_path, odd_nets.traffic("C")), tmp_path / "out"
    words = ["run", str(chosen), "--controller", controller, "--hours", "0.05", "--out", str(out)]
    run = CliRunner().invoke(cli, words)
    assert run.exit_code == 0, run.output
    assert "C: signal 0 has no green in its programme: nobody goes there" in run.output
    assert json.loads((out / "result.json").read_text(encoding="utf-8"))["never_green"] == {"C": [0]}
