"""The agents that live in one process, and all that they know of the rest: what their neighbours tell them.

A region may hold one agent or all of them. Flows between two of its own agents never leave it; those to and from
agents elsewhere travel as messages. Both sides of an interaction hold the same `mean` and `price`, because both compute
them from the same two flows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from utn_controllers.mpc.acceleration import Memory
from utn_controllers.mpc.agent import NOWHERE, Agent
from utn_controllers.mpc.place import Place
from utn_controllers.mpc.receding import RecedingProblem
from utn_controllers.mpc.settings import Settings
from utn_sumo.contract import EXIT, Floats, Forecast, Ints, State

if TYPE_CHECKING:
    from utn_controllers.mpc.batch import Batch

PRODUCER, CONSUMER = 0, 1
"""The two sides of an interaction."""
SUMS = ("apart", "flow", "moved", "mean", "price")
"""Sums of squares over a region's sides of the interactions: primal and dual residual, and their measure."""
DAMPING = 0.5
"""Of `sensitivity`: the share of its neighbours' last word that an agent takes over. Undamped it oscillates."""


@dataclass(frozen=True)
class Message:
    """What one region tells another: one row a link that traffic crosses between them."""

    links: Ints
    """(n,)"""
    numbers: Floats
    """(n, model steps) the sender's copies of the flows [veh], or the prices of its inflows; at first both."""


class Region:
    """Agents with their side of what is agreed: `mean` zb [veh] and `price` lam, (interactions, model steps) each."""

    def __init__(self, places: list[Place], partners: dict[int, int], settings: Settings):
        """`partners` gives the region at the other side of each link that crosses this one's border.

        The junctions of a place that several share are solved side by side.
        """
        self.settings = settings
        self.rho = settings.first_rho if settings.coordination != "none" else 0.0
        shared = sorted({link for place in places for link in (*place.consumed, *place.produced)})
        row = {link: index for index, link in enumerate(shared)}
        self.links = np.array(shared, dtype=np.int64)
        """(n,) the interactions: links between two agents, one of them here at least."""
        self._rows_in = [np.array([row[link] for link in place.consumed], dtype=np.int64) for place in places]
        self._owned = np.zeros((2, len(shared), 1))
        for place in places:
            for side, links in ((CONSUMER, place.consumed), (PRODUCER, place.produced)):
                self._owned[side, [row[link] for link in links]] = 1.0
        crossing = {link: region for link, region in sorted(partners.items()) if link in row}
        self._across = {
            region: np.array([row[link] for link, other in crossing.items() if other == region], dtype=np.int64)
            for region in sorted(set(crossing.values()))
        }
        """Rows that cross the border to each neighbouring region: one of their sides is here, the other there."""
        self.agents = [_agent(place, row, settings) for place in places]
        ends = np.cumsum([[len(place.links), len(place.turns)] for place in places], axis=0)
        starts = ends - [[len(place.links), len(place.turns)] for place in places]
        self._shares = [
            tuple(np.arange(*each) for each in zip(*own, strict=True)) for own in zip(starts, ends, strict=True)
        ]
        """Where each agent's links and turns are among the region's."""
        steps = self.agents[0].problem.steps
        self._flow = np.zeros((2, len(shared), steps))
        self._parts = list(pairwise(np.cumsum([0, *(agent.shared.size for agent in self.agents)]).tolist()))
        """Where each agent's variables are among all."""
        self._shared = np.concatenate([agent.shared for agent in self.agents])
        # What is part of no shared flow goes to a number past the last.
        self._shared[self._shared == NOWHERE] = self._flow.size
        self.mean: Floats = np.zeros((len(shared), steps))
        self.price: Floats = np.zeros((len(shared), steps))
        self._memory = Memory(2 * self.mean.size)
        self._counts = self._owned.sum(axis=0)
        """(n, 1) how many sides of each interaction are here."""
        self._fresh = True

    def begin(self, state: State, forecast: Forecast) -> dict[int, Message]:
        """Take up the state of its own links and turns, an agent's after the other's, of which each is told its own.

        In the first step, tells the neighbours what it expects to come in.
        """
        self._memory.clear()
        states = [state.part(links, turns) for links, turns in self._shares]
        for agent, own, (links, _) in zip(self.agents, states, self._shares, strict=True):
            agent.prepare(own, forecast.part(links), self.rho)
        mode = self.settings.coordination
        if self._fresh or mode == "none":
            self._expect(states)
        else:
            shift = self.agents[0].problem.substeps
            for array in (self.mean, self.price):
                array[:, :-shift] = array[:, shift:].copy()
        if not self._fresh or mode == "none":
            return {}
        self._fresh = False
        expected = np.concatenate([self.mean, self.price], axis=1)
        return self._tell(np.array([expected, expected]), {CONSUMER})

    def _expect(self, states: list[State]) -> None:
        """Set what comes in to what came of late, and its price to what a vehicle more is likely to cost."""
        for agent, own, consumed in zip(self.agents, states, self._rows_in, strict=True):
            place = agent.place
            fed = ~place.part.is_source
            rate = own.past_inflow_veh.mean(axis=0)[fed] / place.part.sample_s
            self.mean[consumed] = rate[:, None] * agent.problem.model.step_s
            if self.settings.coordination != "none":
                self.price[consumed] = self.settings.price(place.remaining_steps[fed])[:, None]

    def greet(self, inbox: list[Message]) -> None:
        """Take over what the neighbours expect to come in, and its price: both sides then start from the same."""
        for message in inbox:
            rows = np.searchsorted(self.links, message.links)
            self.mean[rows], self.price[rows] = np.split(message.numbers, 2, axis=1)

    def solve(self) -> dict[int, Message]:
        """Every agent's best answer to what is agreed so far; the messages that tell the neighbours."""
        mode = self.settings.coordination
        priced = self.price - self.rho * self.mean
        linear = np.array([priced, -self.price - self.rho * self.mean if mode == "admm" else self.mean])
        terms = np.append(linear, 0.0)[self._shared]
        answers = [agent.solve(terms[start:end]) for agent, (start, end) in zip(self.agents, self._parts, strict=True)]
        flow = np.bincount(self._shared, np.concatenate(answers), minlength=self._flow.size + 1)
        self._flow = flow[:-1].astype(float).reshape(self._flow.shape)
        return {} if mode == "none" else self._tell(self._flow, {PRODUCER, CONSUMER})

    def agree(self, inbox: list[Message]) -> Floats:
        """Hear the neighbours' answers, and find where they lead `mean` and `price`, which with `admm` `mix` then sets.

        This region's sums of squares (see `SUMS`) and, with `admm`, the residual's inner products (see `Memory.push`).
        """
        for message in inbox:
            rows = np.searchsorted(self.links, message.links)
            sides = np.where(self._owned[PRODUCER, rows, 0] > 0, CONSUMER, PRODUCER)
            self._flow[sides, rows] = message.numbers
        flow = self._flow
        if self.settings.coordination == "admm":
            # Boyd et al. 2011, 3.4.3: over-relaxed.
            produced, consumed = self.settings.relaxation * flow + (1 - self.settings.relaxation) * self.mean
            mean = (produced + consumed) / 2
            price = self.price + self.rho * (produced - mean)
            owned, apart, moved = self._owned, flow - mean, self.rho * (mean - self.mean)
        else:
            owned, apart, moved = self._owned[PRODUCER], flow[PRODUCER] - self.mean, flow[CONSUMER] - self.price
            mean, price, flow = self.mean + DAMPING * apart, self.price + DAMPING * moved, flow[PRODUCER]
        sums = [_squares(owned, each) for each in (apart, flow)]
        sums += [_squares(self._counts, each) for each in (moved, mean, price)]
        # Agents that stand apart from their own rows have not come to terms either.
        sums[0] += sum(agent.residual for agent in self.agents)
        if self.settings.coordination == "sensitivity":
            # Not mixed: a mix could set an agent an inflow under zero.
            self.mean, self.price = mean, price
        if self.settings.coordination != "admm":
            return np.array(sums)
        scale = np.array([self.rho, 1 / self.rho])[:, None, None]
        before, after = np.array([self.mean, self.price]), np.array([mean, price])
        weight = np.sqrt(self._counts * scale * np.ones_like(after))
        return np.concatenate([sums, self._memory.push(before.ravel(), after.ravel(), weight.ravel())])

    def mix(self, weights: Floats) -> None:
        """Agree on the last rounds' results, mixed by these weights."""
        self.mean, self.price = self._memory.mix(weights).reshape(2, *self.mean.shape)

    def adapt(self, rho: float) -> None:
        """Take another penalty."""
        self.rho = rho
        self._memory.clear()
        for agent in self.agents:
            agent.factorise(rho)

    def finish(self) -> Floats:
        """(Kc, S) greens as they are now, an agent's after the other's."""
        return np.concatenate([agent.settle() for agent in self.agents], axis=1)

    def size(self) -> int:
        """Numbers that its agents share: the interactions' sides here, times the model steps."""
        return int(self._owned.sum()) * int(self.mean.shape[1])

    def _tell(self, numbers: Floats, sides: set[int]) -> dict[int, Message]:
        """Messages with this region's sides of the interactions that cross its border."""
        told = {}
        for region, rows in self._across.items():
            side = np.where(self._owned[PRODUCER, rows, 0] > 0, PRODUCER, CONSUMER)
            kept = np.isin(side, list(sides))
            if kept.any():
                told[region] = Message(self.links[rows[kept]], numbers[side[kept], rows[kept]])
        return told


