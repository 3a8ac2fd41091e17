"""The model run open loop over recorded runs: predictions from every control step, several steps ahead.

`observe` says what the model knows at the start of every control step: x as estimated, the past inflows as the entry
loops counted them, and as queued whoever is on the link and not on the way. `predict` takes the model on from those
states under the greens that were really applied, in the model's own step; a step of the whole cycle is SPEC 2's model.

Arrays have the control step first, then the run (see `Log.stack`), then link, turn or stage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utn_sumo.contract import Floats, Ints, Network
from utn_sumo.model import LinkModel, ModelState, StepFlows, green_windows
from utn_sumo.recording import Log


@dataclass(frozen=True)
class Prediction:
    """Open-loop predictions: arrays (H, starts, runs, Z)."""

    x_veh: Floats
    """Vehicles at the end of each step ahead."""
    queue_veh: Floats
    inflow_veh: Floats
    """Vehicles that enter within each step ahead."""


def starts(log: Log, horizon: int) -> Ints:
    """The control steps from which `horizon` steps ahead are on record, but for the first, when the road is empty."""
    return np.arange(1, len(log.green_s) - horizon + 1)


def observe(model: LinkModel, log: Log, at: Ints, source_queue_veh: Floats) -> ModelState:
    """The model's state (starts, runs, ·) at the start of the control steps `at`, from nothing later than that.

    `source_queue_veh` (K, runs, Z) is who waits outside, known or estimated.
    """
    network = model.network
    counted = np.concatenate(list(log.entered_by_sample_veh), axis=-2)[:, ::-1]
    steps, samples = len(log.green_s), log.entered_by_sample_veh.shape[-2]
    # Newest first: what lies before the start of step k begins at this many samples from the newest of all.
    past = [model.history(counted[:, (steps - k) * samples :], network.sample_s) for k in at]
    past_inflow = tuple(np.array(lag) for lag in zip(*past, strict=True))
    x, measured = log.x_veh[at], log.q_veh[at]
    share = model.on_the_way(model.delay_s(model.by_link(measured)), 0.0)[1:]
    moving = np.sum([part * inflow for part, inflow in zip(share, past_inflow, strict=True)], axis=0)
    queue = np.clip(x - moving, 0.0, x)
    # Who is queued beyond the measure has a turn that nobody knows yet.
    more = np.maximum(queue - model.by_link(measured), 0.0)
    split = measured + log.fraction[at] * model.at_turns(more) + 1e-9
    split = split / model.at_turns(model.by_link(split))
    return ModelState(x, split * model.at_turns(queue), source_queue_veh[at], past_inflow)


@dataclass(frozen=True)
class Outside:
    """What the network's surroundings do: arrays (K, runs, Z) by control step."""

    demand_veh: Floats
    """What wants to enter each source link."""
    source_queue_veh: Floats
    """Who waits outside at the start of the step."""
    disturbance_veh: Floats
    """Who comes onto each link amid it, less those who end there (e_z of SPEC 2.1)."""

    @classmethod
    def known(cls, network: Network, log: Log) -> Outside:
        """As it really was."""
        waiting = np.concatenate([np.zeros_like(log.true_waiting_veh[:1]), log.true_waiting_veh[:-1]])
        demand = (log.entered_veh + log.true_waiting_veh - waiting) * network.is_source
        before = np.concatenate([np.zeros_like(log.true_x_veh[:1]), log.true_x_veh[:-1]])
        left = log.turned_veh @ _by_link(network).T
        return cls(demand, waiting, log.true_x_veh - before - log.entered_veh + left)

    @classmethod
    def foreseen(cls, log: Log) -> Outside:
        """As it was forecast and estimated at the time."""
        return cls(log.forecast_veh, log.source_queue_veh, log.forecast_disturbance_veh)


def predict(model: LinkModel, log: Log, horizon: int, *, outside: Outside, fraction: Floats) -> Prediction:
    """Predict `horizon` control steps from each of `starts(log, horizon)` under the greens of the log.

    `fraction` (H, starts, runs, M) is how the traffic turns in each step ahead.
    """
    at = starts(log, horizon)
    state = observe(model, log, at, outside.source_queue_veh)
    network = model.network
    time_s: Floats = network.control_step_s * np.arange(len(log.green_s), dtype=float)[:, None]
    windows = green_windows(network, log.green_s, model.step_s, time_s)
    steps = windows.shown_s.shape[-2]
    x, queue, inflow = [], [], []
    for ahead in range(horizon):
        entered: Floats = np.zeros_like(state.x_veh)
        for step in range(steps):
            shown, held, end = (each[at + ahead, :, step] for each in (windows.shown_s, windows.held_s, windows.end_s))
            flows: StepFlows
            state = model.disturbed(state, outside.disturbance_veh[at + ahead] / steps)
            demand_veh = outside.demand_veh[at + ahead] / steps
            state, flows = model.step(state, shown, demand_veh, fraction[ahead], end, held_s=held)
            entered = entered + flows.inflow_veh
        x.append(state.x_veh)
        queue.append(model.by_link(state.q_veh))
        inflow.append(entered)
    return Prediction(np.array(x), np.array(queue), np.array(inflow))


def known_fraction(network: Network, log: Log) -> Floats:
    """(K, runs, M) how the traffic that left each link in each control step really turned."""
    by_link = _by_link(network)
    left = log.turned_veh @ by_link.T @ by_link
    return np.asarray(np.where(left > 0, log.turned_veh / np.where(left > 0, left, 1.0), network.fraction))


def _by_link(network: Network) -> Floats:
    """(Z, M) 1 where a turn leaves a link."""
    by_link = np.zeros((len(network.links), len(network.turns)))
    by_link[network.turn_link, np.arange(len(network.turns))] = 1
    return by_link
