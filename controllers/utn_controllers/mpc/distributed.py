"""The controller `dmpc`: one agent a junction, coordinated with its neighbours (SPEC 4)."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from utn_controllers.mpc.coordination import Coordinator
from utn_controllers.mpc.crew import Crew, DaskActors, InProcess, Processes
from utn_controllers.mpc.place import places
from utn_controllers.mpc.problem import Timing
from utn_controllers.mpc.region import Region
from utn_controllers.mpc.settings import Settings
from utn_controllers.mpc.statement import Structure
from utn_sumo.contract import EXIT, Forecast, Network, Plan, State
from utn_sumo.model import check_step

if TYPE_CHECKING:
    from utn_controllers.mpc.agent import Agent
    from utn_controllers.mpc.batch import Batch

__all__ = ["DistributedMPC", "Settings"]


BATCH_FROM = 8
"""Junctions of one structure that are better solved side by side than one by one."""


def _alike(network: Network, junctions: list[int], settings: Settings) -> list[list[int]]:
    """The junctions in groups of one structure where enough of them have it, else alone.

    Alone are those too that share no flow with others: an exact answer ends what they have to say, while those of a
    group come to be exact only in rounds, of which these would need as many for themselves.
    """
    if settings.coordination != "admm":
        return [[junction] for junction in junctions]
    alike: dict[Structure, list[int]] = {}
    apart = [junction for junction in junctions if _is_apart(network, junction)]
    for junction in sorted(set(junctions) - set(apart)):
        alike.setdefault(Structure.of(network.part(junction), settings), []).append(junction)
    large = [group for group in alike.values() if len(group) >= BATCH_FROM]
    few = [junction for group in alike.values() if len(group) < BATCH_FROM for junction in group]
    return [[junction] for junction in sorted([*few, *apart])] + large


def _is_apart(network: Network, junction: int) -> bool:
    """Whether nobody drives from it to another junction, or back to it, nor comes from one."""
    links, turns = network.links_of[junction], network.turns_of[junction]
    return bool(network.is_source[links].all() and (network.turn_next[turns] == EXIT).all())


class DistributedMPC:
    """Chooses greens by a distributed model predictive control; settings as in `Settings`."""

    Settings = Settings

    def __init__(self, network: Network, **settings: Any):
        self.settings = Settings(**settings)
        self.horizon = self.settings.horizon
        self.network = network
        check_step(network, self.settings.step_s or network.control_step_s)
        count = len(network.junctions)
        shared = np.array_split(np.arange(count), min(self.settings.workers, count))
        parted = [_alike(network, junctions.tolist(), self.settings) for junctions in shared]
        found = iter(places(network, [group for groups in parted for group in groups]))
        self._groups = [[next(found) for _ in groups] for groups in parted]
        """Places of each region."""
        self._shares = [
            tuple(np.concatenate([getattr(place, name) for place in group]) for name in ("links", "turns", "stages"))
            for group in self._groups
        ]
        """Links, turns and stages of each region, a junction's after the other's."""
        self.crew = self._crew()
        self._coordinator = Coordinator(self.crew, self.settings)

    @property
    def agents(self) -> list[Agent | Batch]:
        """The agents of this process."""
        assert isinstance(self.crew, InProcess)
        return [agent for region in self.crew.regions for agent in region.agents]

    def timing(self) -> Timing:
        """What the next plan's problems are frozen at, the whole network's; of agents of this process."""
        return Timing.joined([each.receding.timing() for each in self.agents], [each.place for each in self.agents])

    def plan(self, state: State, forecast: Forecast) -> Plan:
        """Coordinated greens for the coming cycle and the control horizon; ControllerError without an optimum."""
        states = [state.part(links, turns) for links, turns, _ in self._shares]
        found, outcome = self._coordinator.plan(states, [forecast.part(links) for links, _, _ in self._shares])
        greens = np.zeros((self.settings.control_horizon, len(self.network.stages)))
        for answer, (_, _, stages) in zip(found, self._shares, strict=True):
            greens[:, stages] = answer
        return Plan(greens[0], greens[1:], facts=vars(outcome))

    def _crew(self) -> Crew:
        """Neighbouring junctions in one region as far as their order tells; whose links cross the borders."""
        sides: dict[int, list[int]] = {}
        for region, group in enumerate(self._groups):
            for place in group:
                for side in place.sides:
                    sides.setdefault(side.link, []).append(region)
        builders = []
        for region, group in enumerate(self._groups):
            partners = {
                link: [other for other in regions if other != region]
                for link, regions in sides.items()
                if region in regions and set(regions) != {region}
            }
            builders.append(partial(Region, group, partners, self.settings))
        if self.settings.agents == "dask":
            return DaskActors(builders, self.settings.scheduler)
        return Processes(builders) if self.settings.agents == "processes" else InProcess(builders)
