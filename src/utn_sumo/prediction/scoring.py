"""The method of scoring: Newton's with the information in place of second derivatives, halving steps that fall."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from utn_sumo.contract import Floats

GAIN = 1e-8
"""A step that promises to raise the log-likelihood by less than this ends the search: 1e-4 standard errors."""
ROUNDING = 1e-4
"""Nor need it promise more where no step raises it: diffuse levels can cost the log-likelihood that many digits."""
HALVINGS = 30


@dataclass(frozen=True)
class Maximum:
    """Where a search ended."""

    params: Floats
    value: float
    iterations: int
    converged: bool


def maximise(
    value: Callable[[Floats], float],
    slopes: Callable[[Floats], tuple[Floats, Floats]],
    start: Floats,
    maxiter: int,
) -> Maximum:
    """Climb `value` (-inf where parameters are inadmissible), given its gradient and its information, from `start`."""
    at, level, iteration, promised = start, value(start), 0, np.inf
    while iteration < maxiter and len(at):
        gradient, information = slopes(at)
        if not np.isfinite(gradient).all():
            break  # at the edge of what is admissible
        scale = 1 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
        step = scale * np.linalg.lstsq(information * np.outer(scale, scale), gradient * scale, rcond=1e-10)[0]
        promised = float(gradient @ step) / 2
        if promised < GAIN:
            break
        iteration += 1
        for _ in range(HALVINGS):
            reached = value(at + step)
            if reached > level:
                break
            step = step / 2
        else:
            break
        at, level = at + step, reached
    return Maximum(at, level, iteration, not len(at) or promised < ROUNDING)
