"""Greens that fill each junction's cycle and keep every least green, by what each stage is worth or is wished to have.

Both go the same way, for all junctions at once: share out, give who is short the least green, and share what is left
among the others. Who was short once stays so, because the others then have less to share.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from utn_sumo.contract import Bools, Floats, Ints, Network

SHORT_S = 1e-9
"""What a green may be under its least: rounding errors."""


def proportional(network: Network, worth: Floats) -> Floats:
    """(S,) greens [s] in proportion to what each stage is worth, (S,) from 0 on; equal where none is worth anything."""
    junction = network.stage_junction
    total = np.bincount(junction, worth)[junction]
    share = np.divide(worth, total, out=np.ones(len(worth)), where=total > 0)

    def shared(free: Bools, rest_s: Floats) -> Floats:
        return np.asarray(share * (rest_s / np.bincount(junction, share * free))[junction])

    return _with_least(network, shared)


def nearest(network: Network, wish_s: Floats) -> Floats:
    """(S,) greens [s] nearest to those wished for (S,), by the sum of squares: TUC's knapsack problem, solved exactly.

    Michelot, J. Optim. Theory Appl. 50 (1986).
    """
    junction = network.stage_junction

    def shared(free: Bools, rest_s: Floats) -> Floats:
        over_s = np.bincount(junction, wish_s * free) - rest_s
        return np.asarray(wish_s - (over_s / np.bincount(junction, free))[junction])

    return _with_least(network, shared)


def _with_least(network: Network, shared: Callable[[Bools, Floats], Floats]) -> Floats:
    """Greens of which `shared` says what the free stages have of their junctions' rests [s]; the others have the least.

    It ends with a free stage at every junction: they can't all be short of what the budget has room for.
    """
    junction, least_s = network.stage_junction, network.min_green_s
    free = np.ones(len(least_s), dtype=np.bool_)
    while True:
        rest_s = network.green_budget_s - np.bincount(junction, least_s * ~free)
        green_s = np.where(free, shared(free, rest_s), least_s)
        short = green_s < least_s - SHORT_S
        if not short.any():
            return green_s
        free &= ~short


def telling(network: Network) -> tuple[Ints, Ints]:
    """Stages and a turn that each serves, in pairs; without turns that all stages serve, which tell none apart."""
    counts = np.bincount(network.stage_junction)
    everywhere = network.serves.sum(axis=0) == counts[network.link_junction[network.turn_link]]
    stage, turn = np.nonzero(network.serves & ~everywhere)
    return stage, turn


class Fullest:
    """Of the lane groups that a stage serves, the fullest: what is to go over its turns there, for their room (G,)."""

    def __init__(self, network: Network, room: Floats):
        stage, self._turn = telling(network)
        pairs = np.stack([stage, network.turn_group[self._turn]])
        (self._stage, group), self._pair = np.unique(pairs, axis=1, return_inverse=True)
        self._room, self._stages = room[group], len(network.stages)

    def by_stage(self, turns: Floats) -> Floats:
        """(S,) of what is to go over each turn (M,); 0 where a stage serves nobody."""
        held = np.bincount(self._pair, turns[self._turn], len(self._stage))
        fullest = np.zeros(self._stages)
        np.maximum.at(fullest, self._stage, held / self._room)
        return fullest


def turn_flow_veh_s(network: Network, fraction: Floats) -> Floats:
    """(M,) what each turn lets through with green and a queue: its share of its lane group's saturation flow."""
    group = network.turn_group
    total = np.bincount(group, fraction, len(network.groups))[group]
    return np.asarray(network.group_saturation_flow_veh_s[group] * fraction / np.maximum(total, 1e-9))
