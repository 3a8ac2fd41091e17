"""What a STARIMA's filter found: statsmodels' results, with updates each cycle and diagnosis in space."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from statsmodels.tsa.statespace.mlemodel import MLEResults

from utn_sumo.contract import Floats
from utn_sumo.errors import SettingError
from utn_sumo.prediction import space_time
from utn_sumo.prediction.form import Form


class STARIMAResults(MLEResults):  # type: ignore[misc]  # statsmodels ships no types
    """A fitted STARIMA, or one filtered with given parameters; statsmodels' results with a few verbs more."""

    def update(self, row: Any) -> STARIMAResults:
        """Results that know one more row (N,), NaN where a value is missing, with the parameters as they were.

        One step of the filter: cheap enough for every cycle. Forecasts start after the new row; what concerns the
        sample, such as `resid` and `llf`, is about the new row alone. To keep or refit the whole sample, `append` all
        new rows to the fitted results.
        """
        values = np.asarray(row, dtype=np.float64).ravel()
        if len(values) != self.model.k_endog:
            raise SettingError(f"row: {len(values)} values for {self.model.k_endog} series; give one per series")
        result: STARIMAResults = self.extend(values[None])
        return result

    def extend(self, endog: Any, exog: Any = None, fit_kwargs: Any = None, **kwargs: Any) -> Any:
        """As statsmodels' own; all new rows count in the likelihood, since the levels before them are known."""
        return super().extend(endog, exog, fit_kwargs, **{"loglikelihood_burn": 0, **kwargs})

    def simulate(self, nsimulations: int, *, anchor: Any = None, initial_state: Any = None, **kwargs: Any) -> Any:
        """As statsmodels' own: from the `anchor` "start", as `STARIMA.simulate`, or "end", on from the sample."""
        if anchor in (None, "start", 0) and initial_state is None:
            return self.model.simulate(self.params, nsimulations, includes_fixed=True, **kwargs)
        return super().simulate(nsimulations, anchor=anchor, initial_state=initial_state, **kwargs)

    def portmanteau(self, nlags: int = 10) -> space_time.Portmanteau:
        """Test that the residuals are white in time and in space; they are scaled to one variance at all sites."""
        form: Form = self.model.form
        coefficients = form.names[form.parts[1].start : form.parts[2].stop]
        fitted = sum(name not in self.fixed_params for name in coefficients)
        return space_time.portmanteau(self._white(), form.weights, nlags, fitted)

    def stacf(self, nlags: int = 10) -> Floats:
        """(nlags, 1 + orders) space-time autocorrelations of the residuals."""
        return space_time.stacf(self._white(), self.model.form.weights, nlags)

    def _white(self) -> Floats:
        """(T - burn, N) one-step errors over their standard deviations."""
        return np.asarray(self.standardized_forecasts_error.T[self.loglikelihood_burn :])

    def summary(self, alpha: float = 0.05, **kwargs: Any) -> Any:
        """The summary of statsmodels, with the space-time portmanteau test in place of its tests series by series."""
        model = self.model
        name = [f"STARIMA{model.order}"]
        name += [f"seasonal differences {model.seasonal_diff}"] if model.seasonal_diff[0] else []
        settings = {
            "title": "STARIMA Results",
            "model_name": name,
            "display_diagnostics": False,
            "display_max_endog": 3,
        }
        table = super().summary(alpha=alpha, **{**settings, **kwargs})
        # Too few rows, as after `update`, have no test.
        with contextlib.suppress(SettingError):
            test = self.portmanteau()
            table.extra_txt = (
                f"Space-time portmanteau: {test.statistic:.2f}, df {test.df}, p {test.pvalue:.3f}\n\n{table.extra_txt}"
            )
        return table
