"""How far forecasts of the demand are from what came, by method and step ahead, over recorded runs.

Each run's history is given to a predictor as the loop gives it, control step by control step; what the forecasts are
held against are the departures in the run's own route file.

Runs differ more among themselves than methods do in one run, as one day is busier than another. Intervals are therefore
within runs: of every run's errors its own mean over the methods is taken away first (Cousineau 2005, with Morey's 2008
correction). `ratio` is the error over that of `profile` in the same run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from utn_sumo import case, demand, network, recording
from utn_sumo.case import SUFFIX
from utn_sumo.contract import Floats, Network
from utn_sumo.errors import ResultError, SettingError
from utn_sumo.prediction.predictor import ADOPTED_AFTER, LEAST_ROWS, METHODS, Predictor
from utn_sumo.recording import Log
from utn_sumo.scenario import Scenario, explain

FIRST_STEP = LEAST_ROWS + ADOPTED_AFTER
"""From which on forecasts are judged: before it there is none from a fitted model."""
CONFIDENCE = 0.95


def recorded(folder: Path) -> Scenario:
    """The scenario of a recorded run. Raises ResultError for a folder that holds none."""
    try:
        return Scenario(**recording.read_json(folder, recording.SETTINGS)["scenario"])
    except (KeyError, TypeError, ValidationError) as error:
        reason = explain(error, Scenario.model_fields) if isinstance(error, ValidationError) else "there is none"
        raise ResultError(
            f"{str(folder)!r} lacks a run's scenario ({reason}): give a folder that `utn run` wrote"
        ) from error


def check_alike(folders: Sequence[Path]) -> None:
    """Raises SettingError for recorded runs that differ in more than their seeds, or a seed that two of them have.

    Raises ResultError for a folder that holds no run.
    """
    first, *others = ((folder, recorded(folder)) for folder in folders)
    seeds = {first[1].seed: first[0]}
    for folder, chosen in others:
        for name in Scenario.model_fields:
            mine, its = getattr(chosen, name), getattr(first[1], name)
            if name not in {"seed", "net"} and mine != its:
                raise SettingError(
                    f"run {str(folder)!r} has {name} {mine!r}, and {str(first[0])!r} {its!r}: forecasts are judged "
                    "over runs that differ by their seeds alone"
                )
        if case.digest(folder / recording.NET) != case.digest(first[0] / recording.NET):
            raise SettingError(f"runs {str(folder)!r} and {str(first[0])!r} are of two nets: give runs of one")
        if chosen.seed in seeds:
            raise SettingError(
                f"runs {str(folder)!r} and {str(seeds[chosen.seed])!r} have one seed, {chosen.seed}: give one of them"
            )
        seeds[chosen.seed] = folder


def rmse_veh_h(folder: Path, horizon: int, refit_steps: int) -> dict[str, list[float]]:
    """Of one recorded run, by method and step ahead; plain data, so that runs can be judged in processes of their own.

    Raises ResultError for a folder that holds no run, SettingError for a run that is too short.
    """
    scenario = recorded(folder)
    if scenario.net.endswith(SUFFIX):
        raise SettingError(f"setting 'net' is {scenario.net!r}: forecasts are judged where the demand was drawn")
    net = network.load(str(folder / recording.NET))
    log = recording.read_log(folder)
    steps = len(log.green_s)
    if steps <= FIRST_STEP + horizon:
        least = FIRST_STEP + horizon + 1
        raise SettingError(
            f"setting 'hours' is {scenario.hours:g}: forecasts are judged in runs of {least} control steps and more,"
            f" {least * net.control_step_s / 3600:.2g} h"
        )
    coming = demand.coming_veh(net, folder / recording.ROUTES, steps)
    mean_veh_h = demand.mean_profile_veh_h(net, scenario.profile, steps, scenario.demand)
    found = {}
    for method in METHODS:
        with Predictor(
            net,
            method,
            profile_veh=mean_veh_h * net.control_step_s / 3600,
            coming_veh=coming,
            refit_steps=refit_steps,
        ) as predictor:
            errors = _errors_veh(predictor, log, coming[0], net, horizon)
        found[method] = (np.sqrt(np.mean(errors**2, axis=(0, 2))) * 3600 / net.control_step_s).tolist()
    return found


def _errors_veh(predictor: Predictor, log: Log, coming_veh: Floats, net: Network, horizon: int) -> Floats:
    """(starts, horizon, sources) forecast less what came."""
    sources = np.flatnonzero(net.is_source)
    waiting = log.source_queue_veh[:, 0] > 0
    # The last step's end is on no record; nothing is foretold from it.
    waited = waiting | np.vstack([waiting[1:], waiting[-1:]])
    errors = []
    for step in range(len(log.green_s) - horizon + 1):
        if step >= FIRST_STEP:
            ahead_veh = predictor.forecast(horizon).demand_veh
            errors.append((ahead_veh - coming_veh[step : step + horizon])[:, sources])
        predictor.observe(log.entered_veh[step, 0], waited[step], np.zeros(len(net.links)))
    return np.array(errors)


def summary(runs: Sequence[dict[str, list[float]]]) -> dict[str, Any]:
    """Means over two runs or more with confidence intervals, by method, step by step and for all steps together."""
    # (runs, methods, steps), the last one all steps together.
    by_step = np.array([[run[method] for method in METHODS] for run in runs])
    whole = np.concatenate([by_step, np.sqrt(np.mean(by_step**2, axis=2, keepdims=True))], axis=2)
    judged = [index for index, method in enumerate(METHODS) if method != "perfect"]
    within = whole - whole[:, judged].mean(axis=1, keepdims=True) + whole[:, judged].mean(axis=(0, 1))
    correction = np.sqrt(len(judged) / (len(judged) - 1))
    half = {"within": correction * _half_width(within), "between": _half_width(whole)}
    ratio = whole[..., -1] / whole[:, [METHODS.index("profile")], -1]
    found = {}
    for index, method in enumerate(METHODS):
        mean, spread = whole[:, index].mean(axis=0), half["within"][index] * (method != "perfect")
        found[method] = {
            "rmse_veh_h": mean[:-1],
            "low_veh_h": (mean - spread)[:-1],
            "high_veh_h": (mean + spread)[:-1],
            "all_steps_rmse_veh_h": mean[-1],
            "all_steps_low_veh_h": (mean - spread)[-1],
            "all_steps_high_veh_h": (mean + spread)[-1],
            "all_steps_between_runs_veh_h": half["between"][index, -1],
            "ratio_to_profile": ratio[:, index].mean(),
            "ratio_half_width": _half_width(ratio[:, index]),
            "all_steps_by_run_veh_h": whole[:, index, -1],
        }
    return found


def _half_width(samples: Floats) -> Floats:
    """Half the confidence interval of the mean over the first axis."""
    from scipy.stats import t  # noqa: PLC0415 - half a second

    count = len(samples)
    quantile = t.ppf((1 + CONFIDENCE) / 2, count - 1)
    return np.asarray(quantile * samples.std(axis=0, ddof=1) / np.sqrt(count))
