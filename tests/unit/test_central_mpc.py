"""The centralized MPC finds the optimum that the agents are held against, in the loop as from scratch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import daqp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

from utn_controllers.mpc.agent import PATIENCE
from utn_controllers.mpc.central import CentralizedMPC, Convex
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.problem import QuadraticProgram, Timing
from utn_controllers.mpc.receding import RecedingProblem
from utn_controllers.mpc.whole import WIDER, WholeProblem, optimum, programs
from utn_sumo import signals
from utn_sumo.contract import Floats, Forecast, Network, Plan, State
from utn_sumo.controllers import build
from utn_sumo.errors import ControllerError, SettingError
from utn_sumo.testing import HARD, levels, random_forecast, random_split, random_state

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


def almost_empty(net: Network, rng: np.random.Generator) -> tuple[State, Forecast]:
    """Few links with anybody on them, and of these some with a trace of a vehicle only, as an estimator leaves it."""
    empty, forecast = HARD["empty"](net, rng, HORIZON)
    links = len(net.links)
    x = 10.0 ** rng.uniform(-9, 0.5, links) * (rng.random(links) < rng.random())
    queue = x * levels(rng, links)
    past = np.zeros_like(empty.past_inflow_veh)
    past[rng.integers(len(past)), :] = (x - queue) * levels(rng, links)
    share = random_split(net, rng)
    share[rng.random(len(share)) < 0.2] = 0.0
    total = np.bincount(net.turn_link, share, links)
    share = np.where(total[net.turn_link] > 0, share / np.maximum(total[net.turn_link], 1e-9), net.fraction)
    demand = net.is_source * 10.0 ** rng.uniform(-9, 0.5, (HORIZON, links)) * (rng.random((HORIZON, links)) < 0.2)
    state = replace(empty, x_veh=x, q_veh=share * queue[net.turn_link], past_inflow_veh=past, fraction=share)
    return state, replace(forecast, demand_veh=demand)


@pytest.fixture(scope="module")
def stubby(utn17: Network) -> Network:
    """utn17 with some links of a metre and less, which hold a fraction of a vehicle."""
    length_m = {"2": 1.0, "5": 0.2, "10": 0.1, "14": 3.0}
    shorter = [
        replace(link, length_m=length_m[link.id], storage_veh=2 * length_m[link.id] / 7.5)
        if link.id in length_m
        else link
        for link in utn17.links
    ]
    return replace(utn17, name="stubby", links=tuple(shorter))


@given(seed=st.integers(0, 2**32 - 1))
@limits(max_examples=60)
def test_almost_nobody_on_the_road_is_planned_for_too(net: Network, cost: str, seed: int) -> None:
    mpc = MPCS.setdefault((net.name, cost), CentralizedMPC(net, cost=cost, tolerance=1e-9))
    for green_s in all_greens(mpc.plan(*almost_empty(net, np.random.default_rng(seed)))):
        signals.admit(Plan(green_s), net)


MPCS: dict[tuple[str, str], CentralizedMPC] = {}


def by_active_sets(whole: WholeProblem, stated: Sequence[QuadraticProgram]) -> float:
    """Least cost by another solver, which needs no interior."""
    numbers = whole.numbers(stated)
    rows = np.vstack([whole.equal.toarray(), numbers["G"].toarray()])
    upper, lower = (np.concatenate([numbers[x], numbers["b"], numbers[h]]) for x, h in (("x_u", "h_u"), ("x_l", "h_l")))
    sense = np.zeros(len(upper), dtype=np.int32)
    sense[upper == lower] = 5
    solver = daqp.Model()
    # As agents do: on empty roads it takes many steps without progress.
    solver.settings = {"cycle_tol": PATIENCE}
    solver.setup(whole.hessian.toarray(), numbers["c"], rows, upper, lower, sense)
    _, least, flag, _ = solver.solve()
    assert flag in (1, 2)
    return float(least + sum(program.constant for program in stated))


@pytest.mark.long
@pytest.mark.parametrize("case", ["almost empty", *HARD])
def test_another_solver_finds_the_same_least_cost(stubby: Network, cost: str, case: str) -> None:
    convex = planner(CentralizedMPC(stubby, cost=cost))
    problems = [each.problem for each in convex.receding]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        met = almost_empty(stubby, rng) if case == "almost empty" else HARD[case](stubby, rng, HORIZON)
        stated = programs(problems, *met, joined(convex.receding))
        # In turn, so that each is solved after others; what the widest bounds may save is the most of WIDER.
        found, _ = convex.whole.solve(stated)
        assert found == pytest.approx(by_active_sets(convex.whole, stated), rel=1e-5, abs=3e3 * WIDER[-1])


def test_it_stays_as_sure_after_many_plans_as_in_the_first(stubby: Network, cost: str) -> None:
    old = CentralizedMPC(stubby, cost=cost)
    rng = np.random.default_rng(5)
    for _ in range(30):
        old.plan(random_state(stubby, rng), random_forecast(stubby, rng, HORIZON))
    new, last = planner(CentralizedMPC(stubby, cost=cost)), planner(old)
    state, forecast = random_state(stubby, rng), random_forecast(stubby, rng, HORIZON)
    stated = programs([each.problem for each in last.receding], state, forecast, joined(last.receding))
    assert last.whole.solve(stated)[0] == new.whole.solve(stated)[0]
    assert last.whole.iterations == new.whole.iterations


def test_a_problem_without_a_solution_is_told(utn17: Network) -> None:
    rng = np.random.default_rng(1)
    convex = planner(CentralizedMPC(utn17))
    problems = [each.problem for each in convex.receding]
    stated = programs(problems, *HARD["ordinary"](utn17, rng, HORIZON), joined(convex.receding))
    upper = stated[0].upper.copy()
    upper[problems[0].layout.leaving[0]] = -1.0
    with pytest.raises(ControllerError, match="no optimum"):
        convex.whole.solve([replace(stated[0], upper=upper), *stated[1:]])
    # And the next is solved as if nothing had been.
    assert convex.whole.solve(stated)[0] == planner(CentralizedMPC(utn17)).whole.solve(stated)[0]


def test_without_its_constraints_it_promises_more_and_its_greens_fit_no_cycle(utn17: Network, cost: str) -> None:
    crowded = HARD["full"](utn17, np.random.default_rng(2), HORIZON)
    kept, dropped = (CentralizedMPC(utn17, cost=cost, constraints=each).plan(*crowded) for each in ("kept", "dropped"))
    assert dropped.facts["cost"] < kept.facts["cost"]
    assert dropped.green_s.min() >= -1e-6
    sums = np.bincount(utn17.stage_junction, dropped.green_s)
    assert (np.abs(sums - utn17.green_budget_s) > 1).any()


@pytest.mark.parametrize(
    ("cost", "case"), [("tts", "flood"), *(("paper", case) for case in ("full", "one link full", "flood", "disturbed"))]
)
def test_who_pays_for_storage_stays_within_it(net: Network, cost: str, case: str) -> None:
    # With nobody moving nobody is over storage: a plan that keeps within it there always is.
    convex = planner(CentralizedMPC(net, cost=cost, tolerance=1e-8))
    problems = [each.problem for each in convex.receding]
    for seed in range(3):
        state, forecast = HARD[case](net, np.random.default_rng(seed), HORIZON)
        _, solutions = convex.whole.solve(programs(problems, state, forecast, joined(convex.receding)))
        for problem, solution in zip(problems, solutions, strict=True):
            assert solution[problem.layout.over_storage].max(initial=0) < 1e-3


@pytest.mark.parametrize("coordination", ["admm", "sensitivity", "none", None])
@pytest.mark.parametrize(
    "weights",
    [{"q": 1e6}, {"r": 1e6}, {"q": 0.0}, {"q": 1e6, "r": 0.0}, {"crowding": 1e6}, {"terminal": 1e6}],
    ids=str,
)
def test_there_is_a_plan_whatever_the_weights(
    utn17: Network, coordination: str | None, weights: dict[str, float]
) -> None:
    cost = "paper" if {"q", "r"} & weights.keys() else "tts"
    who = {"coordination": coordination} if coordination else {}
    mpc = (DistributedMPC if coordination else CentralizedMPC)(utn17, cost=cost, **weights, **who)
    for case in HARD.values():
        signals.admit(mpc.plan(*case(utn17, np.random.default_rng(1), HORIZON)), utn17)


def test_what_a_plan_costs_is_told_in_the_weights_that_were_given(utn17: Network) -> None:
    case = HARD["ordinary"](utn17, np.random.default_rng(1), HORIZON)
    one, many = (CentralizedMPC(utn17, cost="paper", q=q, r=3 * q).plan(*case).facts["cost"] for q in (0.3, 300.0))
    assert many / 1000 == pytest.approx(one, rel=1e-3)


def test_a_cost_without_weights_is_refused_in_a_line(utn17: Network) -> None:
    for name in ("cmpc", "dmpc"):
        with pytest.raises(SettingError, match=r"q and r are both 0.*give one of them a weight"):
            build(name, utn17, {"cost": "paper", "q": 0, "r": 0})


@pytest.mark.parametrize("beside", [{"constraints": "dropped"}, {"greens": "anywhere"}])
def test_settings_that_contradict_each_other_are_refused_in_a_line(utn17: Network, beside: dict[str, str]) -> None:
    with pytest.raises(SettingError, match="leave one of the two settings out"):
        build("cmpc", utn17, {"transcription": "nlp", **beside})


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
