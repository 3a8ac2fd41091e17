"""STARIMA: likelihood, estimates, forecasts and updates against independent reckonings and statsmodels' SARIMAX."""

from __future__ import annotations

import copy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import multivariate_normal
from statsmodels.tools.sm_exceptions import ConvergenceWarning
from statsmodels.tsa.statespace.sarimax import SARIMAX

from utn_sumo import prediction
from utn_sumo.contract import Floats
from utn_sumo.errors import SettingError
from utn_sumo.prediction import STARIMA, STARIMAResults, select_order


def grid(sites: int, width: int) -> Floats:
    """A lattice row by row: the sites beside, above and below are neighbours, with equal weights."""
    row, column = np.divmod(np.arange(sites), width)
    near = (np.abs(row[:, None] - row) + np.abs(column[:, None] - column) == 1).astype(float)
    return near / near.sum(axis=1, keepdims=True)


LINE = grid(3, 3)
WEIGHTS = grid(6, 3)


def simulated(params: list[float], rows: int, weights: Floats, seed: int, *form: Any, **settings: Any) -> Floats:
    empty = np.zeros((rows, len(weights)))
    return np.asarray(STARIMA(empty, *form, [weights], **settings).simulate(params, rows, rng=seed))


def with_gaps(z: Floats, seed: int, share: float = 0.1) -> Floats:
    gone = np.random.default_rng(seed).uniform(size=z.shape) < share
    gone[0] = False
    return np.where(gone, np.nan, z)


@pytest.fixture(scope="module")
def series() -> Floats:
    """120 rows of a STARMA(1, 1) on six sites."""
    return simulated([0.4, 0.3, 0.2, 0.2, 1.0], 120, WEIGHTS, 1, (1, 0, 1), (1, 1))


# What it costs to import


