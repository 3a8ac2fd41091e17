"""Space-time autocorrelations: which orders a STARIMA needs, and whether its residuals are white.

Pfeifer and Deutsch, "A three-stage iterative procedure for space-time modeling", Technometrics 22 (1980). With z_t the
series less their common mean, the space-time autocovariance of spatial orders l, k at time lag s is

    gamma_lk(s) = sum_t (W_l z_t)' (W_k z_{t+s}) / (N (T - s)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from utn_sumo.contract import Floats
from utn_sumo.errors import SettingError
from utn_sumo.prediction.weights import Weights, checked


def stacf(z: Any, weights: Weights, nlags: int) -> Floats:
    """(nlags, 1 + orders) space-time autocorrelations of z (T, N) at time lags 1..nlags and spatial orders 0..k.

    gamma_l0(s) / sqrt(gamma_ll(0) gamma_00(0)): how what the neighbours of order l hold now goes with what a site
    holds s steps later. White noise has a variance of 1 / (N (T - s)). The common mean is removed first; a missing
    value (NaN) counts as the mean. `weights`: W_1..W_k, with or without W_0 = I in front.
    """
    gamma = _covariances(z, weights, nlags)
    scale = np.sqrt(np.diag(gamma[0]) * gamma[0, 0, 0])
    return gamma[1:, :, 0] / np.where(scale > 0, scale, np.inf)


def stpacf(z: Any, weights: Weights, nlags: int) -> Floats:
    """(nlags, 1 + orders) space-time partial autocorrelations of z (T, N), laid out as those of `stacf`.

    The last coefficient of the space-time Yule-Walker equations as they grow: one spatial order at a time, and with
    all spatial orders at each earlier lag.
    """
    gamma = _covariances(z, weights, nlags)
    orders = gamma.shape[1]
    # by_lag[nlags + s] is gamma(s), for s from -nlags to nlags: gamma_lk(-s) = gamma_kl(s).
    by_lag = np.concatenate([gamma[:0:-1].transpose(0, 2, 1), gamma])
    lag, order = np.divmod(np.arange(nlags * orders), orders)
    matrix = by_lag[nlags + lag[:, None] - lag, order[:, None], order]
    right = gamma[1:, :, 0].ravel()
    # A spatial order without neighbours has only zeros: its coefficient is 0.
    last = [np.linalg.lstsq(matrix[:n, :n], right[:n])[0][-1] for n in range(1, len(right) + 1)]
    return np.reshape(last, (nlags, orders))


@dataclass(frozen=True)
class Portmanteau:
    """A test that residuals are white in time and space together."""

    statistic: float
    df: int
    """Degrees of freedom of the chi-square distribution that white residuals give it."""
    pvalue: float


def portmanteau(resid: Any, weights: Weights, nlags: int, fitted: int = 0) -> Portmanteau:
    """The space-time portmanteau test of residuals (T, N), of which `fitted` AR and MA coefficients were estimated.

    N sum_s (T - s) r_s' C^-1 r_s, with r_s the autocorrelations of `stacf` at lag s, and C_lk = tr(W_l W_k') /
    sqrt(tr(W_l W_l') tr(W_k W_k')) their correlation under white noise of one variance: I where the neighbours of
    two orders are never the same. Chi-square with nlags (1 + orders) - fitted degrees of freedom; a spatial order
    without neighbours is left out.
    """
    residuals = _rows(resid, nlags)
    matrices = checked(weights, residuals.shape[1])
    matrices = matrices[matrices.any(axis=(1, 2))]
    df = nlags * len(matrices) - fitted
    if df < 1:
        raise SettingError(
            f"nlags: {nlags} with {len(matrices)} spatial orders leaves no degree of freedom"
            f" beside {fitted} fitted coefficients; raise it"
        )
    products = np.einsum("lij,kij->lk", matrices, matrices)
    scale = np.sqrt(np.diag(products))
    found = stacf(residuals, matrices, nlags)
    left = len(residuals) - np.arange(1, nlags + 1)
    whitened = np.linalg.solve(products / np.outer(scale, scale), found.T)
    statistic = float(residuals.shape[1] * np.sum(left * (found.T * whitened).sum(axis=0)))
    from scipy.stats import chi2  # noqa: PLC0415 - half a second

    return Portmanteau(statistic, df, float(chi2.sf(statistic, df)))


def _covariances(z: Any, weights: Weights, nlags: int) -> Floats:
    """(1 + nlags, orders, orders) gamma_lk(s) times N: N divides out of every figure made of them."""
    rows = _rows(z, nlags)
    matrices = checked(weights, rows.shape[1])
    centred = np.nan_to_num(rows - np.nanmean(rows))
    if not centred.any():
        raise SettingError(f"z: all {rows.size} values are the same; correlations want series that vary")
    lagged = np.einsum("lij,tj->lti", matrices, centred)
    count = len(centred)
    return np.array(
        [np.einsum("lti,kti->lk", lagged[:, : count - s], lagged[:, s:]) / (count - s) for s in range(nlags + 1)]
    )


def _rows(z: Any, nlags: int) -> Floats:
    rows = np.asarray(z, dtype=np.float64)
    if rows.ndim != 2 or not np.isfinite(rows).any() or np.isinf(rows).any():  # noqa: PLR2004
        raise SettingError(f"z: shape {rows.shape} with {np.isfinite(rows).sum()} finite values; give (T, N) numbers")
    if not 1 <= nlags < len(rows):
        raise SettingError(f"nlags: {nlags} is out of range; {len(rows)} rows allow 1 to {len(rows) - 1}")
    return rows
