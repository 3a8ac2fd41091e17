"""The exact problem predicts what the model does, and its greens are better than the relaxed problem's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_controllers.mpc.exact import OPTIONS, ExactProblem, ExactSolution, rolled_out_cost, smooth_windows
from utn_controllers.mpc.place import places
from utn_controllers.mpc.problem import JunctionProblem, Timing
from utn_controllers.mpc.settings import ProblemSettings
from utn_controllers.mpc.whole import optimum
from utn_sumo import signals
from utn_sumo.contract import Floats, Forecast, Network, Plan, State
from utn_sumo.errors import ControllerError
from utn_sumo.model import LinkModel, ModelState, NumpyOperations, SmoothOperations, green_windows
from utn_sumo.testing import HARD, levels, random_forecast, random_greens, random_state

HORIZON, KEPT = 7, 4
Case = tuple[State, Forecast]


def settings_of(cost: str, **chosen: Any) -> ProblemSettings:
    return ProblemSettings.model_validate({"cost": cost, **chosen})


@pytest.fixture(scope="module")
def problem(net: Network, cost: str) -> ExactProblem:
    return ExactProblem(net, settings_of(cost))


@pytest.fixture(scope="module")
def solved(problem: ExactProblem) -> Callable[[int], tuple[Case, ExactSolution]]:
    """Case and solution of a seed, from the equal split."""

    def solve(seed: int) -> tuple[Case, ExactSolution]:
        case = some_case(problem.network, seed)
        return case, problem.solve(*case, equal_greens(problem.network))

    return cache(solve)


def some_case(net: Network, seed: int, horizon: int = HORIZON) -> Case:
    rng = np.random.default_rng(seed)
    return random_state(net, rng), random_forecast(net, rng, horizon)


def equal_greens(net: Network, kept: int = KEPT) -> Floats:
    return np.tile(net.equal_split().green_s, (kept, 1))


def relaxed_greens(net: Network, settings: ProblemSettings, case: Case) -> Floats:
    """Greens (Kc, S) of the convex problem frozen at the equal split."""
    problems = [JunctionProblem(place, settings) for place in places(net)]
    timing = Timing.of(LinkModel(net, net.control_step_s), net.equal_split().green_s)
    _, solutions = optimum(problems, *case, timing)
    greens = np.zeros((KEPT, len(net.stages)))
    for each, solution in zip(problems, solutions, strict=True):
        greens[:, each.place.stages] = each.greens(solution)
    return greens


@pytest.mark.parametrize("seed", range(3))
def test_what_is_predicted_is_what_the_model_does(
    problem: ExactProblem, solved: Callable[[int], tuple[Case, ExactSolution]], seed: int
) -> None:
    case, found = solved(seed)
    real = rolled_out_cost(problem.network, problem.settings, *case, found.greens_s)
    assert found.cost == pytest.approx(real, rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_greens_cost_less_than_the_equal_split_and_than_the_relaxed_problems(
    problem: ExactProblem, solved: Callable[[int], tuple[Case, ExactSolution]], seed: int
) -> None:
    net, settings = problem.network, problem.settings
    case, found = solved(seed)
    tried = [found.greens_s, equal_greens(net), relaxed_greens(net, settings, case)]
    best, equal, relaxed = (rolled_out_cost(net, settings, *case, greens) for greens in tried)
    assert best < 0.999 * equal
    assert best < relaxed


def test_greens_fill_every_cycle_and_keep_every_least(
    problem: ExactProblem, solved: Callable[[int], tuple[Case, ExactSolution]]
) -> None:
    for seed in range(3):
        _, found = solved(seed)
        assert found.greens_s.shape == (KEPT, len(problem.network.stages))
        for green_s in found.greens_s:
            signals.admit(Plan(green_s), problem.network)


def test_from_its_own_solution_it_takes_fewer_iterations_and_stays_there(
    problem: ExactProblem, solved: Callable[[int], tuple[Case, ExactSolution]]
) -> None:
    for seed in range(3):
        case, found = solved(seed)
        again = problem.solve(*case, found.greens_s, near=True)
        assert again.iterations < found.iterations
        assert again.cost == pytest.approx(found.cost, rel=1e-3)


@pytest.mark.parametrize("case", HARD)
def test_there_is_a_plan_for_every_hard_case(utn17: Network, tts_problem: ExactProblem, case: str) -> None:
    state, forecast = HARD[case](utn17, np.random.default_rng(0), HORIZON)
    found = tts_problem.solve(state, forecast, equal_greens(utn17), near=True)
    for green_s in found.greens_s:
        signals.admit(Plan(green_s), utn17)


@pytest.fixture(scope="module")
def tts_problem(utn17: Network) -> ExactProblem:
    return ExactProblem(utn17, settings_of("tts"))


def test_where_the_green_stands_is_foreseen_in_a_finer_model_step_and_with_mixed_cycles(utn17: Network) -> None:
    clocks = [(120.0, 0.0), (60.0, 20.0), (120.0, 45.0), (60.0, 0.0)] * 2
    junctions = [replace(each, cycle_s=c, offset_s=o) for each, (c, o) in zip(utn17.junctions, clocks, strict=True)]
    mixed = replace(utn17, name="mixed", junctions=tuple(junctions))
    settings = settings_of("tts", step_s=60.0, horizon=2)
    finer = ExactProblem(mixed, settings)
    for seed in range(3):
        case, start = some_case(mixed, seed, 2), equal_greens(mixed, 2)
        found = finer.solve(*case, start)
        real, equal = (rolled_out_cost(mixed, settings, *case, greens) for greens in (found.greens_s, start))
        assert found.cost == pytest.approx(real, rel=0.01)
        assert real < equal


@pytest.mark.parametrize("step_s", [120.0, 60.0, 20.0])
def test_smooth_windows_are_the_green_windows(utn17: Network, step_s: float) -> None:
    import casadi as ca

    shifted = replace(utn17, junctions=tuple(replace(each, offset_s=35.0) for each in utn17.junctions))
    # A turn that stays green through the clearance of its stage, one that is early for the next, and one unsignalled.
    holding = replace(utn17.stages[0], held=(utn17.stages[0].turns[:1], utn17.stages[1].turns[:1]))
    held = replace(
        utn17,
        stages=(holding, *(replace(s, turns=tuple(t for t in s.turns if t != 5)) for s in utn17.stages[1:])),
        junctions=tuple(
            replace(j, signal_turns=tuple(tuple(t for t in turns if t != 5) for turns in j.signal_turns))
            for j in shifted.junctions
        ),
    )
    # Cycles that do not divide the control step, as that is of the longest.
    cycles_s = (120.0, 90.0, 70.0, 110.0, 120.0, 90.0, 100.0, 80.0)
    odd = replace(
        held, junctions=tuple(replace(j, cycle_s=own) for j, own in zip(held.junctions, cycles_s, strict=True))
    )
    # No green begins in the last second of a step: the rounded end of that one is in between.
    rng = np.random.default_rng(1)
    for net in (utn17, shifted, held, odd):
        model, green = LinkModel(net, step_s, SmoothOperations(1e-4, 1e-4)), ca.SX.sym("green", len(net.stages))
        steps = range(round(net.control_step_s / step_s))
        symbols = ca.Function(
            "windows", [green], [each for step in steps for each in smooth_windows(model, green, step * step_s)]
        )
        green_s = random_greens(net, rng)
        exact, found = green_windows(net, green_s, step_s), [np.array(each).ravel() for each in symbols(green_s)]
        assert np.array(found[::3]) == pytest.approx(exact.shown_s, abs=1e-3)
        assert np.array(found[1::3]) == pytest.approx(exact.held_s, abs=1e-3)
        tiny = ((exact.shown_s > 0) & (exact.shown_s < 1.5)) @ net.serves > 0
        clear = (exact.end_s > 0) & ~tiny & ((exact.held_s == 0) | (exact.held_s > 1.5))
        assert np.array(found[2::3])[clear] == pytest.approx(exact.end_s[clear], abs=1e-3)


@given(seed=st.integers(0, 2**32 - 1))
def test_flows_that_begin_with_the_right_inflow_and_room_stay_right(utn17: Network, seed: int) -> None:
    rng, model = np.random.default_rng(seed), LinkModel(utn17, 120.0)
    state, forecast = some_case(utn17, seed, 1)
    windows = green_windows(utn17, random_greens(utn17, rng), 120.0)
    start = ModelState(
        state.x_veh, state.q_veh, state.source_queue_veh, model.history(state.past_inflow_veh, utn17.sample_s)
    )
    inputs = start, windows.shown_s[0], forecast.demand_veh[0], state.fraction, windows.end_s[0]
    _, flows = model.step(*inputs)
    again = model.flows(model.terms(*inputs), flows.inflow_veh, flows.open_room_veh)
    for name, number in vars(flows).items():
        assert getattr(again, name) == pytest.approx(number, abs=1e-9)


def test_rounding_is_off_by_half_an_epsilon_at_most() -> None:
    import casadi as ca

    rng, smooth, exact = np.random.default_rng(1), SmoothOperations(0.2, 0.04), NumpyOperations()
    a, b = 3 * levels(rng, 200), 3 * levels(rng, 200) - 1
    assert np.array(smooth.minimum(ca.DM(a), ca.DM(b))).ravel() == pytest.approx(exact.minimum(a, b), abs=0.1)
    assert np.array(smooth.maximum(ca.DM(a), ca.DM(b))).ravel() == pytest.approx(exact.maximum(a, b), abs=0.1)
    assert np.array(smooth.share(ca.DM(b))).ravel() == pytest.approx(exact.share(b), abs=0.02)


@pytest.mark.parametrize("name", ["x_veh", "fraction", "past_inflow_veh"])
def test_a_state_that_is_no_number_is_an_error_in_one_line(
    utn17: Network, tts_problem: ExactProblem, name: str
) -> None:
    state, forecast = some_case(utn17, 0)
    broken = replace(state, **{name: np.full_like(getattr(state, name), np.nan)})
    with pytest.raises(ControllerError, match="not finite"):
        tts_problem.solve(broken, forecast, equal_greens(utn17))


def test_an_answer_that_the_solver_does_not_vouch_for_is_none(utn17: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(OPTIONS, "ipopt.max_iter", 2)
    hasty = ExactProblem(utn17, settings_of("tts", horizon=2))
    with pytest.raises(ControllerError, match=r"no solution \(Maximum_Iterations_Exceeded after 8 iterations\)"):
        hasty.solve(*some_case(utn17, 0), equal_greens(utn17, 2))


def test_where_least_greens_fill_every_cycle_these_are_the_plan_and_nobody_is_warned(
    utn17: Network, capfd: pytest.CaptureFixture[str]
) -> None:
    equal_s = utn17.equal_split().green_s
    stages = tuple(replace(each, min_green_s=own) for each, own in zip(utn17.stages, equal_s.tolist(), strict=True))
    fixed = ExactProblem(replace(utn17, stages=stages), settings_of("tts", horizon=2))
    for seed in range(3):
        found = fixed.solve(*some_case(utn17, seed, 2), equal_greens(utn17, 2))
        assert found.greens_s == pytest.approx(np.tile(equal_s, (2, 1)))
    assert capfd.readouterr() == ("", "")


def test_greens_that_fit_no_cycle_are_an_error_in_one_line(utn17: Network) -> None:
    # Three stages of 40 s and more in a cycle that leaves 105 s.
    stages = tuple(replace(each, min_green_s=40.0) if each.junction == 0 else each for each in utn17.stages)
    crowded = ExactProblem(replace(utn17, stages=stages), settings_of("tts", horizon=1))
    with pytest.raises(ControllerError, match=r"impossible \(.*LBX.*\)$"):
        crowded.solve(*some_case(utn17, 0), equal_greens(utn17, 1))
