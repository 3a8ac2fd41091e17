"""A junction's place in the network: itself, and the little that it has to know of what is round it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network

MOST_LINKS = 1000
"""Of a way through the network: where nobody ever leaves it, as in a net without exits, it would have no end."""
NO_SLACK_S = 1e-9
"""Between bounds as near as this a solver sees an equality."""
PRODUCER, CONSUMER = 0, 1
"""What a junction is to a link: it feeds it, or has it for one of its own."""


class Side(NamedTuple):
    """A junction's part in the flow onto a link: one link has one consumer, and producers one or more."""

    junction: int
    """Among those of its place."""
    kind: int
    """PRODUCER or CONSUMER; a junction that feeds its own link is both."""
    link: int


@dataclass(frozen=True)
class Place:
    """A junction and what it has to know of the network round it: nothing else reaches its problem.

    Several junctions may share a place, one's links, turns and stages after the other's.
    """

    part: Network
    links: Ints
    """(n,) its links' numbers in the whole network."""
    turns: Ints
    stages: Ints
    turn_next: Ints
    """(M,) link of the whole network that each of its turns feeds, or EXIT."""
    remaining_steps: Floats
    """(n,) control steps that a vehicle on each link still needs to leave the network."""

    @property
    def consumed(self) -> list[int]:
        """Links of this junction that any junction feeds."""
        return [int(link) for link in self.links[~self.part.is_source]]

    @property
    def sides(self) -> list[Side]:
        """What its junctions share with each other and with the rest of the network."""
        part = self.part
        at = part.link_junction
        consumed = [Side(int(at[own]), CONSUMER, int(self.links[own])) for own in np.flatnonzero(~part.is_source)]
        feeding = np.flatnonzero(self.turn_next != EXIT)
        return consumed + sorted(
            {Side(int(at[part.turn_link[turn]]), PRODUCER, int(self.turn_next[turn])) for turn in feeding}
        )


def places(network: Network, groups: Iterable[Sequence[int]] | None = None) -> list[Place]:
    """The places of groups of junctions, or else of every junction alone."""
    remaining = remaining_steps(network)
    found = []
    for group in groups or [[junction] for junction in range(len(network.junctions))]:
        links, turns, stages = (
            np.concatenate([np.asarray(each, dtype=np.int64) for each in own])
            for own in (
                [network.links_of[junction] for junction in group],
                [network.turns_of[junction] for junction in group],
                [network.junctions[junction].stages for junction in group],
            )
        )
        part = network.part(*group)
        found.append(Place(part, links, turns, stages, network.turn_next[turns], remaining[links]))
    return found


def has_slack(network: Network) -> Bools:
    """(J,) junctions whose least greens leave something of the cycle.

    At the others the greens' bounds meet. A budget beside them says nothing new, and is one equality too many.
    """
    least_s = np.bincount(network.stage_junction, network.min_green_s, len(network.junctions))
    return np.asarray(network.green_budget_s - least_s > NO_SLACK_S)


def remaining_steps(network: Network) -> Floats:
    """(Z,) control steps that a vehicle on each link still needs to leave the network.

    Free travel and half a cycle's wait on each link of its expected way, summed by the turning fractions.
    """
    own = (network.free_time_s + network.cycle_s[network.link_junction] / 2) / network.control_step_s
    fed = np.flatnonzero(network.turn_next != EXIT)
    size = len(network.links)
    onward = sp.csr_array((network.fraction[fed], (network.turn_link[fed], network.turn_next[fed])), shape=(size, size))
    remaining = own
    for _ in range(MOST_LINKS):
        remaining = own + onward @ remaining
    return np.asarray(remaining, dtype=float)
