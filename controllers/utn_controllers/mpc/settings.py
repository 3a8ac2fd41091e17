"""Settings of the MPC, with the paper's values as defaults where the paper has them."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

RHO = {"tts": 0.2, "paper": 0.6}
"""Penalties that need the fewest iterations, by cost, found on random states of `utn17`."""
OVER_STORAGE = 20.0
"""Cost of a vehicle over storage for one step of `tts`: far above the 1 + horizon that holding it elsewhere costs."""
MOST_VEH = 3000.0
"""Under `paper` a vehicle over storage counts as one more among so many: the thousand of the paper's links or of a long
source queue, and several times as much, since for one who makes room those behind him go too who turn elsewhere."""
MOST = 1e6
"""Of weights: beside more the other terms have no digits left."""
COUNTS_WITH: dict[str, tuple[str, tuple[str, ...]]] = {
    "q": ("cost", ("paper",)),
    "r": ("cost", ("paper",)),
    "crowding": ("cost", ("tts",)),
    "terminal": ("cost", ("tts",)),
    "scheduler": ("agents", ("dask",)),
    "iterations": ("coordination", ("admm", "sensitivity")),
    "rho": ("coordination", ("admm", "sensitivity")),
    "relaxation": ("coordination", ("admm",)),
}
"""Settings that count beside some values of another only. Beside the rest they would do nothing, and nobody be told."""


class ProblemSettings(BaseModel):
    """What states the problem, whoever solves it; every field is checked when the controller is built."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    horizon: int = Field(7, ge=1, le=60, strict=True)
    """Kp, control steps predicted."""
    control_horizon: int = Field(4, ge=1, le=60, strict=True)
    """Kc, control steps in which the greens may change, held after it; 4, or Kp where that is less."""
    step_s: float | None = Field(None, gt=0)
    """Step of the prediction's model; a divisor of the control step, by default all of it."""
    greens: Literal["placed", "anywhere"] = "placed"
    """Where a plan's green stands in the control step: where the plan has it, or in pieces anywhere, as executions that
    go their own way show it. Under these too `placed` has mostly brought less delay (docs/experiments.md)."""
    cost: Literal["tts", "paper"] = "tts"
    """The time that all vehicles spend, or the paper's quadratic cost."""
    constraints: Literal["kept", "dropped"] = "kept"
    """Whether greens must fill their cycles and keep their least, and links their storage; what dropping them costs."""
    q: float = Field(0.1, ge=0, le=MOST)
    """Q of the paper's cost: weight of x^2."""
    r: float = Field(0.3, ge=0, le=MOST)
    """R of the paper's cost: weight of g^2 (g in s)."""
    crowding: float = Field(1.0, ge=0, le=MOST)
    """Weight of x^2 / storage beside the time spent in the `tts` cost: what keeps room on the links."""
    terminal: float = Field(1.0, ge=0, le=MOST)
    """Weight of the time that the vehicles left at the horizon's end still need, in the `tts` cost."""

    @model_validator(mode="before")
    @classmethod
    def _short_horizon(cls, values: Any) -> Any:
        if isinstance(values, dict) and isinstance(values.get("horizon"), int):
            return {"control_horizon": max(1, min(4, values["horizon"])), **values}
        return values

    @model_validator(mode="after")
    def _horizons_fit(self) -> Self:
        if self.control_horizon > self.horizon:
            message = f"control_horizon {self.control_horizon} is beyond horizon {self.horizon}: make it at most that"
            raise ValueError(message)
        return self

    @model_validator(mode="after")
    def _what_is_set_counts(self) -> Self:
        for name, (other, values) in COUNTS_WITH.items():
            if name in self.model_fields_set and getattr(self, other) not in values:
                needed = " or ".join(map(repr, values))
                message = f"{name} does nothing where {other} is {getattr(self, other)!r}: leave it out, or set {other}"
                raise ValueError(f"{message} to {needed}")
        return self

    @model_validator(mode="after")
    def _something_costs(self) -> Self:
        if self.cost == "paper" and self.q == self.r == 0:
            message = "q and r are both 0, and any plan costs the same by the paper's cost: give one of them a weight"
            raise ValueError(message)
        return self

    @property
    def scale(self) -> float:
        """What the convex problem's cost is multiplied by, so that no weight of it is above 1: beside larger ones a
        solver has no digits left for the flows, whose own weight is small.
        """
        weights = (self.q, self.r) if self.cost == "paper" else (self.crowding, self.terminal)
        return 1 / max(1.0, *weights)

    def over_storage_cost(self, steps: int) -> float:
        """Scaled cost of a vehicle over storage for one of so many model steps: an exact penalty (SPEC 3).

        It must be above what that saves elsewhere until the horizon's end. With `paper` that is 2 q x a step: there it
        grows with the horizon and with how many are held.
        """
        if self.cost == "paper":
            return max(OVER_STORAGE, 2 * self.scale * self.q * MOST_VEH * steps)
        return OVER_STORAGE

    def stage_cost(self, x: Any, waiting: Any, storage_veh: Any) -> Any:
        """Cost of one predicted control step with `x` and the source queues `waiting` (Z,), symbols or numbers."""
        import casadi as ca  # noqa: PLC0415 - heavy

        if self.cost == "paper":
            return self.q * (ca.sumsqr(x) + ca.sumsqr(waiting))
        return ca.sum1(x) + ca.sum1(waiting) + self.crowding * ca.sum1(x**2 / storage_veh)

    def terminal_cost(self, x: Any, waiting: Any, remaining: Any) -> Any:
        """Cost of what is left at the end of the horizon; `remaining` (Z,) steps still to travel from each link."""
        import casadi as ca  # noqa: PLC0415 - heavy

        if self.cost == "paper":
            return 0
        return self.terminal * (ca.dot(remaining, x) + ca.dot(remaining, waiting))

    def price(self, remaining: Any) -> Any:
        """What a vehicle more on a link is likely to cost (scaled) before anything is agreed; `remaining` (Z,) steps.

        On a free road a vehicle costs the steps that it still needs.
        """
        return self.scale * remaining if self.cost == "tts" else 0.0 * remaining

    def green_cost(self, green: Any) -> Any:
        """Cost of one step's greens."""
        import casadi as ca  # noqa: PLC0415 - heavy

        if self.cost == "paper":
            return self.r * ca.sumsqr(green)
        return 1e-4 * ca.sumsqr(green)


