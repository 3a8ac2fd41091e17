"""Controllers by name: entry points of the group `utn_sumo.controllers`, ours and users' alike, or `path.py:Class`."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from utn_sumo.contract import Controller, Network
from utn_sumo.errors import ControllerError, SettingError, UtnError, did_you_mean
from utn_sumo.scenario import explain

GROUP = "utn_sumo.controllers"
T = TypeVar("T")


def registered() -> dict[str, EntryPoint]:
    """Entry points by name."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def build(name: str, network: Network, settings: dict[str, Any]) -> Controller:
    """The controller called `name`, built for `network`. Raises ControllerError or SettingError."""
    controller = made(name, maker(name), settings, network)
    if not isinstance(controller, Controller):
        raise ControllerError(
            f"controller {name!r} lacks `horizon` or `plan(state, forecast)`: see contract.Controller"
        )
    return controller


def maker(name: str) -> Callable[..., Any]:
    """What makes the controller called `name`: as a rule its class. Raises ControllerError."""
    factory = _from_file(name) if ".py:" in name else _registered(name)
    if not callable(factory):
        raise ControllerError(f"controller {name!r} is {factory!r}: name a class")
    return factory  # type: ignore[no-any-return]


def made(name: str, factory: Callable[..., T], settings: dict[str, Any], *given: Any) -> T:
    """What the factory of controller `name` makes of its settings, after what else it is given.

    Raises ControllerError or SettingError.
    """
    takes = settings_of(factory)
    for word in settings:
        if word not in takes:
            rest = did_you_mean(word, takes) if takes else "it takes none"
            raise SettingError(f"controller {name!r} has no setting {word!r}: {rest}")
    try:
        return factory(*given, **settings)
    except ValidationError as error:
        raise SettingError(f"controller {name!r}: {explain(error, takes)}") from error
    except UtnError:
        raise
    except Exception as error:
        raise ControllerError(f"controller {name!r} can't be built: {_told(error)}") from error


def settings_of(factory: Any) -> list[str]:
    """Names of the settings that a controller class takes: its `Settings` model's fields, else its arguments."""
    model = getattr(factory, "Settings", None)
    if model is not None:
        return list(model.model_fields)
    return [word for word in inspect.signature(factory).parameters if word != "network"]


def _registered(name: str) -> Any:
    points = registered()
    if name not in points:
        raise ControllerError(f"controller {name!r} is unknown: {did_you_mean(name, points)}, or path.py:Class")
    return points[name].load()


def _from_file(name: str) -> Any:
    path, _, attribute = name.rpartition(":")
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    if spec is None or spec.loader is None or not Path(path).is_file():
        raise ControllerError(f"controller {name!r}: there is no file {path!r}")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ControllerError(f"controller {name!r}: {path!r} can't be loaded: {_told(error)}") from error
    if not hasattr(module, attribute):
        raise ControllerError(f"controller {name!r}: {path!r} has no class {attribute!r}")
    return getattr(module, attribute)


def _told(error: Exception) -> str:
    """What a user's own code raised, in one line: the kind, the text, the line of their file where there is one."""
    return " ".join(f"{type(error).__name__}: {error}".split())
