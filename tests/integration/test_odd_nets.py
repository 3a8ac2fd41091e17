"""Any scenario runs: the corpus of `odd_nets` under its own signals and under every controller of ours."""

from __future__ import annotations

import gzip
import json
import subprocess
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner

from utn_sumo import bridge, case, inspection, monitor, streets
from utn_sumo.cli import cli
from utn_sumo.errors import PlantError, UtnError
from utn_sumo.plant.sumo import PROGRAM
from utn_sumo.scenario import scenario
from utn_sumo.sumo_signals import PEERS
from utn_sumo.sumo_tools import sumo_binary

from . import odd_nets
from .odd_nets import Make

Shown = list[tuple[str, float]]
"""(letters, seconds), one after the other."""
Run = Callable[[Make, str], tuple[dict[str, Any], Path]]

CONTROLLERS = ("fixed", "dmpc", "cmpc")
LEFT_ALONE: dict[Make, set[str]] = {
    odd_nets.one_stage: {"M", "F"},
    odd_nets.railway: {"R", "X"},
    odd_nets.no_yellow: {"A"},
    odd_nets.switched_off: {"A", "B", "D"},
    odd_nets.blinking_at_night: {"C"},
    odd_nets.dual_ring: {"C"},
}
"""Signals that nobody can control; every other one has to be controlled."""
EITHER = {
    odd_nets.programmes_by_the_clock,
    odd_nets.phases_that_are_skipped,
    odd_nets.fractions_of_seconds,
    odd_nets.fraction_in_the_cycle,
}
"""Where it may be left alone as well, if the reason is named."""
BREAKS_OFF = {
    (odd_nets.letters_without_a_stream, "webster"),
    (odd_nets.letters_without_a_stream, "webster+offsets"),
    (odd_nets.switched_off, "webster+offsets"),
}
"""Where SUMO's own tools do."""
UNSTEADY = {odd_nets.bicycle_lanes}
"""Where SUMO's own trips depend on where in memory things lie: libsumo gives others the second time, with one seed.

Or says that a bicycle may depart on no lane: these runs are processes of their own.
"""
NEAR_VEH = 4
"""Vehicles on a link that an estimate may be wrong by: what starts amid links is not announced."""
CLEARS = frozenset("yYu")
GREEN = frozenset("Gg")

every_case = pytest.mark.parametrize("make", odd_nets.CASES, ids=lambda make: make.__name__)
every_controller = pytest.mark.parametrize("controller", CONTROLLERS)


