"""Spatial weights: who is whose neighbour, of which order, and how much each neighbour counts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from utn_sumo.contract import EXIT, Floats, Ints, Network
from utn_sumo.errors import SettingError, did_you_mean

Weights = Sequence[npt.ArrayLike] | Floats
"""W_1..W_k, or W_0..W_k with W_0 = I: each (N, N)."""
NEIGHBOURS = ("upstream", "nearest")


def checked(weights: Weights, sites: int) -> Floats:
    """(1 + orders, N, N) spatial weights with W_0 = I in front, given W_1..W_k or W_0..W_k with W_0 = I.

    Each row is divided by its sum, so that a matrix of zeros and ones does; a row of zeros, a site without
    neighbours of that order, stays zero. Raises SettingError for a wrong shape, for negative or non-finite weights,
    for two orders that are the same.
    """
    given = [np.array(matrix, dtype=np.float64) for matrix in weights]
    identity = np.eye(sites)
    if not given or given[0].shape != identity.shape or (given[0] != identity).any():
        given.insert(0, identity)
    for order, matrix in enumerate(given):
        if matrix.shape != (sites, sites):
            raise SettingError(
                f"weights: W_{order} has shape {matrix.shape}; {sites} series want ({sites}, {sites})"
                " in a list of such matrices, one per spatial order"
            )
        wrong = ~np.isfinite(matrix) | (matrix < 0)
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            raise SettingError(
                f"weights: W_{order}[{row}, {column}] is {matrix[row, column]:g}; weights are finite and not negative"
            )
    found = np.stack([_rows_to_one(matrix) for matrix in given])
    for order, matrix in enumerate(found):
        for other in range(order):
            if matrix.any() and (matrix == found[other]).all():
                raise SettingError(f"weights: W_{order} and W_{other} are the same; give each order its own neighbours")
    return found


def network_weights(
    network: Network,
    orders: int,
    links: Sequence[int] | None = None,
    neighbours: Literal["upstream", "nearest"] = "upstream",
) -> list[Floats]:
    """W_1..W_orders, each (n, n), for series measured on `links` of a network (default: on all, in their order).

    `upstream`: the neighbours of order l are the links l turns upstream and no fewer, since traffic now depends on the
    traffic that was upstream before; each weighs by the share of its traffic that comes down here in l turns (the
    product of the turning fractions, summed over the ways). Links outside `links` are passed through, not left out.

    `nearest`: for series of demand, whose links nothing feeds. The neighbours of order 1 are the other links fewest
    turns away, with or against the traffic, those of order 2 the next nearest, and so on; all weigh the same.

    Rows sum to 1, or to 0 where a link has no such neighbours.
    """
    if orders < 1:
        raise SettingError(f"orders: {orders} is no spatial order; ask for 1 or more")
    if neighbours not in NEIGHBOURS:
        raise SettingError(f"neighbours: {neighbours!r} is unknown; {did_you_mean(neighbours, NEIGHBOURS)}")
    count = len(network.links)
    chosen = np.arange(count) if links is None else np.array(links, dtype=np.int64)
    if chosen.ndim != 1 or not len(chosen) or chosen.min() < 0 or chosen.max() >= count:
        raise SettingError(f"links: {links} are not links of {network.name!r}; give indices from 0 to {count - 1}")
    feeds = _feeds(network)
    found = _upstream(feeds, orders) if neighbours == "upstream" else _nearest(_hops(feeds + feeds.T), chosen, orders)
    return [_rows_to_one(matrix[np.ix_(chosen, chosen)]) for matrix in found]


def _feeds(network: Network) -> Floats:
    """(Z, Z) share of each link's traffic (column) that goes on to a link (row)."""
    feeds = np.zeros((len(network.links),) * 2)
    inside = network.turn_next != EXIT
    np.add.at(feeds, (network.turn_next[inside], network.turn_link[inside]), network.fraction[inside])
    return feeds


def _upstream(feeds: Floats, orders: int) -> list[Floats]:
    hops, reach = _hops(feeds), np.eye(len(feeds))
    found = []
    for order in range(1, orders + 1):
        reach = feeds @ reach
        found.append(np.where(hops == order, reach, 0.0))
    return found


def _nearest(hops: Ints, chosen: Ints, orders: int) -> list[Floats]:
    found = [np.zeros(hops.shape) for _ in range(orders)]
    for row in chosen:
        away = {int(distance) for distance in hops[row, chosen] if distance > 0}
        for matrix, distance in zip(found, sorted(away), strict=False):
            matrix[row] = hops[row] == distance
    return found


def _hops(joined: Floats) -> Ints:
    """(Z, Z) fewest steps from each link (column) to each (row) where `joined` has a way; -1 where there is none."""
    step = joined > 0
    hops = np.where(np.eye(len(joined), dtype=np.bool_), 0, -1)
    reached = hops == 0
    for distance in range(1, len(joined)):
        reached = step @ reached
        fresh = reached & (hops < 0)
        if not fresh.any():
            break
        hops[fresh] = distance
    return hops


def _rows_to_one(matrix: Floats) -> Floats:
    sums = matrix.sum(axis=1, keepdims=True)
    return np.asarray(matrix / np.where(sums > 0, sums, 1.0))