def test_statsmodels_is_imported_only_when_it_is_asked_for() -> None:
    code = (
        "import sys, utn_sumo.prediction, utn_sumo.cli;"
        "print([name for name in ('statsmodels', 'pandas') if name in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "[]\n"


def test_every_public_name_is_there_and_no_other() -> None:
    assert all(getattr(prediction, name).__name__ == name for name in prediction.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'ARIMA'"):
        _ = prediction.ARIMA


def test_a_model_without_series_is_fitted_to_the_series_that_it_is_given() -> None:
    weights = [np.array([[0.0, 1.0], [1.0, 0.0]])]
    series = STARIMA(np.zeros((80, 2)), (1, 0, 0), (1, 0), weights).simulate([0.4, 0.2, 1.0], 80, rng=3)
    later = STARIMA(order=(1, 0, 0), spatial=(1, 0), weights=weights).fit(series, method="conditional")
    at_once = STARIMA(series, order=(1, 0, 0), spatial=(1, 0), weights=weights).fit(method="conditional")
    assert later.params == pytest.approx(at_once.params)
    assert later.forecast(3) == pytest.approx(at_once.forecast(3))
    assert copy.copy(at_once.model).loglike(at_once.params) == pytest.approx(at_once.llf)


# The likelihood


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize(
    ("order", "params", "settings"),
    [
        ((2, 0, 1), [0.5, 0.2, 0.4, 1.1], {}),
        ((0, 0, 2), [0.3, 0.2, 0.9], {}),
        ((1, 1, 1), [0.5, -0.4, 1.2], {}),
        ((0, 1, 0), [1.2], {}),
        ((1, 0, 0), [0.3, 1.0], {"seasonal_diff": (1, 4)}),
        ((2, 0, 1), [0.5, 0.2, 0.4, 1.1], {"enforce_stationarity": False}),
    ],
)
def test_one_site_is_sarimax(series: Floats, gaps: bool, order: Any, params: list[float], settings: Any) -> None:
    z = with_gaps(series[:, :1], 2)[:, 0] if gaps else series[:, 0]
    ours = STARIMA(z, order, **settings).filter(params)
    others = dict(settings)
    times, period = others.pop("seasonal_diff", (0, 0))
    theirs = SARIMAX(z, order=order, seasonal_order=(0, times, 0, period), **others).filter(params)
    assert ours.llf == pytest.approx(theirs.llf, abs=1e-6)
    assert ours.aic == pytest.approx(theirs.aic, abs=1e-6)
    mine, other = ours.get_forecast(6), theirs.get_forecast(6)
    assert np.ravel(mine.predicted_mean) == pytest.approx(other.predicted_mean)
    assert mine.conf_int() == pytest.approx(other.conf_int())


def test_a_mean_is_the_intercept_of_sarimax_over_one_less_the_ar_coefficients(series: Floats) -> None:
    for order in ((1, 0, 1), (1, 1, 1)):
        ours = STARIMA(series[:, 0], order, trend="c").filter([2, 0.3, 0.2, 1.0])
        theirs = SARIMAX(series[:, 0], order=order, trend="c").filter([2 * 0.7, 0.3, 0.2, 1.0])
        assert ours.llf == pytest.approx(theirs.llf, abs=1e-6)
        assert np.ravel(ours.forecast(5)) == pytest.approx(theirs.forecast(5))


def test_one_site_is_fitted_as_sarimax_fits_it(series: Floats) -> None:
    z = with_gaps(series[:, :1], 3)[:, 0]
    ours = STARIMA(z, (1, 0, 1)).fit()
    theirs = SARIMAX(z, order=(1, 0, 1)).fit(disp=0, maxiter=200)
    assert ours.llf == pytest.approx(theirs.llf, abs=1e-5)
    assert ours.params == pytest.approx(theirs.params, abs=1e-3)


def dense_loglike(z: Floats, differences: int) -> float:
    """Of a STARMA(2, 1) on a line of three sites, from the covariance of all its values; the first row is given if
    it is differenced."""
    identity = np.eye(3)
    ar = [0.3 * identity + 0.2 * LINE, 0.1 * identity]
    ma = 0.2 * identity - 0.3 * LINE
    responses = [identity, ar[0] + ma]
    while len(responses) < 200:
        responses.append(ar[0] @ responses[-1] + ar[1] @ responses[-2])
    rows = len(z) - differences
    lagged = [sum(a @ b.T for a, b in zip(responses[lag:], responses, strict=False)) for lag in range(rows)]
    blocks = [[lagged[t - s] if t >= s else lagged[s - t].T for s in range(rows)] for t in range(rows)]
    covariance = 1.5 * np.block(blocks)
    values = z
    if differences:
        add = np.kron(np.tril(np.ones((rows, rows))), identity)
        covariance, values = add @ covariance @ add.T, z[1:] - z[0]
    seen = ~np.isnan(values.ravel())
    return float(multivariate_normal.logpdf(values.ravel()[seen], cov=covariance[np.ix_(seen, seen)]))


@pytest.mark.parametrize("d", [0, 1])
def test_the_likelihood_is_that_of_all_values_at_once(d: int) -> None:
    # Where differences are taken a missing value costs one value, not two differences.
    z = with_gaps(np.random.default_rng(4).normal(size=(15, 3)).cumsum(axis=0), 5, share=0.2)
    model = STARIMA(z, (2, d, 1), ((1, 0), 1), [LINE])
    params = [0.3, 0.2, 0.1, 0.2, -0.3, 1.5]
    assert model.loglike(params) == pytest.approx(dense_loglike(z, d), abs=1e-4)


def test_weights_with_and_without_the_identity_are_the_same(series: Floats) -> None:
    params = [0.4, 0.3, 0.2, 0.2, 1.0]
    ways = ([WEIGHTS], [np.eye(6), WEIGHTS], [WEIGHTS > 0], np.stack([np.eye(6), WEIGHTS]))
    values = np.array([STARIMA(series, (1, 0, 1), (1, 1), way).loglike(params) for way in ways])
    assert values == pytest.approx(values[0])


# The estimates


def test_star_by_least_squares_is_least_squares() -> None:
    weights = grid(5, 5)
    rng = np.random.default_rng(6)
    z = np.zeros((200, 5))
    for t in range(2, 200):
        z[t] = 0.2 * z[t - 1] + 0.5 * weights @ z[t - 1] + 0.02 * z[t - 2] - 0.1 * weights @ z[t - 2]
        z[t] += rng.normal(size=5)
    columns = [z[1:-1], z[1:-1] @ weights.T, z[:-2], z[:-2] @ weights.T]
    matrix = np.stack([column.ravel() for column in columns], axis=1)
    expected, squares, *_ = np.linalg.lstsq(matrix, z[2:].ravel())
    variance = squares[0] / z[2:].size
    results = STARIMA(z, (2, 0, 0), (1, 0), [weights]).fit(method="conditional")
    assert list(results.model.param_names) == ["ar.L1.S0", "ar.L1.S1", "ar.L2.S0", "ar.L2.S1", "sigma2"]
    assert results.params == pytest.approx([*expected, variance])
    assert results.bse[:4] == pytest.approx(np.sqrt(variance * np.diag(np.linalg.inv(matrix.T @ matrix))))


def test_least_squares_need_not_be_stationary_where_that_is_not_asked() -> None:
    z = np.exp(0.02 * np.arange(120))[:, None] * [1.0, 2.0, 3.0] + np.random.default_rng(18).normal(size=(120, 3))
    expected = (z[:-1] * z[1:]).sum() / (z[:-1] ** 2).sum()
    assert expected > 1
    free = STARIMA(z, (1, 0, 0), enforce_stationarity=False).fit(method="conditional")
    assert free.params[0] == pytest.approx(expected)
    with pytest.warns(ConvergenceWarning):
        assert STARIMA(z, (1, 0, 0)).fit().params[0] < 1


def test_a_fixed_coefficient_that_is_inadmissible_is_refused(series: Floats) -> None:
    with pytest.raises(SettingError, match="AR coefficients are not stationary"):
        STARIMA(series, (1, 0, 0)).fit_constrained({"ar.L1.S0": 1.1})


REFERENCE = {"ar.L1.S0": (0.4, 0.0075), "ar.L1.S1": (0.25, 0.025), "ar.L2.S0": (0.25, 0.007), "ma.L1.S1": (-0.3, 0.033)}
"""Coefficients of the reference simulation, and their deviations."""


def reference_estimates(seed: int, **how: Any) -> dict[str, float]:
    weights = grid(94, 10)
    z = simulated([0.4, 0.25, 0.25, 0.0, -0.3, 1.0], 100, weights, seed, (2, 0, 1), ((1, 0), 1))
    model = STARIMA(z, (2, 0, 1), ((1, 0), 1), [weights])
    results = model.fit_constrained({"ma.L1.S0": 0.0}, **how)
    assert results.params[model.param_names.index("ma.L1.S0")] == 0
    return dict(zip(model.param_names, results.params, strict=True))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_reference_simulation_is_recovered(seed: int) -> None:
    found = reference_estimates(seed, method="conditional")
    assert all(abs(found[name] - value) <= 3 * deviation for name, (value, deviation) in REFERENCE.items())


@pytest.mark.long
@pytest.mark.parametrize("seed", range(8))
def test_the_reference_simulation_is_recovered_by_the_exact_likelihood(seed: int) -> None:
    found = reference_estimates(seed)
    assert all(abs(found[name] - value) <= 3 * deviation for name, (value, deviation) in REFERENCE.items())


def test_estimates_spread_as_their_standard_errors_say() -> None:
    true = [0.4, 0.25, 0.3, 1.0]
    scores = []
    for seed in range(40):
        z = simulated(true, 60, WEIGHTS, seed, (1, 0, 1), (1, 0))
        results = STARIMA(z, (1, 0, 1), (1, 0), [WEIGHTS]).fit()
        scores.append((results.params - true) / results.bse)
    assert np.std(scores, axis=0) == pytest.approx(1, abs=0.3)
    assert np.mean(scores, axis=0) == pytest.approx(0, abs=0.5)


def test_means_and_variances_of_the_sites_are_recovered() -> None:
    settings = {"trend": "c", "heteroscedastic": True}
    means, variances = [10.0, -5.0, 3.0], [1.0, 4.0, 9.0]
    z = simulated([*means, 0.4, 0.3, *variances], 400, LINE, 7, (1, 0, 0), (1, 0), **settings)
    results = STARIMA(pd.DataFrame(z, columns=["a", "b", "c"]), (1, 0, 0), (1, 0), [LINE], **settings).fit()
    assert list(results.params.index) == [
        *("mean.a", "mean.b", "mean.c", "ar.L1.S0", "ar.L1.S1", "sigma2.a", "sigma2.b", "sigma2.c")
    ]
    off = (results.params - [*means, 0.4, 0.3, *variances]) / results.bse
    assert np.abs(off).max() < 3


@pytest.mark.parametrize("d", [0, 1])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"trend": "c", "heteroscedastic": True},
        {"trend": "c", "heteroscedastic": True, "enforce_stationarity": False},
    ],
)
def test_the_exact_estimates_are_at_a_maximum(series: Floats, d: int, settings: dict[str, Any]) -> None:
    z = with_gaps(series.cumsum(axis=0) if d else series, 8)
    model = STARIMA(z, (1, d, 1), (1, 1), [WEIGHTS], **settings)
    results = model.fit()
    assert results.mle_retvals["converged"]
    assert results.llf >= model.fit(method="conditional").llf
    for place, error in enumerate(results.bse):
        for sign in (-1, 1):
            aside = results.params.copy()
            aside[place] += sign * 0.05 * error
            assert model.loglike(aside) < results.llf


