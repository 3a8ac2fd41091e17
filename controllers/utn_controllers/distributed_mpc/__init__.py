"""Distributed MPC: one agent a junction, coordinated with its neighbours (SPEC 4).

settings      what a user may set
problem       one junction's problem, stated in CasADi
agent         its solver, and the copies that it shares
coordination  ADMM among the agents
"""

from __future__ import annotations

from typing import Any

import numpy as np

from utn_controllers.distributed_mpc.agent import Agent
from utn_controllers.distributed_mpc.coordination import Consensus, admm
from utn_controllers.distributed_mpc.problem import JunctionProblem
from utn_controllers.distributed_mpc.settings import Settings
from utn_sumo.contract import Forecast, Network, Plan, State

__all__ = ["DistributedMPC", "Settings"]


class DistributedMPC:
    """Chooses greens by a distributed model predictive control; settings as in `Settings`."""

    Settings = Settings

    def __init__(self, network: Network, **settings: Any):
        self.settings = Settings(**settings)
        self.horizon = self.settings.horizon
        self.network = network
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
        if self._consensus is None:
            inflow = np.repeat(state.past_inflow_veh[0][self._fed][:, None], self.horizon, axis=1)
            self._consensus = Consensus(inflow, np.zeros_like(inflow), self.settings.rho)
        else:
            self._consensus.shift()
        for agent in self.agents:
            agent.prepare(state, forecast, self._consensus.rho)
        outcome = admm(self.agents, self._consensus, self.settings)
        greens = np.zeros((self.settings.control_horizon, len(self.network.stages)))
        for agent in self.agents:
            greens[:, agent.problem.stages] = agent.problem.greens(agent.solution)
        return Plan(greens[0], greens[1:], facts=vars(outcome))
