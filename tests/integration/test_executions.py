"""Any planner with any execution: safe, recorded, and what goes wrong is said in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from utn_sumo import bridge, monitor, streets
from utn_sumo.contract import EXIT, Network
from utn_sumo.controllers import EXECUTION, registered
from utn_sumo.detectors import CAR_M, CREEPING_M_S, ids, write
from utn_sumo.errors import ControllerError, SettingError, UtnError
from utn_sumo.plant.eyes import Eyes, Sight
from utn_sumo.plant.heads import Heads
from utn_sumo.scenario import scenario

from . import odd_nets
from .odd_nets import Make

Run = Callable[..., tuple[dict[str, Any], Path]]

OWN = """
import numpy as np

class Keeps:
    def __init__(self, network, every_s=5):
        self.every_s = every_s
    def begin(self, plan, state):
        pass
    def wish(self, view):
        return view.stage

class Raises(Keeps):
    def wish(self, view):
        raise RuntimeError("not today")

class Strays(Keeps):
    def wish(self, view):
        return view.stage[::-1]

class Counts(Keeps):
    due_s = 0
    def wish(self, view):
        if view.time_s != self.due_s:
            raise RuntimeError(f"asked at {view.time_s}, not at {self.due_s}")
        self.due_s += self.every_s
        return view.stage

class Wavers(Counts):
    def wish(self, view):
        self.every_s = 1 + self.due_s % 4
        return super().wish(view)

class Turns(Keeps):
    def __init__(self, network):
        super().__init__(network)
        self.after = {s: j.stages[(k + 1) % len(j.stages)] for j in network.junctions for k, s in enumerate(j.stages)}
    def wish(self, view):
        stage = self.taken(view)
        for index in view.free.nonzero()[0]:
            if view.time_s - view.begin_s[index] >= 15:
                stage[index] = self.after[int(stage[index])]
        return stage
    def taken(self, view):
        return view.stage.copy()

class Scribbles(Turns):
    def taken(self, view):
        for seen in (view.set_waiting_veh, view.waiting_veh, view.near_veh, view.calling):
            seen[:] = 0
        for seen in (view.x_veh, view.entered_veh, view.left_veh, view.parted_veh):
            seen[:] = 1000
        return view.stage
    def wish(self, view):
        stage = super().wish(view)
        view.free[:], view.begin_s[:] = True, 0
        return stage

class Muddles(Keeps):
    def wish(self, view):
        view.stage[:] = (view.stage + 1) % 4
        return view.stage

class CountsBack(Keeps):
    def wish(self, view):
        view.stage[-1] = -1
        return view.stage

class Ends(Keeps):
    def wish(self, view):
        self.every_s = {5: 0, 6: -5, 7: float("nan"), 8: "q", 9: np.int64(4)}.get(int(view.time_s), 5)
        return view.stage

class Planner:
    horizon = 1
    def __init__(self, network, carried_out=None, every_s=5):
        self.network, self.execution = network, carried_out or Keeps(network, every_s)
    def plan(self, state, forecast):
        return self.network.equal_split()

class Hasty(Keeps):
    def __init__(self, network):
        self.every_s = 0

class Idle:
    def __init__(self, network):
        pass
