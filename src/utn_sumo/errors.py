"""Every error that this package raises on purpose.

UtnError                    one line for the user: the thing, the value, the remedy; exit code 2
├── SettingError            a setting, a flag, a configuration file
├── NetworkError            a SUMO network, its programmes, its turning fractions
├── ControllerError         a controller that can't be found or built
├── PlantError              SUMO: start, ownership, a run that broke off
├── PlanError               a plan that must not reach the signals
└── ResultError             a result folder: there already, missing, unreadable
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UtnError(Exception):
    """Base of the tree; its text is one line that a user can act on."""


class SettingError(UtnError):
    """A setting is unknown or out of range."""


class NetworkError(UtnError):
    """A network can't be read or controlled."""


class ControllerError(UtnError):
    """A controller can't be found or built."""


class PlantError(UtnError):
    """SUMO can't be started, or broke off."""


class PlanError(UtnError):
    """A plan must not reach the signals."""


class ResultError(UtnError):
    """A result folder can't be written or read."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The known words, led by the nearest one to `word` where there is one: the end of an error line."""
    names = sorted(known)
    near = difflib.get_close_matches(word, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"{hint}known: {', '.join(names)}"