@pytest.mark.parametrize("d", [0, 1])
def test_slopes_by_smoothing_are_those_of_the_likelihood(series: Floats, d: int) -> None:
    model = STARIMA(with_gaps(series, 16), (2, d, 1), (1, 1), [WEIGHTS], trend="c", heteroscedastic=True)
    at = np.array([*np.linspace(-1, 1, 6), 0.4, 0.2, 0.1, 0.1, 0.0, -0.3, *np.linspace(0.5, 2, 6)])
    found = model._slopes_by_smoothing(at)
    stepped = [(model.loglike(at + aside) - model.loglike(at - aside)) / 2e-4 for aside in 1e-4 * np.eye(len(at))]
    assert np.isnan(found[6:12]).all()
    assert np.delete(found, range(6, 12)) == pytest.approx(np.delete(stepped, range(6, 12)), abs=1e-4)


def test_standard_errors_of_statsmodels_are_to_be_had_and_nearly_the_same(series: Floats) -> None:
    model = STARIMA(series, (1, 0, 1), (1, 1), [WEIGHTS])
    assert model.fit().bse == pytest.approx(model.fit(cov_type="approx").bse, rel=0.1)


def test_coefficients_can_be_fixed(series: Floats) -> None:
    model = STARIMA(series, (1, 0, 1), (1, 1), [WEIGHTS])
    for method in ("exact", "conditional"):
        results = model.fit_constrained({"ma.L1.S1": 0.1, "sigma2": 1.2}, method=method)
        assert results.params[[3, 4]] == pytest.approx([0.1, 1.2])
        assert np.isnan(results.bse[[3, 4]]).all()
        assert results.portmanteau(5).df == 2 * 5 - 3
        assert results.update(series[-1]).params == pytest.approx(results.params)
    with model.fix_params(dict(zip(model.param_names, [0.4, 0.3, 0.2, 0.2, 1.0], strict=True))):
        assert model.fit().params == pytest.approx([0.4, 0.3, 0.2, 0.2, 1.0])


