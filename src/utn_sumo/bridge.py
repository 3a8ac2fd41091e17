"""The loop: plant -> detectors -> estimate -> forecast -> plan -> checked programme -> plant."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from utn_sumo import (
    calibration,
    controllers,
    demand,
    metrics,
    monitor,
    native,
    quiet,
    recording,
    streets,
    sumo_signals,
    traffic,
)
from utn_sumo.case import SUFFIX, Case
from utn_sumo.contract import Floats, Network
from utn_sumo.detectors import Miscount
from utn_sumo.errors import SettingError
from utn_sumo.estimation import Estimator
from utn_sumo.plant.sumo import LOG, SumoPlant
from utn_sumo.plant.untouched import Look
from utn_sumo.prediction import Predictor
from utn_sumo.scenario import Scenario
from utn_sumo.supervisor import Decision, Supervisor

UNKNOWN_VEH = 1.0
"""Vehicles that usually come onto a link amid it in a control step, where nobody says how many."""


LONGEST_RUN_S = 240 * 3600.0
"""As long as the longest run that a scenario may ask for: for one whose end nobody knows."""

OURS = {
    "execution": "plans nothing that could be carried out",
    "calibration": "has no model",
    "loop_error": "has no loops that could miscount",
    "forecast": "looks at no forecast",
    "refit_steps": "looks at no forecast",
}
"""Settings that only our own controllers go by, and why SUMO's do not."""


@dataclass(frozen=True)
class Progress:
    """How far a run is, for whoever watches it."""

    time_s: float
    duration_s: float
    """0, or `LONGEST_RUN_S`, where nobody knows."""
    time_spent_veh_h: float
    queue_veh: float


