"""A scenario: everything that determines a run. A TOML file, flags and keyword arguments say the same things."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from utn_sumo.errors import SettingError, did_you_mean

EXACT = "exact"
"""The execution that shows a plan's greens to the second."""
OF_EXECUTION = "execution."
"""How the names of an execution's settings begin where they stand beside the controller's."""

LAST_SEED = 2**31 - 1
"""The largest that SUMO takes."""


class Scenario(BaseModel):
    """Settings of one run; each is checked here, once."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    net: str = "utn17"
    """A shipped network's name, or the path of a .net.xml."""
    controller: str = "dmpc"
    """A registered controller's name, or `path.py:Class`."""
    execution: str | None = None
    """How its plans are carried out: `exact`, a registered execution's name, or `path.py:Class`; else its own way."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """The controller's own settings; under `execution` those of the execution."""
    hours: float = Field(4.0, gt=0, le=240)
    demand: float = Field(1.0, ge=0, le=10)
    """Scales the demand profile."""
    profile: Literal["peak", "paper", "constant"] = "peak"
    noise: float = Field(0.0, ge=0, le=2)
    """Standard deviation of the correlated noise on the demand, relative."""
    disturbance: float = Field(0.0, ge=0, le=1000)
    """Vehicles an hour that come onto each link amid it, where no loop counts them, for each unit of `demand`."""
    loop_error: float = Field(0.0, ge=0, le=0.2)
    """Standard deviation, over the loops, of the share of vehicles that a loop misses or counts twice."""
    forecast: Literal["starima", "arima", "profile", "last", "perfect"] = "starima"
    """How demand and disturbances are foretold."""
    refit_steps: int = Field(15, ge=1, le=100_000)
    """Control steps between two fits of the forecast's model."""
    calibration: str | None = None
    """Calibration file for the model; `none` for none, else the one beside the net if there is one."""
    seed: int = Field(1, ge=0, le=LAST_SEED)

    @field_validator("*", mode="before")
    @classmethod
    def _no_flag(cls, value: Any) -> Any:
        # It would pass for 1 or 0.
        if isinstance(value, bool):
            message = "it must be a number or a name"
            raise ValueError(message)  # noqa: TRY004 - pydantic takes no TypeError
        return value

    @field_validator("hours")
    @classmethod
    def _lasts(cls, hours: float) -> float:
        if hours * 3600 < 1:
            message = "it must be a second or more"
            raise ValueError(message)
        return hours

    @property
    def controller_settings(self) -> dict[str, Any]:
        """The settings that are the controller's."""
        return {name: value for name, value in self.settings.items() if name != "execution"}

    @property
    def execution_settings(self) -> dict[str, Any]:
        """The settings that are the execution's. Raises SettingError if they are no table, or nobody's."""
        table = self.settings.get("execution", {})
        if not isinstance(table, dict):
            raise SettingError(f"setting 'execution' in 'settings' is {table!r}: it must be a table of settings")
        if table and self.execution in {None, EXACT}:
            name, value = next(iter(table.items()))
            raise SettingError(f"setting 'execution.{name}' is {value!r}: name the execution that takes it")
        return table

    @property
    def name(self) -> str:
        """What its results are called by default: net, controller and execution, demand, seed."""
        parts = [self.net, self.controller, *([] if self.execution is None else [self.execution])]
        names = [Path(part.partition(":")[0]).name.partition(".")[0] for part in parts]
        return f"{'-'.join(names)}-demand{self.demand:g}-seed{self.seed}"

    @property
    def duration_s(self) -> float:
        return round(self.hours * 3600)


def scenario(file: Path | None = None, **given: Any) -> Scenario:
    """A checked scenario from a TOML file (where one is named) and what is given beside it, which wins.

    Raises SettingError with one line that names the setting, its value and the remedy.
    """
    values: dict[str, Any] = {}
    if file is not None:
        try:
            values = tomllib.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise SettingError(f"scenario file {str(file)!r} can't be read ({error}): name a TOML file") from error
    table = values.get("settings", {})
    if not isinstance(table, dict):
        raise SettingError(f"setting 'settings' is {table!r}: it must be a table of the controller's settings")
    own = given.pop("settings", {})
    settings = {**table, **own}
    if isinstance(table.get("execution"), dict) and isinstance(own.get("execution"), dict):
        settings["execution"] = {**table["execution"], **own["execution"]}
    try:
        return Scenario(**{**values, **given, "settings": settings})
    except ValidationError as error:
        raise SettingError(explain(error, Scenario.model_fields)) from error


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as a scenario has them, from a flat table in which those of the execution are called execution.NAME."""
    found = {name: value for name, value in settings.items() if not name.startswith(OF_EXECUTION)}
    inner = {name.removeprefix(OF_EXECUTION): value for name, value in settings.items() if name not in found}
    return {**found, "execution": inner} if inner else found


def flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The flat table of settings that a scenario has."""
    inner = settings.get("execution")
    if not isinstance(inner, dict):
        return dict(settings)
    own = {name: value for name, value in settings.items() if name != "execution"}
    return own | {OF_EXECUTION + name: value for name, value in inner.items()}


def explain(error: ValidationError, known: Iterable[str]) -> str:
    """The first complaint of a validation in one line: the setting, its value, the remedy."""
    first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"setting {name!r} is unknown: {did_you_mean(name, known)}"
    message = first["msg"].removeprefix("Value error, ")
    if not name:
        return message
    remedy = message[0].lower() + message[1:]
    return f"setting {name!r} is {first['input']!r}: {remedy.replace('input should be', 'it must be')}"
