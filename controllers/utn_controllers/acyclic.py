"""Acyclic rules: whichever stage is worth most now, decided anew every few seconds by what is to be seen before it.

They are executions that look at no plan, and go with any planner. As controllers they have the equal split beside them,
which nobody carries out.

max_wave       the stage with most vehicles approaching (RESCO's MAXWAVE)
max_pressure   the stage with most pressure: vehicles before it less those behind it (Varaiya 2013)
priced         the stage that gains most by the vehicles that it can move within a short horizon, at prices of the links

Whom a stage serves has way in it. Who gives way counts where no stage of the junction lets him go first, with all who
share his lane: else whichever stage serves all, with left turns in the gaps of their opposites, would be worth as much
as theirs, however long they wait. Where he shares his lane with some who have red in that stage it counts as well: else
it would be worth most, and go on, while one of these stands in front.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from utn_controllers.fixed_time import FixedTime
from utn_sumo.clearances import HAS_WAY
from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network, Plan, State, View


def served(network: Network) -> Bools:
    """(S, M) turns that count for each stage: those that have way in it, or give way in it and never have their way.

    They do in a stage in which they have way and all go who share some lane with them.
    """
    has_way = np.zeros_like(network.serves)
    for stage, shown in enumerate(network.stages):
        letters = zip(shown.state, network.junctions[shown.junction].signal_turns, strict=True)
        has_way[stage, [turn for letter, turns in letters if letter == HAS_WAY for turn in turns]] = True
    goes = np.zeros_like(has_way)
    for each in network.lane_sets:
        turns = list(each.turns)
        goes[:, turns] |= network.serves[:, turns].all(axis=1, keepdims=True)
    return np.where((has_way & goes).any(axis=0), has_way, network.serves)


class Acyclic:
    """Shows the stage of most worth at every junction. What that is, a subclass says."""

    def __init__(self, network: Network, every_s: float):
        self.network = network
        self.every_s = every_s
        self.fraction = network.fraction
        self.serves = served(network)
        self._best = _Best(network)

    def begin(self, plan: Plan, state: State) -> None:  # noqa: ARG002 - it has no use for a plan
        """Take up the turning fractions as they are at present."""
        self.fraction = state.fraction

    def wish(self, view: View) -> Ints:
        """(J,) the stage of most worth; the present one where none is worth more."""
        return self._best.stages(self.worth(view), view.stage)

    def worth(self, view: View) -> Floats:
        """(S,) what each stage is worth at this moment."""
        raise NotImplementedError

    def by_turn(self, groups: Floats) -> Floats:
        """(M,) of numbers by lane group (G,) each turn's share, as the traffic of the group turns."""
        group = self.network.turn_group
        total = np.bincount(group, self.fraction, len(self.network.groups))[group]
        return np.asarray(groups[group] * self.fraction / np.maximum(total, 1e-9))


class _Best:
    """Finds the best stage of every junction at once."""

    def __init__(self, network: Network):
        self._order = np.concatenate([junction.stages for junction in network.junctions]).astype(np.int64)
        counts = [len(junction.stages) for junction in network.junctions]
        self._starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        self._counts = np.array(counts)

    def stages(self, worth: Floats, present: Ints) -> Ints:
        """(J,) stage of most `worth` (S,); the `present` (J,) where none is worth more, else the first of equals."""
        ordered = worth[self._order]
        most = np.maximum.reduceat(ordered, self._starts)
        at = np.where(ordered >= np.repeat(most, self._counts), np.arange(len(ordered)), len(ordered))
        first = self._order[np.minimum.reduceat(at, self._starts)]
        return np.where(worth[present] >= most, present, first)