@pytest.fixture(scope="module")
def ran(made: Callable[[Make], Path], tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Measures and folder of a case's run."""
    results: dict[tuple[Make, str], tuple[dict[str, Any], Path]] = {}

    def run(make: Make, controller: str) -> tuple[dict[str, Any], Path]:
        if (make, controller) not in results:
            folder = tmp_path_factory.mktemp(f"{make.__name__}-{controller}")
            item = scenario(net=str(made(make)), controller=controller, seed=5)
            if make in UNSTEADY:
                with ProcessPoolExecutor(1, get_context("spawn")) as alone:
                    results[make, controller] = alone.submit(bridge.run, item, folder).result(), folder
            else:
                results[make, controller] = bridge.run(item, folder), folder
        return results[make, controller]

    return run


def trips(folder: Path) -> dict[str, str]:
    """When everybody who drove or walked was through, by id; -1 for those who were not."""
    root = ET.parse(folder / "trips.xml").getroot()
    legs = {item.attrib["id"]: list(item) for item in root.iter("personinfo")}
    walked = {name: parts[-1].get("arrival", "-1") if parts else "-1" for name, parts in legs.items()}
    return {item.attrib["id"]: item.attrib["arrival"] for item in root.iter("tripinfo")} | walked


def switches(folder: Path, signal: str) -> list[tuple[float, str, str]]:
    """(second, letters, programme) of every change of a signal."""
    states = ET.parse(folder / "signals.xml").iter("tlsState")
    return [
        (float(item.attrib["time"]), item.attrib["state"], item.attrib["programID"])
        for item in states
        if item.attrib["id"] == signal
    ]


def begins(folder: Path, signal: str) -> list[tuple[float, str]]:
    """(second, letters) of every change of what a signal shows, whatever programme it is under."""
    changes: list[tuple[float, str]] = []
    for second, state, _ in switches(folder, signal):
        if not changes or changes[-1][1] != state:
            changes.append((second, state))
    return changes


def shown(folder: Path, signal: str) -> Shown:
    """What a signal showed, from its second change to the last: the first and the last were cut off by the window."""
    changes = begins(folder, signal)
    return [(state, end - start) for (start, state), (end, _) in pairwise(changes)][1:]


def greens_s(seen: Shown, letter: int) -> list[float]:
    """How long a letter was green each time, but for those at the ends."""
    spans: list[list[float]] = []
    was = True
    for state, seconds in seen:
        now = state[letter] in GREEN
        if now and not was:
            spans.append([])
        if now and spans:
            spans[-1].append(seconds)
        was = now
    return [sum(span) for span in (spans[:-1] if was else spans)]


def red_before_green_s(seen: Shown, one: int, other: int) -> list[float]:
    """How long a letter had not been green any more each time another turned green."""
    found, since, was = [], 0.0, True
    for state, seconds in seen:
        now = state[other] in GREEN
        if now and not was:
            found.append(since)
        since, was = 0.0 if state[one] in GREEN else since + seconds, now
    return found


def programmes(file: Path) -> dict[str, Shown]:
    """The phases of every signal's own programme, the last one that SUMO reads, as far as it comes to them."""
    chosen = case.read(file)
    found: dict[str, Shown] = {}
    for path in (chosen.net_file, *chosen.additional_files):
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as content:
            root = ET.parse(content).getroot()
        for logic in root.iter("tlLogic"):
            phases, reached = list(logic.iter("phase")), [0]
            while phases and (after := int(phases[reached[-1]].get("next", reached[-1] + 1)) % len(phases)):
                reached.append(after)
            shows = [(item.attrib["state"], float(item.attrib["duration"])) for item in phases]
            # Without phases it only moves the one before.
            found[logic.attrib["id"]] = (
                [shows[place] for place in reached] if shows else found.get(logic.attrib["id"], [])
            )
    return found


def signals_of(file: Path) -> set[str]:
    """Every signal that some connection of the net obeys."""
    path = case.read(file).net_file
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as content:
        return {item.attrib["tl"] for item in ET.parse(content).iter("connection") if "tl" in item.attrib}


def controlled(folder: Path, signals: Iterable[str]) -> set[str]:
    """Signals that showed a programme of ours."""
    return {signal for signal in signals if any(program == PROGRAM for *_, program in switches(folder, signal))}


def clears(state: str) -> bool:
    """Whether somebody has yellow, or red and amber, or nobody has green."""
    return bool(CLEARS & set(state)) or not GREEN & set(state)


def gaps_s(seen: Shown) -> dict[tuple[int, int], float]:
    """Least seconds that clear between one letter's green and another's, where nobody else's began between the two.

    Seconds in which somebody is green and nobody yellow may be a stage of its own, and are not counted.
    """
    found: dict[tuple[int, int], float] = {}
    for start, (state, _) in enumerate(seen[:-1]):
        ended = [letter for letter, shows in enumerate(state) if shows in GREEN and seen[start + 1][0][letter] != shows]
        ended = [letter for letter in ended if seen[start + 1][0][letter] not in GREEN]
        passed = 0.0
        for (before, seconds), (after, _) in zip(seen[start + 1 :], seen[start + 2 :], strict=False):
            passed += seconds if clears(before) else 0
            begun = [i for i, shows in enumerate(after) if shows in GREEN and before[i] not in GREEN]
            for pair in ((one, other) for one in ended for other in begun if one != other):
                found[pair] = min(passed, found.get(pair, passed))
            if begun:
                break
    return found


# Every net under one actuation and one of SUMO's tools, and where these break off: all of both share their code.
OWN_SIGNALS = [
    pytest.param(make, controller, id=f"{make.__name__}-{controller}")
    for place, make in enumerate(odd_nets.CASES)
    for number, controller in enumerate(PEERS)
    if (place + number) % 2 == 0 or (make, controller) in BREAKS_OFF
]


@pytest.mark.long
@pytest.mark.parametrize(("make", "controller"), OWN_SIGNALS)
def test_sumo_s_own_signals_are_safe_or_its_tool_is_named(make: Make, controller: str, ran: Run) -> None:
    if (make, controller) in BREAKS_OFF:
        with pytest.raises(PlantError, match=r"SUMO's tls\w+.py broke off .*use another controller"):
            ran(make, controller)
        return
    result, _ = ran(make, controller)
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert result["arrived"] > 0
    assert LEFT_ALONE.get(make, set()) <= set(result["left_alone"])


@every_case
def test_native_trips_are_those_of_the_bare_sumo(make: Make, made: Callable[[Make], Path], ran: Run) -> None:
    result, folder = ran(make, "native")
    file, bare = made(make), folder.with_name(f"{folder.name}-bare")
    bare.mkdir()
    subprocess.run(
        [
            sumo_binary("sumo"),
            *("-c", str(file), "--seed", "5", "--no-step-log", "--no-warnings"),
            *("--tripinfo-output", str(bare / "trips.xml"), "--tripinfo-output.write-unfinished"),
            "--tripinfo-output.write-undeparted",
        ],
        check=True,
        capture_output=True,
    )
    assert result["arrived"] > 0
    if make in UNSTEADY:
        assert trips(folder).keys() == trips(bare).keys()
    else:
        assert trips(folder) == trips(bare)


@every_controller
@every_case
def test_controllers_run_it_safely(make: Make, controller: str, made: Callable[[Make], Path], ran: Run) -> None:
    result, folder = ran(make, controller)
    _, native = ran(make, "native")
    assert result["fallbacks"] == 0, result["fallback_reasons"]
    assert result["unsafe_signal_s"] == 0, result["unsafe_reasons"]
    assert set(trips(folder)) == set(trips(native))
    signals = signals_of(made(make))
    alone = result["left_alone"]
    assert controlled(folder, signals) == signals - set(alone)
    assert all(alone.values())


@every_case
def test_signals_are_left_alone_only_where_nobody_can_control_them(make: Make, made: Callable[[Make], Path]) -> None:
    alone = streets.controllable(case.read(made(make))).left_alone
    expected = LEFT_ALONE.get(make, set())
    assert set(alone) == expected or (make in EITHER and alone), alone


@every_case
def test_inspect_names_every_signal(make: Make, made: Callable[[Make], Path], tmp_path: Path) -> None:
    file = made(make)
    done = CliRunner().invoke(cli, ["inspect", str(file), "--out", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.exception
    found = json.loads(done.stdout)
    assert {item["id"] for item in found["junctions"]} | set(found["left_alone"]) == signals_of(file)


MENDED = {odd_nets.yellow_forgotten, odd_nets.green_too_soon}
"""They show phases that the net's own programme has not."""


@pytest.mark.parametrize(
    "make", [make for make in odd_nets.CASES if make not in MENDED], ids=lambda make: make.__name__
)
def test_phases_keep_their_order_and_clearances_their_seconds(
    make: Make, made: Callable[[Make], Path], ran: Run
) -> None:
    result, folder = ran(make, "dmpc")
    own = programmes(made(make))
    step_s = float(dict(case.read(made(make)).options).get("step-length", "1"))
    for signal in own.keys() - result["left_alone"].keys():
        states = [state for state, _ in own[signal]]
        assert states, f"{signal} has no programme to keep to"
        follows = set(zip(states, [*states[1:], states[0]], strict=True)) | {(state, state) for state in states}
        seen = shown(folder, signal)
        assert seen
        for (state, seconds), (after, _) in pairwise(seen):
            assert (state, after) in follows, signal
            if clears(state):
                lengths = {length for each, length in own[signal] if each == state}
                # What is no multiple of a step SUMO rounds up and down in turn.
                assert any(abs(seconds - length) < step_s for length in lengths), (signal, state, seconds, lengths)


@every_case
def test_no_stream_turns_green_sooner_after_another_than_in_the_nets_own_programme(
    make: Make, made: Callable[[Make], Path], ran: Run
) -> None:
    result, folder = ran(make, "dmpc")
    own = programmes(made(make))
    for signal in own.keys() - result["left_alone"].keys():
        least = gaps_s(3 * own[signal])
        for pair, seconds in gaps_s(shown(folder, signal)).items():
            assert seconds >= least.get(pair, 0), (signal, pair)


UNSAFE = {odd_nets.programmes_by_the_clock, *MENDED}
"""A change of programmes cuts a green short, which is what the monitor is there to see, as what others mend."""


@pytest.mark.parametrize(
    "make", [make for make in odd_nets.CASES if make not in UNSAFE], ids=lambda make: make.__name__
)
def test_the_monitor_has_nothing_to_say_against_a_nets_own_programme(
    make: Make, made: Callable[[Make], Path], ran: Run
) -> None:
    chosen = case.read(made(make))
    result, folder = ran(make, "native")
    net = streets.controllable(chosen)
    verdict = monitor.watch(net, folder / "signals.xml", result["hours"] * 3600, chosen.begin_s)
    assert not verdict.reasons


@pytest.mark.parametrize(
    ("make", "says"),
    [(odd_nets.yellow_forgotten, "without yellow"), (odd_nets.green_too_soon, "are open together")],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_an_unsafe_programme_is_seen_under_native_and_mended_under_others(ran: Run, make: Make, says: str) -> None:
    verdict, _ = ran(make, "native")
    assert any(says in reason for reason in verdict["unsafe_reasons"])
    for controller in CONTROLLERS:
        result, _ = ran(make, controller)
        assert (result["left_alone"], result["unsafe_reasons"]) == ({}, [])


@pytest.mark.parametrize("make", LEFT_ALONE, ids=lambda make: make.__name__)
@every_controller
def test_signals_left_alone_show_what_they_show_without_us(make: Make, controller: str, ran: Run) -> None:
    (_, folder), (_, native) = ran(make, controller), ran(make, "native")
    for signal in LEFT_ALONE[make]:
        assert switches(folder, signal) == switches(native, signal)


@every_case
def test_the_estimate_of_who_is_on_a_link_stays_near_the_truth(make: Make, ran: Run) -> None:
    _, folder = ran(make, "dmpc")
    lines = [json.loads(line) for line in (folder / "cycles.jsonl").read_text(encoding="utf-8").splitlines()]
    for line, after in pairwise(lines):
        assert after["state"]["x_veh"] == pytest.approx(line["truth"]["x_veh"], abs=NEAR_VEH)


@every_controller
def test_crossings_are_green_as_long_as_the_net_demands_and_cleared_while_their_street_is_still_red(
    controller: str, ran: Run
) -> None:
    _, folder = ran(odd_nets.protected_crossings, controller)
    seen = shown(folder, "C")
    for letter in range(12, 16):
        greens = greens_s(seen, letter)
        assert len(greens) >= 2
        assert min(greens) >= odd_nets.CROSSING_LEAST_S
    # Letter 12 crosses the northern arm, out of which 0 to 2 come; 13 the eastern, with 3 to 5.
    for crossing, stream in ((12, 1), (13, 4)):
        assert min(red_before_green_s(seen, crossing, stream)) >= odd_nets.CROSSING_CLEARS_S + 4
    # Their street's own green goes on while they clear.
    assert {state: seconds for state, seconds in seen if state == "GGgrrrGGgrrrrrrr"} == {
        "GGgrrrGGgrrrrrrr": odd_nets.CROSSING_CLEARS_S
    }


@every_controller
def test_pedestrians_amid_a_street_get_their_green_and_across(controller: str, ran: Run) -> None:
    result, folder = ran(odd_nets.crossing_amid_a_street, controller)
    assert "M" not in result["left_alone"]
    greens = greens_s(shown(folder, "M"), 2)
    assert len(greens) >= 3
    assert min(greens) >= 4
    crossed = {name: arrival for name, arrival in trips(folder).items() if name.startswith("across")}
    assert len(crossed) == 12
    assert "-1" not in crossed.values()


@every_controller
def test_a_turn_that_may_pass_at_red_always_may(controller: str, ran: Run) -> None:
    _, folder = ran(odd_nets.right_on_red, controller)
    for _, state, _ in switches(folder, "C"):
        assert all(state[letter] == "s" for letter in (0, 4, 8, 12) if state[letter] not in "Ggy"), state
    assert any(state[4] == "s" for _, state, _ in switches(folder, "C"))


@every_controller
def test_a_stream_that_two_stages_serve_has_no_yellow_between_them(controller: str, ran: Run) -> None:
    _, folder = ran(odd_nets.leading_green, controller)
    states = [state for state, _ in shown(folder, "C")]
    after = {after for state, after in pairwise(states) if state == "GGGrrrrrrrrr"}
    assert after == {odd_nets.NORTH_SOUTH}


@every_controller
def test_a_green_is_held_while_others_clear(controller: str, ran: Run) -> None:
    _, folder = ran(odd_nets.lagging_green, controller)
    seen = shown(folder, "C")
    assert {seconds for state, seconds in seen if state == "GGgrrryyyrrr"} == {3}
    # Two seconds of red for everybody who might cross the left turn from the north, before it is protected.
    assert {seconds for state, seconds in seen if state == "GGgrrrrrrrrr"} == {2}


@every_controller
def test_red_and_amber_is_shown_before_every_green(controller: str, ran: Run) -> None:
    _, folder = ran(odd_nets.red_and_amber, controller)
    seen = shown(folder, "C")
    assert {seconds for state, seconds in seen if "u" in state} == {2}
    for (state, _), (after, _) in pairwise(seen):
        assert all(was in "ugG" for was, now in zip(state, after, strict=True) if now in GREEN)


@every_controller
def test_arrows_shorter_than_our_own_least_green_are_still_shown(controller: str, ran: Run) -> None:
    _, folder = ran(odd_nets.short_greens, controller)
    arrows = [seconds for state, seconds in shown(folder, "C") if state in {"rrGrrrrrGrrr", "rrrrrGrrrrrG"}]
    assert len(arrows) >= 8
    assert min(arrows) >= 4


def test_the_last_programme_that_is_read_is_the_one_to_start_from(made: Callable[[Make], Path], ran: Run) -> None:
    (junction,) = streets.controllable(case.read(made(odd_nets.several_programmes))).junctions
    assert (junction.cycle_s, junction.offset_s) == (80, 7)
    _, native = ran(odd_nets.several_programmes, "native")
    assert {program for *_, program in switches(native, "C")} == {"evening"}


@every_controller
def test_the_clock_does_not_take_a_signal_out_of_the_controllers_hands(controller: str, ran: Run) -> None:
    result, folder = ran(odd_nets.programmes_by_the_clock, controller)
    used = [program for *_, program in switches(folder, "C")]
    if "C" in result["left_alone"]:
        assert PROGRAM not in used
        assert "WAUT" in result["left_alone"]["C"]
    else:
        assert set(used[used.index(PROGRAM) :]) == {PROGRAM}


@pytest.mark.parametrize("controller", ["native", *CONTROLLERS])
def test_cycles_begin_where_the_nets_offsets_have_them(controller: str, ran: Run) -> None:
    _, folder = ran(odd_nets.offsets, controller)
    for signal, offset_s in odd_nets.OFFSETS_S.items():
        starts = [second for second, state in begins(folder, signal)[1:] if state == odd_nets.NORTH_SOUTH]
        assert len(starts) >= 3
        assert {(second - offset_s) % 60 for second in starts} == {0}


@pytest.mark.parametrize("controller", ["native", *CONTROLLERS])
def test_a_window_that_begins_amid_a_cycle_leaves_the_cycle_where_it_is(controller: str, ran: Run) -> None:
    _, folder = ran(odd_nets.late_begin, controller)
    starts = [second for second, state in begins(folder, "A")[1:] if state == odd_nets.NORTH_SOUTH]
    assert len(starts) >= 3
    assert {second % 60 for second in starts} == {0}


@pytest.mark.parametrize("controller", ["native", *CONTROLLERS])
def test_a_window_ends_when_it_says(controller: str, ran: Run) -> None:
    assert ran(odd_nets.half_second_steps, controller)[0]["hours"] * 3600 == pytest.approx(250.5)
    assert ran(odd_nets.late_begin, controller)[0]["hours"] * 3600 == pytest.approx(293)


@every_controller
def test_without_an_end_everybody_arrives_and_walks_home(controller: str, ran: Run) -> None:
    result, folder = ran(odd_nets.no_end, controller)
    assert result["unfinished"] == 0
    assert all(float(arrival) >= 0 for arrival in trips(folder).values())


@every_controller
def test_who_stands_too_long_is_taken_away_as_the_scenario_wants(controller: str, ran: Run) -> None:
    assert ran(odd_nets.teleports, controller)[0]["teleports"] > 0


@every_controller
def test_outputs_that_a_scenario_asks_for_are_not_written_where_its_files_are(controller: str, tmp_path: Path) -> None:
    file = odd_nets.flat_configuration(tmp_path)
    bridge.run(scenario(net=str(file), controller=controller), tmp_path / "run")
    assert not {path.name for path in tmp_path.iterdir()} & {"theirs.xml", "sum.xml", "theirs.log"}


def test_a_scenario_s_own_scale_is_scaled_further(tmp_path: Path) -> None:
    file = odd_nets.flat_configuration(tmp_path)
    once, twice = (
        bridge.run(scenario(net=str(file), controller="native", demand=scale), tmp_path / str(scale))
        for scale in (1.0, 2.0)
    )
    vehicles = [result["arrived"] + result["unfinished"] for result in (once, twice)]
    assert vehicles[1] == pytest.approx(2 * vehicles[0], rel=0.05)


@pytest.mark.parametrize("controller", ["native", *CONTROLLERS])
def test_zipped_files_give_the_same_trips(controller: str, ran: Run) -> None:
    assert trips(ran(odd_nets.zipped, controller)[1]) == trips(ran(odd_nets.plain, controller)[1])


@pytest.mark.parametrize("make", [odd_nets.pedestrians, odd_nets.bicycle_lanes], ids=lambda make: make.__name__)
def test_sidewalks_and_bicycle_lanes_hold_no_cars(make: Make, made: Callable[[Make], Path]) -> None:
    links, usual = (
        {link["id"]: link for link in inspection.inspect(streets.controllable(case.read(made(each))))["links"]}
        for each in (make, odd_nets.plain)
    )
    assert links["W-C"]["storage_veh"] == pytest.approx(usual["W-C"]["storage_veh"], rel=0.1)
    assert links["W-C"]["saturation_flow_veh_h"] == pytest.approx(usual["W-C"]["saturation_flow_veh_h"])


def test_every_stream_that_shares_a_letter_is_served(made: Callable[[Make], Path]) -> None:
    net = streets.controllable(case.read(made(odd_nets.shared_letters)))
    assert net.serves.any(axis=0).all()


def test_a_turn_that_passes_the_signals_by_waits_for_no_stage(made: Callable[[Make], Path]) -> None:
    net = streets.controllable(case.read(made(odd_nets.slip_lanes)))
    past = {("nC-C", "C-W"), ("W-C", "C-sC")}
    turns = [index for index, turn in enumerate(net.turns) if (net.links[turn.link].id, turn.to_edge) in past]
    assert turns
    assert net.unsignalled[turns].all()


@pytest.mark.parametrize("make", odd_nets.REFUSED, ids=lambda make: make.__name__)
@every_controller
def test_what_can_not_be_controlled_is_refused_in_one_line(
    make: Make, controller: str, made: Callable[[Make], Path], tmp_path: Path
) -> None:
    with pytest.raises(UtnError, match=odd_nets.REFUSED[make]) as caught:
        bridge.run(scenario(net=str(made(make)), controller=controller), tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("make", odd_nets.REFUSED, ids=lambda make: make.__name__)
def test_what_can_not_be_controlled_still_runs_under_its_own_signals(make: Make, ran: Run) -> None:
    assert ran(make, "native")[0]["arrived"] > 0