class Settings(ProblemSettings):
    """Settings of the distributed MPC: the problem's, and how the agents come to terms."""

    coordination: Literal["admm", "sensitivity", "none"] = "admm"
    """How the agents come to terms."""
    agents: Literal["here", "processes", "dask"] = "here"
    """Where they live: in this process, in a pool of processes, or as Dask actors."""
    workers: int = Field(1, ge=1, le=1000)
    """Regions that the agents are parted into: one a process, or one an actor."""
    scheduler: str | None = None
    """Address of a Dask scheduler; without it the actors are processes of this machine."""
    iterations: int = Field(60, ge=1, le=1000)
    """Most iterations in a control step."""
    rho: float | None = Field(None, gt=0, le=MOST)
    """First penalty, beside a cost whose weights are 1 at most; by default what suits the cost."""
    relaxation: float = Field(1.6, gt=0, lt=2)
    """How far an iteration goes beyond what the agents have agreed on."""
    tolerance_abs: float = Field(0.02, gt=0)
    """Absolute tolerance of the residuals [veh]."""
    tolerance_rel: float = Field(1.5e-3, ge=0)
    """Relative tolerance of the residuals."""

    @property
    def first_rho(self) -> float:
        """The penalty to begin with."""
        return self.rho or RHO[self.cost]