class WaveSettings(BaseModel):
    """Settings of `max_wave`."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    every_s: float = Field(5.0, ge=1, le=60)
    """Time between two decisions [s]."""


class Wave(Acyclic):
    """Shows the stage with most vehicles approaching, every few seconds anew."""

    Settings = WaveSettings

    def __init__(self, network: Network, **settings: float):
        super().__init__(network, WaveSettings(**settings).every_s)

    def worth(self, view: View) -> Floats:
        return np.asarray(self.serves @ self.by_turn(view.near_veh))


class PressureSettings(WaveSettings):
    """Settings of `max_pressure`."""

    count: Literal["waiting", "near"] = "waiting"
    """Vehicles that make the pressure: those that stand, or all in view."""
    per: Literal["lane", "storage", "none"] = "lane"
    """What they are divided by."""


class Pressure(Acyclic):
    """Shows the stage with most pressure, vehicles before it less vehicles behind it, every few seconds anew."""

    Settings = PressureSettings

    def __init__(self, network: Network, **settings: float | str):
        chosen = PressureSettings(**settings)  # type: ignore[arg-type]
        super().__init__(network, chosen.every_s)
        self._near = chosen.count == "near"
        lanes = np.array([len(group.lanes) for group in network.groups], dtype=float)
        room = {"lane": lanes, "none": np.ones(len(lanes)), "storage": lanes}[chosen.per]
        if chosen.per == "storage":
            by_link = np.bincount(network.group_link, lanes, len(network.links))
            room = network.storage_veh[network.group_link] * lanes / by_link[network.group_link]
        self._room = room
        self._next = np.maximum(network.turn_next, 0)
        # Who stands between the nodes of one signal is before its own stages: none of them is worth less for that.
        own = network.link_junction[self._next] == network.link_junction[network.turn_link]
        self._fed = (network.turn_next != EXIT) & ~own

    def worth(self, view: View) -> Floats:
        net = self.network
        veh = view.near_veh if self._near else view.waiting_veh
        before = (veh / self._room)[net.turn_group]
        behind = np.bincount(net.turn_link, self.fraction * before, len(net.links))[self._next] * self._fed
        flow = self.by_turn(net.group_saturation_flow_veh_s)
        return np.asarray(self.serves @ (flow * (before - behind)))


class PricedSettings(WaveSettings):
    """Settings of `priced`, found on `utn17` at demands 0.6, 1.0 and 1.3 with seeds 1 to 3."""

    horizon_s: float = Field(15.0, gt=0)
    """How far ahead a stage is judged [s]; another than the present one loses its clearance of it."""
    crowding: float = Field(2.0, ge=0)
    """By how much a full link is dearer than an empty one, in vehicles."""
    full: float = Field(0.5, gt=0)
    """Share of its storage from which a link is fed no more: beyond it some lane is full and stops the junction."""


class Prices(Acyclic):
    """Shows the stage that gains most: by the vehicles that it can move in a short horizon, at prices of the links.

    A link costs the more the fuller it is, and what a stage moves gains the difference, as pressure does.

    Into a full link nothing is gained. A stage is judged by whom it can let through within the horizon, so that among
    queues that all fill it the present stage goes on, which has no clearance to wait for; where few are about, the
    stage with most of them comes next.
    """

    Settings = PricedSettings

    def __init__(self, network: Network, **settings: float):
        self.settings = PricedSettings(**settings)
        super().__init__(network, self.settings.every_s)
        self._fed = network.turn_next != EXIT
        self._next = np.maximum(network.turn_next, 0)
        self._stage, self._turn = np.nonzero(self.serves)

    def worth(self, view: View) -> Floats:
        net, settings = self.network, self.settings
        taken = view.x_veh / net.storage_veh
        ahead = np.where(self._fed, taken[self._next], 0.0)
        gain = np.maximum(1 + settings.crowding * (taken[net.turn_link] - ahead), 0.0)
        gain[self._fed & (taken[self._next] > settings.full)] = 0.0
        lost_s = net.clearance_s[view.stage][net.stage_junction]
        lost_s[view.stage] = 0.0
        open_s = np.maximum(settings.horizon_s - lost_s, 1.0)
        near = self.by_turn(view.near_veh)
        most = self.by_turn(net.group_saturation_flow_veh_s)
        stage, turn = self._stage, self._turn
        moved = np.minimum(near[turn], open_s[stage] * most[turn]) + TIE_SHARE * near[turn]
        return np.asarray(np.bincount(stage, gain[turn] * moved, len(net.stages)), dtype=float)


TIE_SHARE = 1e-3
"""What vehicles beyond the horizon count: who is equal within it is told apart by the longer queue."""


class MaxWave(FixedTime):
    """Shows the stage with most vehicles approaching, every few seconds anew."""

    Settings = WaveSettings

    def __init__(self, network: Network, **settings: float):
        super().__init__(network)
        self.execution = Wave(network, **settings)


class MaxPressure(FixedTime):
    """Shows the stage with most pressure, vehicles before it less vehicles behind it, every few seconds anew."""

    Settings = PressureSettings

    def __init__(self, network: Network, **settings: float | str):
        super().__init__(network)
        self.execution = Pressure(network, **settings)


class Priced(FixedTime):
    """Shows the stage that gains most: by the vehicles that it can move in a short horizon, at prices of the links."""

    Settings = PricedSettings

    def __init__(self, network: Network, **settings: float):
        super().__init__(network)
        self.execution = Prices(network, **settings)
