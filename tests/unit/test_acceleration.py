"""Mixing the last rounds finds the fixed point of a linear round at once, wherever its parts are kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_controllers.mpc.acceleration import MEMORY, Memory, Mixer
from utn_sumo.contract import Floats

SEEDS = st.integers(0, 2**32 - 1)


def contraction(rng: np.random.Generator, size: int) -> tuple[Floats, Floats, Floats]:
    """A linear round u -> Au + b that shrinks, and its fixed point."""
    matrix = rng.normal(size=(size, size))
    matrix *= 0.9 / np.abs(np.linalg.eigvals(matrix)).max()
    constant = rng.normal(size=size)
    return matrix, constant, np.linalg.solve(np.eye(size) - matrix, constant)


@given(seed=SEEDS, size=st.integers(1, 6))
def test_a_linear_round_is_at_its_fixed_point_after_as_many_rounds_as_it_has_numbers(seed: int, size: int) -> None:
    matrix, constant, fixed = contraction(np.random.default_rng(seed), size)
    memory, mixer, u = Memory(size), Mixer(), np.zeros(size)
    first = np.linalg.norm(constant)
    for _ in range(6 * size + 6):
        after = matrix @ u + constant
        u = memory.mix(mixer.weights(memory.push(u, after, np.ones(size))))
    plain = np.zeros(size)
    for _ in range(6 * size + 6):
        plain = matrix @ plain + constant
    error, plain_error = (np.linalg.norm(each - fixed) for each in (u, plain))
    assert error <= max(1e-5 * first * np.linalg.cond(np.eye(size) - matrix), 1.1 * plain_error)


@given(seed=SEEDS)
def test_two_regions_come_to_the_weights_of_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole, parts, mixer, summed = Memory(10), (Memory(4), Memory(6)), Mixer(), Mixer()
    for _ in range(MEMORY + 3):
        before, after, weight = rng.normal(size=(3, 10)) + 2
        products = sum(
            part.push(before[where], after[where], np.abs(weight[where]))
            for part, where in zip(parts, (slice(4), slice(4, 10)), strict=True)
        )
        weights = mixer.weights(whole.push(before, after, np.abs(weight)))
        assert weights.sum() == pytest.approx(1)
        assert summed.weights(np.asarray(products)) == pytest.approx(weights, rel=1e-4, abs=1e-6)
        mixed = whole.mix(weights)
        assert np.concatenate([part.mix(weights) for part in parts]) == pytest.approx(mixed, rel=1e-9)


def test_after_a_leap_that_led_astray_the_memory_starts_anew() -> None:
    memory, mixer = Memory(1), Mixer()
    for residual in (1.0, 0.5, 5.0):
        weights = mixer.weights(memory.push(np.zeros(1), np.array([residual]), np.ones(1)))
        mixed = memory.mix(weights)
    assert weights.tolist() == [1.0]
    assert mixed.tolist() == [5.0]


def test_a_round_that_changes_nothing_stays_where_it_is() -> None:
    memory, mixer, u = Memory(3), Mixer(), np.array([1.0, 2.0, 3.0])
    for _ in range(MEMORY + 2):
        u = memory.mix(mixer.weights(memory.push(u, u, np.ones(3))))
    assert u == pytest.approx([1, 2, 3])
