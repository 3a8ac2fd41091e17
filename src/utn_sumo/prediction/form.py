"""The form of a STARIMA: which coefficients it has, where they stand among the parameters, what matrices they make."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from utn_sumo.contract import Floats, Ints

Term = tuple[int, int]
"""(time lag, spatial order) of one coefficient."""


@dataclass(frozen=True)
class Form:
    """Of N series w_t, already differenced, with means mu and innovations e_t of variances sigma2:

    w_t - mu = sum ar_il W_l (w_{t-i} - mu) + sum ma_il W_l e_{t-i} + e_t.

    Parameters stand in the order mean (N), ar, ma, sigma2 (1, or N where each site has its own).
    """

    ar: tuple[Term, ...]
    ma: tuple[Term, ...]
    weights: Floats
    """(1 + orders, N, N), W_0 = I in front."""
    sites: tuple[str, ...]
    mean: bool
    heteroscedastic: bool

    @cached_property
    def p(self) -> int:
        """The longest time lag of the autoregression."""
        return max((lag for lag, _ in self.ar), default=0)

    @cached_property
    def q(self) -> int:
        """The longest time lag of the moving average."""
        return max((lag for lag, _ in self.ma), default=0)

    @cached_property
    def names(self) -> list[str]:
        """Of the parameters, in statsmodels' manner: `ar.L1.S0` is that of time lag 1 and spatial order 0."""
        return [
            *(f"mean.{site}" for site in self.sites if self.mean),
            *(f"ar.L{lag}.S{order}" for lag, order in self.ar),
            *(f"ma.L{lag}.S{order}" for lag, order in self.ma),
            *([f"sigma2.{site}" for site in self.sites] if self.heteroscedastic else ["sigma2"]),
        ]

    @cached_property
    def parts(self) -> tuple[slice, slice, slice, slice]:
        """Where mean, ar, ma and sigma2 stand among the parameters."""
        mean = len(self.sites) * self.mean
        ends = [0, mean, mean + len(self.ar), mean + len(self.ar) + len(self.ma), len(self.names)]
        return slice(*ends[0:2]), slice(*ends[1:3]), slice(*ends[2:4]), slice(*ends[3:5])

    def mean_of(self, params: Any) -> Any:
        """(N,)"""
        return params[self.parts[0]] if self.mean else np.zeros(len(self.sites))

    def variance_of(self, params: Any) -> Any:
        """(N,) of the innovations."""
        return params[self.parts[3]] * np.ones(len(self.sites))

    def ar_matrices(self, params: Any) -> Any:
        """(p, N, N) sum_l ar_il W_l by time lag i = 1..p; of the parameters' own type, complex ones too."""
        return self._matrices(self.ar, self.p, params[self.parts[1]])

    def ma_matrices(self, params: Any) -> Any:
        """(q, N, N) the same of the moving average."""
        return self._matrices(self.ma, self.q, params[self.parts[2]])

    def _matrices(self, terms: tuple[Term, ...], lags: int, coefficients: Any) -> Any:
        by_order = np.zeros((lags, len(self.weights)), dtype=coefficients.dtype)
        for (lag, order), coefficient in zip(terms, coefficients, strict=True):
            by_order[lag - 1, order] = coefficient
        return np.tensordot(by_order, self.weights, 1)

    def ar_root(self, params: Floats) -> float:
        """The largest modulus that the autoregression multiplies a deviation by: stationary below 1."""
        return _largest_root(self.ar_matrices(params))

    def ma_root(self, params: Floats) -> float:
        """The same of how the moving average carries an error in an innovation on: invertible below 1."""
        return _largest_root(-self.ma_matrices(params))


def _largest_root(matrices: Floats) -> float:
    """The largest modulus among the roots of det(I x^n - M_1 x^(n-1) - ... - M_n) = 0; or, if cheaper, a bound below 1.

    Where the rows of |M_1| + ... + |M_n| sum to less than 1 no root is as large as 1, and no eigenvalues are needed.
    """
    if not len(matrices):
        return 0.0
    bound = float(np.abs(matrices).sum(axis=(0, 2)).max())
    if not np.isfinite(bound):
        return np.inf
    if bound < 1:
        return bound
    size = matrices.shape[1]
    companion = np.eye(len(matrices) * size, k=-size)
    companion[:size] = np.concatenate([*matrices], axis=1)
    return float(np.abs(np.linalg.eigvals(companion)).max())


def difference(z: Floats, polynomial: Ints) -> Floats:
    """(T - K, N) of z (T, N): sum_j polynomial_j z_{t-j}, where the polynomial has K + 1 coefficients."""
    span, rows = len(polynomial) - 1, max(0, len(z) - len(polynomial) + 1)
    return np.asarray(sum(c * z[span - j : span - j + rows] for j, c in enumerate(polynomial)))


def difference_polynomial(d: int, seasonal: tuple[int, int]) -> Ints:
    """Coefficients of (1 - B)^d (1 - B^s)^D by power of the backshift B, for seasonal differences (D, s)."""
    times, period = seasonal
    polynomial = np.array([1], dtype=np.int64)
    step = np.zeros(period + 1, dtype=np.int64)
    step[0], step[-1] = 1, -1
    for factor in (*(np.array([1, -1]) for _ in range(d)), *(step for _ in range(times))):
        polynomial = np.convolve(polynomial, factor)
    return polynomial
