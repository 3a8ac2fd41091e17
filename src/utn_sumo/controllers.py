"""Controllers and executions by name: entry points of the groups `utn_sumo.controllers` and `utn_sumo.executions`, ours
and users' alike, or `path.py:Class`.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from inspect import Parameter
from numbers import Integral
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from utn_sumo.contract import Controller, Execution, Network, is_pause
from utn_sumo.errors import ControllerError, SettingError, UtnError, did_you_mean
from utn_sumo.scenario import EXACT, Scenario, explain

T = TypeVar("T")

MOST_HORIZON = 1000
"""Cycles of forecast at most: each is in every line of a run's record."""


@dataclass(frozen=True)
class Kind:
    """A kind of thing that is found by name."""

    noun: str
    contract: Any
    """Protocol that it has to follow."""
    needs: str
    others: Mapping[str, str]
    """What there is beside the registered ones, and what it does."""

    @property
    def group(self) -> str:
        """Its entry-point group."""
        return f"utn_sumo.{self.noun}s"


CONTROLLER = Kind(
    "controller",
    Controller,
    "`horizon` or `plan(state, forecast)`",
    {"native": "The net's own signal programmes, untouched."},
)
EXECUTION = Kind(
    "execution",
    Execution,
    "`every_s`, `begin(plan, state)` or `wish(view)`",
    {EXACT: "The plan's greens, to the second."},
)


def registered(kind: Kind = CONTROLLER) -> dict[str, EntryPoint]:
    """Entry points by name."""
    return {point.name: point for point in sorted(entry_points(group=kind.group), key=lambda point: point.name)}


def build(name: str, network: Network, settings: dict[str, Any]) -> Controller:
    """The controller called `name`, built for `network`. Raises ControllerError or SettingError."""
    found: Controller = _built(CONTROLLER, name, network, settings)
    if not isinstance(found.horizon, Integral) or not 1 <= found.horizon <= MOST_HORIZON:
        least_most = f"make it a whole number from 1 on, {MOST_HORIZON} at most"
        raise ControllerError(f"controller {name!r} has horizon {found.horizon!r}: {least_most}")
    return found


def build_execution(scenario: Scenario, network: Network, controller: Controller) -> tuple[str, Execution | None]:
    """What carries out a scenario's plans, and its name; the controller's own execution if the scenario names none.

    None shows a plan's greens to the second. Raises ControllerError or SettingError.
    """
    settings, name = scenario.execution_settings, scenario.execution
    if name is None:
        own = getattr(controller, "execution", None)
        if own is None:
            return EXACT, None
        return _name_of(own), _deciding(own, f"execution {own!r} of controller {scenario.controller!r}")
    if name == EXACT:
        return name, None
    return name, _deciding(_built(EXECUTION, name, network, settings), f"execution {name!r}")


def _deciding(found: Any, who: str) -> Execution:
    """An execution that may be asked. Raises ControllerError."""
    _check_contract(EXECUTION, found, who)
    if not is_pause(found.every_s):
        raise ControllerError(f"{who} decides every {found.every_s!r} s: make `every_s` 1 or more")
    return found  # type: ignore[no-any-return]


def _name_of(execution: Execution) -> str:
    """The name that its class is registered under, else the class's own."""
    path = f"{type(execution).__module__}:{type(execution).__qualname__}"
    names = (name for name, point in registered(EXECUTION).items() if point.value == path)
    return next(names, type(execution).__qualname__)


def _built(kind: Kind, name: str, network: Network, settings: dict[str, Any]) -> Any:
    found = made(name, maker(name, kind), settings, network, noun=kind.noun)
    _check_contract(kind, found, f"{kind.noun} {name!r}")
    return found


def _check_contract(kind: Kind, found: Any, who: str) -> None:
    if not isinstance(found, kind.contract):
        raise ControllerError(f"{who} lacks {kind.needs}: see contract.{kind.noun.capitalize()}")


def maker(name: str, kind: Kind = CONTROLLER) -> Callable[..., Any]:
    """What makes the controller or execution called `name`: as a rule its class. Raises ControllerError."""
    factory = _from_file(kind, name) if ".py:" in name else _registered(kind, name)
    if not callable(factory):
        raise ControllerError(f"{kind.noun} {name!r} is {factory!r}: name a class")
    return factory  # type: ignore[no-any-return]


def made(name: str, factory: Callable[..., T], settings: dict[str, Any], *given: Any, noun: str = CONTROLLER.noun) -> T:
    """What the factory of controller `name` makes of its settings, after what else it is given.

    Raises ControllerError or SettingError.
    """
    takes = settings_of(factory)
    for word in settings:
        if word not in takes and not _takes_any(factory):
            rest = did_you_mean(word, takes) if takes else "it takes none"
            raise SettingError(f"{noun} {name!r} has no setting {word!r}: {rest}")
    try:
        return factory(*given, **settings)
    except ValidationError as error:
        raise SettingError(f"{noun} {name!r}: {explain(error, takes)}") from error
    except UtnError:
        raise
    except (Exception, SystemExit) as error:
        raise ControllerError(f"{noun} {name!r} can't be built: {_told(error)}") from error


def settings_of(factory: Any) -> list[str]:
    """Names of the settings that a class takes: its `Settings` model's fields, else its arguments."""
    model = getattr(factory, "Settings", None)
    if model is not None:
        return list(model.model_fields)
    arguments = inspect.signature(factory).parameters.values()
    nameless = {Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL}
    return [each.name for each in arguments if each.name != "network" and each.kind not in nameless]


def _takes_any(factory: Any) -> bool:
    """Whether a class takes settings of whatever name, as by `**settings` without a `Settings` model."""
    arguments = inspect.signature(factory).parameters.values()
    return not hasattr(factory, "Settings") and any(each.kind is Parameter.VAR_KEYWORD for each in arguments)


def takes_those_of_execution(name: str) -> bool:
    """Whether the settings of the controller called `name` are those of an execution, which it brings itself.

    Raises ControllerError.
    """
    model = getattr(maker(name), "Settings", None)
    theirs = (getattr(maker(each, EXECUTION), "Settings", None) for each in registered(EXECUTION))
    return model is not None and any(model is each for each in theirs)


def _registered(kind: Kind, name: str) -> Any:
    points = registered(kind)
    if name not in points:
        known = did_you_mean(name, [*points, *kind.others])
        raise ControllerError(f"{kind.noun} {name!r} is unknown: {known}, or path.py:Class")
    return points[name].load()


def _from_file(kind: Kind, name: str) -> Any:
    path, _, attribute = name.rpartition(":")
    # A name that no other module has, whatever theirs is called.
    spec = importlib.util.spec_from_file_location(str(Path(path).resolve()).replace(".", "_"), path)
    if spec is None or spec.loader is None or not Path(path).is_file():
        raise ControllerError(f"{kind.noun} {name!r}: there is no file {path!r}")
    module = importlib.util.module_from_spec(spec)
    # Annotations that are text are looked up there, by pydantic and dataclasses.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[spec.name]
        raise ControllerError(f"{kind.noun} {name!r}: {path!r} can't be loaded: {_told(error)}") from error
    if not hasattr(module, attribute):
        raise ControllerError(f"{kind.noun} {name!r}: {path!r} has no class {attribute!r}")
    return getattr(module, attribute)


def _told(error: BaseException) -> str:
    """What a user's own code raised, in one line: the kind, the text, the line of their file where there is one."""
    return " ".join(f"{type(error).__name__}: {error}".split())
