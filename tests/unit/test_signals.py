"""Nothing reaches the signals that is not safe to show; what does is the wish in whole seconds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo import signals
from utn_sumo.contract import Floats, Network, Plan
from utn_sumo.errors import PlanError

WEIGHTS = st.lists(st.floats(0, 1), min_size=17, max_size=17)


def wish(net: Network, weights: list[float]) -> Floats:
    """A valid plan in real numbers: what the least greens leave is shared by the weights."""
    green = net.min_green_s.copy()
    for junction, budget in zip(net.junctions, net.green_budget_s, strict=True):
        stages = list(junction.stages)
        weight = np.array(weights)[stages] + 1e-3
        green[stages] += (budget - green[stages].sum()) * weight / weight.sum()
    return green


def sums(net: Network, green_s: Floats) -> Floats:
    return np.bincount(net.stage_junction, green_s)


@given(weights=WEIGHTS)
def test_a_valid_wish_is_shown_in_whole_seconds_within_a_second_of_it(utn17: Network, weights: list[float]) -> None:
    wished = wish(utn17, weights)
    shown = signals.admit(Plan(wished), utn17).green_s
    assert (shown == shown.round()).all()
    assert sums(utn17, shown).tolist() == utn17.green_budget_s.tolist()
    assert (shown >= utn17.min_green_s).all()
    assert np.abs(shown - wished).max() < 1


@given(weights=WEIGHTS, seed=st.integers(0, 2**32 - 1))
def test_a_solvers_last_digits_are_forgiven(utn17: Network, weights: list[float], seed: int) -> None:
    noise = np.random.default_rng(seed).uniform(-9e-4, 9e-4, len(utn17.stages))
    shown = signals.admit(Plan(wish(utn17, weights) + noise), utn17).green_s
    assert sums(utn17, shown).tolist() == utn17.green_budget_s.tolist()
    assert (shown >= utn17.min_green_s).all()


def test_the_stage_that_loses_most_by_rounding_gets_the_second_that_is_left(utn17: Network) -> None:
    green = utn17.equal_split().green_s
    green[:3] = 35.1, 35.3, 34.6
    assert signals.admit(Plan(green), utn17).green_s[:3].tolist() == [35, 35, 35]
    green[:3] = 20.2, 50.5, 34.3
    assert signals.admit(Plan(green), utn17).green_s[:3].tolist() == [20, 51, 34]


def test_a_plan_in_whole_seconds_is_shown_as_it_is(utn17: Network) -> None:
    plan = replace(utn17.equal_split(), facts={"iterations": 3})
    admitted = signals.admit(plan, utn17)
    assert admitted.green_s.tolist() == plan.green_s.tolist()
    assert admitted.facts == {"iterations": 3}


def refusal(plan: Plan, net: Network) -> str:
    with pytest.raises(PlanError) as caught:
        signals.admit(plan, net)
    line = str(caught.value)
    assert "\n" not in line
    return line


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_plan_that_is_not_finite_is_refused(utn17: Network, value: float) -> None:
    green = utn17.equal_split().green_s
    green[4] = value
    assert "not finite at stage 4" in refusal(Plan(green), utn17)


@pytest.mark.parametrize("green", [np.zeros(16), np.zeros((1, 17)), np.array(55.0), [], None])
def test_a_plan_of_another_shape_is_refused(utn17: Network, green: Any) -> None:
    assert "17 stages" in refusal(Plan(green), utn17)


@pytest.mark.parametrize("green", [["long"] * 17, [[1.0], [1.0, 2.0]]], ids=["words", "ragged"])
def test_a_plan_that_is_no_row_of_numbers_is_refused(utn17: Network, green: Any) -> None:
    refusal(Plan(green), utn17)


@pytest.mark.parametrize("short_s", [9.9, 0.0, -5.0])
def test_a_green_under_the_least_is_refused(utn17: Network, short_s: float) -> None:
    green = utn17.equal_split().green_s
    green[3:5] = short_s, 110 - short_s
    line = refusal(Plan(green), utn17)
    assert "J2" in line
    assert f"{short_s:g} s" in line


@pytest.mark.parametrize("extra_s", [-1.0, 0.1, 10.0])
def test_greens_that_do_not_fill_the_cycle_are_refused(utn17: Network, extra_s: float) -> None:
    green = utn17.equal_split().green_s
    green[3] += extra_s
    line = refusal(Plan(green), utn17)
    assert "J2" in line
    assert "110 s" in line


def doctored(net: Network, **changed: Any) -> Network:
    """The network with another first stage at J1."""
    return replace(net, stages=(replace(net.stages[0], **changed), *net.stages[1:]))


YELLOW, RED = "yyyrrrrrrr", "rrrrrrrrrr"


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"state": "GGGGGGGrrr"}, "conflict"),
        ({"clearance": (("GGGrrrGrrr", 3.0), (RED, 2.0))}, "conflict"),
        ({"clearance": ((RED, 5.0),)}, "without yellow"),
        ({"clearance": ((YELLOW[1:], 3.0), (RED, 2.0))}, "9 letters for 10 signals"),
        ({"clearance": ((YELLOW, 3.0), (RED, 2.0), (RED, 0.0))}, "whole seconds"),
        ({"clearance": ((YELLOW, 3.5), (RED, 1.5))}, "whole seconds"),
    ],
)
def test_a_network_whose_stages_are_unsafe_is_never_shown(utn17: Network, changed: Any, reason: str) -> None:
    line = refusal(utn17.equal_split(), doctored(utn17, **changed))
    assert "J1" in line
    assert reason in line


def test_a_cycle_shows_every_stage_and_then_its_clearance(utn17: Network) -> None:
    green = utn17.equal_split().green_s
    phases = signals.cycle_phases(utn17, 1, green)
    assert phases == [
        ("GGGrrr", 55), ("yyyrrr", 3), ("rrrrrr", 2), ("rrrGGG", 55), ("rrryyy", 3), ("rrrrrr", 2),
    ]  # fmt: skip


def test_a_programme_that_does_not_fill_its_cycle_is_refused(utn17: Network) -> None:
    phases = signals.cycle_phases(utn17, 1, utn17.equal_split().green_s)
    with pytest.raises(PlanError, match=r"J2.*118 s.*120 s"):
        signals.check_programme(utn17, 1, phases[:-1])


def test_every_stage_may_take_all_the_green_that_the_others_can_spare(utn17: Network) -> None:
    for index, stage in enumerate(utn17.stages):
        green = utn17.equal_split().green_s
        green[list(utn17.junctions[stage.junction].stages)] = 10
        green[index] += utn17.green_budget_s[stage.junction] - green[utn17.stage_junction == stage.junction].sum()
        assert signals.admit(Plan(green), utn17).green_s.tolist() == green.tolist()
