"""Fixed time: the same greens in every cycle."""

from __future__ import annotations

from utn_sumo.contract import Forecast, Network, Plan, State


class FixedTime:
    """Every stage of a junction gets an equal share of the green."""

    horizon = 1

    def __init__(self, network: Network):
        self._plan = network.equal_split()

    def plan(self, state: State, forecast: Forecast) -> Plan:  # noqa: ARG002 - it looks at neither
        """The equal split, whatever the state."""
        return self._plan