def _agent(place: Place, row: dict[int, int], settings: Settings) -> Agent | Batch:
    """Who solves a place's problem. The shared flows are numbered as in an array (sides, interactions, model steps)."""
    receding = RecedingProblem(place, settings)
    problem, layout = receding.problem, receding.problem.layout
    shared = np.full((problem.count, layout.size), NOWHERE)
    steps = np.arange(problem.steps)

    def join(position: int, block: Ints, side: int, link: int) -> None:
        """Say of what shared flow the variables are that a link or turn has, in the order of the place."""
        junction, own = divmod(position, block.shape[1])
        shared[junction, block[:, own]] = (side * len(row) + row[link]) * problem.steps + steps

    for position, link in enumerate(place.links.tolist()):
        if not place.part.is_source[position]:
            join(position, layout.inflow, CONSUMER, link)
    for position, link in enumerate(place.turn_next.tolist()):
        if link != EXIT:
            join(position, layout.leaving, PRODUCER, link)
    if problem.count == 1:
        return Agent(receding, shared, given=settings.coordination != "admm")
    from utn_controllers.mpc.batch import Batch  # noqa: PLC0415 - compiles its loops

    return Batch(receding, shared)


def _squares(weight: Floats, numbers: Floats) -> float:
    """Weighted sum of squares. Not by BLAS, whose threads wait for each other on a busy machine."""
    return float((weight * numbers * numbers).sum())
