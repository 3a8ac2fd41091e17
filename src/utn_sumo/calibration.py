"""Link parameters from recorded runs: least squares on the model's prediction error, one and several steps ahead.

Fitted by link: saturation flow, storage, queue spacing, free speed; for the network: the start-up lag; and turning
fractions from the turn loops. Read off the record is what a source lets in at most while vehicles wait outside. Each
comes with its standard error. A calibration is a JSON file beside the
net, or named in a scenario; the demand and the plant never see it, only the model does.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from utn_sumo.contract import Floats, Network
from utn_sumo.errors import NetworkError
from utn_sumo.model import LinkModel
from utn_sumo.recording import Log
from utn_sumo.rollout import Outside, predict, starts
from utn_sumo.xml_files import stem

STEP_S = 10.0
"""The paper's sampling interval."""
ERROR_SHARE, LEAST_ERROR_VEH = 0.6, 1.0
"""Size of an error, against which a parameter's distance from its prior weighs: as a share of what x itself changes by
on that link, so that a link where little happens counts like any other, but no less than a vehicle."""
FITTED = {"saturation_flow_veh_s": 0.2, "storage_veh": 0.1, "queue_spacing_m": 0.1, "free_speed_m_s": 0.2}
"""Parameters of a link, and their relative standard deviation about what the network's links have in common: a link
that never saturates or fills is taken to be like the others. The road's length settles most of the storage."""
WAITING_VEH, WAITING_STEPS = 3.0, 8
"""Vehicles that wait outside all through a step whose entry is taken to be used in full, and how many such steps."""
COMMON_SHARE = 0.3
"""Standard deviation of what the links have in common about what the net says, relative."""
LAG_PRIOR_S = 2.0
EVALUATIONS = 8
WHOLE = 1e-3
"""By how much the turning fractions of a link in a file may sum to other than 1."""
HORIZON = 4
FITTED_AHEAD = (0, HORIZON - 1)
"""Control steps ahead whose errors are fitted: one step alone would let a parameter be right first and wrong later."""


def calibrate(network: Network, log: Log, step_s: float = STEP_S) -> dict[str, Any]:
    """Fit `network` to the runs of the log and return the calibration as it goes into its file.

    `step_s` is the model's step with which it is fitted; the parameters suit that step best.
    `one_step_rmse_veh` is the error that is left in each of the runs, in their order. Standard errors take the model's
    to be of their usual size at least: of links on which nobody drove they say as little as was known before.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415 - heavy

    fractions, fraction_sd = _fractions(network, log)
    entry, entry_sd = _entry_flow_veh_s(network, log)
    with_turns = _with_entries(_with_fractions(network, fractions), entry)
    size = len(FITTED) * len(network.links)
    start = np.append(np.ones(size), network.startup_lag_s)
    spread = np.array(list(FITTED.values()))[:, None]
    outside, first = Outside.known(network, log), starts(log, HORIZON)

    changed = np.array([log.x_veh[first] - log.true_x_veh[first + ahead] for ahead in FITTED_AHEAD])
    usual_veh = np.maximum(ERROR_SHARE * np.sqrt(np.mean(changed**2, axis=(1, 2), keepdims=True)), LEAST_ERROR_VEH)

    def residual(parameters: Floats) -> Floats:
        model = LinkModel(_scaled(with_turns, parameters), step_s)
        turning = np.array([log.fraction[first]] * HORIZON)
        prediction = predict(model, log, HORIZON, outside=outside, fraction=turning)
        error = np.array([prediction.x_veh[ahead] - log.true_x_veh[first + ahead] for ahead in FITTED_AHEAD])
        factors = parameters[:-1].reshape(len(FITTED), -1)
        common = factors.mean(axis=1, keepdims=True)
        alone, together = (factors - common) / spread, (common - 1) / COMMON_SHARE
        lag = (parameters[-1:] - start[-1]) / LAG_PRIOR_S
        return np.concatenate([(error / usual_veh).ravel(), alone.ravel(), together.ravel(), lag])

    fit = least_squares(
        residual,
        start,
        bounds=(np.append(np.full(size, 0.2), 0.0), np.append(np.full(size, 2.0), 10.0)),
        diff_step=0.02,
        x_scale=np.append(np.full(size, 0.1), 1.0),
        max_nfev=EVALUATIONS,
    )
    error = fit.fun[: len(first) * log.x_veh[0].size].reshape(-1, *log.x_veh.shape[1:]) * usual_veh[0]
    # Residuals are in units of their usual size. Smaller ones, as of empty roads, are no measure of the parameters.
    scale = max(2 * fit.cost / max(len(fit.fun) - len(fit.x), 1), 1.0)
    sd = np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac)) * scale)
    content = _content(_scaled(with_turns, fit.x), fit.x, sd, fraction_sd)
    for index in np.flatnonzero(np.isfinite(entry)):
        content["links"][network.links[index].id]["entry_flow_veh_s"] = [entry[index], entry_sd[index]]
    return {"one_step_rmse_veh": np.sqrt(np.mean(error**2, axis=(0, 2))).tolist(), **content}


def _scaled(network: Network, parameters: Floats) -> Network:
    """The network with its links' parameters times the given factors, and the start-up lag."""
    factors = parameters[:-1].reshape(len(FITTED), -1)
    links = tuple(
        replace(
            link, **{name: getattr(link, name) * float(row[index]) for name, row in zip(FITTED, factors, strict=True)}
        )
        for index, link in enumerate(network.links)
    )
    return replace(network, links=links, startup_lag_s=float(parameters[-1]))


