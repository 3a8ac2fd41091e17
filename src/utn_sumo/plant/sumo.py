"""SUMO as the plant: the one door to libsumo.

How a plan is handed over (tests/integration/test_plant.py shows 0.0 s of drift): at the second in which a junction's
cycle begins, `setProgramLogic` replaces its programme, which alone would leave the first green its old length, and
`setPhase` starts that green anew, so that the plan acts from that very second. Between two junctions' boundaries
the simulation jumps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from utn_sumo import detectors
from utn_sumo.case import Case, in_digits
from utn_sumo.contract import (
    AREA_REACH_M,
    LEAST_PAUSE_S,
    SAMPLE_S,
    Bools,
    Execution,
    Floats,
    Ints,
    Measurement,
    Network,
    Plan,
    State,
    View,
    is_pause,
)
from utn_sumo.errors import PlanError, PlantError
from utn_sumo.plant.eyes import Eyes, Sight
from utn_sumo.plant.functions import bare
from utn_sumo.plant.heads import Heads
from utn_sumo.plant.patience import LONGEST_RED_S, longest_red_s
from utn_sumo.signals import cycle_phases

PROGRAM = "utn"
NO_WORDS = "Process Error"
"""What SUMO's errors say that it has written down elsewhere."""
STATIC = 0
"""SUMO's type of programmes of fixed times."""
LOG = "sumo.log"
"""What SUMO complains of, in a run's folder."""


@dataclass(frozen=True)
class Truth:
    """What SUMO itself knows over one control step: for the record and for tests, never for a controller."""

    x_veh: Floats
    """(Z,) vehicles on each link at the end of the step."""
    waiting_veh: Floats
    """(Z,) vehicles that wait to be inserted on each link at its end."""
    queue_veh: Floats
    """(Z,) halting vehicles on each link at its end."""
    max_x_veh: Floats
    """(Z,) largest sampled number of vehicles on each link."""
    max_queue_veh: Floats
    """(Z,) largest sampled number of halting vehicles on each link."""
    in_network_veh: int
    """Vehicles on any road at the end of the step."""
    time_spent_veh_h: float
    """Time that vehicles spent in the step, on the road or waiting to enter, from the samples."""


