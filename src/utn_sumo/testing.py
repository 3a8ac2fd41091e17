"""States and forecasts to try a controller on: at random, and the hard ones that a run meets once in a year."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from utn_sumo.contract import Floats, Forecast, Network, State

DEMAND_VEH_H = 1200.0
"""Most that a random forecast has at a source link; a hard one has ten times as much."""


def levels(rng: np.random.Generator, *shape: int) -> Floats:
    """Numbers from 0 to 1, both ends among them."""
    return np.clip(rng.uniform(-0.3, 1.3, shape), 0, 1)


def random_split(network: Network, rng: np.random.Generator) -> Floats:
    """(M,) shares of the turns, which sum to 1 over a link."""
    weight = levels(rng, len(network.turns)) + 1e-3
    return np.asarray(weight / np.bincount(network.turn_link, weight)[network.turn_link])


def random_state(network: Network, rng: np.random.Generator) -> State:
    """A state that an estimator could give: queues within x, x within storage, past inflows that fit the rest."""
    links = len(network.links)
    x = rng.uniform(0, 1) * levels(rng, links) * network.storage_veh
    queue = levels(rng, links) * x
    entered = levels(rng, network.delay_samples, links) + 1e-9
    return State(
        cycle=0,
        time_s=0.0,
        x_veh=x,
        q_veh=random_split(network, rng) * queue[network.turn_link],
        source_queue_veh=network.is_source * levels(rng, links) * 30,
        past_inflow_veh=entered / entered.sum(axis=0) * levels(rng, links) * (x - queue),
        turned_veh=np.zeros(len(network.turns)),
        fraction=random_split(network, rng),
        disturbance_veh=np.zeros(links),
    )


def random_forecast(network: Network, rng: np.random.Generator, horizon: int) -> Forecast:
    """Demand at every source, anew in each of the steps."""
    most_veh = DEMAND_VEH_H * network.control_step_s / 3600
    return Forecast(network.is_source * most_veh * levels(rng, horizon, len(network.links)))


def random_greens(network: Network, rng: np.random.Generator) -> Floats:
    """(S,) greens that fill every cycle and keep every least."""
    green = network.min_green_s.copy()
    for junction, budget in zip(network.junctions, network.green_budget_s, strict=True):
        stages = list(junction.stages)
        green[stages] += (budget - green[stages].sum()) * rng.dirichlet(np.ones(len(stages)))
    return green


def filled(network: Network, rng: np.random.Generator, share: Floats) -> State:
    """A state with this share (Z,) of every link's storage taken, all of it queued."""
    state, x = random_state(network, rng), share * network.storage_veh
    queue = random_split(network, rng) * x[network.turn_link]
    return replace(state, x_veh=x, q_veh=queue, past_inflow_veh=0 * state.past_inflow_veh)


def _empty(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    state = filled(network, rng, np.zeros(len(network.links)))
    nobody = np.zeros(len(network.links))
    return replace(state, source_queue_veh=nobody), Forecast(np.zeros((horizon, len(network.links))))


def _full(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    return filled(network, rng, np.ones(len(network.links))), random_forecast(network, rng, horizon)


def _over_full(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    over = 1 + 0.3 * levels(rng, len(network.links))
    return filled(network, rng, over), random_forecast(network, rng, horizon)


def _one_link_full(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    share = np.zeros(len(network.links))
    share[rng.integers(len(share))] = 1.0
    return filled(network, rng, share), random_forecast(network, rng, horizon)


def _flood(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    state = random_state(network, rng)
    waiting = 1000 * network.is_source * levels(rng, len(network.links))
    return replace(state, source_queue_veh=waiting), Forecast(10 * random_forecast(network, rng, horizon).demand_veh)


def _stale(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    """The forecast of another hour, and the past inflows of another hour than x: more on the way than there is."""
    state, other = random_state(network, rng), random_state(network, rng)
    return replace(state, past_inflow_veh=3 * other.past_inflow_veh), random_forecast(network, rng, horizon)


def _dead_link(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    """One link's detectors are silent, though its neighbours are full: nobody there, nobody came, one turn in use."""
    link = int(rng.integers(len(network.links)))
    turns = np.flatnonzero(network.turn_link == link)
    state = filled(network, rng, np.ones(len(network.links)))
    x, q, fraction = state.x_veh.copy(), state.q_veh.copy(), state.fraction.copy()
    x[link] = q[turns] = fraction[turns] = 0.0
    fraction[turns[0]] = 1.0
    return replace(state, x_veh=x, q_veh=q, fraction=fraction), random_forecast(network, rng, horizon)


def _queue_beyond(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    """Counts that contradict each other: more queued than there is."""
    state = random_state(network, rng)
    return replace(state, q_veh=2 * state.q_veh + 1), random_forecast(network, rng, horizon)


def _disturbed(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    """Many are expected to come onto links amid them, and more to vanish than there are."""
    state, forecast = random_state(network, rng), random_forecast(network, rng, horizon)
    unruly = rng.uniform(-1, 1, forecast.demand_veh.shape) * network.storage_veh
    return state, replace(forecast, disturbance_veh=unruly)


def _ordinary(network: Network, rng: np.random.Generator, horizon: int) -> tuple[State, Forecast]:
    return random_state(network, rng), random_forecast(network, rng, horizon)


HARD: dict[str, Callable[[Network, np.random.Generator, int], tuple[State, Forecast]]] = {
    "ordinary": _ordinary,
    "empty": _empty,
    "full": _full,
    "over full": _over_full,
    "one link full": _one_link_full,
    "flood": _flood,
    "stale": _stale,
    "dead link": _dead_link,
    "queue beyond its link": _queue_beyond,
    "disturbed": _disturbed,
}
"""What a controller must have a plan for, by name: (network, rng, horizon) to a state and a forecast."""
