"""The agents that live in one process, and all that they know of the rest: what their neighbours tell them.

A region may hold one agent or all of them. What two agents share is the flow onto a link: its consumer's copy is to be
what its producers send, all together. Every such side has its own target, what it sends or takes by what is agreed, and
all sides of a link the same price, because all of them compute it from the same sums. What agents elsewhere
add to these sums travels as messages.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from utn_controllers.mpc.acceleration import Memory
from utn_controllers.mpc.agent import NOWHERE, Agent
from utn_controllers.mpc.interactions import Interactions, Message
from utn_controllers.mpc.place import CONSUMER, PRODUCER, Place, Side
from utn_controllers.mpc.receding import RecedingProblem
from utn_controllers.mpc.settings import Settings
from utn_sumo.contract import EXIT, Bools, Floats, Forecast, Ints, State

if TYPE_CHECKING:
    from utn_controllers.mpc.batch import Batch

SUMS = ("apart", "flow", "moved", "target", "price")
"""Sums of squares over a region's sides: primal and dual residual, and their measure."""
DAMPING = 0.5
"""Of `sensitivity`: the share of its neighbours' last word that an agent takes over. Undamped it oscillates."""


class Region:
    """Agents with their sides of what is agreed: `target` [veh] and `price`, (sides, model steps) each."""

    def __init__(self, places: list[Place], partners: dict[int, list[int]], settings: Settings):
        """`partners` gives, for links with sides here and elsewhere, the region of every side elsewhere.

        The junctions of a place that several share are solved side by side.
        """
        self.settings = settings
        self.rho = settings.first_rho if settings.coordination != "none" else 0.0
        own = [place.sides for place in places]
        starts = np.cumsum([0, *map(len, own)]).tolist()
        self.agents = [
            _agent(place, {side: start + index for index, side in enumerate(each)}, settings)
            for place, each, start in zip(places, own, starts, strict=False)
        ]
        ends = np.cumsum([[len(place.links), len(place.turns)] for place in places], axis=0)
        begins = ends - [[len(place.links), len(place.turns)] for place in places]
        self._shares = [
            tuple(np.arange(*each) for each in zip(*both, strict=True)) for both in zip(begins, ends, strict=True)
        ]
        """Where each agent's links and turns are among the region's."""
        steps = self.agents[0].problem.steps
        self._parts = list(pairwise(np.cumsum([0, *(agent.shared.size for agent in self.agents)]).tolist()))
        """Where each agent's variables are among all."""
        self._shared = np.concatenate([agent.shared for agent in self.agents])
        # What is part of no side goes to a number past the last.
        self._shared[self._shared == NOWHERE] = starts[-1] * steps
        self.interactions = Interactions(own, partners, steps)
        self._flow = np.zeros((starts[-1], steps))
        self._total = self.interactions.total(self._flow)
        """Of the flows of an interaction's producers and of its consumer's, here and, once heard of, elsewhere."""
        self.target: Floats = np.zeros_like(self._flow)
        self.price: Floats = np.zeros_like(self._flow)
        self._memory = Memory(2 * self.target.size)
        self._fresh = True

    def forget(self) -> None:
        """Begin as on the first day: nothing is agreed, and no solver goes on from anything."""
        self.rho = self.settings.first_rho if self.settings.coordination != "none" else 0.0
        self._fresh = True
        self._memory.clear()
        for array in (self.target, self.price):
            array[:] = 0.0
        for agent in self.agents:
            agent.forget()

    def begin(self, state: State, forecast: Forecast) -> dict[int, Message]:
        """Take up the state of its own links and turns, an agent's after the other's, of which each is told its own.

        In the first step, tells the neighbours what it expects to come in.
        """
        self._memory.clear()
        states = [state.part(links, turns) for links, turns in self._shares]
        for agent, own, (links, _) in zip(self.agents, states, self._shares, strict=True):
            agent.prepare(own, forecast.part(links), self.rho)
        mode = self.settings.coordination
        if not self._fresh and mode != "none":
            shift = self.agents[0].problem.substeps
            for array in (self.target, self.price):
                array[:, :-shift] = array[:, shift:].copy()
            return {}
        expected = self._expected(states)
        self._suppose(self.interactions.held[CONSUMER], *expected)
        if not self._fresh or mode == "none":
            return {}
        self._fresh = False
        both = np.concatenate(expected, axis=1)
        return self.interactions.tell(np.array([both, both]), CONSUMER)

    def _expected(self, states: list[State]) -> tuple[Floats, Floats]:
        """(n, model steps) what comes in on its own agents' links and its price.

        What came of late, and what a vehicle more is likely to cost.
        """
        flow, price = np.zeros_like(self._total)
        for agent, own in zip(self.agents, states, strict=True):
            place = agent.place
            fed = ~place.part.is_source
            rows = np.searchsorted(self.interactions.links, place.links[fed])
            rate = own.past_inflow_veh.mean(axis=0)[fed] / place.part.sample_s
            flow[rows] = rate[:, None] * agent.problem.model.step_s
            if self.settings.coordination != "none":
                price[rows] = self.settings.price(place.remaining_steps[fed])[:, None]
        return flow, price

    def _suppose(self, known: Bools, flow: Floats, price: Floats) -> None:
        """Start from a flow and a price (n, model steps) of the interactions that are `known` (n,)."""
        row = self.interactions.row
        here = known[row]
        self.target[here] = self.interactions.first(flow)[here]
        self.price[here] = price[row][here]

    def greet(self, inbox: list[Message]) -> None:
        """Take over what the neighbours expect to come in, and its price: all sides then start from the same."""
        for message in inbox:
            rows = self.interactions.rows(message)
            expected = np.zeros_like(self._total)
            expected[:, rows] = np.split(message.numbers, 2, axis=1)
            self._suppose(np.isin(self.interactions.links, message.links), *expected)

    def solve(self) -> dict[int, Message]:
        """Every agent's best answer to what is agreed so far; the messages that tell the neighbours."""
        mode = self.settings.coordination
        sign = self.interactions.sign
        linear = sign * self.price - self.rho * self.target
        if mode != "admm":
            linear = np.where(sign > 0, linear, self.target)
        terms = np.append(linear, 0.0)[self._shared]
        answers = [agent.solve(terms[start:end]) for agent, (start, end) in zip(self.agents, self._parts, strict=True)]
        flow = np.bincount(self._shared, np.concatenate(answers), minlength=self._flow.size + 1)[:-1]
        self._flow = flow.astype(float).reshape(self._flow.shape)
        self._total = self.interactions.total(self._flow)
        return {} if mode == "none" else self.interactions.tell(self._total, PRODUCER, CONSUMER)

    def agree(self, inbox: list[Message]) -> Floats:
        """Hear the neighbours' answers, and find where they lead `target` and `price`, which `mix` sets with `admm`.

        This region's sums of squares (see `SUMS`) and, with `admm`, the residual's inner products (see `Memory.push`).
        """
        self.interactions.hear(self._total, inbox)
        flow, (produced, consumed) = self._flow, self._total
        row, sign = self.interactions.row, self.interactions.sign
        if self.settings.coordination == "admm":
            # Boyd et al. 2011, 7.3.2 and 3.4.3: every side goes the same way towards a sum of none, over-relaxed.
            beyond = self.settings.relaxation * ((produced - consumed) / self.interactions.count)[row]
            target = self.target + self.settings.relaxation * (flow - self.target) - sign * beyond
            price = self.price + self.rho * beyond
            own, apart, moved = np.ones_like(sign), flow - target, self.rho * (target - self.target)
        else:
            own = np.maximum(sign, 0.0)
            wanted = np.where(own > 0, flow, produced[row])
            apart, moved = wanted - self.target, consumed[row] - self.price
            target, price = self.target + DAMPING * apart, self.price + DAMPING * moved
        sums = [_squares(own, each) for each in (apart, flow)]
        sums += [_squares(np.ones_like(own), each) for each in (moved, target, price)]
        # Agents that stand apart from their own rows have not come to terms either.
        sums[0] += sum(agent.residual for agent in self.agents)
        if self.settings.coordination == "sensitivity":
            # Not mixed: a mix could set an agent an inflow under zero.
            self.target, self.price = target, price
        if self.settings.coordination != "admm":
            return np.array(sums)
        weight = np.sqrt(np.repeat([self.rho, 1 / self.rho], target.size))
        before, after = np.array([self.target, self.price]).ravel(), np.array([target, price]).ravel()
        return np.concatenate([sums, self._memory.push(before, after, weight)])

    def mix(self, weights: Floats) -> None:
        """Agree on the last rounds' results, mixed by these weights."""
        self.target, self.price = self._memory.mix(weights).reshape(2, *self.target.shape)

    def adapt(self, rho: float) -> None:
        """Take another penalty."""
        self.rho = rho
        self._memory.clear()
        for agent in self.agents:
            agent.factorise(rho)

    def finish(self) -> Floats:
        """(Kc, S) greens as they are now, an agent's after the other's."""
        return np.concatenate([agent.settle() for agent in self.agents], axis=1)

    def size(self) -> tuple[int, int]:
        """Numbers that its agents share: their sides, times the model steps; of these, those told to other agents."""
        return self._flow.size, self.interactions.told


def _agent(place: Place, number: dict[Side, int], settings: Settings) -> Agent | Batch:
    """Who solves a place's problem. The shared flows are numbered as in an array (sides, model steps)."""
    receding = RecedingProblem(place, settings)
    problem, layout = receding.problem, receding.problem.layout
    shared = np.full((problem.count, layout.size), NOWHERE)
    steps = np.arange(problem.steps)

    def join(position: int, block: Ints, kind: int, link: int) -> None:
        """Say of what shared flow the variables are that a link or turn has, in the order of the place."""
        junction, own = divmod(position, block.shape[1])
        shared[junction, block[:, own]] = number[Side(junction, kind, link)] * problem.steps + steps

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