def test_a_search_that_is_cut_short_says_so(series: Floats) -> None:
    with pytest.warns(ConvergenceWarning, match="no maximum of the likelihood after 1 iterations"):
        STARIMA(series, (1, 0, 1), (1, 1), [WEIGHTS]).fit([0, 0, 0, 0, 9.0], maxiter=1)


def test_estimates_stay_invertible_where_that_is_asked(series: Floats) -> None:
    differenced = np.diff(series, axis=0)
    model = STARIMA(differenced, (1, 0, 1), (0, 0))
    with pytest.warns(ConvergenceWarning):
        results = model.fit()
    assert abs(results.params[1]) < 1


# Forecasts


def test_intervals_hold_the_future_at_their_rate() -> None:
    settings: dict[str, Any] = {"order": (1, 1, 1), "spatial": (1, 1), "weights": [WEIGHTS]}
    truth = [0.3, 0.3, 0.2, -0.4, 1.0]
    z = np.asarray(STARIMA(np.zeros((700, 6)), **settings).simulate(truth, 700, rng=9))
    results = STARIMA(z[:150], **settings).fit()
    held = []
    for t in range(150, 690):
        results = results.update(z[t])
        low, high = np.split(results.get_forecast(5).conf_int(alpha=0.2), 2, axis=1)
        # statsmodels' columns: lower and upper bounds of all series, in that order.
        held.append((low <= z[t + 1 : t + 6]) & (z[t + 1 : t + 6] <= high))
    assert np.mean(held, axis=(0, 2)) == pytest.approx(0.8, abs=0.04)


