"""The problem of a junction, or of several alike, from step to step.

What the last plan foresaw is what the next problem is frozen at.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.mpc.place import Place
from utn_controllers.mpc.problem import JunctionProblem, Programs, Timing
from utn_controllers.mpc.settings import ProblemSettings
from utn_sumo.contract import Floats, Forecast, State

LEAST_EXPECTED_S = 1.0
"""Where constraints are dropped a stage may have been left without green: the next may not."""


class RecedingProblem:
    """A problem with the memory of the last solution."""

    def __init__(self, place: Place, settings: ProblemSettings):
        self.place = place
        self.problem = JunctionProblem(place, settings)
        self._expected_s = place.part.equal_split().green_s
        """(S,) greens that the coming step is likely to have."""
        self._delay_s: Floats | None = None
        """(steps, n) delays that the last plan predicts for the coming steps."""
        self._state: State | None = None

    def timing(self) -> Timing:
        """What the next programme is frozen at."""
        found = Timing.of if self.problem.settings.greens == "placed" else Timing.anywhere
        return found(self.problem.model, np.maximum(self._expected_s, LEAST_EXPECTED_S), self._delay_s)

    def programs(self, state: State, forecast: Forecast) -> Programs:
        """The programmes of the junctions' own state, for the coming steps."""
        self._state = state
        return self.problem.programs(state, forecast, self.timing())

    def settle(self, solution: Floats) -> Floats:
        """(Kc, S) greens of the last programmes' solution (junctions, n), which the next ones are then frozen at."""
        assert self._state is not None
        greens = self.problem.greens(solution)
        self._expected_s = greens[min(1, len(greens) - 1)]
        self._delay_s = self.problem.predicted_delay_s(self._state, solution, self._delay_s)
        return greens
