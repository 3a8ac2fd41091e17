"""The conditional likelihood: innovations one after the other, the first p rows given, what was before at the mean.

It starts the exact search, gives it its information matrix, and is a method of its own for many sites. A missing
value stands at its own prediction, which is what the Kalman filter would put there if it had no neighbours.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import Floats
from utn_sumo.prediction.form import Form, Term


def innovations(form: Form, params: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Innovations (T - p, N) of w (T, N), NaN where w is; their derivatives (T - p, k, N) by mean, ar and ma."""
    sites, pad = len(form.sites), max(form.q - form.p, 0)
    first = form.p + pad
    count = form.parts[3].start
    by_mean = np.zeros((count, sites))
    by_mean[form.parts[0]] = -np.eye(sites)[: form.parts[0].stop]
    z = np.concatenate([np.zeros((pad, sites)), w - form.mean_of(params)])
    missing = np.isnan(z)
    dz = np.where(missing[:, None], 0.0, by_mean)
    dz[:pad] = 0.0
    z[missing] = 0.0
    e, de = np.zeros_like(z), np.zeros_like(dz)
    step = np.concatenate([*form.ar_matrices(params), *form.ma_matrices(params), np.zeros((sites, 0))], axis=1)
    lagged_z, lagged_e = (np.einsum("lij,tj->tli", form.weights, series) for series in (z, e))
    ar_lag, ar_order = np.array(form.ar, dtype=np.int64).reshape(-1, 2).T
    ma_lag, ma_order = np.array(form.ma, dtype=np.int64).reshape(-1, 2).T
    ar_back, ma_back = range(1, form.p + 1), range(1, form.q + 1)
    for t in range(first, len(z)):
        past = np.concatenate([*(z[t - i] for i in ar_back), *(e[t - i] for i in ma_back), np.zeros(0)])
        d_past = [*(dz[t - i] for i in ar_back), *(de[t - i] for i in ma_back), np.zeros((count, 0))]
        predicted = step @ past
        d_predicted = np.concatenate(d_past, axis=1) @ step.T
        d_predicted[form.parts[1]] += lagged_z[t - ar_lag, ar_order]
        d_predicted[form.parts[2]] += lagged_e[t - ma_lag, ma_order]
        gone = missing[t]
        e[t] = np.where(gone, 0.0, z[t] - predicted)
        de[t] = np.where(gone, 0.0, dz[t] - d_predicted)
        if gone.any():
            z[t, gone] = predicted[gone]
            dz[t][:, gone] = d_predicted[:, gone]
            lagged_z[t] = form.weights @ z[t]
        if form.q:
            lagged_e[t] = form.weights @ e[t]
    return np.where(missing, np.nan, e)[first:], de[first:]


def loglike(form: Form, params: Floats, w: Floats) -> float:
    """The Gaussian log-likelihood of the innovations; -inf where they can't be reckoned one after the other."""
    variance = form.variance_of(params)
    if (variance <= 0).any() or form.ma_root(params) >= 1:
        return -np.inf
    e, _ = innovations(form, params, w)
    terms = np.log(2 * np.pi * variance) + e**2 / variance
    return -float(np.nansum(terms)) / 2


def slopes(form: Form, params: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Gradient (k,) and information (k, k) of `loglike`; the information is nearly that of the exact likelihood."""
    e, de = innovations(form, params, w)
    variance = form.variance_of(params)
    counts, squares = (~np.isnan(e)).sum(axis=0), np.nansum(e**2, axis=0)
    by_variance = (squares / variance - counts) / (2 * variance)
    of_variance = counts / (2 * variance**2)
    if not form.heteroscedastic:
        by_variance, of_variance = by_variance.sum(keepdims=True), of_variance.sum(keepdims=True)
    gradient = -np.einsum("tkn,tn->k", de, np.nan_to_num(e) / variance)
    scaled = (de / np.sqrt(variance)).transpose(1, 0, 2)
    information = np.zeros((len(params), len(params)))
    information[: len(gradient), : len(gradient)] = np.tensordot(scaled, scaled, axes=((1, 2), (1, 2)))
    information[len(gradient) :, len(gradient) :] = np.diag(of_variance)
    return np.concatenate([gradient, by_variance]), information


def first_guess(form: Form, w: Floats) -> Floats:
    """Hannan and Rissanen's: innovations from a long autoregression, then least squares on them and the series.

    It need be neither stationary nor invertible.
    """
    mean = np.nanmean(w, axis=0) if form.mean else np.zeros(len(form.sites))
    z = np.nan_to_num(w - mean)
    e = np.zeros_like(z)
    long = form.p + form.q + 2
    if form.q and len(z) > 2 * long:
        orders = range(len(form.weights))
        e = _regress(form, z, [(z, [(lag, order) for lag in range(1, long + 1) for order in orders])])[1]
    coefficients, rest = _regress(form, z, [(z, form.ar), (e, form.ma)])
    squares = np.where(np.isnan(w), np.nan, rest) ** 2
    variance = np.nanmean(squares, axis=0) if form.heteroscedastic else np.nanmean(squares, keepdims=True)[0]
    return np.concatenate([mean if form.mean else [], coefficients, np.maximum(variance, np.finfo(float).tiny)])


def _regress(form: Form, z: Floats, terms: list[tuple[Floats, list[Term] | tuple[Term, ...]]]) -> tuple[Floats, Floats]:
    """Least squares of z on lags of series in space and time: the coefficients, and what is left of z (T, N)."""
    first = max((lag for _, each in terms for lag, _ in each), default=0)
    columns = [(form.weights[o] @ x[first - i : len(x) - i].T).T.ravel() for x, each in terms for i, o in each]
    matrix = np.stack(columns, axis=1) if columns else np.zeros((z[first:].size, 0))
    coefficients = np.asarray(np.linalg.lstsq(matrix, z[first:].ravel())[0], dtype=np.float64)
    rest = np.zeros_like(z)
    rest[first:] = z[first:] - (matrix @ coefficients).reshape(z[first:].shape)
    return coefficients, rest
