"""Functions in machine code, which is kept on disk until anything that went into it is changed."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any

from numba import njit
from numba.core import caching, config, event
from numba.core.dispatcher import Dispatcher

UNSAID_S = 5.0
"""Whoever waits longer than this for machine code is told what for."""
EXACT_ENOUGH = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may do to sums and products; infinities keep their meaning."""


def compiled(function: Callable[..., Any]) -> Any:
    """The function in machine code, kept on disk from one run to the next where there is a place for it."""
    return _compiled(function)


def inlined(function: Callable[..., Any]) -> Any:
    """As `compiled`, its code put into that of each that calls it: handing over many arrays takes longer than a sum."""
    return _compiled(function, forceinline=True)


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    with _ours():
        try:
            return njit(cache=True, fastmath=EXACT_ENOUGH, **options)(function)
        except RuntimeError:  # neither the package's folder nor the user's can be written
            return njit(fastmath=EXACT_ENOUGH, **options)(function)


@contextmanager
def _ours() -> Iterator[None]:
    """Our places to keep machine code, instead of numba's, for what is compiled meanwhile (a setting of numba's)."""
    settings: Any = config
    before = settings.CACHE_LOCATOR_CLASSES
    settings.CACHE_LOCATOR_CLASSES = ",".join(f"{__name__}.{place.__name__}" for place in (Chosen, InTree, UserWide))
    try:
        yield
    finally:
        settings.CACHE_LOCATOR_CLASSES = before


class _Announcement(event.Listener):
    """Says once a process why nothing is to be seen for a while, as a warning of this module's logger."""

    def __init__(self) -> None:
        self._under_way = 0
        """Functions that are being compiled: one, and those that it calls."""
        self._since_s = self._spent_s = 0.0
        self._said = False

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002 - which function is of no interest
        """Something is not on disk yet."""
        if not self._under_way:
            self._since_s = time.perf_counter()
        self._under_way += 1
        if not self._said and self._spent_s + time.perf_counter() - self._since_s > UNSAID_S:
            self._said = True
            logging.getLogger(__name__).warning("compiling, the first time on this machine: up to a minute or so")

    def on_end(self, event: event.Event) -> None:  # noqa: ARG002
        """It is, or there was an error in it."""
        self._under_way -= 1
        if not self._under_way:
            self._spent_s += time.perf_counter() - self._since_s


event.register("numba:compile", _Announcement())  # type: ignore[no-untyped-call]


class _Whole:
    """A place where machine code is out of date as soon as anything that went into it has changed.

    numba goes by the file of the function alone. What it calls in others, and the constants that it takes from them,
    are in its machine code as well.
    """

    def __init__(self, function: FunctionType, file: str):
        super().__init__(function, file)  # type: ignore[call-arg]  # of the place that it is mixed into
        self._function = function

    def get_source_stamp(self) -> str:
        return stamp(self._function)


class Chosen(_Whole, caching.UserProvidedCacheLocator):
    """The folder that `NUMBA_CACHE_DIR` names."""


class InTree(_Whole, caching.InTreeCacheLocator):
    """Beside the function's own file."""


class UserWide(_Whole, caching.UserWideCacheLocator):
    """The user's own cache."""


def stamp(function: FunctionType) -> str:
    """Of all that goes into a function's machine code: the files of what its module calls, on and on, and constants."""
    seen: dict[str, str] = {}
    _gather(function, seen)
    return hashlib.sha256(repr(sorted(seen.items())).encode()).hexdigest()


def _gather(function: FunctionType, seen: dict[str, str]) -> None:
    file, names = function.__code__.co_filename, function.__globals__
    if file in seen:
        return
    own = [repr((name, fixed)) for name, value in sorted(names.items()) if (fixed := _fixed(name, value)) is not None]
    seen[file] = hashlib.sha256("".join([Path(file).read_text(encoding="utf-8"), *own]).encode()).hexdigest()
    for value in names.values():
        if isinstance(value, Dispatcher):
            _gather(value.py_func, seen)


def _fixed(name: str, value: object) -> object:
    """What machine code has of a name of its module for good: a constant, or the order of a named tuple's fields."""
    if name.startswith("__"):
        return None
    return value if isinstance(value, int | float | str | tuple) else getattr(value, "_fields", None)
