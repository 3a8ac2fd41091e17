"""Many sparse symmetric systems of one pattern at a time: K = L D L', for matrices that need no pivoting.

The numbers of `lanes` systems lie side by side, so that one instruction works on several. A stack of systems is
(stacks, numbers, lanes). Quasi-definite matrices, as a quadratic programme's, can be factorised so in any order of
their rows (Vanderbei 1995); no library does it for a batch on a processor.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from utn_sumo.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints


class Factorisation:
    """Where a factor has numbers, for matrices with numbers where `pattern` (n, n) has them, the diagonal always."""

    def __init__(self, pattern: Bools):
        size = len(pattern)
        # SuperLU finds the order that fills in least, and, on any values that need no pivots, the fill-in itself.
        values = np.where(pattern | pattern.T, -1.0, 0.0)
        np.fill_diagonal(values, size + 1.0)
        options = {"SymmetricMode": True, "Equil": False}
        found = splu(sp.csc_array(values), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, relax=1, options=options)
        self.position: Ints = np.asarray(found.perm_c, dtype=np.int64)
        """(n,) where each row of the matrix is in the factor."""
        factor = sp.tril(found.L, -1, format="csc")
        factor.sort_indices()
        self.starts = factor.indptr.astype(np.int64)
        """(n + 1,) where each column of L begins."""
        self.rows = factor.indices.astype(np.int64)
        columns = np.repeat(np.arange(size), np.diff(self.starts))
        self._at = np.full((size, size), -1)
        self._at[self.rows, columns] = np.arange(len(self.rows))
        self.targets = self._eliminations()

    def _eliminations(self) -> Ints:
        """What each pair of numbers in a column changes, in turn: a number of L, or of D by -1 - its row."""
        targets = [np.zeros(0, dtype=np.int64)]
        for start, end in zip(self.starts[:-1], self.starts[1:], strict=True):
            below = self.rows[start:end]
            first, second = np.tril_indices(len(below))
            pair = self._at[below[first], below[second]]
            targets.append(np.where(first == second, -1 - below[first], pair))
        return np.concatenate(targets)

    def places(self, rows: Ints, columns: Ints) -> Ints:
        """Where in L the matrix' numbers at these places off its diagonal belong."""
        first, second = self.position[rows], self.position[columns]
        return np.asarray(self._at[np.maximum(first, second), np.minimum(first, second)])


@compiled
def factorise(lower: Floats, diagonal: Floats, starts: Ints, targets: Ints) -> None:
    """Turn the numbers of matrices into those of L and 1/D.

    `lower` is (stacks, numbers of L, lanes), `diagonal` (stacks, n, lanes).
    """
    for stack in range(len(diagonal)):
        at = 0
        for column in range(len(starts) - 1):
            count = starts[column + 1] - starts[column]
            own = lower[stack, starts[column] : starts[column] + count]
            end = at + count * (count + 1) // 2
            _eliminate(own, diagonal[stack, column], lower[stack], diagonal[stack], targets[at:end])
            at = end


@compiled
def _eliminate(own: Floats, pivot: Floats, lower: Floats, diagonal: Floats, targets: Ints) -> None:
    """One column's numbers `own` out of the later ones, each pair's out of its target."""
    at = 0
    count, lanes = own.shape
    scaled = np.empty_like(own)
    for lane in range(lanes):
        pivot[lane] = 1 / pivot[lane]
    for first in range(count):
        for lane in range(lanes):
            scaled[first, lane] = own[first, lane] * pivot[lane]
        for second in range(first + 1):
            target = targets[at]
            at += 1
            changed = diagonal[-1 - target] if target < 0 else lower[target]
            for lane in range(lanes):
                changed[lane] -= scaled[first, lane] * own[second, lane]
    own[:] = scaled


@compiled
def substitute(lower: Floats, inverse: Floats, starts: Ints, rows: Ints, right: Floats) -> None:
    """Turn the right-hand sides `right` (n, lanes) of one stack, in the factor's order, into the solutions."""
    size, lanes = right.shape
    for column in range(size):
        known = right[column]
        for place in range(starts[column], starts[column + 1]):
            factor, changed = lower[place], right[rows[place]]
            for lane in range(lanes):
                changed[lane] -= factor[lane] * known[lane]
    for column in range(size - 1, -1, -1):
        unknown, pivot = right[column], inverse[column]
        for lane in range(lanes):
            unknown[lane] *= pivot[lane]
        for place in range(starts[column], starts[column + 1]):
            factor, known = lower[place], right[rows[place]]
            for lane in range(lanes):
                unknown[lane] -= factor[lane] * known[lane]
