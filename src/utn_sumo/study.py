"""Studies over several runs, as the commands call them: mismatch of model and plant, calibration of the model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from utn_sumo import (
    bridge,
    calibration,
    floor,
    forecast_report,
    mismatch,
    plots,
    processes,
    recording,
    streets,
    sumo_signals,
    traffic,
)
from utn_sumo.case import SUFFIX
from utn_sumo.errors import SettingError
from utn_sumo.model import check_step
from utn_sumo.recording import Log
from utn_sumo.scenario import Scenario, scenario

FLOOR_CUTS = 4
FLOOR_REPLICAS = 6
INPUTS = ("known", "forecast")


def record(scenarios: Sequence[Scenario], folder: Path, tick: Callable[[], None], least_steps: int = 1) -> list[Path]:
    """Run the scenarios in parallel processes and return their result folders; `tick` is called after each.

    Raises SettingError before any that `check` refuses.
    """
    for item in scenarios:
        check(item, least_steps)
    jobs = [(item, folder / "runs" / f"demand{item.demand:g}-seed{item.seed}") for item in scenarios]
    with processes.pool(afresh=True) as pool:
        for _ in pool.map(_record, jobs):
            tick()
    return [path for _, path in jobs]


def _record(job: tuple[Scenario, Path]) -> None:
    bridge.run(*job)


def check(item: Scenario, least_steps: int) -> None:
    """Raises SettingError for a scenario without a record of control steps, or with fewer than `least_steps`."""
    if item.controller in sumo_signals.RUNS:
        raise SettingError(
            f"setting 'controller' is {item.controller!r}: SUMO switches its signals, and no control step is on "
            "record: name one that plans, as dmpc"
        )
    duration_s: float | None = item.duration_s
    if item.net.endswith(SUFFIX):
        chosen = traffic.given(item)
        duration_s = None if chosen.end_s is None else chosen.end_s - chosen.begin_s
    step_s = streets.named(item.net).control_step_s
    if duration_s is not None and np.ceil(duration_s / step_s) < least_steps:
        raise SettingError(
            f"setting 'hours' gives runs of {duration_s / 3600:.3g} h: make them {least_steps} control steps or more, "
            f"{np.ceil(least_steps * step_s / 36) / 100:g} h"
        )


def study_mismatch(
    base: dict[str, Any],
    demands: Sequence[float],
    seeds: Sequence[int],
    folder: Path,
    *,
    step_s: float | None,
    horizon: int,
    inputs: str,
    turning: str,
    with_floor: bool,
    tick: Callable[[], None],
) -> list[dict[str, Any]]:
    """The mismatch by demand: one object each, under the names of `mismatch.summary`, also in `folder`/mismatch.json.

    The net of `base` may be a .sumocfg, whose traffic `demands` scale. Without a `step_s` the model steps as the loops
    are read, every 10 s or as near under it as divides the control step.
    """
    for name, value in (("inputs", inputs), ("turning", turning)):
        if value not in INPUTS:
            raise SettingError(f"setting {name!r} is {value!r}: it must be 'known' or 'forecast'")
    whole = streets.named(base["net"])
    model = calibration.for_model(whole, base.get("calibration"))
    step_s = whole.sample_s if step_s is None else step_s
    check_step(whole, step_s)
    results = []
    for demand in demands:
        items = [scenario(**base, demand=demand, seed=seed) for seed in seeds]
        folders = record(items, folder, tick, horizon + 2)
        log = Log.stack([recording.read_log(path) for path in folders])
        if len(log.green_s) <= horizon + 1:
            raise SettingError(
                f"the runs were over after {len(log.green_s)} control steps: make them more than {horizon + 1}"
            )
        floor_veh = None
        if with_floor:
            cuts = np.linspace(1, len(log.green_s) - horizon, FLOOR_CUTS + 2)[1:-1].astype(int)
            floor_veh = floor.spread(whole, folders[0], cuts.tolist(), FLOOR_REPLICAS, horizon)
            tick()
        found = mismatch.errors(
            model, log, step_s, horizon, known_demand=inputs == "known", known_turning=turning == "known"
        )
        results.append(
            {
                "net": base["net"],
                "controller": items[0].controller,
                "demand": demand,
                "seeds": list(seeds),
                "hours": len(log.x_veh) * whole.control_step_s / 3600,
                "step_s": step_s,
                "inputs": inputs,
                "turning": turning,
                **mismatch.summary(model, found, floor_veh),
            }
        )
        plots.mismatch(results[-1], model, found, folder)
        # One that is stopped keeps what it has.
        recording.write_json(folder / "mismatch.json", {"results": results})
    return results


def study_forecasts(
    folders: Sequence[Path], folder: Path, *, horizon: int, refit_steps: int, tick: Callable[[], None]
) -> dict[str, Any]:
    """Errors of the forecasts over recorded runs, as `forecast_report.summary` gives them; a plot into `folder`."""
    jobs = [(path, horizon, refit_steps) for path in folders]
    runs = []
    with processes.pool() as pool:
        for found in pool.map(_judge, jobs):
            runs.append(found)
            tick()
    first = forecast_report.recorded(folders[0]).model_dump()
    kept = ("net", "controller", "demand", "profile", "noise", "hours")
    result = {
        **{name: first[name] for name in kept},
        "runs": len(runs),
        "horizon": horizon,
        "methods": forecast_report.summary(runs),
    }
    plots.forecasts(result, folder)
    return result


def _judge(job: tuple[Path, int, int]) -> dict[str, list[float]]:
    with threadpool_limits(1):
        return forecast_report.rmse_veh_h(*job)


def study_calibration(
    base: dict[str, Any],
    demands: Sequence[float],
    seeds: Sequence[int],
    folder: Path,
    *,
    step_s: float | None,
    tick: Callable[[], None],
) -> dict[str, Any]:
    """Record runs and fit the model with a step of `step_s` to them: the content of a calibration file.

    Net, demands and step are as in `study_mismatch`.
    """
    whole = streets.named(base["net"])
    step_s = whole.sample_s if step_s is None else step_s
    check_step(whole, step_s)
    items = [scenario(**base, demand=demand, seed=seed) for demand in demands for seed in seeds]
    log = Log.stack([recording.read_log(path) for path in record(items, folder, tick, calibration.HORIZON + 2)])
    fitted = calibration.calibrate(whole, log, step_s)
    made = {
        "step_s": step_s,
        "net": base["net"],
        "controller": items[0].controller,
        "demands": list(demands),
        "seeds": list(seeds),
    }
    hours = len(log.x_veh) * whole.control_step_s / 3600
    return {"made_from": {**made, "hours": hours}, **fitted}
