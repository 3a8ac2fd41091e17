"""Anderson acceleration of the coordination (Walker and Ni 2011): what is agreed next is mixed from the last rounds.

A round takes what is agreed, u, to g(u), and is done when both are the same. Of the last rounds' g the mix
is taken whose residuals g - u, mixed alike, cancel best. Every region holds its own part of these vectors and tells
only inner products; the weights, a handful of numbers, are the same for all.
"""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import Floats

MEMORY = 10
"""Rounds that are mixed."""
REGULARISATION = 1e-8
"""Relative to the sum of squares: rounds that say the same must not be weighed against each other."""
NOTHING = 1e-100
"""Added for rounds that change nothing at all."""
SAFEGUARD = 2.0
"""After a mix whose residual is this many times the last one the memory starts anew."""


class Memory:
    """One region's part of the last rounds, in slots that are used in turn."""

    def __init__(self, size: int) -> None:
        self._residuals = np.zeros((MEMORY, size))
        self._results = np.zeros((MEMORY, size))
        self._slots: list[int] = []
        """Slots in use, the oldest round's first."""

    def push(self, before: Floats, after: Floats, weight: Floats) -> Floats:
        """Remember a round that took `before` to `after` (size,); its residual's inner products (rounds,), newest last.

        `weight` (size,) scales the entries to one unit, and counts what two regions share by half in each.
        """
        slot = self._slots.pop(0) if len(self._slots) == MEMORY else len(self._slots)
        self._slots.append(slot)
        np.subtract(after, before, out=self._residuals[slot])
        self._residuals[slot] *= weight
        self._results[slot] = after
        return np.asarray((self._residuals @ self._residuals[slot])[self._slots])

    def mix(self, weights: Floats) -> Floats:
        """The rounds' results by these weights; older rounds than there are weights are forgotten."""
        if len(weights) < len(self._slots):
            self._residuals[: len(weights)] = self._residuals[self._slots[-len(weights) :]]
            self._results[: len(weights)] = self._results[self._slots[-len(weights) :]]
            self._slots = list(range(len(weights)))
        by_slot = np.zeros(MEMORY)
        by_slot[self._slots] = weights
        return np.asarray(by_slot @ self._results)

    def clear(self) -> None:
        """Forget everything."""
        self._slots = []


class Mixer:
    """Finds the weights, from the inner products summed over the regions."""

    def __init__(self) -> None:
        self._products = np.zeros((0, 0))

    def weights(self, products: Floats) -> Floats:
        """(rounds,) the weights of the next mix, for the newest residual's inner products."""
        kept = len(products) - 1
        table = np.empty((kept + 1, kept + 1))
        table[:kept, :kept] = self._products[len(self._products) - kept :, len(self._products) - kept :]
        table[kept] = table[:, kept] = products
        if kept and table[kept, kept] > SAFEGUARD**2 * table[kept - 1, kept - 1]:
            table = table[kept:, kept:]
        self._products = table
        regular = table.copy()
        diagonal = regular.reshape(-1)[:: len(table) + 1]
        diagonal += REGULARISATION * diagonal.sum() + NOTHING
        found = np.linalg.solve(regular, np.ones(len(table)))
        return np.asarray(found / found.sum())
