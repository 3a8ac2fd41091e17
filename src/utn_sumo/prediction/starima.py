"""STARIMA: an ARIMA of many series whose coefficients are shared by all sites and act through spatial weights.

Pfeifer and Deutsch (1980), as a state-space model of statsmodels: exact likelihood, missing values, forecasts with
intervals, everything that statsmodels' own results can do.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from statsmodels.tools.sm_exceptions import ConvergenceWarning, ValueWarning
from statsmodels.tsa.statespace.initialization import Initialization
from statsmodels.tsa.statespace.kalman_smoother import SMOOTHER_DISTURBANCE, SMOOTHER_DISTURBANCE_COV
from statsmodels.tsa.statespace.mlemodel import MLEModel, MLEResultsWrapper

from utn_sumo.contract import Floats
from utn_sumo.errors import SettingError, did_you_mean
from utn_sumo.prediction import conditional, inputs
from utn_sumo.prediction.form import Form, difference, difference_polynomial
from utn_sumo.prediction.results import STARIMAResults
from utn_sumo.prediction.scoring import Maximum, maximise
from utn_sumo.prediction.weights import Weights, checked

METHODS = ("exact", "conditional")
MOST_STATES = 3000
LARGEST_ROOT = 1 - 1e-6
"""Of the autoregression: nearer to 1 the stationary variance has no digits left, nor has the likelihood."""
EDGE = 1e-3
"""Below the largest root a search that has found no maximum was on its way to it."""
SHRINK, SHRINKINGS = 0.9, 100
"""Of the coefficients of a first guess, until it is admissible."""
STEP = 1e-3
"""Of the differences that give the slope of the exact likelihood, in standard errors."""
COVARIANCE = "Covariance matrix calculated from the information of the conditional likelihood."


@dataclass(frozen=True)
class Specification:
    """A STARIMA that still wants its series: what `STARIMA(order=..., spatial=..., weights=...)` without `endog` is."""

    settings: dict[str, Any]

    def fit(self, endog: Any, **kwargs: Any) -> STARIMAResults:
        """The results of `STARIMA(endog, ...)`, fitted with `kwargs`."""
        return STARIMA(endog, **self.settings).fit(**kwargs)


class STARIMA(MLEModel):  # type: ignore[misc]  # statsmodels ships no types
    r"""Space-time autoregressive integrated moving average model of N series.

    With w_t the series differenced d times, and D times at the season s, and W_0 = I,

        w_t - mu = sum_i sum_l ar_il W_l (w_{t-i} - mu) + sum_i sum_l ma_il W_l e_{t-i} + e_t,   e_t ~ N(0, sigma2 I).

    Signs are statsmodels': ma is +theta, where Pfeifer and Deutsch write -theta. Parameters are called
    `ar.L1.S0` (time lag 1, spatial order 0), `ma.L1.S1`, `sigma2`, and `mean.<series>`.

    endog               (T, N) array or DataFrame; a (T,) one is one site. NaN is a missing value. Without it this is a
                        `Specification`, whose `fit` takes the series.
    order               (p, d, q).
    spatial             (m, n): spatial orders of the autoregressive and of the moving average part, from 0 to m or n;
                        each an int for all time lags, or one int per time lag.
    weights             W_1..W_k, or W_0..W_k with W_0 = I; each (N, N), its row z the weights of z's neighbours. Rows
                        are divided by their sums; a site without neighbours has a row of zeros. See `network_weights`.
    seasonal_diff       (D, s): D differences at a season of s steps.
    trend               "n": none, mu = 0. "c": a mean mu of each differenced series: its level, or its drift if d = 1.
    heteroscedastic     each site has an innovation variance of its own, `sigma2.<series>`.
    enforce_stationarity, enforce_invertibility
                        refuse other parameters, and start from the stationary distribution; without the first all
                        states start diffuse, as in statsmodels' SARIMAX.

    Single coefficients are left out with `model.fit_constrained({"ma.L1.S0": 0})`.

    Differences are taken inside the state space, which keeps the levels of the last d + D s rows: they are integrated
    back with the right variances, and a missing value costs one value, not every difference it is part of. As in
    SARIMAX these states start approximately diffuse, with an `initial_variance` of 1e6 (times the variance of the
    differences where that is beyond 1e-3 to 1e3), and the first d + D s rows do not count in the likelihood.
    There are N (max(p, q + 1) + d + D s) states: rather than differencing at a long season subtract its mean profile.

    Further keywords go to `MLEModel`. Raises SettingError for whatever is out of range.
    """

    def __new__(cls, endog: Any = None, *_: Any, **settings: Any) -> Any:
        """A model, or a specification where there are settings and no series (a copy is made without either)."""
        return Specification(settings) if endog is None and settings else super().__new__(cls)

    def __init__(
        self,
        endog: Any,
        order: tuple[int, int, int] = (1, 0, 0),
        spatial: tuple[int | Sequence[int], int | Sequence[int]] = (0, 0),
        weights: Weights = (),
        *,
        seasonal_diff: tuple[int, int] = (0, 0),
        trend: Literal["n", "c"] = "n",
        heteroscedastic: bool = False,
        enforce_stationarity: bool = True,
        enforce_invertibility: bool = True,
        **kwargs: Any,
    ):
        series = inputs.series(endog)
        sites = 1 if series.ndim == 1 else series.shape[1]
        self._settings = {
            "order": order,
            "spatial": spatial,
            "weights": weights,
            "seasonal_diff": seasonal_diff,
            "trend": trend,
            "heteroscedastic": heteroscedastic,
            "enforce_stationarity": enforce_stationarity,
            "enforce_invertibility": enforce_invertibility,
            **kwargs,
        }
        if trend not in ("n", "c"):
            raise SettingError(f'trend: {trend!r} is unknown; give "n" for none or "c" for a mean of each series')
        p, d, q = inputs.integers("order", order, 3)
        times, period = inputs.integers("seasonal_diff", seasonal_diff, 2)
        if times and not period:
            raise SettingError(
                f"seasonal_diff: {times} differences at a season of {period}; a season has 1 step or more"
            )
        matrices = checked(weights, sites)
        if not isinstance(spatial, Sequence) or len(spatial) != 2:  # noqa: PLR2004
            raise SettingError(
                f"spatial: {spatial!r} is no pair; give (m, n), the spatial orders of the AR and MA parts"
            )
        ar = inputs.terms("AR", p, spatial[0], matrices)
        ma = inputs.terms("MA", q, spatial[1], matrices)
        self.order, self.seasonal_diff = (p, d, q), (times, period)
        self.enforce_stationarity, self.enforce_invertibility = enforce_stationarity, enforce_invertibility
        self.polynomial = difference_polynomial(d, (times, period))
        """Of the differences, by power of the backshift."""
        span, self._blocks = len(self.polynomial) - 1, max(p, q + 1)
        self._levels = sites * span
        states = self._levels + sites * self._blocks
        if states > MOST_STATES:
            raise SettingError(
                f"STARIMA: {states} states are more than {MOST_STATES}; subtract the mean profile of a long season"
                " rather than differencing at it, or take fewer series"
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ValueWarning)  # of the index: what is wrong with it is an error here
            super().__init__(series, k_states=states, k_posdef=sites, **kwargs)
        if self._index_generated and not self._index_none:
            raise SettingError(
                "endog: the steps of its index are not regular; give dates of one frequency with missing rows as NaN,"
                " whole numbers that follow one another, or an array"
            )
        names = [str(name) for name in np.atleast_1d(self.endog_names)]
        self.form = Form(ar, ma, matrices, tuple(names), trend == "c", heteroscedastic)
        self._lay_out(sites, span)
        if "initial_variance" not in kwargs:
            self.ssm.initial_variance *= inputs.unit(difference(self.endog, self.polynomial))
        self._beginning = self.ssm.initialization = self._initialization("approximate_diffuse")
        if "loglikelihood_burn" not in kwargs:
            self.loglikelihood_burn = span + (0 if enforce_stationarity else self._blocks)

    def _lay_out(self, sites: int, span: int) -> None:
        """What the parameters don't touch: the states are the last levels, then the blocks of Harvey's ARMA form."""
        identity, start = np.eye(sites), self._levels
        self["design", :, :start] = np.kron(-self.polynomial[1:], identity)
        self["design", :, start : start + sites] = identity
        transition = np.zeros((self.k_states, self.k_states))
        if span:
            transition[:sites] = self["design"]
            transition[sites:start, : start - sites] = np.eye(start - sites)
        transition[start:-sites, start + sites :] = np.eye(self.k_states - start - sites)
        self._fixed_transition = transition
        self._fixed_selection = np.zeros((self.k_states, sites))
        self._fixed_selection[start : start + sites] = identity

    def _initialization(self, levels: Literal["approximate_diffuse", "known"]) -> Any:
        """Levels diffuse, or known to be zero; the rest at its stationary distribution where that is enforced."""
        start = Initialization(self.k_states, approximate_diffuse_variance=self.ssm.initial_variance)
        split = self._levels if self.enforce_stationarity else self.k_states
        if split and levels == "known":
            start.set((0, split), "known", constant=np.zeros(split), stationary_cov=np.zeros((split, split)))
        elif split:
            start.set((0, split), "approximate_diffuse")
        if split < self.k_states:
            start.set((split, self.k_states), "stationary")
        return start

    def clone(self, endog: Any, exog: Any = None, **kwargs: Any) -> STARIMA:
        """The same model of other data."""
        if exog is not None:
            raise SettingError("exog: a STARIMA has no exogenous regressors; subtract their effect from the series")
        return STARIMA(endog, **{**self._settings, **kwargs})

    @property
    def param_names(self) -> list[str]:
        """In the order of the parameters."""
        return self.form.names

    @property
    def state_names(self) -> list[str]:
        """The last levels of each series, newest first, then the blocks of its ARMA form."""
        back = range(1, 1 + self._levels // self.k_endog)
        return [
            *(f"level.L{lag}.{site}" for lag in back for site in self.form.sites),
            *(f"arma.{block}.{site}" for block in range(self._blocks) for site in self.form.sites),
        ]

    @property
    def start_params(self) -> Floats:
        """The conditional estimates."""
        return np.asarray(self.handle_params(self._conditional_maximum(None, 50).params))

    @property
    def _res_classes(self) -> dict[str, Any]:
        return {"fit": (STARIMAResults, MLEResultsWrapper)}

    def update(self, params: Any, **kwargs: Any) -> Any:
        """Set the state space to these parameters; SettingError where they are inadmissible."""
        params = super().update(params, **kwargs)
        self._admit(np.real(params))
        form, start, sites = self.form, self._levels, self.k_endog
        transition = self._fixed_transition.astype(params.dtype)
        for block, matrix in enumerate(form.ar_matrices(params)):
            rows = start + block * sites
            transition[rows : rows + sites, start : start + sites] += matrix
        selection = self._fixed_selection.astype(params.dtype)
        for block, matrix in enumerate(form.ma_matrices(params), start=1):
            rows = start + block * sites
            selection[rows : rows + sites] = matrix
        self["transition"], self["selection"] = transition, selection
        self["state_cov"] = np.diag(form.variance_of(params))
        if form.mean:
            mean = form.mean_of(params)
            self["obs_intercept"] = mean[:, None]
            if start:
                intercept = np.zeros((self.k_states, 1), dtype=params.dtype)
                intercept[:sites, 0] = mean
                self["state_intercept"] = intercept
        return params

    def _admit(self, params: Floats) -> None:
        variance = self.form.variance_of(params)
        if not (variance > 0).all():
            raise SettingError(f"STARIMA: a variance sigma2 of {variance.min():g} is not positive; give one above 0")
        if self.enforce_stationarity and (root := self.form.ar_root(params)) > LARGEST_ROOT:
            raise SettingError(
                f"STARIMA: the AR coefficients are not stationary (largest root {root:.7g}, it must be below 1);"
                " difference the series, lower p, or set enforce_stationarity=False"
            )
        if self.enforce_invertibility and (root := self.form.ma_root(params)) >= 1:
            raise SettingError(
                f"STARIMA: the MA coefficients are not invertible (largest root {root:.4g}, it must be below 1);"
                " difference less, lower q, or set enforce_invertibility=False"
            )

    def fit(
        self,
        start_params: Any = None,
        *,
        method: Literal["exact", "conditional"] = "exact",
        maxiter: int = 50,
        cov_type: str | None = None,
        cov_kwds: dict[str, Any] | None = None,
        includes_fixed: bool = False,
    ) -> STARIMAResults:
        """Estimate the parameters.

        `exact` climbs the Kalman filter's likelihood by scoring, from the conditional estimates: half a second for 17
        sites and 480 rows, 6 to 10 s for 94 sites and 100 rows. `conditional` takes the first p rows as given and what
        was before as the mean (least squares where there is no MA part), and filters only once: a tenth of that, and
        the one for more sites. Standard errors come from the information of the conditional likelihood, or by
        statsmodels' own `cov_type`.
        """
        if method not in METHODS:
            raise SettingError(f"method: {method!r} is unknown; {did_you_mean(method, METHODS)}")
        if start_params is not None:
            start_params = self.handle_params(start_params, transformed=True, includes_fixed=includes_fixed)
        found = self._conditional_maximum(start_params, maxiter)
        if method == "exact":
            found = self._exact_maximum(found.params, maxiter)
        params = self.handle_params(found.params)
        if not found.converged:
            warnings.warn(
                f"STARIMA: no maximum of the likelihood after {found.iterations} iterations; {self._remedy(params)}",
                ConvergenceWarning,
                stacklevel=2,
            )
        if cov_type is None:
            cov_type, cov_kwds = (
                "custom",
                {
                    "custom_cov_type": "expected",
                    "custom_cov_params": self._covariance(params),
                    "custom_description": COVARIANCE,
                },
            )
        results: STARIMAResults = self.filter(params, includes_fixed=True, cov_type=cov_type, cov_kwds=cov_kwds)
        results.mle_retvals = {"converged": found.converged, "iterations": found.iterations, "fopt": found.value}
        results.mle_settings = {"method": method, "maxiter": maxiter}
        return results

    def _remedy(self, params: Floats) -> str:
        """What to do about a search that ended at these parameters and at no maximum."""
        root = self.form.ar_root(params)
        if not self.enforce_stationarity or root < LARGEST_ROOT - EDGE:
            return "lower the order or raise maxiter"
        mean = "" if self.form.mean else 'give the series their level (trend="c") or '
        return f"the series wander (largest AR root {root:.7g}): {mean}difference them"

    @property
    def _free(self) -> Any:
        """Places of the parameters that are not fixed."""
        every = np.arange(len(self.form.names))
        return every[self._free_params_index] if self._has_fixed_params else every

    def _differenced(self) -> Floats:
        """(T - d - D s, N) the series to fit; SettingError where there is too little of it."""
        w = difference(self.endog, self.polynomial)
        used = int(np.isfinite(w[self.form.p :]).sum())
        if used <= len(self._free):
            raise SettingError(
                f"endog: {used} values after differences and lags are too few for {len(self._free)} parameters;"
                " give more rows or lower the order"
            )
        still = np.nanmax(w, axis=0, initial=-np.inf) <= np.nanmin(w, axis=0, initial=np.inf)
        if still.all() or (still.any() and (self.form.heteroscedastic or self.form.mean)):
            site = self.form.sites[int(np.argmax(still))]
            raise SettingError(f"endog: series {site!r} does not vary after differences; leave it out")
        return w

    def _conditional_maximum(self, start: Floats | None, maxiter: int) -> Maximum:
        """Over the free parameters, from full parameters or from a first guess."""
        w, free = self._differenced(), self._free

        def slopes(at: Floats) -> tuple[Floats, Floats]:
            gradient, information = conditional.slopes(self.form, self.handle_params(at), w)
            return gradient[free], information[np.ix_(free, free)]

        def value(at: Floats) -> float:
            params = self.handle_params(at)
            try:
                self._admit(params)
            except SettingError:
                return -np.inf
            return conditional.loglike(self.form, params, w)

        begin = (conditional.first_guess(self.form, w) if start is None else start)[free]
        coefficients = (free >= self.form.parts[1].start) & (free < self.form.parts[2].stop)
        for _ in range(SHRINKINGS if start is None else 0):
            if np.isfinite(value(begin)):
                break
            begin[coefficients] *= SHRINK
        self._admit(self.handle_params(begin))
        return maximise(value, slopes, begin, maxiter)

    def _exact_maximum(self, start: Floats, maxiter: int) -> Maximum:
        w, free = self._differenced(), self._free

        def value(at: Floats) -> float:
            try:
                return float(self.loglike(at, includes_fixed=False))
            except (SettingError, np.linalg.LinAlgError):
                return -np.inf

        def slopes(at: Floats) -> tuple[Floats, Floats]:
            _, information = conditional.slopes(self.form, self.handle_params(at), w)
            information = information[np.ix_(free, free)]
            # Steps in standard errors: diffuse levels can cost the log-likelihood more digits than smaller steps bear.
            steps = STEP / np.sqrt(np.diag(information))
            by_smoothing = self._slopes_by_smoothing(self.handle_params(at))[free]
            stepped = np.isnan(by_smoothing)
            rises = [value(at + aside) - value(at - aside) for aside in np.diag(steps)[stepped]]
            by_smoothing[stepped] = np.array(rises) / (2 * steps[stepped])
            return by_smoothing, information

        return maximise(value, slopes, start, maxiter)

    def _slopes_by_smoothing(self, params: Floats) -> Floats:
        """Of the exact likelihood by means and variances where each site has its own; NaN for all that takes steps.

        Koopman and Shephard, "Exact score for time series models in state space form", Biometrika 79 (1992). One pass
        of the disturbance smoother has all sites, where steps take two of the filter for each. It knows nothing of
        rows that don't count, but for those of the levels, which say nothing.
        """
        form, sites, start = self.form, self.k_endog, self._levels
        slopes = np.full(len(params), np.nan)
        burnt = self.loglikelihood_burn != len(self.polynomial) - 1
        if burnt or not (form.mean or form.heteroscedastic):
            return slopes
        self.update(params, includes_fixed=True)
        smoothed = self.ssm.smooth(smoother_output=SMOOTHER_DISTURBANCE | SMOOTHER_DISTURBANCE_COV)
        # Slopes by the state after each row, the first row's own start apart.
        by_state, start_state = smoothed.scaled_smoothed_estimator, smoothed.scaled_smoothed_estimator_presample
        if form.mean:
            by_level = by_state[:sites].sum(axis=1) if start else 0.0
            slopes[form.parts[0]] = smoothed.smoothing_error.sum(axis=1) + by_level
        if form.heteroscedastic:
            arma = np.s_[start:, start:]
            by_shocks = (by_state @ by_state.T - smoothed.scaled_smoothed_estimator_cov.sum(axis=-1))[arma]
            if self.enforce_stationarity:
                spread = np.outer(start_state, start_state) - smoothed.scaled_smoothed_estimator_cov_presample
                by_shocks = by_shocks + solve_discrete_lyapunov(self["transition"][arma].T, spread[arma])
            selection = self["selection"][start:]
            slopes[form.parts[3]] = np.einsum("ai,ab,bi->i", selection, by_shocks, selection) / 2
        return slopes

    def _covariance(self, params: Floats) -> Floats:
        """Of the estimates: the inverse information, NaN where a parameter is fixed."""
        _, information = conditional.slopes(self.form, params, self._differenced())
        covariance = np.full(information.shape, np.nan)
        inside = np.ix_(self._free, self._free)
        covariance[inside] = np.linalg.pinv(information[inside], hermitian=True)
        return covariance

    def simulate(self, params: Any, nsimulations: int, *args: Any, **kwargs: Any) -> Any:
        """As statsmodels' own; from the start of the sample, diffuse levels of differenced series begin at 0."""
        beginning = self.ssm.initialization
        if beginning is self._beginning:
            self.ssm.initialization = self._initialization("known")
        try:
            return super().simulate(params, nsimulations, *args, **kwargs)
        finally:
            self.ssm.initialization = beginning
