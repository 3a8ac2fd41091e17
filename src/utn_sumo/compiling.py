"""Functions in machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

EXACT_ENOUGH = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may do to sums and products; infinities keep their meaning."""


def compiled(function: Callable[..., Any]) -> Any:
    """The function in machine code, kept on disk from one run to the next where there is a place for it."""
    return _compiled(function)


def inlined(function: Callable[..., Any]) -> Any:
    """As `compiled`, its code put into that of each that calls it: handing over many arrays takes longer than a sum."""
    return _compiled(function, forceinline=True)


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    try:
        return njit(cache=True, fastmath=EXACT_ENOUGH, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's can be written
        return njit(fastmath=EXACT_ENOUGH, **options)(function)