def run(
    scenario: Scenario, folder: Path | None = None, on_cycle: Callable[[Progress], None] | None = None
) -> dict[str, Any]:
    """Run a scenario and return its measures under the names of SPEC 7; everything else is in the folder.

    A KeyboardInterrupt ends the run early with a whole, readable result that says so. Raises UtnError.
    """
    check_execution(scenario)
    if alone := sumo_signals.RUNS.get(scenario.controller):
        return alone(scenario, folder, on_cycle and (lambda *seen: on_cycle(_progress(*seen))))
    chosen = traffic.given(scenario) if scenario.net.endswith(SUFFIX) else None
    net = streets.named(scenario.net) if chosen is None else streets.taken_over(chosen)
    # Controller and model see the calibrated links; plant, demand and counting go by the real ones.
    known = calibration.for_model(net, scenario.calibration)
    controller = controllers.build(scenario.controller, known, scenario.controller_settings)
    carried_out, execution = controllers.build_execution(scenario, known, controller)
    step_s, duration_s = net.control_step_s, _duration_s(scenario, chosen)
    steps = int(np.ceil(duration_s / step_s))
    driving = chosen or traffic.drawn(scenario, net)
    folder = recording.new_folder(folder, scenario.name)
    driving = _kept(driving, net, folder)
    predictor = _predictor(net, scenario, driving, steps)
    # Of other people's vehicles some start amid links, and nobody says how many.
    disturbance_veh = scenario.disturbance * scenario.demand * step_s / 3600 if chosen is None else UNKNOWN_VEH
    estimator = Estimator(net, known, scenario.loop_error, disturbance_veh)
    miscount, horizon = Miscount(net, scenario.loop_error, scenario.seed), controller.horizon
    supervisor = Supervisor(net, controller)
    tally = _Tally()
    interrupted = False

    # Small matrices: more threads than one only wait for each other.
    with (
        threadpool_limits(1),
        predictor,
        SumoPlant(net, driving, folder, seed=scenario.seed, duration_s=duration_s, execution=execution) as plant,
    ):
        # SUMO's own start is in its own time; what follows is its time, the controller's, or the bridge's.
        started, start_s = time.perf_counter(), plant.sumo_time_s
        recorder, state = recording.Recorder(folder, _settings(scenario, driving, plant.version)), estimator.initial()
        try:
            for step in range(steps):
                ahead = predictor.forecast(horizon)
                decision = supervisor.ask(state, ahead)
                seen = miscount.distort(plant.run(decision.plan, state))
                recorder.write(
                    {
                        "cycle": step,
                        "state": state,
                        "forecast": ahead,
                        "decision": decision,
                        "seen": seen,
                        "truth": plant.truth,
                    }
                )
                before, state = state, estimator.update(seen, ahead.demand_veh[0])
                waited = (before.source_queue_veh > 0) | (state.source_queue_veh > 0)
                predictor.observe(seen.entered_veh.sum(axis=0), waited, state.disturbance_veh)
                tally.add(decision, plant, np.bincount(net.turn_link, seen.turned_veh).astype(float))
                if chosen is not None and chosen.end_s is None and plant.is_over:
                    break
                if on_cycle:
                    queue_veh = float(seen.queue_veh.sum() + state.source_queue_veh.sum())
                    on_cycle(Progress(plant.time_s, duration_s, tally.time_spent_veh_h, queue_veh))
        except KeyboardInterrupt:
            interrupted = True
        finally:
            recorder.close()
    verdict = monitor.watch(net, folder / "signals.xml", plant.time_s, plant.begin_s, in_order=execution is None)
    greens = metrics.Greens(net, folder / "signals.xml", plant.time_s, plant.begin_s)
    trips = metrics.trip_measures(folder / "trips.xml", chosen.called if chosen else (), plant.begin_s + plant.time_s)
    elapsed_s = time.perf_counter() - started
    result = {
        "controller": scenario.controller,
        "execution": carried_out,
        "net": scenario.net,
        "demand": scenario.demand,
        "seed": scenario.seed,
        "hours": plant.time_s / 3600,
        **trips,
        "max_queue_veh": tally.max_queue_veh,
        "max_vehicles_veh": tally.max_vehicles_veh,
        "over_storage_veh": tally.over_storage_veh(net.storage_veh),
        "teleports": metrics.teleports(folder / "statistics.xml"),
        "left_out_veh": metrics.left_out_veh(folder / LOG),
        "gridlock": metrics.gridlocked(net, tally.x_veh, tally.left_veh, greens.by_turn_s(tally.ends_s)),
        "longest_red_s": greens.longest_wait_s(plant.waiting),
        "unsafe_signal_s": verdict.unsafe_signal_s,
        "fallbacks": tally.fallbacks + len(plant.failures),
        "sumo_time_s": plant.sumo_time_s,
        "control_time_s": tally.control_time_s + plant.decision_time_s,
        "access_time_s": plant.access_time_s,
        "bridge_time_s": elapsed_s - (plant.sumo_time_s - start_s) - tally.control_time_s - plant.decision_time_s,
        "interrupted": interrupted,
        "left_alone": dict(net.left_alone),
        "never_green": dict(net.never_green),
        "unsafe_reasons": verdict.reasons[:20],
        "fallback_reasons": [*tally.fallback_reasons, *plant.failures][:20],
        "out": str(folder),
    }
    recording.write_json(folder / recording.RESULT, result)
    return result


def _duration_s(scenario: Scenario, chosen: Case | None) -> float:
    """How long a run is at the most: of a case without an end until everybody has arrived."""
    if chosen is None:
        return scenario.duration_s
    return LONGEST_RUN_S if chosen.end_s is None else chosen.end_s - chosen.begin_s


def _progress(time_s: float, duration_s: float, seen: Look) -> Progress:
    return Progress(time_s, duration_s, seen.time_spent_veh_h, float(seen.halting_veh))


