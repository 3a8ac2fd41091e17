"""How fast a STARIMA is fitted and kept up to date: what `tools/bench.py forecast` measures.

Series are simulated from the model itself, on the links of a network with its own weights.
"""

from __future__ import annotations

import statistics
import time
from typing import Any, Literal

import numpy as np

from utn_sumo import network
from utn_sumo.prediction import STARIMA, network_weights

HORIZON = 7
COEFFICIENTS = (0.4, 0.25, 0.25, 0.0, 0.0, -0.3, 1.0)
"""Of order (2, 0, 1), spatial order 1: ar.L1, ar.L2, ma.L1 of both spatial orders each; sigma2."""


def measure(net: str, rows: int, repeats: int) -> dict[str, Any]:
    """Medians over `repeats` series: seconds a fit, milliseconds an update with a forecast and its intervals."""
    weights = network_weights(network.load(net), 1)
    sites = len(weights[0])
    empty = STARIMA(np.zeros((rows, sites)), (2, 0, 1), (1, 1), weights)
    fits: dict[Literal["exact", "conditional"], list[float]] = {"exact": [], "conditional": []}
    updates: list[float] = []
    for seed in range(repeats):
        series = np.asarray(empty.simulate(np.array(COEFFICIENTS), rows + 1, rng=seed))
        for method, seconds in fits.items():
            started = time.perf_counter()
            results = empty.clone(series[:-1]).fit(method=method)
            seconds.append(time.perf_counter() - started)
        started = time.perf_counter()
        results.update(series[-1]).get_forecast(HORIZON).conf_int()
        updates.append(time.perf_counter() - started)
    return {
        "series": sites,
        "rows": rows,
        "starima_fit_s": statistics.median(fits["exact"]),
        "starima_conditional_fit_s": statistics.median(fits["conditional"]),
        "starima_update_ms": 1000 * statistics.median(updates),
    }
