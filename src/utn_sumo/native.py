"""`--controller native`: a scenario under the net's own signal programmes, measured as every other run is.

Nothing is added to it but records, so that the trips are those of the bare `sumo` with the same seed.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from utn_sumo import metrics, monitor, quiet, recording, streets, traffic
from utn_sumo.case import SUFFIX, Case
from utn_sumo.contract import Network
from utn_sumo.errors import UtnError
from utn_sumo.plant import untouched
from utn_sumo.plant.sumo import LOG, records, write_outputs
from utn_sumo.plant.untouched import Look
from utn_sumo.scenario import Scenario

NAME = "native"


def run(
    scenario: Scenario, folder: Path | None = None, on_look: Callable[[float, float, Look], None] | None = None
) -> dict[str, Any]:
    """Run a scenario under the net's own programmes; see `measured`.

    Signals are judged as far as we could control them, against the clearances that they show themselves.
    """
    chosen = of(scenario)
    try:
        judged = streets.controllable(chosen)
    except UtnError:
        judged = None
    return measured(scenario, chosen, judged, folder, on_look)


def measured(
    scenario: Scenario,
    chosen: Case,
    judged: Network | None,
    folder: Path | None,
    on_look: Callable[[float, float, Look], None] | None,
    *,
    programmes: str | None = None,
) -> dict[str, Any]:
    """Run a case by SUMO alone and return its measures under the names of SPEC 7; everything else is in the folder.

    `programmes` is the additional file with the signal programmes to show instead of the net's; signals are judged by
    the rules of the network `judged`. Queues and vehicles are the most on one road. What only our own links have is
    null. `on_look` gets the time into the run [s], how long it will be [s] (0 where that is unknown), and how full the
    roads are. Raises UtnError.
    """
    started = time.perf_counter()
    folder = recording.new_folder(folder, scenario.name)
    brought = scenario.net.endswith(SUFFIX)
    chosen = quiet.silenced(chosen, folder) if brought else _kept(chosen, folder)
    if programmes is not None:
        added = folder / recording.PROGRAMMES
        added.write_text(programmes, encoding="utf-8")
        chosen = replace(chosen, additional_files=(*chosen.additional_files, added))
    case = {"case": chosen.record()} if brought else {}
    settings = {"scenario": scenario.model_dump(), **case, "versions": recording.versions(untouched.version())}
    recording.write_json(folder / recording.SETTINGS, settings)
    outputs = folder / "outputs.add.xml"
    write_outputs(outputs)

    def look(seen: Look) -> None:
        if on_look:
            on_look(seen.time_s - chosen.begin_s, (chosen.end_s or chosen.begin_s) - chosen.begin_s, seen)

    outcome = untouched.run(
        [*chosen.arguments([outputs]), *records(folder, scenario.seed)],
        chosen.begin_s,
        chosen.end_s,
        folder / LOG,
        look,
    )
    verdict = judged and monitor.watch(judged, folder / "signals.xml", outcome.end_s - chosen.begin_s, chosen.begin_s)
    result = {
        "controller": scenario.controller,
        "execution": None,
        "net": scenario.net,
        "demand": scenario.demand,
        "seed": scenario.seed,
        "hours": (outcome.end_s - chosen.begin_s) / 3600,
        **metrics.trip_measures(folder / "trips.xml", chosen.called, outcome.end_s),
        "max_queue_veh": outcome.max_queue_veh,
        "max_vehicles_veh": outcome.max_vehicles_veh,
        "over_storage_veh": None,
        "teleports": metrics.teleports(folder / "statistics.xml"),
        "left_out_veh": metrics.left_out_veh(folder / LOG),
        "gridlock": None,
        "longest_red_s": None,
        "unsafe_signal_s": verdict and verdict.unsafe_signal_s,
        "fallbacks": 0,
        "sumo_time_s": outcome.sumo_time_s,
        "control_time_s": 0.0,
        "access_time_s": 0.0,
        "bridge_time_s": time.perf_counter() - started - outcome.sumo_time_s,
        "interrupted": outcome.interrupted,
        "left_alone": dict(judged.left_alone) if judged else {},
        "never_green": dict(judged.never_green) if judged else {},
        "unsafe_reasons": verdict.reasons[:20] if verdict else [],
        "fallback_reasons": [],
        "out": str(folder),
    }
    recording.write_json(folder / recording.RESULT, result)
    return result


def _kept(chosen: Case, folder: Path) -> Case:
    """A case of our own demand, with copies of its files in the run's folder."""
    (routes,) = chosen.route_files
    net = Path(shutil.copyfile(chosen.net_file, folder / recording.NET))
    kept = Path(shutil.copyfile(routes, folder / recording.ROUTES))
    return replace(chosen, file=net, net_file=net, route_files=(kept,))


def of(scenario: Scenario) -> Case:
    """The scenario's net and traffic: of a .sumocfg its own, else a net with demand drawn as for every controller."""
    if scenario.net.endswith(SUFFIX):
        return traffic.given(scenario)
    net = streets.named(scenario.net)
    options = (("time-to-teleport", "-1"), ("max-depart-delay", "-1"), ("collision.action", "warn"))
    return Case(
        net.net_file, net.net_file, (traffic.drawn(scenario, net),), (), 0.0, scenario.duration_s, -1.0, options
    )