def _predictor(net: Network, scenario: Scenario, driving: Path | Case, steps: int) -> Predictor:
    """What foretells demand and disturbances. Of other people's demand there is no profile, and no look ahead."""
    profile_veh = coming_veh = None
    if isinstance(driving, Path):
        profile_veh_h = demand.mean_profile_veh_h(net, scenario.profile, steps, scenario.demand)
        profile_veh = profile_veh_h * net.control_step_s / 3600
        coming_veh = demand.coming_veh(net, driving, steps) if scenario.forecast == "perfect" else None
    return Predictor(
        net,
        scenario.forecast,
        profile_veh=profile_veh,
        coming_veh=coming_veh,
        disturbed=profile_veh is None or scenario.disturbance > 0,
        refit_steps=scenario.refit_steps,
        background=True,
    )


def check_execution(scenario: Scenario) -> None:
    """Raise SettingError for settings that nobody would go by: of a controller's own execution beside another one,
    `OURS` beside signals that SUMO switches itself, and under `native` any.
    """
    who, settings = scenario.controller, scenario.controller_settings
    if who not in sumo_signals.RUNS:
        if scenario.execution is not None and settings and controllers.takes_those_of_execution(who):
            name, value = next(iter(settings.items()))
            raise SettingError(
                f"setting {name!r} is {value!r}: it goes with the execution that controller {who!r} has itself, and "
                f"beside {scenario.execution!r} nobody takes it: leave one of the two out"
            )
        return
    for name, why in OURS.items():
        value = getattr(scenario, name)
        if value != Scenario.model_fields[name].default and (name, value) != ("calibration", "none"):
            raise SettingError(
                f"setting {name!r} is {value!r}: controller {who!r} {why}, SUMO switches its signals: leave it out"
            )
    if who == native.NAME and scenario.settings:
        name = next(iter(scenario.settings))
        raise SettingError(f"controller {who!r} has no setting {name!r}: it takes none")


class _Tally:
    """What the run adds up as it goes."""

    def __init__(self) -> None:
        self.control_time_s = 0.0
        self.time_spent_veh_h = 0.0
        self.fallbacks = 0
        self.fallback_reasons: list[str] = []
        self.x_veh: list[Floats] = []
        self.left_veh: list[Floats] = []
        self.ends_s: list[float] = []
        self._max_x_veh: list[Floats] = []
        self._max_queue_veh: list[Floats] = []

    def add(self, decision: Decision, plant: SumoPlant, left_veh: Floats) -> None:
        truth = plant.truth
        assert truth is not None
        self.control_time_s += decision.control_time_s
        if decision.rung != "solved":
            self.fallbacks += 1
            self.fallback_reasons.append(f"at {plant.time_s:g} s {decision.rung}: {decision.reason}")
        self.time_spent_veh_h += truth.time_spent_veh_h
        self.x_veh.append(truth.x_veh)
        self.left_veh.append(left_veh)
        self.ends_s.append(plant.time_s)
        self._max_x_veh.append(truth.max_x_veh)
        self._max_queue_veh.append(truth.max_queue_veh)

    @property
    def max_vehicles_veh(self) -> float:
        """Most vehicles on one link."""
        return float(np.max(self._max_x_veh, initial=0.0))

    @property
    def max_queue_veh(self) -> float:
        """Most standing vehicles on one link."""
        return float(np.max(self._max_queue_veh, initial=0.0))

    def over_storage_veh(self, storage_veh: Floats) -> float:
        """Most vehicles on one link beyond its storage."""
        if not self._max_x_veh:
            return 0.0
        return float(np.max(np.array(self._max_x_veh) - storage_veh, initial=0.0))


def _kept(driving: Path | Case, net: Network, folder: Path) -> Path | Case:
    """What the run is made from, as its folder keeps it."""
    if isinstance(driving, Case):
        return quiet.silenced(driving, folder)
    shutil.copyfile(net.net_file, folder / recording.NET)
    return Path(shutil.copyfile(driving, folder / recording.ROUTES))


def _settings(scenario: Scenario, driving: Path | Case, sumo: str) -> dict[str, Any]:
    brought = {"case": driving.record()} if isinstance(driving, Case) else {}
    return {"scenario": scenario.model_dump(), **brought, "versions": recording.versions(sumo)}
