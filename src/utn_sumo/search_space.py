"""Where a controller's settings are searched: ranges and choices, from its own bounds or from what a user says."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from utn_sumo.controllers import CONTROLLER, EXECUTION, Kind, maker
from utn_sumo.errors import SettingError, did_you_mean
from utn_sumo.scenario import EXACT, OF_EXECUTION, explain

WIDE = 100
"""From so many times its low end on a range is searched by its logarithm."""
DIGITS = 4
INSIDE = 1e-3
"""How far within a bound that is itself excluded a search begins, as a share of the range."""

Settings = dict[str, Any]
"""By name; those of an execution are called execution.NAME."""


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, ends included."""

    low: float
    high: float
    whole: bool

    def distribution(self) -> Any:
        """In optuna's terms."""
        from optuna import distributions  # noqa: PLC0415 - an extra

        log = self.low > 0 and self.high >= WIDE * self.low
        if self.whole:
            return distributions.IntDistribution(int(self.low), int(self.high), log=log)
        return distributions.FloatDistribution(self.low, self.high, log=log)

    def setting(self, value: float) -> float:
        """A proposed value in as many digits as mean anything."""
        return value if self.whole else min(max(float(f"{value:.{DIGITS}g}"), self.low), self.high)

    def __contains__(self, value: Any) -> bool:
        return value is not None and self.low <= value <= self.high


@dataclass(frozen=True)
class Choice:
    """One of some values."""

    values: tuple[Any, ...]

    def distribution(self) -> Any:
        """In optuna's terms."""
        from optuna import distributions  # noqa: PLC0415 - an extra

        return distributions.CategoricalDistribution(self.values)

    def setting(self, value: Any) -> Any:
        """A proposed value as it is."""
        return value

    def __contains__(self, value: Any) -> bool:
        return value in self.values


@dataclass(frozen=True)
class Space:
    """What is searched of the settings of a controller, and of the execution beside it if there is one."""

    models: Mapping[str, type[BaseModel]]
    """By how the names of their settings begin."""
    searched: Mapping[str, Range | Choice]

    @property
    def distributions(self) -> dict[str, Any]:
        """In optuna's terms."""
        return {name: each.distribution() for name, each in self.searched.items()}

    @property
    def defaults(self) -> Settings:
        """What the searched settings are when nobody sets them."""
        fields = _fields(self.models)
        return {name: fields[name].get_default() for name in self.searched}

    @property
    def left(self) -> list[str]:
        """Settings that stay as they are."""
        return [name for name in _fields(self.models) if name not in self.searched]

    def settings(self, proposed: Mapping[str, Any]) -> Settings:
        """Settings from optuna's parameters."""
        return {name: each.setting(proposed[name]) for name, each in self.searched.items()}

    def refusal(self, settings: Settings) -> str | None:
        """Why controller or execution do not take settings together, if they do not."""
        for prefix, model in self.models.items():
            own = {name: settings[prefix + name] for name in model.model_fields if prefix + name in settings}
            try:
                model(**own)
            except ValidationError as error:
                return explain(error, model.model_fields)
        return None

    def tell_defaults(self, study: Any) -> None:
        """Have an optuna study begin with the defaults, of value 0, if they are within the space."""
        from optuna import trial  # noqa: PLC0415 - an extra

        if all(value in self.searched[name] for name, value in self.defaults.items()):
            known: dict[str, Any] = {"params": self.defaults, "distributions": self.distributions}
            study.add_trial(trial.create_trial(**known, value=0.0, intermediate_values={0: 0.0}))