def _with_fractions(network: Network, fractions: Floats) -> Network:
    turns = (replace(turn, fraction=float(share)) for turn, share in zip(network.turns, fractions, strict=True))
    return replace(network, turns=tuple(turns))


def _fractions(network: Network, log: Log) -> tuple[Floats, Floats]:
    """(M,) turning fractions from the turn loops, one vehicle's worth of the table added, and standard errors."""
    turned = network.fraction + log.turned_veh.sum(axis=(0, 1))
    total = np.bincount(network.turn_link, turned)[network.turn_link]
    share = turned / total
    return share, np.sqrt(share * (1 - share) / total)


def _entry_flow_veh_s(network: Network, log: Log) -> tuple[Floats, Floats]:
    """(Z,) what enters at most while somebody waits outside all the time, and its standard error; infinite where
    nobody waits so often enough.
    """
    waiting = Outside.known(network, log).source_queue_veh
    all_through = (np.minimum(waiting, log.true_waiting_veh) > WAITING_VEH) & network.is_source
    entry, sd = np.full(len(network.links), np.inf), np.full(len(network.links), np.nan)
    for index in range(len(network.links)):
        rate = log.entered_veh[..., index][all_through[..., index]] / network.control_step_s
        if len(rate) >= WAITING_STEPS:
            # A queue that reaches the entry lets in less: the freest steps tell what else there is.
            freest = np.sort(rate)[len(rate) * 3 // 4 :]
            entry[index], sd[index] = freest.mean(), freest.std() / np.sqrt(len(freest))
    return entry, sd


def _with_entries(network: Network, entry_flow_veh_s: Floats) -> Network:
    links = (
        replace(link, entry_flow_veh_s=float(flow)) for link, flow in zip(network.links, entry_flow_veh_s, strict=True)
    )
    return replace(network, links=tuple(links))


def _content(network: Network, parameters: Floats, sd: Floats, fraction_sd: Floats) -> dict[str, Any]:
    relative = (sd[:-1] / parameters[:-1]).reshape(len(FITTED), -1)
    links: dict[str, Any] = {}
    for index, link in enumerate(network.links):
        links[link.id] = {
            name: [getattr(link, name), getattr(link, name) * relative[row, index]] for row, name in enumerate(FITTED)
        }
        links[link.id]["turns"] = {
            turn.to_edge: [turn.fraction, fraction_sd[position]]
            for position, turn in enumerate(network.turns)
            if turn.link == index
        }
    return {"startup_lag_s": [network.startup_lag_s, sd[-1]], "links": links}


def for_model(network: Network, chosen: str | None) -> Network:
    """The network as the model is to see it: with the calibration that is chosen, `none` for none, else the one
    beside the net if there is one.
    """
    if chosen == "none":
        return network
    if chosen:
        return applied(network, Path(chosen))
    beside = beside_net(network)
    return applied(network, beside) if beside.is_file() else network


def beside_net(network: Network) -> Path:
    """Where the calibration of a net lies that is taken without asking."""
    return network.net_file.with_name(f"{stem(network.net_file)}.calibration.json")


def applied(network: Network, path: Path) -> Network:
    """The network with the parameters of a calibration file. Raises NetworkError if it does not fit the network."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise NetworkError(f"calibration {str(path)!r} can't be read ({error}): make one with utn calibrate") from error
    try:
        links = tuple(replace(link, **_values(content["links"][link.id])) for link in network.links)
        turns = tuple(
            replace(turn, fraction=float(content["links"][network.links[turn.link].id]["turns"][turn.to_edge][0]))
            for turn in network.turns
        )
        lag_s = float(content["startup_lag_s"][0])
        _check(network, [turn.fraction for turn in turns], lag_s)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise NetworkError(
            f"calibration {str(path)!r} does not fit net {network.name!r} (lacks or misplaces {error}): make one with "
            "utn calibrate"
        ) from error
    return replace(network, links=links, turns=turns, startup_lag_s=lag_s)


def _values(link: Mapping[str, Any]) -> dict[str, Any]:
    optional = ("entry_flow_veh_s",) if "entry_flow_veh_s" in link else ()
    values = {name: float(link[name][0]) for name in (*FITTED, *optional)}
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} is {value:g}")
    return values


def _check(network: Network, fractions: Sequence[float], lag_s: float) -> None:
    """Raise ValueError unless the turning fractions (M,) of each link are shares of 1, and the lag is from 0 on."""
    if not 0 <= lag_s < np.inf:
        raise ValueError(f"startup_lag_s is {lag_s:g}")
    for turn, share in zip(network.turns, fractions, strict=True):
        if not 0 <= share <= 1:
            raise ValueError(f"the fraction of {network.links[turn.link].id} to {turn.to_edge} is {share:g}")
    total = np.bincount(network.turn_link, fractions)
    for index in set(network.turn_link.tolist()):
        if abs(total[index] - 1) > WHOLE:
            raise ValueError(f"the fractions of {network.links[index].id} sum to {total[index]:g}")
