"""Splits by what is before the stages: every junction's cycle is shared out anew once a control step.

proportional          by the traffic before the stages
cyclic_max_pressure   by their pressure, traffic before them less traffic behind them

Who waits outside for room on a link counts with it: its queue goes on there.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from utn_controllers import splits
from utn_sumo.contract import EXIT, Floats, Forecast, Network, Plan, State


class SplitSettings(BaseModel):
    """Settings of `proportional`."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    count: Literal["queue", "vehicles"] = "vehicles"
    """What is shared out by: who stands when the step begins, or all on the link. The first is common, but the queue
    before the stage that has just had its green is then always short, and delays on `utn17` are half as much again."""


class Proportional:
    """A stage has green in proportion to the traffic per lane of the fullest lane group that it serves.

    Webster's rule of equal degrees of saturation, with what is there now for the flow: Webster, Traffic Signal Settings
    (Road Research Technical Paper 39, 1958).
    """

    horizon = 1
    Settings = SplitSettings

    def __init__(self, network: Network, **settings: str):
        self._take_up(network, SplitSettings(**settings))  # type: ignore[arg-type]

    def _take_up(self, network: Network, settings: SplitSettings) -> None:
        self.network = network
        self._standing = settings.count == "queue"
        self._lanes = np.array([len(group.lanes) for group in network.groups], dtype=float)
        self._fullest = splits.Fullest(network, self._lanes)

    def plan(self, state: State, forecast: Forecast) -> Plan:  # noqa: ARG002 - it goes by what is there
        """Greens in proportion to what the stages are worth; equal ones where nobody is before any."""
        return Plan(splits.proportional(self.network, self.worth(state)))

    def worth(self, state: State) -> Floats:
        """(S,) vehicles per lane."""
        return self._fullest.by_stage(self.veh(state))

    def veh(self, state: State) -> Floats:
        """(M,) vehicles that count, by turn."""
        link = self.network.turn_link
        outside = state.source_queue_veh[link] * state.fraction
        return outside + (state.q_veh if self._standing else state.x_veh[link] * state.fraction)


class PressureSettings(SplitSettings):
    """Settings of `cyclic_max_pressure`."""

    per: Literal["lane", "storage", "none"] = "lane"
    """What vehicles are divided by."""


class CyclicMaxPressure(Proportional):
    """A stage has green in proportion to its pressure, in a fixed cycle.

    That is the sum over its turns of their saturation flows times vehicles before them less those behind them, as
    these turn on (Varaiya, Transportation Research C 36, 2013); nothing of a turn with more behind it. What a lane
    group holds counts whole for each of its turns, because it is one queue. Le et al. (Transportation Research C 58,
    2015) share a fixed cycle out among all stages, by exp(pressure); in proportion to it there is no scale to set.
    Cyclic forms are reviewed by Levin, Journal of Transportation Engineering A 149 (2023).
    """

    Settings = PressureSettings

    def __init__(self, network: Network, **settings: str):
        chosen = PressureSettings(**settings)  # type: ignore[arg-type]
        self._take_up(network, chosen)
        on_link = np.bincount(network.group_link, self._lanes, len(network.links))
        per_lane_veh = (network.storage_veh / on_link)[network.group_link]
        one = np.ones(len(network.groups))
        self._room = {"lane": self._lanes, "storage": per_lane_veh * self._lanes, "none": one}[chosen.per]
        self._fed = network.turn_next != EXIT
        self._next = np.maximum(network.turn_next, 0)
        self._stage, self._turn = splits.telling(network)

    def worth(self, state: State) -> Floats:
        """(S,) pressure."""
        net, stage, turn = self.network, self._stage, self._turn
        before = (np.bincount(net.turn_group, self.veh(state), len(net.groups)) / self._room)[net.turn_group]
        behind = np.bincount(net.turn_link, state.fraction * before, len(net.links))[self._next] * self._fed
        pressure = splits.turn_flow_veh_s(net, state.fraction) * np.maximum(before - behind, 0.0)
        return np.asarray(np.bincount(stage, pressure[turn], len(net.stages)), dtype=float)
