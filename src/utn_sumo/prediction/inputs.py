"""What a STARIMA is asked for, checked: each error is one line that says what to give instead."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from utn_sumo.contract import Floats
from utn_sumo.errors import SettingError
from utn_sumo.prediction.form import Term

SMALL = 1e-3


def series(endog: Any) -> Any:
    """As floats, a DataFrame or Series as such; SettingError where it is not (T, N) numbers or NaN."""
    framed = isinstance(endog, pd.DataFrame | pd.Series)
    try:
        values = endog.astype(np.float64) if framed else np.asarray(endog, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SettingError(f"endog: {error}; give numbers, NaN where one is missing") from error
    if values.ndim not in (1, 2) or not values.size:
        raise SettingError(f"endog: shape {values.shape}; give (T, N), a row per step and a column per site")
    if np.isinf(np.asarray(values)).any():
        raise SettingError("endog: a value is infinite; give NaN where one is missing")
    return values


def unit(differences: Floats) -> float:
    """What to measure a diffuse variance in: 1, or the variance of the differences if that is of another order."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        variance = float(np.nanvar(differences))
    return 1.0 if not variance > 0 or SMALL < variance < 1 / SMALL else variance


def integers(name: str, given: Any, count: int) -> tuple[int, ...]:
    """`given` as a tuple of so many integers, none negative."""
    try:
        numbers = tuple(int(number) for number in given)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count or min(numbers, default=0) < 0 or numbers != tuple(given):
        raise SettingError(f"{name}: {given!r} is not {count} integer{'s' * (count != 1)} of 0 or more")
    return numbers


def terms(part: str, lags: int, spatial: int | Sequence[int], weights: Floats) -> tuple[Term, ...]:
    """(time lag, spatial order) of each coefficient of one part of the model."""
    each = integers(f"spatial, {part}", (spatial,) * lags if isinstance(spatial, int | np.integer) else spatial, lags)
    most, given = max(each, default=0), len(weights) - 1
    if most > given:
        raise SettingError(
            f"spatial: {part} order {most} wants W_1 to W_{most}; weights has {given} of them beside W_0 = I"
        )
    for order in range(most + 1):
        if not weights[order].any():
            raise SettingError(
                f"weights: W_{order} has no neighbours at all; lower the spatial order of the {part} part"
            )
    return tuple((lag, order) for lag, highest in enumerate(each, start=1) for order in range(highest + 1))