def test_differences_are_integrated_back(series: Floats) -> None:
    params = [0.3, 0.3, 0.2, 1.0]
    form = ((1, 0, 1), (1, 0), [WEIGHTS])
    levels = series.cumsum(axis=0)
    steps = STARIMA(np.diff(levels, axis=0), *form).filter(params).forecast(8)
    found = STARIMA(levels, (1, 1, 1), *form[1:]).filter(params)
    assert found.forecast(8) == pytest.approx(levels[-1] + steps.cumsum(axis=0), abs=1e-4)
    twice = STARIMA(levels.cumsum(axis=0), (1, 2, 1), *form[1:]).filter(params)
    last = levels.sum(axis=0)
    assert twice.forecast(8) == pytest.approx(last + found.forecast(8).cumsum(axis=0), abs=1e-3)


def test_the_variance_of_a_random_walk_grows_with_the_horizon(series: Floats) -> None:
    ahead = STARIMA(series, (0, 1, 0)).filter([2.0]).get_forecast(5)
    assert ahead.var_pred_mean == pytest.approx(2.0 * np.arange(1, 6)[:, None, None] * np.eye(6))


def test_a_season_goes_on() -> None:
    season = np.array([[0, 5, 1], [4, 1, 7], [9, 2, 2], [1, 1, 3]])
    z = np.tile(season, (12, 1)) + np.random.default_rng(10).normal(scale=0.01, size=(48, 3))
    results = STARIMA(z, (1, 0, 0), (1, 0), [LINE], seasonal_diff=(1, 4)).fit()
    assert results.forecast(8) == pytest.approx(np.tile(season, (2, 1)), abs=0.1)


def test_a_drift_goes_on() -> None:
    z = np.arange(80)[:, None] * [1.0, 2.0, -1.0] + np.random.default_rng(11).normal(size=(80, 3))
    results = STARIMA(z, (1, 1, 0), (1, 0), [LINE], trend="c").fit()
    assert results.forecast(10)[-1] - z[-1] == pytest.approx([10, 20, -10], abs=3)


