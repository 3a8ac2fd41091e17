"""The model as plant: SPEC 2, exact, in samples of 10 s with the greens where they stand in the cycle.

This is what the paper simulates on ("sampling rate of 10 seconds"). Its state is handed out whole and without error,
since the paper's controllers measured everything.

A plan is carried out as far as signals can. Greens that do not fill their cycle leave the rest of it red; greens that
overfill it are scaled down to what the cycle leaves; greens under the least are shown as they are. All three are
told (`Misfits`) and nothing is refused, so that what a plan without constraints costs is to be seen in the traffic.

A full link takes nobody (SPEC 2.3, third term), so that no x ever exceeds its storage here, whatever a controller
does. Who finds no room waits before the link, at a source outside of the network: a state constraint is broken
where a link and who waits to enter it are together more than the link holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utn_sumo.contract import Bools, Floats, Network, Plan, State
from utn_sumo.errors import PlantError
from utn_sumo.model import LinkModel, ModelState, green_windows
from utn_sumo.signals import TOLERANCE_S


@dataclass(frozen=True)
class Misfits:
    """Which junctions' greens can't be shown as wished: arrays (J,)."""

    overfull: Bools
    """Their sum is more than the cycle leaves."""
    unfilled: Bools
    """It is less."""
    short: Bools
    """One of them is under the least green."""

    @classmethod
    def of(cls, network: Network, green_s: Floats) -> Misfits:
        """Those of the wish `green_s` (S,), with the tolerance of the signals."""
        junctions = len(network.junctions)
        excess_s = np.bincount(network.stage_junction, green_s, junctions) - network.green_budget_s
        tolerance_s = TOLERANCE_S * np.bincount(network.stage_junction, minlength=junctions)
        short = green_s < network.min_green_s - TOLERANCE_S
        return cls(
            excess_s > tolerance_s,
            excess_s < -tolerance_s,
            np.bincount(network.stage_junction, short, junctions) > 0,
        )

    @property
    def any(self) -> Bools:
        """(J,) junctions with one of them."""
        return self.overfull | self.unfilled | self.short


@dataclass(frozen=True)
class Passed:
    """What one control step came to."""

    state: State
    """At its end."""
    green_s: Floats
    """(S,) greens that were shown."""
    misfits: Misfits
    entered_veh: Floats
    """(P, Z) into each link, by sample."""
    max_x_veh: Floats
    """(Z,) largest number of vehicles on each link at the end of a sample."""
    max_queue_veh: Floats
    """(Z,) largest queue on each link at the end of a sample."""
    time_spent_veh_h: float
    """On the road or waiting to enter."""


class MacroscopicPlant:
    """One run of the model under a known demand, deterministic."""

    def __init__(self, network: Network, demand_veh: Floats, state: State | None = None):
        """`demand_veh` (K, Z) wants to enter in each control step, evenly; without a `state` the network is empty."""
        self.network = network
        self.state = state or _empty(network)
        """As it is now, exact."""
        self._demand_veh = demand_veh
        self._model = LinkModel(network, network.sample_s)
        self._first = self.state.cycle

    def run(self, plan: Plan) -> Passed:
        """Run one control step under `plan`. Raises PlantError when there is no more demand."""
        network, model, before = self.network, self._model, self.state
        step = before.cycle - self._first
        if step >= len(self._demand_veh):
            raise PlantError(f"demand is known for {len(self._demand_veh)} control steps: there is no step {step + 1}")
        green_s = showable_s(network, plan.green_s)
        windows = green_windows(network, green_s, model.step_s)
        demand_veh = self._demand_veh[step] / network.samples
        now = ModelState(
            before.x_veh, before.q_veh, before.source_queue_veh, tuple(before.past_inflow_veh[: model.lags])
        )
        entered, turned, x, queue, present_veh = [], np.zeros(len(network.turns)), [], [], 0.0
        for shown_s, held_s, end_s in zip(windows.shown_s, windows.held_s, windows.end_s, strict=True):
            now, flows = model.step(now, shown_s, demand_veh, before.fraction, end_s, held_s=held_s)
            entered.append(flows.inflow_veh)
            turned = turned + flows.leaving_veh
            x.append(now.x_veh)
            queue.append(model.by_link(now.q_veh))
            present_veh += float(now.x_veh.sum() + now.source_queue_veh.sum())
        past = np.vstack([entered[::-1], before.past_inflow_veh])[: len(before.past_inflow_veh)]
        self.state = State(
            cycle=before.cycle + 1,
            time_s=before.time_s + network.control_step_s,
            x_veh=now.x_veh,
            q_veh=now.q_veh,
            source_queue_veh=now.source_queue_veh,
            past_inflow_veh=past,
            turned_veh=turned,
            fraction=before.fraction,
            disturbance_veh=before.disturbance_veh,
        )
        return Passed(
            state=self.state,
            green_s=green_s,
            misfits=Misfits.of(network, plan.green_s),
            entered_veh=np.array(entered),
            max_x_veh=np.max(x, axis=0),
            max_queue_veh=np.max(queue, axis=0),
            time_spent_veh_h=present_veh * model.step_s / 3600,
        )


def showable_s(network: Network, green_s: Floats) -> Floats:
    """(S,) greens that a signal can show for the wish `green_s`: scaled down where they overfill their cycle."""
    total_s = np.bincount(network.stage_junction, green_s, len(network.junctions))
    share = np.minimum(1.0, network.green_budget_s / np.maximum(total_s, 1e-9))
    return np.asarray(green_s * share[network.stage_junction])


def _empty(network: Network) -> State:
    links, turns = len(network.links), len(network.turns)
    past_inflow_veh = np.zeros((network.delay_samples, links))
    nobody, none_by_turn = np.zeros(links), np.zeros(turns)
    return State(0, 0.0, nobody, none_by_turn, nobody, past_inflow_veh, none_by_turn, network.fraction, nobody)
