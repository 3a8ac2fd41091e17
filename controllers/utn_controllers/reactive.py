"""Acyclic rules that may show any stage every few seconds, by what is to be seen before it."""

from __future__ import annotations

import numpy as np

from utn_controllers.fixed_time import FixedTime
from utn_sumo.contract import Floats, Ints, Network, Plan, State, View


class MaxWave(FixedTime):
    """The stage with most vehicles in view before it, decided anew every `every_s` seconds."""

    def __init__(self, network: Network, every_s: float = 5.0, switch_veh: float = 0.0):
        super().__init__(network)
        self.execution = Wave(network, every_s, switch_veh)


class Wave:
    """Shows the stage with most vehicles in view."""

    def __init__(self, network: Network, every_s: float, switch_veh: float):
        self.every_s = every_s
        self.switch_veh = switch_veh
        self.network = network
        self.weight = served_share(network)
        self._stages = [np.array(junction.stages) for junction in network.junctions]

    def begin(self, plan: Plan, state: State) -> None:
        """It has no use for a plan."""

    def wish(self, view: View) -> Ints:
        """The stage that serves most vehicles."""
        worth = self.weight @ view.near_veh
        worth[view.stage] += self.switch_veh
        return np.array([stages[np.argmax(worth[stages])] for stages in self._stages])


class Priced(FixedTime):
    """The stage that gains most by the vehicles that it moves."""

    def __init__(
        self,
        network: Network,
        every_s: float = 5.0,
        crowding: float = 2.0,
        stay: float = 1.0,
        power: float = 1.0,
        gate: float = 0.0,
        permitted: float = 1.0,
        full: float = 0.9,
        horizon_s: float = 10.0,
        lost_s: float = 0.0,
    ):
        super().__init__(network)
        self.execution = PricedExecution(network, every_s, crowding, stay, power, gate, permitted, full, horizon_s, lost_s)


class PricedExecution:
    """Prices of links: the steps still to go, and crowding."""

    def __init__(self, network, every_s, crowding, stay, power, gate, permitted, full, horizon_s, lost_s):
        from utn_controllers.mpc.place import remaining_steps

        self.every_s = every_s
        self.network = network
        self.crowding, self.stay, self.power, self.gate, self.full = crowding, stay, power, gate, full
        self.remaining = remaining_steps(network)
        self.horizon_s, self.lost_s = horizon_s, lost_s
        self.sat = network.group_saturation_flow_veh_s[network.turn_group]
        total = np.bincount(network.turn_group, network.fraction, len(network.groups))
        self.share = network.fraction / np.maximum(total[network.turn_group], 1e-9)
        self.serves = np.zeros((len(network.stages), len(network.turns)))
        for index, stage in enumerate(network.stages):
            for turn in stage.turns:
                letters = {
                    stage.state[k]
                    for k, turns in enumerate(network.junctions[stage.junction].signal_turns)
                    if turn in turns
                }
                self.serves[index, turn] = 1.0 if "G" in letters else permitted
        self._stages = [np.array(junction.stages) for junction in network.junctions]
        self.fed = network.turn_next >= 0
        self.next = np.maximum(network.turn_next, 0)

    def begin(self, plan: Plan, state: State) -> None:
        self.fraction = state.fraction
        total = np.bincount(self.network.turn_group, state.fraction, len(self.network.groups))
        self.share = state.fraction / np.maximum(total[self.network.turn_group], 1e-9)

    def wish(self, view: View) -> Ints:
        net = self.network
        occ = view.x_veh / net.storage_veh
        price = self.remaining + self.crowding * occ**self.power
        link = net.turn_link
        ahead = np.where(self.fed, price[self.next], 0.0)
        gain = np.maximum(price[link] - ahead, 0.0) / np.maximum(self.remaining[link], 1e-9)
        blocked = self.fed & (occ[self.next] > self.full)
        gain[blocked] = 0.0
        coming = self.share * view.near_veh[net.turn_group]
        lost_s = net.clearance_s[view.stage][net.stage_junction] + self.lost_s
        lost_s[view.stage] = 0.0
        cap = self.sat * self.share * np.maximum(self.horizon_s - lost_s, 1.0)[:, None]
        worth = (self.serves * gain * (np.minimum(coming, cap) + 1e-3 * coming)).sum(axis=1)
        worth[view.stage] *= self.stay
        worth[view.stage] += 1e-6
        return np.array([stages[np.argmax(worth[stages])] for stages in self._stages])


def served_share(network: Network) -> Floats:
    """(S, G) share of each lane group's traffic that a stage serves."""
    share = np.zeros((len(network.stages), len(network.groups)))
    total = np.bincount(network.turn_group, network.fraction, len(network.groups))
    for index, stage in enumerate(network.stages):
        for turn in stage.turns:
            group = network.turns[turn].group
            share[index, group] += network.turns[turn].fraction / max(total[group], 1e-9)
    return share


class Rated(FixedTime):
    """The stage with the best rate."""

    def __init__(self, network: Network, every_s: float = 5.0, crowding: float = 2.0, tau_s: float = 12.0, extra_s: float = 0.0, full: float = 0.9, queue: float = 0.0):
        super().__init__(network)
        self.execution = RatedExecution(network, every_s, crowding, 1, 1, 0, 1, full, 10, 0)
        self.execution.tau_s, self.execution.extra_s, self.execution.queue = tau_s, extra_s, queue


class RatedExecution(PricedExecution):
    def wish(self, view: View) -> Ints:
        net = self.network
        occ = view.x_veh / net.storage_veh
        price = self.remaining + self.crowding * occ**self.power
        link = net.turn_link
        ahead = np.where(self.fed, price[self.next], 0.0)
        gain = np.maximum(price[link] - ahead, 0.0) / np.maximum(self.remaining[link], 1e-9)
        gain[self.fed & (occ[self.next] > self.full)] = 0.0
        near = self.share * view.near_veh[net.turn_group]
        sat = self.sat * self.share
        worth = self.serves * gain
        lost_s = net.clearance_s[view.stage][net.stage_junction] + self.extra_s
        clear_s = (self.serves * (near / np.maximum(sat, 1e-9))).max(axis=1)
        rate = (worth @ near) / (lost_s + clear_s)
        waiting = self.share * view.waiting_veh[net.turn_group]
        now = np.minimum(sat, near / self.tau_s + self.queue * waiting)
        own = (worth * now).sum(axis=1)
        rate[view.stage] = own[view.stage] + 1e-6
        return np.array([stages[np.argmax(rate[stages])] for stages in self._stages])
