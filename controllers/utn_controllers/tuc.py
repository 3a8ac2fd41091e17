"""TUC: the linear-quadratic regulator of the store-and-forward model, g = nominal - L x, made to fit the cycles.

Diakaki, Papageorgiou and Aboudolas, Control Engineering Practice 10 (2002); Aboudolas, Papageorgiou and Kosmatopoulos,
Transportation Research C 17 (2009).
"""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from utn_controllers import splits
from utn_sumo.contract import EXIT, Floats, Forecast, Network, Plan, State

RANK = 1e-9
"""Modes that move x by less than this share of what the strongest does are moved by rounding errors alone."""


class Settings(BaseModel):
    """Settings of `tuc`."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    r: float = Field(0.01, ge=1e-6, le=1e3)
    """R = r I: weight of the greens [s] squared, beside the vehicles squared over the storage. To be found by trial
    (Aboudolas et al. 2009): 0.1 delays by 2 % less on `utn17` at demand 1.0 and 7 % at 1.3, 1e-4 by 5 % less on other
    nets, 3 % and 21 % more on `utn17`."""


LINKS_A_TRIP = 100
"""Links after which nobody is followed any further: where no link led out of a circuit, flows would have no end."""


class TUC:
    """Greens by how many vehicles are before each stop line, those that wait outside for room on its link among them.

    What queues for lanes of its own, a lane group, is what a link is in the literature: by whole links the queue of a
    pocket would give green to the many lanes beside it.

    The nominal greens are those of equal degrees of saturation (Webster 1958) under the demand that is expected for the
    step, however it turns at present. Equal splits for nominal greens delay by 7 % more on `utn17` at demand 1.0.
    """

    horizon = 1
    Settings = Settings

    def __init__(self, network: Network, **settings: float):
        self.network = network
        lanes = np.array([len(group.lanes) for group in network.groups], dtype=float)
        link = network.group_link
        room_veh = network.storage_veh[link] * lanes / np.bincount(link, lanes)[link]
        self.gain = regulator(store_and_forward(network), 1 / room_veh, Settings(**settings).r)
        self._fullest = splits.Fullest(network, network.group_saturation_flow_veh_s)

    def plan(self, state: State, forecast: Forecast) -> Plan:
        """The greens nearest to those that the regulator wishes for."""
        wish_s = self.nominal_s(state, forecast) - self.gain @ self.before_veh(state)
        return Plan(splits.nearest(self.network, wish_s))

    def before_veh(self, state: State) -> Floats:
        """(G,) vehicles before each lane group: its queue, and of those who are on the way its share."""
        net = self.network
        queue = np.bincount(net.turn_group, state.q_veh, len(net.groups))
        standing = np.bincount(net.group_link, queue, len(net.links))
        coming = np.maximum(state.x_veh - standing, 0.0) + state.source_queue_veh
        return np.asarray(queue + coming[net.group_link] * net.group_shares(state.fraction))

    def nominal_s(self, state: State, forecast: Forecast) -> Floats:
        """(S,) greens [s] for the flows that the expected demand comes to on every link."""
        net = self.network
        fed = net.turn_next != EXIT
        entering = np.maximum(np.sum(forecast.outside_veh, axis=0)[0], 0.0)
        flow = entering
        for _ in range(LINKS_A_TRIP):
            turned = flow[net.turn_link] * state.fraction
            flow = entering + np.bincount(net.turn_next[fed], turned[fed], len(net.links))
        return splits.proportional(net, self._fullest.by_stage(flow[net.turn_link] * state.fraction))


def store_and_forward(network: Network) -> Floats:
    """(G, S) B of x(k+1) = x(k) + B (g(k) - nominal): vehicles in a control step for a second of each stage's green.

    A turn with green lets its saturation flow through, in every stage that serves it. A second more for one stage is
    taken from the others of its junction, from all alike, since their sum is the cycle's: B moves no vehicle by greens
    that nobody can give.
    """
    stage, turn = np.nonzero(network.serves)
    flow = splits.turn_flow_veh_s(network, network.fraction)[turn]
    ahead = network.turn_next[turn]
    moved = np.zeros((len(network.groups), len(network.stages)))
    np.add.at(moved, (network.turn_group[turn], stage), -flow)
    # Of who comes onto a link each of its lane groups has its share.
    place, group = np.nonzero(ahead[:, None] == network.group_link)
    np.add.at(moved, (group, stage[place]), flow[place] * network.group_shares(network.fraction)[group])
    moved *= network.control_step_s / network.cycle_s[network.stage_junction]
    for junction in network.junctions:
        stages = list(junction.stages)
        moved[:, stages] -= moved[:, stages].mean(axis=1, keepdims=True)
    return moved


def regulator(moved: Floats, weight: Floats, r: float) -> Floats:
    """(S, n) L of u = -L x, by which the sum of x' diag(weight) x + r |u|^2 is least, x(k+1) = x(k) + `moved` u(k).

    Fewer greens are free than there are numbers in x, so that part of x stays as it is whatever they are: an
    integrator out of reach, with which the Riccati equation has no stabilising solution. The singular vectors of the
    scaled model part what is in reach from what is not, and as the state is the identity they leave a scalar equation
    of each mode: p = p + 1 - (size p)^2 / (r + size^2 p), gain = size p / (r + size^2 p). What is out of reach has a
    gain of 0.
    """
    scale = np.sqrt(weight)
    mode_x, size, mode_u = np.linalg.svd(scale[:, None] * moved, full_matrices=False)
    reach = size > RANK * max(size.max(initial=0.0), RANK)
    size = size[reach]
    p = (1 + np.sqrt(1 + 4 * r / size**2)) / 2
    gain = size * p / (r + size**2 * p)
    return np.asarray((mode_u[reach].T * gain) @ mode_x[:, reach].T * scale)
