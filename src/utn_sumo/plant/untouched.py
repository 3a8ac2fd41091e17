"""SUMO as it is, with nobody at the signals: the net's own programmes, whatever they are."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from utn_sumo.errors import PlantError
from utn_sumo.plant.sumo import SumoPlant, broken_off, did_not_start

LOOK_S = 10.0
"""Time between two looks at how full the roads are."""


@dataclass(frozen=True)
class Look:
    """How full the roads are at a moment."""

    time_s: float
    halting_veh: int
    time_spent_veh_h: float
    """Since the run began, on the road or waiting to enter it, from the looks."""


@dataclass(frozen=True)
class Outcome:
    """How a run went, as far as its records do not tell."""

    end_s: float
    sumo_time_s: float
    max_queue_veh: float
    """Most halting vehicles on one road."""
    max_vehicles_veh: float
    """Most vehicles on one road."""
    interrupted: bool


def version() -> str:
    """SUMO's own version string."""
    import libsumo  # noqa: PLC0415 - heavy

    return str(libsumo.getVersion()[1])


def run(
    arguments: Sequence[str], begin_s: float, end_s: float | None, log: Path, on_look: Callable[[Look], None]
) -> Outcome:
    """Run SUMO from `begin_s` to `end_s`, or until nobody is left, and look at it every `LOOK_S`.

    Among its `arguments` is that its errors go to the file `log`.

    Raises PlantError if SUMO does not start or breaks off. A KeyboardInterrupt ends the run early.
    """
    import libsumo  # noqa: PLC0415 - heavy

    if SumoPlant.is_open():
        raise PlantError("SUMO already runs in this process: close that plant first, or use another process")
    started = time.perf_counter()
    now_s, queue_veh, vehicles_veh, interrupted, present_veh_s = begin_s, 0.0, 0.0, False, 0.0
    try:
        libsumo.start(["sumo", *arguments])
    except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
        raise did_not_start(error) from error
    spent_s = time.perf_counter() - started
    try:
        roads = [edge for edge in libsumo.edge.getIDList() if not edge.startswith(":")]
        while now_s < end_s if end_s is not None else libsumo.simulation.getMinExpectedNumber() > 0:
            now_s = now_s + LOOK_S if end_s is None else min(now_s + LOOK_S, end_s)
            started = time.perf_counter()
            libsumo.simulationStep(now_s)
            spent_s += time.perf_counter() - started
            halting = [libsumo.edge.getLastStepHaltingNumber(road) for road in roads]
            queue_veh = max([queue_veh, *halting])
            vehicles_veh = max([vehicles_veh, *map(libsumo.edge.getLastStepVehicleNumber, roads)])
            on_road = libsumo.vehicle.getIDCount()
            present_veh_s += LOOK_S * (on_road + len(libsumo.simulation.getPendingVehicles()))
            on_look(Look(now_s, sum(halting), present_veh_s / 3600))
    except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
        raise broken_off(libsumo, error, log) from error
    except KeyboardInterrupt:
        interrupted = True
    finally:
        started = time.perf_counter()
        libsumo.close()
        spent_s += time.perf_counter() - started
    return Outcome(now_s, spent_s, float(queue_veh), float(vehicles_veh), interrupted)
