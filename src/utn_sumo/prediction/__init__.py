"""What will come from outside: the forecast that a controller is handed each control step, and the models behind it.

    Predictor                           each control step's forecast, by any of five methods
    STARIMA, STARIMAResults             space-time ARIMA on statsmodels' state space
    stacf, stpacf, portmanteau          which orders to try, and what the residuals still hold
    select_order                        the orders by AIC or BIC
    network_weights                     spatial weights of a road network

    weights = network_weights(network, orders=1)
    results = STARIMA(counts, order=(2, 0, 1), spatial=(1, 1), weights=weights, trend="c").fit()
    results = results.update(row)                            # each cycle, without fitting again
    results.get_forecast(7).conf_int()

statsmodels takes seconds to import: what stands on it is imported when it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from utn_sumo.prediction.predictor import Predictor
from utn_sumo.prediction.space_time import Portmanteau, portmanteau, stacf, stpacf
from utn_sumo.prediction.weights import network_weights

if TYPE_CHECKING:
    from utn_sumo.prediction.results import STARIMAResults
    from utn_sumo.prediction.selection import OrderSelection, select_order
    from utn_sumo.prediction.starima import STARIMA

__all__ = [
    "STARIMA",
    "OrderSelection",
    "Portmanteau",
    "Predictor",
    "STARIMAResults",
    "network_weights",
    "portmanteau",
    "select_order",
    "stacf",
    "stpacf",
]

_ON_STATSMODELS = {
    "STARIMA": "starima",
    "STARIMAResults": "results",
    "OrderSelection": "selection",
    "select_order": "selection",
}


def __getattr__(name: str) -> Any:
    if name not in _ON_STATSMODELS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_ON_STATSMODELS[name]}"), name)
