"""Greens by worth or by wish: they fill the cycles, keep the leasts, and are what they are called."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_controllers import splits
from utn_sumo.contract import Floats, Network
from utn_sumo.testing import random_greens

seeds = st.integers(0, 2**31)
SCALES = (1e-300, 1e-3, 1.0, 1e6)


def worths(network: Network, seed: int) -> Floats:
    """Of every size, and none at all for some stages and some junctions."""
    rng = np.random.default_rng(seed)
    worth = rng.exponential(1.0, len(network.stages)) ** 3 * rng.choice(SCALES)
    worth[rng.random(len(worth)) < 0.3] = 0.0
    worth[rng.random(len(network.junctions))[network.stage_junction] < 0.2] = 0.0
    return worth


def assert_fits(network: Network, green_s: Floats) -> None:
    assert (green_s >= network.min_green_s - 1e-6).all()
    assert np.bincount(network.stage_junction, green_s) == pytest.approx(network.green_budget_s)


@given(seed=seeds)
def test_shared_out_greens_are_in_proportion_or_the_least(utn17: Network, seed: int) -> None:
    worth = worths(utn17, seed)
    green_s = splits.proportional(utn17, worth)
    assert_fits(utn17, green_s)
    for junction in utn17.junctions:
        stages = np.array(junction.stages)
        if not worth[stages].any():
            assert green_s[stages] == pytest.approx(green_s[stages].mean())
            continue
        rate = worth[stages] / worth[stages].max() / green_s[stages]
        above = green_s[stages] > utn17.min_green_s[stages] + 1e-6
        assert rate[above] == pytest.approx(rate[above].mean())
        # Who has the least green would have less by worth.
        assert (rate[~above] <= rate[above].max() * (1 + 1e-6)).all()


@given(seed=seeds, scale=st.floats(1e-6, 1e6))
def test_in_proportion_only_the_ratios_count(utn17: Network, seed: int, scale: float) -> None:
    worth = worths(utn17, seed)
    once, scaled = splits.proportional(utn17, worth), splits.proportional(utn17, worth * scale)
    if worth.max() * scale > 1e-290:
        assert scaled == pytest.approx(once)


@given(seed=seeds, more=st.floats(0, 1e3))
def test_worth_more_never_has_less(utn17: Network, seed: int, more: float) -> None:
    worth = worths(utn17, seed)
    stage = seed % len(worth)
    richer = worth.copy()
    richer[stage] += more
    assert splits.proportional(utn17, richer)[stage] >= splits.proportional(utn17, worth)[stage] - 1e-9


@given(seed=seeds)
def test_no_other_greens_are_nearer_to_the_wish(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    wish_s = rng.normal(0, rng.choice([1.0, 50.0, 1e4]), len(utn17.stages))
    green_s = splits.nearest(utn17, wish_s)
    assert_fits(utn17, green_s)
    for _ in range(20):
        # The wish is beyond a plane through the nearest greens on whose other side all others are.
        other_s = random_greens(utn17, rng)
        assert (wish_s - green_s) @ (other_s - green_s) <= 1e-6 * np.abs(wish_s).max()


@given(seed=seeds)
def test_greens_that_fit_are_their_own_nearest(utn17: Network, seed: int) -> None:
    green_s = random_greens(utn17, np.random.default_rng(seed))
    assert splits.nearest(utn17, green_s) == pytest.approx(green_s)


def test_more_than_the_least_by_hand(utn17: Network) -> None:
    """J1 has 105 s for three stages with 10 s at least; worth 1, 1, 20 leaves the first two short."""
    stages = list(utn17.junctions[0].stages)
    worth, wish_s = np.zeros(len(utn17.stages)), np.zeros(len(utn17.stages))
    worth[stages] = 1, 1, 20
    wish_s[stages] = 0, 50, 80
    assert splits.proportional(utn17, worth)[stages] == pytest.approx([10, 10, 85])
    assert splits.nearest(utn17, wish_s)[stages] == pytest.approx([10, 32.5, 62.5])