"""


@pytest.fixture
def own(tmp_path: Path) -> str:
    path = tmp_path / "own.py"
    path.write_text(OWN, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("controller", ["fixed", "dmpc", "cmpc", "tuc", "priced"])
@pytest.mark.parametrize("execution", ["exact", *registered(EXECUTION)])
def test_any_planner_runs_with_any_execution(run_of: Run, controller: str, execution: str) -> None:
    result, folder = run_of(controller=controller, execution=execution, hours=0.1)
    assert result["execution"] == execution
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert (result["fallbacks"], result["fallback_reasons"]) == (0, [])
    assert result["arrived"] > 80
    assert result["longest_red_s"] <= 180
    assert json.loads((folder / "result.json").read_text(encoding="utf-8"))["execution"] == execution


@pytest.mark.parametrize("make", odd_nets.CASES, ids=lambda make: make.__name__)
def test_greens_that_end_early_are_safe_on_odd_nets(make: Make, made: Callable[[Make], Path], tmp_path: Path) -> None:
    chosen = scenario(net=str(made(make)), controller="fixed", execution="actuated", seed=5)
    result = bridge.run(chosen, tmp_path / "run")
    assert (result["unsafe_signal_s"], result["unsafe_reasons"]) == (0, [])
    assert (result["fallbacks"], result["fallback_reasons"]) == (0, [])
    assert result["arrived"] > 0
    assert result["longest_red_s"] <= 180


def test_without_a_name_it_is_the_controllers_own_or_exact(run_of: Run) -> None:
    for controller, execution in (("max_wave", "max_wave"), ("fixed", "exact")):
        default, _ = run_of(controller=controller, hours=0.1)
        named, _ = run_of(controller="fixed", execution=execution, hours=0.1)
        assert default["execution"] == execution
        assert default["total_delay_veh_h"] == named["total_delay_veh_h"]


def test_greens_that_end_early_save_delay_and_keep_the_order_of_stages(run_of: Run, utn17: Network) -> None:
    settings = {"controller": "fixed", "hours": 0.5, "demand": 0.6}
    exact, early = (run_of(execution=execution, **settings) for execution in ("exact", "actuated"))
    assert early[0]["total_delay_veh_h"] < 0.75 * exact[0]["total_delay_veh_h"]
    switches = monitor.read_switches(early[1] / "signals.xml")
    for junction in utn17.junctions:
        stages = {utn17.stages[stage].state: place for place, stage in enumerate(junction.stages)}
        places = [stages[state] for _, state in switches[junction.id] if state in stages]
        in_order = [(after - before) % len(stages) == 1 for before, after in pairwise(places) if after != before]
        # Out of order only over a stage that nobody was before.
        assert np.mean(in_order) > 0.5


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("Raises", "not today"),
        ("Strays", "no stage for each junction"),
        ("Muddles", "no stage for each junction"),
        ("CountsBack", "no stage for each junction"),
    ],
)
def test_an_execution_that_fails_is_written_down_and_everybody_still_gets_green(
    own: str, name: str, why: str, tmp_path: Path
) -> None:
    chosen = scenario(controller="fixed", execution=f"{own}:{name}", hours=0.2)
    result = bridge.run(chosen, tmp_path / "run")
    assert result["fallbacks"] > 0
    assert why in result["fallback_reasons"][0]
    assert result["unsafe_signal_s"] == 0
    assert result["arrived"] > 50


def test_what_an_execution_writes_into_what_it_sees_is_its_wish_alone(own: str, tmp_path: Path) -> None:
    copied, written = (
        bridge.run(scenario(controller="fixed", execution=f"{own}:{name}", hours=0.2), tmp_path / name)
        for name in ("Turns", "Scribbles")
    )
    assert written["fallback_reasons"] == []
    assert written["longest_red_s"] == copied["longest_red_s"] <= 180
    assert written["total_delay_veh_h"] == copied["total_delay_veh_h"]
    shown = [monitor.read_switches(tmp_path / name / "signals.xml") for name in ("Turns", "Scribbles")]
    assert shown[0] == shown[1]
    assert all(len(switches) > 50 for switches in shown[0].values())


def test_an_execution_that_does_not_say_when_to_ask_it_again_is_written_down_and_asked_after_a_second(
    own: str, tmp_path: Path
) -> None:
    result = bridge.run(scenario(controller="fixed", execution=f"{own}:Ends", hours=0.02), tmp_path / "run")
    said = [reason.rpartition(": `every_s` is ")[::2] for reason in result["fallback_reasons"]]
    assert [when.partition(" execution")[0] for when, _ in said] == ["at 5 s", "at 6 s", "at 7 s", "at 8 s"]
    assert [what.partition(":")[0] for _, what in said] == ["0", "-5", "nan", "'q'"]


@pytest.mark.parametrize("name", ["Counts", "Wavers"])
def test_an_execution_is_asked_every_time_whether_a_junction_is_free_or_none(
    own: str, name: str, tmp_path: Path
) -> None:
    """It may keep in mind what has come since: all junctions begin with a least green in which none is free."""
    chosen = scenario(controller="fixed", execution=f"{own}:{name}", hours=0.05)
    assert bridge.run(chosen, tmp_path / "run")["fallback_reasons"] == []


@pytest.mark.parametrize(
    ("settings", "kind", "complaint"),
    [
        ({"execution": "actuatd"}, ControllerError, "execution 'actuatd' is unknown: did you mean 'actuated'?"),
        ({"execution": "none.py:Own"}, ControllerError, "there is no file 'none.py'"),
        ({"execution": "OWN:Hasty"}, ControllerError, "make `every_s` 1 or more"),
        ({"execution": "OWN:Idle"}, ControllerError, "lacks `every_s`"),
        ({"execution": "OWN:Keeps", "settings": {"execution": {"every_s": "x"}}}, ControllerError, "every 'x' s: make"),
        (
            {"controller": "OWN:Planner", "settings": {"carried_out": "actuated"}},
            ControllerError,
            "execution 'actuated'",
        ),
        ({"controller": "OWN:Planner", "settings": {"carried_out": 3}}, ControllerError, "execution 3 of controller"),
        ({"controller": "OWN:Planner", "settings": {"every_s": 0.5}}, ControllerError, "decides every 0.5 s: make"),
        ({"execution": "actuated", "settings": {"execution": {"gap": 2}}}, SettingError, "did you mean 'gap_s'?"),
        ({"execution": "actuated", "settings": {"execution": {"gap_s": 0}}}, SettingError, "'gap_s' is 0"),
        ({"execution": "actuated", "settings": {"execution": 2}}, SettingError, "must be a table"),
        ({"execution": "exact", "settings": {"execution": {"gap_s": 2}}}, SettingError, "'execution.gap_s' is 2"),
        ({"settings": {"execution": {"gap_s": 2}}}, SettingError, "name the execution that takes it"),
        ({"controller": "actuated", "execution": "exact"}, SettingError, "leave it out"),
        ({"controller": "native", "execution": "priced"}, SettingError, "leave it out"),
        (
            {"controller": "recommended", "execution": "exact", "settings": {"horizon_s": 60}},
            SettingError,
            "'horizon_s' is 60: it goes with the execution that controller 'recommended' has itself",
        ),
        (
            {"controller": "max_pressure", "execution": "scheduled", "settings": {"every_s": 7}},
            SettingError,
            "beside 'scheduled' nobody takes it: leave one of the two out",
        ),
    ],
)
def test_a_mistake_is_named_and_leaves_nothing_behind(
    settings: dict[str, Any], kind: type[UtnError], complaint: str, own: str, tmp_path: Path
) -> None:
    settings = {"controller": "fixed", **settings}
    settings |= {name: settings[name].replace("OWN", own) for name in ("controller", "execution") if name in settings}
    with pytest.raises(kind) as caught:
        bridge.run(scenario(**settings), tmp_path / "run")
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_what_a_file_for_all_controllers_says_as_it_is_without_is_no_mistake_beside_sumo_s_own_signals() -> None:
    usual = {"calibration": "none", "loop_error": 0, "forecast": "starima", "refit_steps": 15}
    bridge.check_execution(scenario(controller="actuated", **usual))


class Counting:
    """A libsumo whose detectors see nobody, and which counts how often each kind of reading is made."""

    def __init__(self) -> None:
        self.asked: dict[str, int] = {}
        self.lanearea = self.inductionloop = self.edge = self.person = self

    def __getattr__(self, name: str) -> Callable[[str], int]:
        def read(_: str) -> int:
            self.asked[name] = self.asked.get(name, 0) + 1
            return 0

        return read


def test_zones_are_read_before_those_junctions_that_are_asked_for_and_no_others(utn17: Network) -> None:
    sumo = Counting()
    eyes, names = Eyes(utn17, ids(utn17), sumo), ids(utn17).set_zone
    own = utn17.link_junction[utn17.group_link]
    for junction in range(len(utn17.junctions)):
        sumo.asked.clear()
        eyes.zone_veh(np.arange(len(utn17.junctions)) == junction)
        expected = sum(len(lane) for group in np.flatnonzero(own == junction) for lane in names[group])
        assert sumo.asked == {"getLastStepVehicleNumber": expected}


def test_what_nobody_asks_for_is_not_read_and_nothing_is_read_twice(utn17: Network) -> None:
    sumo = Counting()
    eyes, heads = Eyes(utn17, ids(utn17), sumo), Heads(utn17, lambda index, state: None)
    sight = Sight(eyes, heads, 7.0, heads.free(7.0))
    assert sumo.asked == {}
    assert (sight.near_veh == sight.near_veh).all()
    assert sumo.asked == {"getLastStepVehicleNumber": sum(map(len, ids(utn17).area))}
    sight.gap_one_s(0)
    assert sumo.asked["getTimeSinceDetection"] == len(utn17.groups[0].lanes)
    assert "getLastStepHaltingNumber" not in sumo.asked


def test_who_stands_amid_a_junction_and_on_the_entry_of_the_road_ahead_is_seen(tmp_path: Path) -> None:
    net = streets.named(str(odd_nets.offsets(tmp_path)))
    names = ids(net)
    turn, other = [t for t, each in enumerate(net.turns) if names.amid[t] and each.next_link != EXIT][:2]
    standing, covered = set(names.amid[turn]), set(names.entry[net.turns[turn].next_link])

    class Jam(Counting):
        full = False

        def __getattr__(self, name: str) -> Callable[[str], int]:
            def read(detector: str) -> int:
                if name == "getTimeSinceDetection":
                    return 0 if self.full and detector in covered else 5
                return int(name == "getLastStepHaltingNumber" and detector in standing)

            return read

    sumo = Jam()
    eyes = Eyes(net, names, sumo)
    assert eyes.standing_amid_veh(turn) == len(standing)
    assert eyes.standing_amid_veh(other) == 0
    assert not eyes.is_taken(turn)
    sumo.full = True
    assert eyes.is_taken(turn)


def test_who_creeps_amid_a_junction_is_seen_to_stand_on_whichever_of_its_lanes(tmp_path: Path) -> None:
    import libsumo

    odd_nets.row("C", lanes=2).net(tmp_path, odd_nets.NO_TURNAROUNDS)
    case_file = odd_nets.case(
        tmp_path, odd_nets.traffic("C", period=4) + odd_nets.flow("left", "E-C", "C-sC", period=4)
    )
    net = streets.named(str(case_file))
    write(net, tmp_path / "detectors.add.xml", 90, within_step=True)
    eyes = Eyes(net, ids(net), libsumo)
    ahead = [turn for turn, each in enumerate(net.turns) if len(each.via_lanes) > 1]
    assert ahead
    creeping, off = 0, 0
    libsumo.start(["sumo", "-c", str(case_file), "-a", str(tmp_path / "detectors.add.xml"), "--no-step-log"])
    try:
        for _ in range(240):
            libsumo.simulationStep()
            for turn in ahead:
                inside = [veh for lane in net.turns[turn].via_lanes for veh in libsumo.lane.getLastStepVehicleIDs(lane)]
                slow = sum(libsumo.vehicle.getSpeed(vehicle) < CREEPING_M_S for vehicle in inside)
                creeping, off = creeping + slow, off + abs(eyes.standing_amid_veh(turn) - slow)
    finally:
        libsumo.close()
    assert creeping > 10
    assert off == 0


SEES = """
import libsumo
import numpy as np
from utn_sumo.contract import CLOSE_ZONES, ZONES_M

