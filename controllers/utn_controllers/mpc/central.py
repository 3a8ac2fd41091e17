"""The controller `cmpc`: the whole network's problem solved at once (SPEC 3)."""

from __future__ import annotations

from typing import Any, Literal, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from utn_controllers.mpc.exact import ExactProblem
from utn_controllers.mpc.place import places
from utn_controllers.mpc.receding import RecedingProblem
from utn_controllers.mpc.settings import ProblemSettings
from utn_controllers.mpc.whole import WholeProblem
from utn_sumo.contract import Floats, Forecast, Network, Plan, State
from utn_sumo.model import check_step


class CentralSettings(ProblemSettings):
    """Settings of the centralized MPC: the problem's, and how it is written down."""

    transcription: Literal["convex", "nlp"] = "convex"
    """A quadratic programme (the minimum relaxed, the delays frozen), or the exact model with a smooth minimum."""
    tolerance: float = Field(1e-6, gt=0, le=1e-2)
    """Of the quadratic programme's solver, absolute and relative."""

    @model_validator(mode="after")
    def _exact_is_constrained(self) -> Self:
        if self.transcription == "nlp" and self.constraints == "dropped":
            message = "constraints can be dropped from the convex transcription only: leave one of the two settings out"
            raise ValueError(message)
        if self.transcription == "nlp" and self.greens == "anywhere":
            message = "greens may stand anywhere in the convex transcription only: leave one of the two settings out"
            raise ValueError(message)
        return self


class CentralizedMPC:
    """Chooses greens by a centralized model predictive control; settings as in `CentralSettings`."""

    Settings = CentralSettings

    def __init__(self, network: Network, **settings: Any):
        self.settings = CentralSettings(**settings)
        self.horizon = self.settings.horizon
        self.network = network
        check_step(network, self.settings.step_s or network.control_step_s)
        planner = Convex if self.settings.transcription == "convex" else Exact
        self.planner: Planner = planner(network, self.settings)

    def plan(self, state: State, forecast: Forecast) -> Plan:
        """Optimal greens for the coming cycle and the control horizon; ControllerError without an optimum."""
        greens, facts = self.planner.plan(state, forecast)
        return Plan(greens[0], greens[1:], facts=facts)


class Planner(Protocol):
    """One way to write the problem down."""

    def plan(self, state: State, forecast: Forecast) -> tuple[Floats, dict[str, Any]]:
        """(Kc, S) greens, and what is worth recording."""
        ...


class Convex:
    """The junctions' problems side by side, frozen as the agents' are."""

    def __init__(self, network: Network, settings: CentralSettings):
        self._control_horizon, self._stages = settings.control_horizon, len(network.stages)
        self._scale = settings.scale
        self.receding = [RecedingProblem(place, settings) for place in places(network)]
        self.whole = WholeProblem([each.problem for each in self.receding], tolerance=settings.tolerance)

    def plan(self, state: State, forecast: Forecast) -> tuple[Floats, dict[str, Any]]:
        programs = [
            each.programs(state.part(each.place.links, each.place.turns), forecast.part(each.place.links)).only
            for each in self.receding
        ]
        cost, solutions = self.whole.solve(programs)
        greens = np.zeros((self._control_horizon, self._stages))
        for each, solution in zip(self.receding, solutions, strict=True):
            greens[:, each.place.stages] = each.settle(solution)
        return greens, {"cost": cost / self._scale, "solver_iterations": self.whole.iterations}


class Exact:
    """The exact model, from what the last plan foresaw; at first from what the convex problem finds."""

    def __init__(self, network: Network, settings: CentralSettings):
        self._problem = ExactProblem(network, settings)
        self._convex = Convex(network, settings)
        self._foreseen_s: Floats | None = None

    def plan(self, state: State, forecast: Forecast) -> tuple[Floats, dict[str, Any]]:
        if self._foreseen_s is None:
            start_s, _ = self._convex.plan(state, forecast)
            solution = self._problem.solve(state, forecast, start_s)
        else:
            solution = self._problem.solve(state, forecast, self._foreseen_s, near=True)
        self._foreseen_s = np.vstack([solution.greens_s[1:], solution.greens_s[-1:]])
        return solution.greens_s, {"cost": solution.cost, "solver_iterations": solution.iterations}