@pytest.mark.parametrize(
    ("order", "seasonal", "trend"), [((1, 0, 1), (0, 0), "c"), ((1, 1, 1), (0, 0), "n"), ((1, 1, 0), (1, 3), "c")]
)
@pytest.mark.parametrize("framed", [False, True])
def test_update_append_and_filtering_anew_are_the_same(
    series: Floats, order: Any, seasonal: Any, trend: Any, framed: bool
) -> None:
    z: Any = with_gaps(series, 12)
    if framed:
        z = pd.DataFrame(z, index=pd.date_range("2024-01-01", periods=len(z), freq="2min"), columns=list("abcdef"))
    settings: Any = {"spatial": (1, 0), "weights": [WEIGHTS], "seasonal_diff": seasonal, "trend": trend}
    begun = STARIMA(z[:110], order, **settings).fit(method="conditional")
    updated = begun
    for row in np.asarray(z)[110:]:
        updated = updated.update(row)
    anew = STARIMA(z, order, **settings).filter(np.asarray(begun.params))
    for results in (updated, begun.append(z[110:]), begun.extend(z[110:]), begun.apply(z)):
        assert isinstance(getattr(results, "_results", results), STARIMAResults)
        ours, theirs = results.get_forecast(5), anew.get_forecast(5)
        np.testing.assert_allclose(ours.predicted_mean, theirs.predicted_mean, rtol=1e-7)
        np.testing.assert_allclose(ours.conf_int(), theirs.conf_int(), rtol=1e-7)
    if framed:
        assert updated.forecast(2).index[0] == pd.Timestamp("2024-01-01 04:00")


@pytest.mark.parametrize("d", [0, 1])
def test_the_likelihood_of_what_came_later_adds_up(series: Floats, d: int) -> None:
    z = with_gaps(series, 17)
    model = STARIMA(z[:110], (1, d, 1), (1, 1), [WEIGHTS])
    begun = model.filter([0.4, 0.3, 0.2, 0.2, 1.0])
    later = begun.update(z[110]).llf + begun.update(z[110]).extend(z[111:]).llf
    assert begun.llf + later == pytest.approx(begun.append(z[110:]).llf)


def test_a_row_of_nothing_only_moves_time_on(series: Floats) -> None:
    results = STARIMA(series, (1, 1, 1), (1, 1), [WEIGHTS]).filter([0.4, 0.3, 0.2, 0.2, 1.0])
    blind = results.update(np.full(6, np.nan))
    assert blind.forecast(3) == pytest.approx(results.forecast(4)[1:])


def test_refitting_on_appended_rows_is_fitting_them_all(series: Floats) -> None:
    form = ((1, 0, 1), (1, 0), [WEIGHTS])
    refitted = STARIMA(series[:80], *form).fit().append(series[80:], refit=True)
    assert refitted.params == pytest.approx(STARIMA(series, *form).fit().params, abs=1e-4)


# Simulation and diagnosis


def test_simulations_repeat_and_have_the_spread_of_the_model() -> None:
    model = STARIMA(np.zeros((10, 3)), (1, 0, 0), (1, 0), [LINE])
    one, same = (model.simulate([0.5, 0.3, 1.0], 4000, rng=1) for _ in range(2))
    assert (one == same).all()
    step = 0.5 * np.eye(3) + 0.3 * LINE
    expected = np.linalg.solve(np.eye(9) - np.kron(step, step), np.eye(3).ravel()).reshape(3, 3)
    assert np.cov(one.T) == pytest.approx(expected, rel=0.15)


def test_simulated_levels_begin_at_zero_and_go_on_from_the_end(series: Floats) -> None:
    results = STARIMA(series + 50, (1, 1, 0), (1, 0), [WEIGHTS]).filter([0.3, 0.2, 1.0])
    assert np.abs(results.simulate(3, rng=1)).max() < 20
    ends = results.simulate(3, anchor="end", repetitions=500, rng=1)
    assert ends.mean(axis=2) == pytest.approx(results.forecast(3), abs=0.5)


def test_the_right_model_leaves_white_residuals_and_a_wrong_one_does_not(series: Floats) -> None:
    right = STARIMA(with_gaps(series, 13), (1, 0, 1), (1, 1), [WEIGHTS]).fit()
    wrong = STARIMA(series, (1, 0, 0), (0, 0), [WEIGHTS]).fit()
    assert right.portmanteau().pvalue > 0.05 > wrong.portmanteau().pvalue
    assert np.abs(right.stacf(5)).max() < 4 / np.sqrt(series.size)