def space(controller: str, over: Sequence[str] = (), execution: str | None = None) -> Space:
    """Where the settings of a controller are searched: those named in `over`, else all numbers that have both bounds,
    or where there are none all choices; of these none that is refused beside the others' defaults.

    A setting is named as `name=low:high`, as `name=value,value,...`, or alone, for its own range or choices; those of
    an execution likewise, as `execution.name`. Raises UtnError.
    """
    whose = f"controller {controller!r}"
    if controller in CONTROLLER.others:
        raise SettingError(f"{whose} takes no settings: there is nothing to tune, name another")
    models = _model(CONTROLLER, controller, "")
    if execution is not None and execution != EXACT:
        whose += f" with execution {execution!r}"
        models |= _model(EXECUTION, execution, OF_EXECUTION)
    fields = _fields(models)
    if not fields:
        raise SettingError(
            f"{whose} has no settings that say what they may be: give its class `Settings`, a pydantic model"
        )
    if not over:
        own = {name: _own(each) for name, each in fields.items() if _counts(models, name, each)}
        ranges: dict[str, Range | Choice] = {name: each for name, each in own.items() if isinstance(each, Range)}
        bounded = ranges or {name: each for name, each in own.items() if each is not None}
        if not bounded:
            raise SettingError(
                f"{whose}: none of its settings ({', '.join(fields)}) has bounds or choices: "
                f"say where to search, as in --over {next(iter(fields))}=1:10"
            )
        return Space(models, bounded)
    searched: dict[str, Range | Choice] = {}
    for text in over:
        name, equals, where = (word.strip() for word in text.partition("="))
        if name not in fields:
            raise SettingError(f"{whose} has no setting {name!r}: {did_you_mean(name, fields)}")
        if name in searched:
            raise SettingError(f"--over {text!r}: {name!r} is there already, say once where to search it")
        found = _said(text, fields[name], where) if equals else _own(fields[name])
        if found is None:
            raise SettingError(f"--over {text!r}: it has no bounds of its own, write {name}=low:high or {name}=a,b,c")
        searched[name] = found
    return Space(models, searched)


def _model(kind: Kind, name: str, prefix: str) -> dict[str, type[BaseModel]]:
    """The model of somebody's settings, if they have one, by how their names begin. Raises ControllerError."""
    made_by = maker(name, kind)
    model = getattr(made_by, "Settings", made_by)
    return {prefix: model} if isinstance(model, type) and issubclass(model, BaseModel) else {}


def _fields(models: Mapping[str, type[BaseModel]]) -> dict[str, FieldInfo]:
    """All settings by name."""
    return {prefix + name: field for prefix, model in models.items() for name, field in model.model_fields.items()}


def kind_of(field: FieldInfo) -> Any:
    """The type of a setting, None aside."""
    kinds = [each for each in get_args(field.annotation) if each is not type(None)]
    return kinds[0] if len(kinds) == 1 and get_origin(field.annotation) is not Literal else field.annotation


def _counts(models: Mapping[str, type[BaseModel]], name: str, field: FieldInfo) -> bool:
    """Whether a setting may be set while the others are at their defaults."""
    alone = Space(models, {})
    return alone.refusal({name: field.get_default()}) == alone.refusal({})


def _own(field: FieldInfo) -> Range | Choice | None:
    """The range or choices that a setting has by itself."""
    kind = kind_of(field)
    if kind is bool:
        return Choice((False, True))
    if get_origin(kind) is Literal:
        return Choice(get_args(kind))
    bounds = {
        key: getattr(each, key) for each in field.metadata for key in ("ge", "gt", "le", "lt") if hasattr(each, key)
    }
    low, high = bounds.get("ge", bounds.get("gt")), bounds.get("le", bounds.get("lt"))
    if kind not in (int, float) or low is None or high is None:
        return None
    edge = 1 if kind is int else INSIDE * (high - low)
    return Range(low + edge * ("ge" not in bounds), high - edge * ("le" not in bounds), kind is int)


def _said(text: str, field: FieldInfo, where: str) -> Range | Choice:
    """The range or choices that a user gives a setting; each value is checked as the controller would."""
    kind, (low, colon, high) = kind_of(field), where.partition(":")
    words = [low, high] if colon else where.split(",")
    bounded: Any = Annotated[field.annotation, field]
    check: TypeAdapter[Any] = TypeAdapter(bounded)
    try:
        values = [check.validate_python(_value(word.strip())) for word in words]
    except ValidationError as error:
        message = error.errors()[0]["msg"].replace("Input should", "it must")
        raise SettingError(f"--over {text!r}: {message}") from error
    if not colon:
        return Choice(tuple(dict.fromkeys(values)))
    if kind not in (int, float) or not all(map(math.isfinite, values)) or values[0] >= values[1]:
        raise SettingError(f"--over {text!r}: a range is low:high, of numbers; other settings take choices, as a,b,c")
    return Range(values[0], values[1], kind is int)


def _value(word: str) -> Any:
    """The value that JSON reads in a word, else the word."""
    try:
        return json.loads(word)
    except json.JSONDecodeError:
        return word
