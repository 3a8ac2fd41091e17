"""The controller `dmpc`: one agent a junction, coordinated with its neighbours (SPEC 4)."""

from __future__ import annotations

from typing import Any

import numpy as np

from utn_controllers.mpc.agent import Agent
from utn_controllers.mpc.coordination import Consensus, admm
from utn_controllers.mpc.problem import JunctionProblem, Timing
from utn_controllers.mpc.settings import Settings
from utn_sumo.contract import Forecast, Network, Plan, State
from utn_sumo.model import LinkModel, check_step

__all__ = ["DistributedMPC", "Settings"]


class DistributedMPC:
    """Chooses greens by a distributed model predictive control; settings as in `Settings`."""

    Settings = Settings

    def __init__(self, network: Network, **settings: Any):
        self.settings = Settings(**settings)
        self.horizon = self.settings.horizon
        self.network = network
        step_s = self.settings.step_s or network.control_step_s
        check_step(network, step_s)
        self._model = LinkModel(network, step_s)
        self._expected_s = network.equal_split().green_s
        """(S,) greens that the coming step is likely to have: where they stand is frozen in the problem."""
        fed = [link for link, item in enumerate(network.links) if not item.is_source]
        place = {link: row for row, link in enumerate(fed)}
        self._fed = np.array(fed, dtype=np.int64)
        self.agents = [
            Agent(JunctionProblem(network, junction, self.settings), place)
            for junction in range(len(network.junctions))
        ]
        self._consensus: Consensus | None = None

    def plan(self, state: State, forecast: Forecast) -> Plan:
        """Coordinated greens for the coming cycle and the control horizon; ControllerError without an optimum."""
        timing = self.timing()
        if self._consensus is None:
            rate = state.past_inflow_veh.mean(axis=0)[self._fed] / self.network.sample_s
            inflow = np.repeat(rate[:, None] * self._model.step_s, self.agents[0].problem.steps, axis=1)
            self._consensus = Consensus(inflow, np.zeros_like(inflow), self.settings.rho)
        else:
            self._consensus.shift(self.agents[0].problem.substeps)
        for agent in self.agents:
            agent.prepare(state, forecast, timing, self._consensus.rho)
        outcome = admm(self.agents, self._consensus, self.settings)
        greens = np.zeros((self.settings.control_horizon, len(self.network.stages)))
        for agent in self.agents:
            greens[:, agent.problem.stages] = agent.problem.greens(agent.solution)
        self._expected_s = greens[min(1, len(greens) - 1)]
        return Plan(greens[0], greens[1:], facts=vars(outcome))

    def timing(self) -> Timing:
        """Where the next plan's problem has the greens."""
        return Timing.of(self._model, self._expected_s)
