"""What an execution sees, made up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utn_sumo.contract import CLOSE_ZONES, ZONES_M, Bools, Floats, Ints, Network
from utn_sumo.plant.patience import Patience


@dataclass(frozen=True)
class Scene:
    """A contract.View of arrays."""

    time_s: float
    stage: Ints
    begin_s: Floats
    free: Bools
    waiting_veh: Floats
    set_waiting_veh: Floats
    near_veh: Floats
    set_zone_veh: Floats
    link_zone_veh: Floats
    x_veh: Floats
    gap_s: Floats
    entered_veh: Floats
    left_veh: Floats
    parted_veh: Floats
    set_link: Ints
    set_junction: Ints
    link_junction: Ints
    calling: Floats
    side_stand_veh: Floats
    side_gone_veh: Floats
    amid_veh: Floats

    def zone_veh(self, junctions: Bools) -> tuple[Floats, Floats]:
        return (
            np.where(junctions[self.set_junction][:, None], self.set_zone_veh, 0.0),
            np.where(junctions[self.link_junction][:, None], self.link_zone_veh, 0.0),
        )

    def standing_amid_veh(self, turn: int) -> float:
        return float(self.amid_veh[turn])

    def side_standing_veh(self, roads: Bools) -> Floats:
        return np.where(roads, self.side_stand_veh, 0.0)

    def side_left_veh(self, roads: Bools) -> Floats:
        return np.where(roads, self.side_gone_veh, np.nan)

    def close_one_veh(self, lane_set: int) -> float:
        before = self.link_zone_veh[self.set_link[lane_set]]
        return float(self.set_zone_veh[lane_set, :CLOSE_ZONES].sum() + before[:CLOSE_ZONES].sum())

    def near_one_veh(self, group: int) -> float:
        return float(self.near_veh[group])

    def gap_one_s(self, group: int) -> float:
        return float(self.gap_s[group])


def by_the_line(veh: Floats) -> Floats:
    """(L, zones) everybody of a lane set (L,) in the zone next to the stop line."""
    return np.pad(veh[:, None], ((0, 0), (0, len(ZONES_M) - 1)))


def scene(
    network: Network, time_s: float = 0.0, stage: Ints | None = None, *, veh: Floats | float = 0.0, gap_s: float = 0.0
) -> Scene:
    """Everybody stands, and nobody has come or left since; every junction shows its first stage and is free.

    Unless it is said otherwise.
    """
    groups, sets = np.zeros(len(network.groups)), np.zeros(len(network.lane_sets))
    everybody = groups + veh
    return Scene(
        time_s,
        np.array([junction.stages[0] for junction in network.junctions]) if stage is None else stage,
        np.zeros(len(network.junctions)),
        np.ones(len(network.junctions), dtype=bool),
        everybody,
        sets + veh,
        everybody,
        by_the_line(sets + veh),
        np.zeros((len(network.links), len(ZONES_M))),
        np.zeros(len(network.links)),
        groups + gap_s,
        np.zeros(len(network.links)),
        sets,
        np.zeros(len(network.links)),
        network.set_link,
        network.link_junction[network.set_link],
        network.link_junction,
        np.zeros(len(network.callers)),
        np.zeros(len(network.side_roads)),
        np.zeros(len(network.side_roads)),
        np.zeros(len(network.turns)),
    )


def allowed(patience: Patience, wish: Ints, now: Scene) -> Ints:
    """(J,) what patience makes of a wish at this moment."""
    patience.look(now)
    return patience.allow(wish, now.stage, now.time_s)
