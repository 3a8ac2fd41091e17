"""ADMM among the agents (SPEC 4): consensus on the flow between every producer and its consumer.

Boyd et al. 2011, sections 3.4.1 (varying penalty), 3.4.3 (over-relaxation) and 3.3.1 (stopping).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from utn_controllers.mpc.settings import Settings
from utn_sumo.contract import Floats

if TYPE_CHECKING:
    from utn_controllers.mpc.agent import Agent

ADAPT_RATIO = 10.0
"""The penalty adapts while one residual is this many times the other, then it is frozen for good."""
ADAPT_FACTOR = 2.0
BYTES_PER_NUMBER = 8


@dataclass
class Consensus:
    """What the agents agree on, kept warm from one control step to the next."""

    mean: Floats
    """(interactions, model steps) zb [veh]."""
    price: Floats
    """(interactions, model steps) lam."""
    rho: float
    frozen: bool = False
    """Whether rho has settled."""

    def shift(self, steps: int) -> None:
        """One control step of so many model steps on: everything moves up by it, and the last one is repeated."""
        for array in (self.mean, self.price):
            array[:, :-steps] = array[:, steps:].copy()


@dataclass(frozen=True)
class Outcome:
    """How a coordination ended."""

    iterations: int
    primal_veh: float
    dual: float
    converged: bool
    bytes_exchanged: int


def admm(agents: list[Agent], consensus: Consensus, settings: Settings) -> Outcome:
    """Iterate until both residuals are under tolerance or the cap is reached; changes `consensus`.

    Raises ControllerError if an agent has no optimum.
    """
    shape = consensus.mean.shape
    numbers = consensus.mean.size
    primal = dual = np.inf
    converged = False
    iteration = 0
    for iteration in range(1, settings.iterations + 1):  # noqa: B007 - used after the loop
        flow = np.zeros((2, *shape))
        for agent in agents:
            rows = agent.interactions
            flow[agent.side, rows] = agent.solve(consensus.mean[rows], consensus.price[rows])
        produced, consumed = settings.relaxation * flow + (1 - settings.relaxation) * consensus.mean
        before = consensus.mean
        consensus.mean = (produced + consumed) / 2
        consensus.price = consensus.price + consensus.rho * (produced - consensus.mean)

        primal = float(np.sqrt(np.sum((flow - consensus.mean) ** 2)))
        dual = float(consensus.rho * np.sqrt(2 * np.sum((consensus.mean - before) ** 2)))
        scale = np.sqrt(2 * numbers) * settings.tolerance_abs
        sizes = max(np.sqrt(np.sum(flow**2)), np.sqrt(2 * np.sum(consensus.mean**2)))
        prices = np.sqrt(2 * np.sum(consensus.price**2))
        converged = bool(
            primal <= scale + settings.tolerance_rel * sizes
            and dual <= scale * consensus.rho + settings.tolerance_rel * prices
        )
        if converged:
            break
        if not consensus.frozen:
            _adapt(agents, consensus, primal, dual)
    return Outcome(iteration, primal, dual, converged, 2 * iteration * numbers * BYTES_PER_NUMBER)


def _adapt(agents: list[Agent], consensus: Consensus, primal: float, dual: float) -> None:
    """Move rho towards balanced residuals; the first time that they are balanced, freeze it."""
    if primal > ADAPT_RATIO * dual:
        consensus.rho *= ADAPT_FACTOR
    elif dual > ADAPT_RATIO * primal:
        consensus.rho /= ADAPT_FACTOR
    else:
        consensus.frozen = True
        return
    for agent in agents:
        agent.factorise(consensus.rho)