class SumoPlant:
    """One SUMO run behind libsumo. Use as a context manager; only one may be open in a process."""

    _owner: SumoPlant | None = None

    def __init__(
        self,
        network: Network,
        routes: Path | Case,
        folder: Path,
        *,
        seed: int,
        duration_s: float,
        execution: Execution | None = None,
    ):
        """`folder` takes SUMO's own outputs: trips.xml, signals.xml (every switch), sumo.log.

        With an `execution` that carries the plans out, else they are shown to the second.

        With a case for `routes` its files, its window's begin and its other options are SUMO's; times count from there.
        """
        self.network = network
        self.routes = routes
        self.folder = folder
        self.seed = seed
        self.duration_s = duration_s
        self.time_s = 0.0
        self.begin_s = routes.begin_s if isinstance(routes, Case) else 0.0
        """SUMO's time at our 0."""
        self.sumo_time_s = 0.0
        """Wall time spent inside SUMO: start, steps, close."""
        self.decision_time_s = 0.0
        """Wall time of the execution's decisions, reading what they are made by included."""
        self.access_time_s = 0.0
        """Of that, inside SUMO's functions: those that read detectors, found by name, and those that show signals."""
        self.truth: Truth | None = None
        self.waiting: list[tuple[float, Bools]] = []
        """(time, whether somebody stands before the stop line (L,)) at each sample, for the record."""
        self.failures: list[str] = []
        """What an execution did wrong, whose junctions then kept their stages."""
        self._ids = detectors.ids(network)
        self._entered: list[tuple[float, Floats]] = []
        """(time, what the entry loops have counted since the control step began) at each reading."""
        self._boundary_s = [junction.offset_s % junction.cycle_s for junction in network.junctions]
        self._junctions = np.arange(len(network.junctions))
        self._execution = execution
        self._heads: Any = None
        self._eyes: Any = None
        self._set_state: Any = None
        self._decision_s = 0.0
        """When the execution is asked next."""
        self._sumo: Any = None
        self._places: dict[str, list[tuple[Any, str]]] = {}
        """Of each edge what SUMO counts its motor vehicles by: the edge as a whole, or some of its lanes."""

    def __enter__(self) -> Self:
        if SumoPlant._owner is not None:
            # libsumo would silently replace the first simulation by the second.
            raise PlantError("SUMO already runs in this process: close that plant first, or use another process")
        import libsumo  # noqa: PLC0415 - heavy, and only this door needs it

        additional = [self.folder / "detectors.add.xml", self.folder / "outputs.add.xml"]
        within_step = self._execution is not None
        detectors.write(self.network, additional[0], self.network.control_step_s, within_step=within_step)
        write_outputs(additional[1])
        arguments = self._arguments(additional)
        started = time.perf_counter()
        try:
            libsumo.start(["sumo", *arguments])
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise did_not_start(error) from error
        self.sumo_time_s = time.perf_counter() - started
        SumoPlant._owner = self
        self._sumo = libsumo
        self._eyes = Eyes(self.network, self._ids, libsumo)
        self._set_state = bare(libsumo, "trafficlight", "setRedYellowGreenState")
        lets_out = getattr(self._execution, "lets_out", False)
        longest_s = longest_red_s(self.routes.teleport_s) if isinstance(self.routes, Case) else LONGEST_RED_S
        self._heads = Heads(self.network, self._show, self._eyes if lets_out else None, longest_s)
        for edge, lanes in self.network.edge_lanes.items():
            whole = libsumo.edge.getLaneNumber(edge) == len(lanes)
            places = [(libsumo.edge, edge)] if whole else [(libsumo.lane, f"{edge}_{lane}") for lane in lanes]
            self._places[edge] = places
        return self

    def _arguments(self, additional: list[Path]) -> list[str]:
        if isinstance(self.routes, Case):
            window = replace(self.routes, end_s=self.begin_s + self.duration_s)
            return [*window.arguments(additional), *records(self.folder, self.seed)]
        return run_arguments(
            self.network.net_file, self.routes, additional, self.folder, seed=self.seed, duration_s=self.duration_s
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        started = time.perf_counter()
        self._sumo.close()
        self.sumo_time_s += time.perf_counter() - started
        self._sumo = None
        SumoPlant._owner = None

    @classmethod
    def is_open(cls) -> bool:
        """Whether this process has a plant: libsumo takes one simulation at a time."""
        return cls._owner is not None

    @property
    def is_over(self) -> bool:
        """Whether nobody is on the road, or will be."""
        return int(self._sumo.simulation.getMinExpectedNumber()) == 0

    @property
    def version(self) -> str:
        """SUMO's own version string."""
        return str(self._sumo.getVersion()[1])

    def run(self, plan: Plan, state: State | None = None) -> Measurement:
        """Run one control step under `plan` and return what the detectors saw.

        Each junction takes the plan over where its own cycle begins, and repeats it if its cycle is
        shorter than the control step; an execution makes of it what it likes, and of the `state` that it was made from.
        Raises PlantError if SUMO breaks off.
        """
        end_s = min(self.time_s + self.network.control_step_s, self.duration_s)
        peak_x = np.zeros(len(self.network.links))
        peak_queue = np.zeros(len(self.network.links))
        try:
            spent_veh_s = 0.0
            self._entered = [(self.time_s, np.zeros(len(self.network.links)))]
            sampled_s = self.time_s
            if self._execution is not None and state is not None:
                self._eyes.begin(self.time_s, state.x_veh)
                self._begin(self._execution, plan, state)
            while self.time_s < end_s:
                switched_s = self._switch(plan) if self._execution is None else self._decide(self._execution)
                sample_s = (self.time_s // SAMPLE_S + 1) * SAMPLE_S
                self.time_s = min(sample_s, end_s, switched_s)
                self._step()
                if self._execution is not None and self.time_s % SAMPLE_S and self.time_s < end_s:
                    continue
                self._entered.append((self.time_s, self._entered_so_far()))
                x_veh = self._by_link("getLastStepVehicleNumber")
                np.maximum(peak_x, x_veh, out=peak_x)
                spent_veh_s += self._present() * (self.time_s - sampled_s)
                sampled_s = self.time_s
                self.waiting.append((self.time_s, self._eyes.by_set(self._eyes.standing_veh()) > 0))
                queue_veh = self._by_link("getLastStepHaltingNumber")
                np.maximum(peak_queue, queue_veh, out=peak_queue)
            pending = self._sumo.edge.getPendingVehicles
            waiting = np.array([float(sum(len(pending(edge)) for edge in link.edges)) for link in self.network.links])
            self.truth = Truth(
                x_veh, waiting, queue_veh, peak_x, peak_queue, self._sumo.vehicle.getIDCount(), spent_veh_s / 3600
            )
            return self._measure()
        except (self._sumo.TraCIException, self._sumo.FatalTraCIError) as error:
            raise broken_off(self._sumo, error, self.folder / LOG) from error

    def redraw(self, onward: Callable[[int], list[str]], rng: np.random.Generator, speed_share: float) -> None:
        """Give every vehicle on the road a new future: another way, and a slightly other speed.

        The way is new from the next junction on for those that are still before the reach of its lane-area detectors;
        for those within it from the junction after that, since the lane that they are in has settled the turn.
        `onward` draws the edges from the start of a link to an exit.
        """
        vehicles, network = self._sumo.vehicle, self.network
        first_edge = {link.edges[0]: index for index, link in enumerate(network.links)}
        for name in sorted(vehicles.getIDList()):
            route, at = list(vehicles.getRoute(name)), vehicles.getRouteIndex(name)
            ahead = next((place for place in range(at + 1, len(route)) if route[place] in first_edge), len(route))
            start = next((place for place in range(at, -1, -1) if route[place] in first_edge), None)
            edges = route[at:ahead]
            if start is not None:
                link = network.links[first_edge[route[start]]]
                rest_m = sum(network.edge_length_m[edge] for edge in link.edges[at - start :])
                to_stop_m = rest_m - vehicles.getLanePosition(name)
                on_edge = vehicles.getRoadID(name) == route[at]
                if on_edge and to_stop_m > AREA_REACH_M:
                    vehicles.setRoute(name, onward(first_edge[route[start]])[at - start :])
                    edges = []
            if edges and ahead < len(route):
                vehicles.setRoute(name, [*edges, *onward(first_edge[route[ahead]])])
            factor = vehicles.getSpeedFactor(name) * (1 + speed_share * rng.standard_normal())
            vehicles.setSpeedFactor(name, factor)

    def _step(self) -> None:
        started = time.perf_counter()
        self._sumo.simulationStep(self.begin_s + self.time_s)
        self.sumo_time_s += time.perf_counter() - started

    def _switch(self, plan: Plan) -> float:
        """Hand the plan over where a cycle begins now; when the next one does."""
        if self.time_s == 0:
            self._lead_in(plan)
        for index, boundary_s in enumerate(self._boundary_s):
            if boundary_s == self.time_s:
                self._hand_over(index, plan.green_s)
                self._boundary_s[index] += self.network.junctions[index].cycle_s
        return min(self._boundary_s)

    def _decide(self, execution: Execution) -> float:
        """Ask the execution if it is time, and show what is due; when there is something to do next."""
        started, read_s = time.perf_counter(), self._eyes.sumo_time_s
        heads: Heads = self._heads
        if self.time_s == 0:
            heads.start(self.time_s)
        heads.advance(self.time_s)
        if self.time_s >= self._decision_s:
            free = heads.free(self.time_s)
            # An execution that keeps in mind who has come looks every time, though no junction may be free.
            view = Sight(self._eyes, heads, self.time_s, free)
            # Whatever a foreign execution writes into what it sees: nothing here goes by that.
            heads.patience.look(view)
            wish = heads.patience.allow(self._wish(execution, view), heads.stage, self.time_s)
            if wish is not heads.stage:
                for index in (free & (wish != heads.stage)).nonzero()[0].tolist():
                    heads.switch(index, int(wish[index]), self.time_s)
            self._decision_s += self._pause_s(execution)
        self.access_time_s += self._eyes.sumo_time_s - read_s
        self.decision_time_s += time.perf_counter() - started
        return min(self._decision_s, heads.next_s)

    def _begin(self, execution: Execution, plan: Plan, state: State) -> None:
        started = time.perf_counter()
        try:
            execution.begin(plan, state)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a foreign execution may raise anything
            self._failed(error)
        self.decision_time_s += time.perf_counter() - started

    def _wish(self, execution: Execution, view: View) -> Ints:
        """What the execution wishes; the heads' own stages where that is no others, or names none of each junction."""
        present: Ints = self._heads.stage
        try:
            wish = np.asarray(execution.wish(view))
            # Counting takes half the time of any().
            if wish is view.stage and not np.count_nonzero(wish != present):
                return present
            others = wish.shape != present.shape or (wish < 0) | (self.network.stage_junction[wish] != self._junctions)
            if np.count_nonzero(others):
                raise PlanError(f"{wish.tolist()} is no stage for each junction")  # noqa: TRY301 - one way out
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a foreign execution may raise anything
            self._failed(error)
            return present
        return wish

    def _pause_s(self, execution: Execution) -> float:
        """Time until the execution is asked again; the least there is if it does not say."""
        try:
            every_s = execution.every_s
            if not is_pause(every_s):
                raise PlanError(f"`every_s` is {every_s!r}: make it 1 or more")  # noqa: TRY301 - one way out
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a foreign execution may raise anything
            self._failed(error)
            return LEAST_PAUSE_S
        return every_s

    def _failed(self, error: BaseException) -> None:
        self.failures.append(f"at {self.time_s:g} s execution: {type(error).__name__}: {error}")

    def _show(self, index: int, state: str) -> None:
        started = time.perf_counter()
        self._set_state(self.network.junctions[index].id, state)
        self.access_time_s += time.perf_counter() - started

    def _present(self) -> int:
        return int(self._sumo.vehicle.getIDCount()) + len(self._sumo.simulation.getPendingVehicles())

    def _hand_over(self, index: int, green_s: Floats) -> None:
        lights = self._sumo.trafficlight
        junction = self.network.junctions[index]
        phases = [
            lights.Phase(float(duration), state) for state, duration in cycle_phases(self.network, index, green_s)
        ]
        lights.setProgramLogic(junction.id, lights.Logic(PROGRAM, 0, 0, phases))
        lights.setPhase(junction.id, 0)

    def _lead_in(self, plan: Plan) -> None:
        """Until a junction's first cycle begins show the end of one, where SUMO by itself would not be at its end then.

        It is with programmes of fixed times, not with those whose greens SUMO ends as it thinks best. Nor may it show
        what is mended.
        """
        lights = self._sumo.trafficlight
        for index, (junction, until_s) in enumerate(zip(self.network.junctions, self._boundary_s, strict=True)):
            if until_s == 0:
                continue
            types = {logic.programID: logic.type for logic in lights.getAllProgramLogics(junction.id)}
            if types[lights.getProgram(junction.id)] == STATIC and not junction.is_mended:
                continue
            self._hand_over(index, plan.green_s)
            durations_s = [seconds for _, seconds in cycle_phases(self.network, index, plan.green_s)]
            place, rest_s = len(durations_s) - 1, until_s
            while rest_s > durations_s[place]:
                rest_s -= durations_s[place]
                place -= 1
            lights.setPhase(junction.id, place)
            lights.setPhaseDuration(junction.id, rest_s)

    def _by_link(self, getter: str) -> Floats:
        """The sum of a getter over each link's lanes for motor vehicles."""
        return np.array(
            [
                float(sum(getattr(kind, getter)(name) for edge in link.edges for kind, name in self._places[edge]))
                for link in self.network.links
            ]
        )

    def _interval(self) -> tuple[Any, Any]:
        """Getters of a loop's count and occupancy [%] over the present control step, until now.

        At the step's end its interval has just closed; before it, what the interval has so far is meant.
        """
        loop = self._sumo.inductionloop
        if self.time_s % self.network.control_step_s == 0:
            return loop.getLastIntervalVehicleNumber, loop.getLastIntervalOccupancy
        return loop.getIntervalVehicleNumber, loop.getIntervalOccupancy

    def _entered_so_far(self) -> Floats:
        return _total(self._interval()[0], self._ids.entry)

    def _measure(self) -> Measurement:
        area = self._sumo.lanearea
        counted, covered = self._interval()

        def occupancy(groups: Sequence[Sequence[str]]) -> Floats:
            return np.asarray(_total(covered, groups) / (100 * np.array([len(group) for group in groups])))

        times, readings = zip(*self._entered, strict=True)
        # A loop takes back whom it has counted standing if they change lanes on it: the later reading holds.
        entered = np.minimum.accumulate(np.array(readings)[::-1])[::-1]
        start_s = times[0]
        edges_s = start_s + self.network.sample_s * np.arange(self.network.samples + 1)
        by_sample = [np.diff(np.interp(edges_s, times, column)) for column in entered.T]
        return Measurement(
            time_s=self.time_s,
            entered_veh=np.array(by_sample).T,
            turned_veh=_total(counted, self._ids.turn),
            queue_veh=_total(area.getLastStepHaltingNumber, self._ids.area),
            group_queue_veh=_total(area.getLastStepHaltingNumber, self._ids.group),
            group_seen_veh=_total(area.getLastStepVehicleNumber, self._ids.group),
            beside_veh=_total(counted, self._ids.joining) - _total(counted, self._ids.parting),
            uncounted_veh=self._eyes.uncounted_veh,
            seen_veh=_total(area.getLastStepVehicleNumber, self._ids.area),
            entry_occupancy=occupancy(self._ids.entry),
            stop_line_occupancy=occupancy(self._ids.stop_line),
        )


def _total(getter: Any, groups: Sequence[Sequence[str]]) -> Floats:
    """The sum of a getter over each group of detectors."""
    return np.array([float(sum(map(getter, group))) for group in groups])


def write_outputs(path: Path) -> None:
    """Additional file that makes SUMO record every signal switch beside its trips."""
    path.write_text(
        '<additional><timedEvent type="SaveTLSSwitchStates" dest="signals.xml"/></additional>\n', encoding="utf-8"
    )


def run_arguments(
    net_file: Path, routes: Path, additional: Sequence[Path], folder: Path, *, seed: int, duration_s: float
) -> list[str]:
    """Options of a run, the same for libsumo and for the bare `sumo` binary, which makes replays equal."""
    return [
        "--net-file", str(net_file),
        "--route-files", str(routes),
        "--additional-files", ",".join(map(str, additional)),
        "--begin", "0",
        "--end", f"{duration_s:g}",
        "--step-length", "1",
        "--time-to-teleport", "-1",
        "--collision.action", "warn",
        "--max-depart-delay", "-1",
        *records(folder, seed),
    ]  # fmt: skip


def records(folder: Path, seed: int) -> list[str]:
    """Options that make SUMO write down every trip, and nothing of its own to the screen."""
    return [
        "--seed", str(seed),
        "--tripinfo-output", str(folder / "trips.xml"),
        "--tripinfo-output.write-unfinished",
        "--tripinfo-output.write-undeparted",
        "--statistic-output", str(folder / "statistics.xml"),
        "--no-step-log",
        "--duration-log.disable",
        "--no-warnings",
        "--error-log", str(folder / LOG),
    ]  # fmt: skip


def did_not_start(error: Exception) -> PlantError:
    """What to raise for an error before the run; SUMO itself says of most on standard error what it is."""
    said = first_line(error)
    return PlantError(f"SUMO did not start ({'see above' if said == NO_WORDS else said}): mend the scenario")


def broken_off(sumo: Any, error: Exception, log: Path) -> PlantError:
    """What to raise for an error amid a run of `sumo`, the module libsumo."""
    time_s = in_digits(sumo.simulation.getTime())
    return PlantError(f"SUMO broke off at {time_s} s of its time ({first_line(error)}): mend the scenario, see {log}")


def first_line(error: Exception) -> str:
    """What SUMO says of an error, without the rest."""
    return (str(error).splitlines() or [type(error).__name__])[0]
