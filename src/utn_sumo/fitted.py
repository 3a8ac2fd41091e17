"""A controller's wish, made showable: what signals would refuse is scaled to its cycle, so that it can drive them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from utn_sumo import controllers
from utn_sumo.contract import Floats, Forecast, Network, Plan, State

NOTHING_S = 1e-6
"""Added to each wish, so that a junction that wishes for nothing gets equal shares."""


class Fitted:
    """Another controller, its greens scaled to fill each junction's cycle and none under its least.

    Named as `path.py:Class`, with the other one's name and settings as its own settings.
    """

    def __init__(self, network: Network, controller: str, settings: dict[str, Any]):
        self.network = network
        self._controller = controllers.build(controller, network, settings)
        self.horizon = self._controller.horizon

    def plan(self, state: State, forecast: Forecast) -> Plan:
        """The other one's plan, fitted."""
        wish = self._controller.plan(state, forecast)
        ahead_s = None if wish.ahead_s is None else np.array([fit_s(self.network, row) for row in wish.ahead_s])
        return replace(wish, green_s=fit_s(self.network, wish.green_s), ahead_s=ahead_s)


def fit_s(network: Network, green_s: Floats) -> Floats:
    """(S,) the greens `green_s` in their proportions, each junction's summing to its budget, none under its least."""
    fitted = np.zeros(len(green_s))
    for junction, budget_s in zip(network.junctions, network.green_budget_s, strict=True):
        stages = list(junction.stages)
        wish, least = np.maximum(green_s[stages], 0.0) + NOTHING_S, network.min_green_s[stages]
        short = np.zeros(len(stages), dtype=np.bool_)
        # Who comes out under the least gets the least, and the others share what that leaves.
        for _ in stages:
            rest_s = budget_s - least[short].sum()
            fitted[stages] = np.where(short, least, wish * rest_s / max(wish[~short].sum(), NOTHING_S))
            short |= fitted[stages] < least
    return fitted
