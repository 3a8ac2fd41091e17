"""How far the macroscopic model is from the microscopic plant: error by horizon and link, beside two references and
the floor.

References: persistence (x stays what it was) and the historical mean (x at that time of day over the other seeds). The
floor is the spread of SUMO itself, see `floor`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from utn_sumo.contract import Floats, Network
from utn_sumo.model import LinkModel
from utn_sumo.recording import Log
from utn_sumo.rollout import Outside, known_fraction, predict, starts


@dataclass(frozen=True)
class Errors:
    """Errors of one prediction over starts and runs: arrays (H, cases, Z), prediction less truth."""

    x_veh: Floats
    queue_veh: Floats
    inflow_veh: Floats
    persistence_veh: Floats
    """Of x, by persistence."""
    history_veh: Floats | None
    """Of x, by the historical mean; None with one seed."""
    measured_veh: Floats
    """x itself."""
    scale_veh: Floats
    """(Z,) mean true x, by which errors are normalised."""


def errors(
    network: Network, log: Log, step_s: float, horizon: int, *, known_demand: bool = True, known_turning: bool = False
) -> Errors:
    """Errors of the model with a step of `step_s`, over all the runs of one demand.

    With `known_demand` the model is told who will want to enter, who waits outside, and who comes or ends amid links;
    without, it has the forecast and the estimate. With `known_turning` it is told how the traffic will turn in each
    step ahead.
    """
    model = LinkModel(network, step_s)
    outside = Outside.known(network, log) if known_demand else Outside.foreseen(log)
    first = starts(log, horizon)
    at = first + np.arange(horizon)[:, None]
    fraction = known_fraction(network, log)[at] if known_turning else np.array([log.fraction[first]] * horizon)
    prediction = predict(model, log, horizon, outside=outside, fraction=fraction)
    true_x = log.true_x_veh[at]
    runs = true_x.shape[2]
    history = (log.true_x_veh.sum(axis=1, keepdims=True) - log.true_x_veh) / max(runs - 1, 1)

    def cases(error_veh: Floats) -> Floats:
        return error_veh.reshape(horizon, -1, error_veh.shape[-1])

    return Errors(
        x_veh=cases(prediction.x_veh - true_x),
        queue_veh=cases(prediction.queue_veh - log.true_queue_veh[at]),
        inflow_veh=cases(prediction.inflow_veh - log.entered_veh[at]),
        persistence_veh=cases(log.x_veh[first] - true_x),
        history_veh=cases(history[at] - true_x) if runs > 1 else None,
        measured_veh=cases(true_x),
        scale_veh=log.true_x_veh.mean(axis=(0, 1)),
    )


def rmse(error_veh: Floats) -> Floats:
    """(H, Z) root mean square over the cases of (H, cases, Z)."""
    return np.asarray(np.sqrt(np.mean(error_veh**2, axis=1)))


def summary(network: Network, found: Errors, floor_veh: Floats | None) -> dict[str, Any]:
    """The measures by horizon: means over links, and the same by link. `floor_veh` (H, Z) or None.

    A ratio of means over links is the mean RMSE over the mean of the reference's RMSE.
    """

    def measures(pick: Any) -> dict[str, Any]:
        x, persistence = pick(rmse(found.x_veh)), pick(rmse(found.persistence_veh))
        rows = {
            "rmse_veh": x,
            "bias_veh": pick(found.x_veh.mean(axis=1)),
            "nrmse": x / np.maximum(pick(np.broadcast_to(found.scale_veh, (len(x), len(found.scale_veh)))), 1e-9),
            "persistence_rmse_veh": persistence,
            "rmse_over_persistence": x / np.maximum(persistence, 1e-9),
            "queue_rmse_veh": pick(rmse(found.queue_veh)),
            "queue_bias_veh": pick(found.queue_veh.mean(axis=1)),
            "flow_rmse_veh": pick(rmse(found.inflow_veh)),
            "flow_bias_veh": pick(found.inflow_veh.mean(axis=1)),
        }
        if found.history_veh is not None:
            rows["rmse_over_history"] = x / np.maximum(pick(rmse(found.history_veh)), 1e-9)
        if floor_veh is not None:
            rows["floor_veh"] = pick(floor_veh)
            rows["rmse_over_floor"] = x / np.maximum(pick(floor_veh), 1e-9)
        return rows

    return {
        **measures(lambda values: values.mean(axis=1)),
        "links": {
            link.id: measures(lambda values, index=index: values[:, index]) for index, link in enumerate(network.links)
        },
    }