class Sees:
    every_s = 3
    def __init__(self, network, path):
        self.network, self.path = network, path
    def begin(self, plan, state):
        pass
    def wish(self, view):
        off, all_veh = 0.0, 0
        zone_veh, before_veh = view.zone_veh(np.ones(len(self.network.junctions), dtype=bool))
        close_veh = zone_veh[:, :CLOSE_ZONES].sum(axis=1) + before_veh[self.network.set_link, :CLOSE_ZONES].sum(axis=1)
        assert [view.close_one_veh(lane_set) for lane_set in range(len(close_veh))] == close_veh.tolist()
        for group, lanes in enumerate(self.network.groups):
            edge = self.network.links[lanes.link].edges[-1]
            away_m = [
                self.network.edge_length_m[edge] - libsumo.vehicle.getLanePosition(vehicle)
                for lane in lanes.lanes for vehicle in libsumo.lane.getLastStepVehicleIDs(f"{edge}_{lane}")
            ]
            true = np.histogram(away_m, [0.0, *ZONES_M])[0]
            off, all_veh = off + abs(true - zone_veh[group]).sum(), all_veh + true.sum()
        with open(self.path, "a", encoding="utf-8") as file:
            print(off, all_veh, file=file)
        return np.array([j.stages[int(view.time_s // 30) % len(j.stages)] for j in self.network.junctions])
"""


def test_zones_show_where_vehicles_are(tmp_path: Path) -> None:
    own, seen = tmp_path / "sees.py", tmp_path / "seen.txt"
    own.write_text(SEES, encoding="utf-8")
    settings = {"execution": {"path": str(seen)}}
    chosen = scenario(controller="fixed", execution=f"{own}:Sees", hours=0.3, settings=settings)
    assert bridge.run(chosen, tmp_path / "run")["fallbacks"] == 0
    off_veh, all_veh = np.loadtxt(seen).sum(axis=0)
    assert all_veh > 10_000
    # A vehicle that changes lanes is on two for a while.
    assert off_veh < 0.02 * all_veh


@pytest.mark.parametrize("make", odd_nets.CASES, ids=lambda make: make.__name__)
def test_zones_cover_what_the_detectors_see_and_nothing_twice(
    make: Make, made: Callable[[Make], Path], tmp_path: Path
) -> None:
    net = streets.named(str(made(make)))
    write(net, tmp_path / "detectors.add.xml", 90, within_step=True)
    areas: dict[str, list[tuple[float, float]]] = {}
    zones: dict[str, list[tuple[float, float]]] = {}
    for element in ET.parse(tmp_path / "detectors.add.xml").getroot().iter("laneAreaDetector"):
        if element.attrib["id"].startswith(("utn_amid", "utn_call", "utn_wait")):
            continue
        kind = zones if "_zone" in element.attrib["id"] else areas
        kind.setdefault(element.attrib["lane"], []).append(
            (float(element.attrib["pos"]), float(element.attrib["endPos"]))
        )
    named = ids(net)
    assert sum(map(len, zones.values())) == sum(
        len(names) for rows in (named.set_zone, named.upstream_zone) for zone in rows for names in zone
    )
    # Inside a node the zone sees a vehicle sooner than the area, which the edge before it ends with.
    inside = {lane for lane in zones if lane.startswith(":")}
    assert zones.keys() - inside == areas.keys() - inside
    assert areas.keys() <= zones.keys()
    for lane in inside:
        assert zones.pop(lane) == [(0.0, -0.01)]
        assert areas.pop(lane, [(CAR_M, -0.01)]) == [(CAR_M, -0.01)]
    for lane, ((begin_m, end_m),) in areas.items():
        pieces = sorted(zones[lane])
        assert pieces[0][0] == pytest.approx(begin_m, abs=0.01)
        assert end_m - CAR_M - 0.01 <= pieces[-1][1] <= end_m
        assert all(before[1] <= after[0] for before, after in pairwise(pieces))


ASIDE = """
import libsumo
import numpy as np

class Aside:
    every_s = 2
    def __init__(self, network, path):
        self.network, self.path = network, path
        self.off = {"t-A": ("t-st", set()), "u-B": ("u-su", set())}
    def begin(self, plan, state):
        pass
    def wish(self, view):
        parted = [view.parted_veh[self.network.link_index(link)] for link in self.off]
        for edge, gone in self.off.values():
            gone.update(libsumo.edge.getLastStepVehicleIDs(edge))
        truly = [len(gone) for _, gone in self.off.values()]
        every = np.ones(len(self.network.side_roads), dtype=bool)
        stand, left = view.side_standing_veh(every), view.side_left_veh(every)
        edges = [side.edge for side in self.network.side_roads]
        true = [libsumo.edge.getLastStepHaltingNumber(edge) for edge in edges]
        with open(self.path, "a", encoding="utf-8") as file:
            print(*left, *stand, *true, *parted, *truly, view.parted_veh.sum(), file=file)
        return view.stage
"""


def test_who_stands_on_side_roads_is_seen_and_who_leaves_them_is_counted_on_over_control_steps(tmp_path: Path) -> None:
    own, seen = tmp_path / "aside.py", tmp_path / "seen.txt"
    own.write_text(ASIDE, encoding="utf-8")
    chosen = scenario(
        net=str(odd_nets.side_streets(tmp_path)),
        controller="fixed",
        execution=f"{own}:Aside",
        settings={"execution": {"path": str(seen)}},
    )
    assert bridge.run(chosen, tmp_path / "run")["fallbacks"] == 0
    left, stand, true, parted, truly, all_parted = np.split(np.loadtxt(seen), [2, 4, 6, 8, 10], axis=1)
    # Who is on a loop as a control step begins is counted again in the new one, and in the old one no more.
    assert (np.diff(left, axis=0) >= -1).all()
    # One every 15 s and one every 30 s for 240 s; all have gone by 300 s. Steps of control are a minute.
    assert left[-1].tolist() == [16, 8]
    # Those who turn off the street, on either side: one may be amid the node, or on a loop as a control step begins.
    assert (np.abs(parted - truly) <= 1).all()
    assert (truly[-1] >= 5).all()
    assert (parted.sum(axis=1) == all_parted[:, 0]).all()
    # Who is slow, but does not stand by SUMO's edges, may stand by its detectors.
    assert true.max() > 0
    assert (stand >= true - 1).all()
    assert (stand[true > 0] > 0).mean() > 0.9


@pytest.mark.parametrize("controller", ["recommended", "max_wave", "max_pressure", "priced"])
def test_who_waits_alone_inside_the_node_before_a_last_edge_of_no_length_is_let_go(
    controller: str, tmp_path: Path
) -> None:
    file = odd_nets.hardly_an_edge(tmp_path)
    result = bridge.run(scenario(net=str(file), controller=controller), tmp_path / "run")
    assert (result["arrived"], result["unfinished"]) == (81, 0)
    (lone,) = (trip for trip in ET.parse(tmp_path / "run" / "trips.xml").iter("tripinfo") if trip.get("id") == "lone")
    waited_s = float(lone.attrib["waitingTime"])
    assert waited_s < 40
    assert abs(result["longest_red_s"] - waited_s) <= 5
