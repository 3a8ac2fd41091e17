"""What controllers and executions may be told: each setting with its default, what it may be, and what it means."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from utn_sumo.controllers import CONTROLLER, EXECUTION, Kind, maker, registered, settings_of
from utn_sumo.errors import ControllerError, did_you_mean
from utn_sumo.search_space import kind_of

BOUNDS = {"ge": "from {} on", "gt": "over {}", "le": "up to {}", "lt": "under {}"}


@dataclass(frozen=True)
class Setting:
    """One of a controller's settings, in words."""

    name: str
    default: str
    may_be: str
    means: str


@dataclass(frozen=True)
class Entry:
    """A controller or execution that is found by name."""

    noun: str
    name: str
    does: str
    """Its first line."""
    settings: tuple[Setting, ...]


def entries(name: str | None = None) -> list[Entry]:
    """All that there are, or those called `name`, which may be a controller and an execution, or `path.py:Class`.

    Raises ControllerError if there is none of that name.
    """
    if name is not None and ".py:" in name:
        return [_entry(CONTROLLER, name, maker(name))]
    found = [
        _entry(kind, each, point.load())
        for kind in (CONTROLLER, EXECUTION)
        for each, point in registered(kind).items()
        if name in {None, each}
    ]
    found += [
        Entry(kind.noun, each, does, ())
        for kind in (CONTROLLER, EXECUTION)
        for each, does in kind.others.items()
        if name in {None, each}
    ]
    if not found:
        names = {*registered(CONTROLLER), *registered(EXECUTION), *CONTROLLER.others, *EXECUTION.others}
        raise ControllerError(f"controller {name!r} is unknown: {did_you_mean(str(name), names)}, or path.py:Class")
    return sorted(found, key=lambda entry: entry.noun)


def _entry(kind: Kind, name: str, factory: Any) -> Entry:
    model = getattr(factory, "Settings", factory)
    if isinstance(model, type) and issubclass(model, BaseModel):
        settings = [_setting(each, field) for each, field in model.model_fields.items()]
    else:
        arguments = inspect.signature(factory).parameters
        settings = [Setting(each, _default(arguments[each].default), "", "") for each in settings_of(factory)]
    return Entry(kind.noun, name, (inspect.getdoc(factory) or "").partition("\n")[0], tuple(settings))


def _setting(name: str, field: FieldInfo) -> Setting:
    return Setting(name, _default(field.get_default()), _may_be(field), " ".join((field.description or "").split()))


def _default(value: Any) -> str:
    return "" if value is inspect.Parameter.empty else "none" if value is None else str(value)


def _may_be(field: FieldInfo) -> str:
    """The values that a setting takes, in words."""
    kind = kind_of(field)
    if get_origin(kind) is Literal:
        return ", ".join(map(str, get_args(kind)))
    if kind is bool:
        return "true, false"
    bounds = [
        said.format(f"{getattr(each, key):g}")
        for key, said in BOUNDS.items()
        for each in field.metadata
        if hasattr(each, key)
    ]
    words = {int: "whole number", float: "number", str: "text"}.get(kind, str(getattr(kind, "__name__", kind)))
    return ", ".join([words, *bounds])
