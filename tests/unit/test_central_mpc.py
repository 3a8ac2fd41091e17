"""The centralized MPC finds the optimum that the agents are held against, in the loop as from scratch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from utn_controllers.mpc.central import CentralizedMPC, Convex
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.problem import Timing
from utn_controllers.mpc.receding import RecedingProblem
from utn_controllers.mpc.statement import STORAGE_PENALTY
from utn_controllers.mpc.whole import optimum, programs
from utn_sumo import signals
from utn_sumo.contract import Floats, Network, Plan
from utn_sumo.controllers import build
from utn_sumo.errors import SettingError
from utn_sumo.testing import HARD, random_forecast, random_state

HORIZON = 7


def joined(receding: Sequence[RecedingProblem]) -> Timing:
    """What all of them are frozen at."""
    return Timing.joined([each.timing() for each in receding], [each.place for each in receding])


def all_greens(plan: Plan) -> Floats:
    return np.vstack([plan.green_s, np.asarray(plan.ahead_s)])


def planner(mpc: CentralizedMPC) -> Convex:
    assert isinstance(mpc.planner, Convex)
    return mpc.planner


def test_plans_in_the_loop_are_the_optimum_from_scratch(net: Network, cost: str) -> None:
    mpc = CentralizedMPC(net, cost=cost, tolerance=1e-8)
    receding = planner(mpc).receding
    problems = [each.problem for each in receding]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        state, forecast = random_state(net, rng), random_forecast(net, rng, HORIZON)
        best, _ = optimum(problems, state, forecast, joined(receding))
        plan = mpc.plan(state, forecast)
        assert plan.facts["cost"] == pytest.approx(best, rel=1e-6)
        for green_s in all_greens(plan):
            signals.admit(Plan(green_s), net)


def test_no_agents_do_better_and_many_iterations_do_as_well(net: Network, cost: str) -> None:
    rng = np.random.default_rng(9)
    state, forecast = random_state(net, rng), random_forecast(net, rng, HORIZON)
    central = CentralizedMPC(net, cost=cost, tolerance=1e-8)
    receding = planner(central).receding
    problems, timing = [each.problem for each in receding], joined(receding)
    best = central.plan(state, forecast).facts["cost"]
    patient = DistributedMPC(net, cost=cost, iterations=400, tolerance_abs=1e-5, tolerance_rel=1e-6)
    reached, _ = optimum(problems, state, forecast, timing, all_greens(patient.plan(state, forecast)))
    assert -1e-7 <= reached / best - 1 < 1e-4


def test_solutions_agree_on_every_flow_between_junctions(utn17: Network, cost: str) -> None:
    rng = np.random.default_rng(4)
    state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, HORIZON)
    convex = planner(CentralizedMPC(utn17, cost=cost))
    problems = [each.problem for each in convex.receding]
    stated = programs(problems, state, forecast, joined(convex.receding))
    found, solutions = convex.whole.solve(stated)
    total = sum(program.cost(solution) for program, solution in zip(stated, solutions, strict=True))
    assert found == pytest.approx(total, rel=1e-6)
    sent, taken = np.zeros((HORIZON, 17)), np.zeros((HORIZON, 17))
    for problem, solution in zip(problems, solutions, strict=True):
        taken[:, problem.place.links] = solution[problem.layout.inflow]
        for turn, link in enumerate(problem.place.turn_next):
            if link >= 0:
                sent[:, link] += solution[problem.layout.leaving[:, turn]]
    fed = ~utn17.is_source
    assert taken[:, fed] == pytest.approx(sent[:, fed], abs=1e-3)


@pytest.mark.parametrize("case", HARD)
def test_there_is_a_plan_for_every_hard_case(net: Network, cost: str, case: str) -> None:
    mpc = CentralizedMPC(net, cost=cost)
    for seed in range(3):
        signals.admit(mpc.plan(*HARD[case](net, np.random.default_rng(seed), HORIZON)), net)


def test_without_its_constraints_it_promises_more_and_its_greens_fit_no_cycle(utn17: Network, cost: str) -> None:
    crowded = HARD["full"](utn17, np.random.default_rng(2), HORIZON)
    kept, dropped = (CentralizedMPC(utn17, cost=cost, constraints=each).plan(*crowded) for each in ("kept", "dropped"))
    assert dropped.facts["cost"] < kept.facts["cost"]
    assert dropped.green_s.min() >= -1e-6
    sums = np.bincount(utn17.stage_junction, dropped.green_s)
    assert (np.abs(sums - utn17.green_budget_s) > 1).any()


def test_who_pays_for_storage_stays_within_it(utn17: Network) -> None:
    # Exact penalty: the price of a vehicle over storage is above all that holding it elsewhere can cost.
    assert STORAGE_PENALTY > 1 + HORIZON
    state, forecast = HARD["flood"](utn17, np.random.default_rng(1), HORIZON)
    convex = planner(CentralizedMPC(utn17, tolerance=1e-8))
    problems = [each.problem for each in convex.receding]
    _, solutions = convex.whole.solve(programs(problems, state, forecast, joined(convex.receding)))
    for problem, solution in zip(problems, solutions, strict=True):
        assert solution[problem.layout.over_storage].max(initial=0) < 1e-3


def test_settings_that_contradict_each_other_are_refused_in_a_line(utn17: Network) -> None:
    with pytest.raises(SettingError, match="leave one of the two settings out"):
        build("cmpc", utn17, {"transcription": "nlp", "constraints": "dropped"})


def test_the_exact_transcription_plans_step_after_step(utn17: Network) -> None:
    rng, mpc = np.random.default_rng(6), CentralizedMPC(utn17, transcription="nlp", horizon=3)
    state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, 3)
    first = mpc.plan(state, forecast)
    second = mpc.plan(state, forecast)
    for plan in (first, second):
        for green_s in all_greens(plan):
            signals.admit(Plan(green_s), utn17)
    # From the rest of the last plan on, and not from nothing.
    assert second.facts["solver_iterations"] < first.facts["solver_iterations"]
