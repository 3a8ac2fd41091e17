"""The fallback ladder: solved plan, else the rest of the last good one, else the backup plan. Never raises.

Every rung is admitted by `signals` before it is given out, so that a controller, ours or a user's, can't bring the
run down or an unsafe plan onto the street.
"""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import dataclass
from typing import Literal

from utn_sumo import signals
from utn_sumo.contract import Controller, Forecast, Network, Plan, State

Rung = Literal["solved", "shifted", "backup"]


@dataclass(frozen=True)
class Decision:
    """The plan that goes to the plant, where it came from, and why not from higher up."""

    plan: Plan
    rung: Rung
    reason: str
    """Empty for a solved plan."""
    control_time_s: float
    """Wall time of the controller."""


class Supervisor:
    """Asks one controller, cycle by cycle."""

    def __init__(self, network: Network, controller: Controller):
        self.network = network
        self.controller = controller
        # Raises PlanError at the start of a run, and not amid it, if the net's own stages can't be shown safely.
        self._backup = signals.admit(network.equal_split(), network)
        self._ahead: list[Plan] = []
        """What the last solved plan foresaw, next cycle first."""

    def ask(self, state: State, forecast: Forecast) -> Decision:
        """A plan that is safe to apply, whatever the controller does."""
        started = time.perf_counter()
        try:
            # Whatever it writes into what it is told is no matter to anybody else.
            wish = self.controller.plan(*deepcopy((state, forecast)))
            plan = signals.admit(wish, self.network)
            ahead = [] if wish.ahead_s is None else [Plan(green_s) for green_s in wish.ahead_s]
        except (Exception, SystemExit, GeneratorExit) as error:  # noqa: BLE001 - a foreign one may raise anything
            reason = f"{type(error).__name__}: {error}"
        else:
            self._ahead = ahead
            return Decision(plan, "solved", "", time.perf_counter() - started)
        spent_s = time.perf_counter() - started
        if self._ahead:
            try:
                return Decision(signals.admit(self._ahead.pop(0), self.network), "shifted", reason, spent_s)
            except Exception as error:  # noqa: BLE001 - nor is what it foresaw to be trusted
                reason = f"{reason}; the last plan's rest: {error}"
        return Decision(self._backup, "backup", reason, spent_s)