def test_the_summary_names_model_parameters_and_the_portmanteau(series: Floats) -> None:
    results = STARIMA(series, (1, 0, 1), (1, 1), [WEIGHTS]).fit()
    text = str(results.summary())
    for piece in ("STARIMA(1, 0, 1)", "ar.L1.S1", "ma.L1.S1", "sigma2", "Space-time portmanteau: "):
        assert piece in text
    assert "portmanteau" not in str(results.extend(series[:5]).summary())


@pytest.mark.parametrize("criterion", ["aic", "bic"])
def test_the_orders_are_found_again(criterion: Any) -> None:
    z = simulated([0.4, 0.4, 1.0], 150, WEIGHTS, 14, (1, 0, 0), (1, 0))
    found = select_order(z, [WEIGHTS], criterion=criterion)
    assert (found.order, found.spatial) == ((1, 0, 0), (1, 0))
    assert len(found.table) == 1 + 2 + 2 * 2 + 2 * 2 * 2
    assert found.table[criterion].is_monotonic_increasing


def test_fits_of_wandering_series_are_told_from_maxima_and_how_to_make_them_some() -> None:
    walk = np.cumsum(np.random.default_rng(0).normal(0, 2, (240, 4)), axis=0)
    others = (np.ones((4, 4)) - np.eye(4)) / 3
    with pytest.warns(ConvergenceWarning, match=r'the series wander .*\(trend="c"\) or difference them'):
        results = STARIMA(walk, (1, 0, 0), (1, 0), [others]).fit()
    # As likely as any model of a walk whose variance is known, and no more.
    assert results.llf == pytest.approx(STARIMA(walk, (0, 1, 0)).fit().llf, abs=50)
    assert np.isfinite(results.get_forecast(3).conf_int()).all()
    with pytest.warns(ConvergenceWarning, match="the series wander"):
        found = select_order(walk, [others], max_order=(1, 0, 0))
    assert found.table["converged"][0]
    assert not found.table["converged"].is_monotonic_increasing
    assert found.table["converged"].is_monotonic_decreasing
    for converged in (True, False):
        assert found.table["aic"][found.table["converged"] == converged].is_monotonic_increasing


def test_a_root_as_good_as_one_is_refused() -> None:
    with pytest.raises(SettingError, match=r"not stationary .*largest root 0\.9999999"):
        STARIMA(np.zeros((9, 1)), (1, 0, 0)).update([1 - 1e-7, 1.0])


# Unhappy askings

ROWS = np.random.default_rng(15).normal(size=(30, 3))


