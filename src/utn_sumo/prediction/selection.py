"""Orders of a STARIMA by an information criterion, over a grid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import pandas as pd

from utn_sumo.errors import SettingError, did_you_mean
from utn_sumo.prediction.starima import STARIMA
from utn_sumo.prediction.weights import Weights

CRITERIA = ("aic", "aicc", "bic", "hqic")


@dataclass(frozen=True)
class OrderSelection:
    """What a search over orders found."""

    order: tuple[int, int, int]
    """(p, d, q) of the best."""
    spatial: tuple[int, int]
    """Its spatial orders (m, n)."""
    table: pd.DataFrame
    """A row per model: order, spatial, the number of parameters, whether its fit `converged`, the log-likelihood, the
    criterion; the best first, after those that converged the others."""


def select_order(
    endog: Any,
    weights: Weights,
    max_order: tuple[int, int, int] = (2, 0, 1),
    max_spatial: tuple[int, int] = (1, 1),
    *,
    criterion: Literal["aic", "aicc", "bic", "hqic"] = "aic",
    method: Literal["conditional", "exact"] = "conditional",
    **settings: Any,
) -> OrderSelection:
    """Fit every STARIMA with p, q and spatial orders up to the given ones, with max_order's d, and rank them.

    `method` is that of `STARIMA.fit`; the criterion always takes the exact likelihood of what it finds. `settings` are
    STARIMA's own: trend, seasonal_diff, ... What has no maximum of the likelihood comes last, with a warning. The
    BIC counts rows of `endog`, as statsmodels does, not single values.
    """
    if criterion not in CRITERIA:
        raise SettingError(f"criterion: {criterion!r} is unknown; {did_you_mean(criterion, CRITERIA)}")
    rows = []
    for order, spatial in _grid(max_order, max_spatial):
        results = STARIMA(endog, order, spatial, weights, **settings).fit(method=method, cov_type="none")
        rows.append(
            {
                "order": order,
                "spatial": spatial,
                "parameters": len(results.params),
                "converged": bool(results.mle_retvals["converged"]),
                "llf": float(results.llf),
                criterion: float(results.info_criteria(criterion)),
            }
        )
    table = pd.DataFrame(rows).sort_values(["converged", criterion], ascending=[False, True], ignore_index=True)
    return OrderSelection(table["order"][0], table["spatial"][0], table)


def _grid(
    max_order: tuple[int, int, int], max_spatial: tuple[int, int]
) -> Iterator[tuple[tuple[int, int, int], tuple[int, int]]]:
    """Orders and spatial orders; a part without time lags has no spatial order to vary."""
    p_most, d, q_most = max_order
    for p, q in product(range(p_most + 1), range(q_most + 1)):
        for m, n in product(range(max_spatial[0] + 1 if p else 1), range(max_spatial[1] + 1 if q else 1)):
            yield (p, d, q), (m, n)
