"""Who shares the flow onto which link: one consumer, whose copy is to be what its producers send all together.

A region counts its agents' sides of the interactions one after the other, and the interactions that they are sides of.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from utn_controllers.mpc.place import PRODUCER, Side
from utn_sumo.contract import Floats, Ints


@dataclass(frozen=True)
class Message:
    """What one region tells another: a row for each kind of side that it has at a link with sides in both."""

    links: Ints
    """(n,)"""
    kinds: Ints
    """(n,) PRODUCER or CONSUMER."""
    numbers: Floats
    """(n, model steps) sums over the sender's sides of this kind: of their flows [veh], or the price of what comes in;
    at first both, side by side."""


class Interactions:
    """Those with a side in one region, n of them."""

    def __init__(self, sides: Sequence[Sequence[Side]], partners: Mapping[int, Sequence[int]], steps: int):
        """`sides` are those of each place; `partners` the region of every side elsewhere, for links with any."""
        every = [side for own in sides for side in own]
        self.links = np.array(sorted({side.link for side in every}), dtype=np.int64)
        """(n,)"""
        self.row = np.searchsorted(self.links, np.array([side.link for side in every], dtype=np.int64))
        """(sides,) which interaction each is a side of."""
        kind = np.array([side.kind for side in every], dtype=np.int64)
        self.sign = np.where(kind == PRODUCER, 1.0, -1.0)[:, None]
        """(sides, 1) 1 of a producer's, -1 of a consumer's."""
        self.held = np.zeros((2, len(self.links)), dtype=np.bool_)
        """(2, n) whether any side of a kind is here."""
        self.held[kind, self.row] = True
        elsewhere = np.array([len(partners.get(link, ())) for link in self.links.tolist()], dtype=np.int64)
        self.count = (np.bincount(self.row, minlength=len(self.links)) + elsewhere)[:, None]
        """(n, 1) sides of each, here and elsewhere."""
        by_agent = Counter((place, side.junction, side.link) for place, own in enumerate(sides) for side in own)
        of_link = dict(zip(self.links.tolist(), self.count[:, 0].tolist(), strict=True))
        self.told = steps * sum(number for (*_, link), number in by_agent.items() if number < of_link[link])
        """Numbers that the agents here tell others in a round: all but those of links that only their own feed."""
        self._across = {
            region: np.flatnonzero([region in partners.get(link, ()) for link in self.links.tolist()])
            for region in sorted({region for regions in partners.values() for region in regions})
        }
        """Rows that each neighbouring region has sides of too."""
        self._summand = ((kind * len(self.links) + self.row)[:, None] * steps + np.arange(steps)).ravel()
        self._shape = 2, len(self.links), steps

    def total(self, flow: Floats) -> Floats:
        """(2, n, model steps) what all producers here send and what the consumer takes; `flow` (sides, model steps)."""
        summed = np.bincount(self._summand, flow.ravel(), minlength=int(np.prod(self._shape)))
        return np.asarray(summed, dtype=float).reshape(self._shape)

    def hear(self, total: Floats, inbox: Sequence[Message]) -> None:
        """Add to such a total (2, n, model steps) what others have."""
        for message in inbox:
            total[message.kinds, self.rows(message)] += message.numbers

    def rows(self, message: Message) -> Ints:
        """Which interactions a message is about."""
        return np.searchsorted(self.links, message.links)

    def tell(self, numbers: Floats, *kinds: int) -> dict[int, Message]:
        """What of `numbers` (2, n, any) each neighbouring region is to hear from this one."""
        told = {}
        for region, rows in self._across.items():
            kind, position = np.nonzero(self.held[:, rows])
            kept = np.isin(kind, kinds)
            if kept.any():
                kind, row = kind[kept], rows[position[kept]]
                told[region] = Message(self.links[row], kind, numbers[kind, row])
        return told

    def first(self, expected: Floats) -> Floats:
        """(sides, any) of what is `expected` (n, any) to come in: all of it for a consumer, its part for a producer."""
        producers = np.maximum(self.count - 1, 1)
        return np.where(self.sign > 0, (expected / producers)[self.row], expected[self.row])