@pytest.mark.parametrize(
    ("endog", "settings", "message"),
    [
        (ROWS, {"order": (1, 0)}, r"order: \(1, 0\) is not 3 integers of 0 or more"),
        (ROWS, {"order": (1, -1, 0)}, r"order: \(1, -1, 0\) is not 3 integers"),
        (ROWS, {"order": (1.5, 0, 0)}, r"order: \(1.5, 0, 0\) is not 3 integers"),
        (ROWS, {"order": "two"}, "order: 'two' is not 3 integers"),
        (ROWS, {"spatial": 1}, "spatial: 1 is no pair"),
        (ROWS, {"spatial": (2, 0)}, "spatial: AR order 2 wants W_1 to W_2; weights has 1 of them"),
        (ROWS, {"spatial": ((1, 0), 0)}, r"spatial, AR: \(1, 0\) is not 1 integer"),
        (ROWS, {"weights": [LINE[:2, :2]]}, r"weights: W_1 has shape \(2, 2\); 3 series want \(3, 3\)"),
        (ROWS, {"weights": [-LINE]}, "weights: W_1.* finite and not negative"),
        (ROWS, {"weights": [LINE, LINE > 0]}, "weights: W_2 and W_1 are the same"),
        (ROWS, {"weights": [0 * LINE], "spatial": (1, 0)}, "weights: W_1 has no neighbours at all; lower the spatial"),
        (ROWS, {"seasonal_diff": (1, 0)}, "seasonal_diff: 1 differences at a season of 0"),
        (ROWS, {"seasonal_diff": (1, 2000)}, "STARIMA: 6003 states are more than 3000"),
        (ROWS, {"trend": "ct"}, "trend: 'ct' is unknown"),
        (ROWS * np.inf, {}, "endog: a value is infinite"),
        ([["a", "b"]], {}, "endog: could not convert string to float: 'a'; give numbers"),
        (pd.DataFrame(ROWS, index=np.arange(30) ** 2), {}, "endog: the steps of its index are not regular"),
        (pd.DataFrame(ROWS, index=pd.to_datetime(np.arange(30) ** 2)), {}, "endog: the steps of its index are not"),
        (ROWS[None], {}, r"endog: shape \(1, 30, 3\); give \(T, N\)"),
    ],
)
def test_a_model_that_cannot_be_is_refused_in_one_line(endog: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message) as caught:
        STARIMA(endog, **{"order": (1, 0, 0), "weights": [LINE], **settings})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("endog", "settings", "message"),
    [
        (ROWS[:1], {}, "endog: 0 values after differences and lags are too few for 3 parameters"),
        (ROWS[:2], {"order": (1, 3, 0)}, "endog: 0 values after differences"),
        (ROWS * np.nan, {}, "endog: 0 values"),
        (ROWS * 0, {}, "endog: series 'y1' does not vary"),
        (ROWS * [1, 0, 1], {"heteroscedastic": True}, "endog: series 'y2' does not vary"),
        (ROWS * [1, np.nan, 1], {"trend": "c"}, "endog: series 'y2' does not vary"),
    ],
)
def test_what_cannot_be_fitted_is_refused_in_one_line(endog: Floats, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message) as caught:
        STARIMA(endog, **{"order": (1, 0, 0), "spatial": (1, 0), "weights": [LINE], **settings}).fit()
    assert "\n" not in str(caught.value)


def test_inadmissible_parameters_are_refused_in_one_line() -> None:
    form = (ROWS, (2, 0, 2), (1, 0), [LINE])
    fine, theta = [0.3, 0.3, 0.2, 0.1], [0.3, 0.2]
    for params, message in (
        ([0.5, 0.4, 0.2, 0.1, *theta, 1], "AR coefficients are not stationary .largest root 1.1"),
        ([*fine, 0.5, -1.5, 1], "MA coefficients are not invertible .largest root"),
        ([*fine, *theta, -1], "a variance sigma2 of -1 is not positive"),
    ):
        with pytest.raises(SettingError, match=message) as caught:
            STARIMA(*form).filter(params)
        assert "\n" not in str(caught.value)
    free = STARIMA(*form, enforce_stationarity=False, enforce_invertibility=False)
    assert np.isfinite(free.filter([0.5, 0.4, 0.2, 0.1, 0.5, -1.5, 1]).llf)


def test_other_unhappy_askings_are_one_line() -> None:
    model = STARIMA(ROWS, (1, 0, 0))
    with pytest.raises(SettingError, match="row: 2 values for 3 series; give one per series"):
        model.fit().update([1.0, 2.0])
    with pytest.raises(SettingError, match="method: 'exct' is unknown; did you mean 'exact'"):
        model.fit(method="exct")
    with pytest.raises(SettingError, match="exog: a STARIMA has no exogenous regressors"):
        model.clone(ROWS, exog=ROWS)
    with pytest.raises(SettingError, match="criterion: 'mic' is unknown"):
        select_order(ROWS, [LINE], criterion="mic")


def test_the_guide_runs(capsys: pytest.CaptureFixture[str]) -> None:
    guide = (Path(__file__).parents[2] / "docs" / "starima.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    exec(guide.split("```python\n")[1].split("```")[0], names)
    assert names["found"].order == (1, 0, 1)
    assert names["ahead"].predicted_mean.shape == (7, 17)
    assert "mean.y17" in capsys.readouterr().out
