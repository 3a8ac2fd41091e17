"""How the agents come to terms (SPEC 4): rounds of solving, telling the neighbours, and agreeing, until it is enough.

`admm`         exchange between the producers of a link and its consumer, which with one producer is consensus on the
               flow between them: Boyd et al. 2011, sections 7.3.2, 3.4.1 (varying penalty), 3.4.3 (over-relaxation)
               and 3.3.1 (stopping)
`sensitivity`  the paper's mu: a producer is told what a vehicle more would cost its consumer, who takes what comes;
               damped, with a proximal term
`none`         every agent for itself, with the inflow that it has seen of late

Nothing is decided here but when to stop and the penalty, from one sum of squares a region.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from utn_controllers.mpc.acceleration import Mixer
from utn_controllers.mpc.crew import Crew
from utn_controllers.mpc.interactions import Message
from utn_controllers.mpc.region import SUMS
from utn_controllers.mpc.settings import Settings
from utn_sumo.contract import Floats, Forecast, State
from utn_sumo.errors import ControllerError

ADAPT_RATIO = 10.0
"""The penalty adapts while one residual is this many times the other, then it is frozen for good."""
ADAPT_FACTOR = 2.0
BYTES_PER_NUMBER = 8


@dataclass(frozen=True)
class Outcome:
    """How a coordination ended."""

    iterations: int
    primal_veh: float
    dual: float
    converged: bool
    bytes_exchanged: int


class Coordinator:
    """Leads a crew of regions from one control step to the next."""

    def __init__(self, crew: Crew, settings: Settings):
        self.crew = crew
        self.settings = settings
        self._rho = settings.first_rho
        self._numbers, self._told = (sum(each) for each in zip(*crew.call("size"), strict=True))
        self._frozen = settings.coordination != "admm"

    def plan(self, states: list[State], forecasts: list[Forecast]) -> tuple[list[Floats], Outcome]:
        """Greens (Kc, S) by region, and how they were come by, from what concerns each region.

        Raises ControllerError if an agent has no optimum. What has been agreed by then is forgotten everywhere: some
        regions may have gone on and others not, and numbers that no agent could bear must not come back.
        """
        try:
            return self._plan(states, forecasts)
        except Exception:
            self._frozen = self.settings.coordination != "admm"
            self._rho = self.settings.first_rho
            # Of a crew that has lost somebody this can't be had: what it says next is what has happened.
            with suppress(ControllerError):
                self.crew.call("forget")
            raise

    def _plan(self, states: list[State], forecasts: list[Forecast]) -> tuple[list[Floats], Outcome]:
        crew, settings = self.crew, self.settings
        crew.call("greet", self._deliver(crew.call("begin", states, forecasts)))
        primal = dual = np.inf
        converged = False
        iterations = 1 if settings.coordination == "none" else settings.iterations
        iteration = 0
        mixer = Mixer()
        for iteration in range(1, iterations + 1):  # noqa: B007 - used after the loop
            inboxes = self._deliver(crew.call("solve"))
            sums = sum(crew.call("agree", inboxes))
            apart, flow, moved, target, price = np.sqrt(sums[: len(SUMS)])
            primal, dual = float(apart), float(moved)
            scale = np.sqrt(self._numbers) * settings.tolerance_abs
            converged = bool(
                primal <= scale + settings.tolerance_rel * max(flow, target)
                and dual <= scale * self._rho + settings.tolerance_rel * price
            )
            if settings.coordination == "admm":
                crew.call("mix", [mixer.weights(sums[len(SUMS) :])] * len(crew))
            if converged:
                break
            if not self._frozen and self._adapt(primal, dual):
                mixer = Mixer()
        exchanged = 0 if settings.coordination == "none" else iteration * self._told * BYTES_PER_NUMBER
        return crew.call("finish"), Outcome(iteration, primal, dual, converged, exchanged)

    def _deliver(self, outboxes: list[dict[int, Message]]) -> list[list[Message]]:
        """Every region's messages to it, by sender."""
        inboxes: list[list[Message]] = [[] for _ in outboxes]
        for outbox in outboxes:
            for region, message in outbox.items():
                inboxes[region].append(message)
        return inboxes

    def _adapt(self, primal: float, dual: float) -> bool:
        """Move rho towards balanced residuals, if need be; the first time that they are balanced, freeze it."""
        if primal > ADAPT_RATIO * dual:
            self._rho *= ADAPT_FACTOR
        elif dual > ADAPT_RATIO * primal:
            self._rho /= ADAPT_FACTOR
        else:
            self._frozen = True
            return False
        self.crew.call("adapt", [self._rho] * len(self.crew))
        return True
