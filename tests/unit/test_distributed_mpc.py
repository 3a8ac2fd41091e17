"""The agents' plans are feasible and, given iterations, as good as those of the whole problem solved at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import Any

import daqp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.integration import odd_nets
from utn_controllers.mpc.agent import Agent
from utn_controllers.mpc.central import CentralizedMPC
from utn_controllers.mpc.distributed import DistributedMPC, Settings
from utn_controllers.mpc.place import places, remaining_steps
from utn_controllers.mpc.problem import JunctionProblem, QuadraticProgram, Timing
from utn_controllers.mpc.statement import REGULARISATION
from utn_controllers.mpc.whole import optimum, programs
from utn_sumo import signals
from utn_sumo.contract import EXIT, Floats, Forecast, Network, Plan, State
from utn_sumo.errors import ControllerError, SettingError
from utn_sumo.model import LinkModel, ModelState, StepFlows, green_windows
from utn_sumo.testing import HARD, random_forecast, random_greens, random_state

SEEDS = st.integers(0, 2**32 - 1)
HORIZON = 7


def retimed(net: Network, name: str, *clocks: tuple[float, float]) -> Network:
    """The network with these (cycle, offset) at its junctions, over and over."""
    junctions = [
        replace(junction, cycle_s=cycle_s, offset_s=offset_s)
        for junction, (cycle_s, offset_s) in zip(net.junctions, cycle(clocks), strict=False)
    ]
    return replace(net, name=name, junctions=tuple(junctions))


@pytest.fixture(scope="module")
def mixed(utn17: Network) -> Network:
    """utn17 with junctions of 60 and of 120 s, some of them offset."""
    return retimed(utn17, "mixed", (120, 0), (60, 20), (120, 45), (60, 0))


@pytest.fixture(scope="module")
def motley(utn17: Network) -> Network:
    """utn17 with junctions of 60, 90 and 120 s: a control step of 360 s."""
    return retimed(utn17, "motley", (120, 0), (60, 20), (90, 40))


@pytest.fixture(params=["utn17", "utn17-long", "mixed"], scope="module")
def any_net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network, mixed: Network) -> Network:
    return {"utn17": utn17, "utn17-long": utn17_long, "mixed": mixed}[request.param]


def quiet_state(net: Network, x: Floats | None = None, q: Floats | None = None) -> State:
    """Nobody on the road but `x` (Z,) and, among these, the queues `q` (M,)."""
    links, turns = np.zeros(len(net.links)), np.zeros(len(net.turns))
    q = turns if q is None else q
    on_links = np.bincount(net.turn_link, q).astype(float) if x is None else x
    past = np.zeros((net.delay_samples, len(net.links)))
    return State(0, 0.0, on_links, q, links, past, turns, net.fraction, links)


def some_forecast(net: Network, rng: np.random.Generator, horizon: int = HORIZON) -> Forecast:
    return random_forecast(net, rng, horizon)


def all_greens(plan: Plan) -> Floats:
    return plan.green_s[None] if plan.ahead_s is None else np.vstack([plan.green_s, plan.ahead_s])


def assert_admissible(net: Network, plan: Plan) -> None:
    for green_s in all_greens(plan):
        signals.admit(Plan(green_s), net)


def test_greens_fill_every_cycle_and_keep_every_least(net: Network, cost: str) -> None:
    rng, mpc = np.random.default_rng(19), DistributedMPC(net, cost=cost)
    for _ in range(10):
        plan = mpc.plan(random_state(net, rng), some_forecast(net, rng))
        assert plan.green_s.shape == (17,)
        assert plan.ahead_s is not None
        assert plan.ahead_s.shape == (3, 17)
        assert_admissible(net, plan)


@pytest.mark.parametrize("coordination", ["admm", "sensitivity", "none"])
@pytest.mark.parametrize("case", HARD)
def test_there_is_a_plan_for_every_hard_case(net: Network, cost: str, coordination: str, case: str) -> None:
    mpc = DistributedMPC(net, cost=cost, coordination=coordination)
    for seed in range(3):
        assert_admissible(net, mpc.plan(*HARD[case](net, np.random.default_rng(seed), HORIZON)))


@pytest.mark.parametrize("coordination", ["admm", "sensitivity", "none"])
def test_there_is_a_plan_where_the_least_greens_of_a_junction_fill_its_cycle(utn17: Network, coordination: str) -> None:
    for shares in ([1 / 3, 1 / 3, 1 / 3], [0.2, 0.3, 0.5]):
        least_s = utn17.min_green_s.copy()
        least_s[list(utn17.junctions[0].stages)] = utn17.green_budget_s[0] * np.array(shares)
        stages = zip(utn17.stages, least_s.tolist(), strict=True)
        full = replace(utn17, stages=tuple(replace(stage, min_green_s=own) for stage, own in stages))
        mpc = DistributedMPC(full, coordination=coordination)
        for case in HARD.values():
            assert_admissible(full, mpc.plan(*case(full, np.random.default_rng(1), HORIZON)))


def test_at_the_default_stop_plans_are_within_a_thousandth_of_the_best(utn17: Network, cost: str) -> None:
    for seed in range(10):
        rng = np.random.default_rng([seed, 4])
        assert (
            gap_to_the_optimum(DistributedMPC(utn17, cost=cost), random_state(utn17, rng), some_forecast(utn17, rng))
            < 1e-3
        )


def test_a_price_on_what_neighbours_get_is_better_than_none_and_consensus_better_than_a_price(
    utn17: Network, cost: str
) -> None:
    gaps: dict[str, list[float]] = {"admm": [], "sensitivity": [], "none": []}
    for seed in range(5):
        for mode, found in gaps.items():
            rng = np.random.default_rng(seed)
            mpc = DistributedMPC(utn17, cost=cost, coordination=mode)
            found.append(gap_to_the_optimum(mpc, random_state(utn17, rng), some_forecast(utn17, rng)))
    admm, sensitivity, none = (np.mean(found) for found in gaps.values())
    assert admm < sensitivity < 0.5 * none


def test_agents_for_themselves_exchange_nothing_and_answer_once(utn17: Network) -> None:
    facts = ask(DistributedMPC(utn17, coordination="none")).facts
    assert facts["bytes_exchanged"] == 0
    assert facts["iterations"] == 1


def patient(net: Network, **chosen: Any) -> DistributedMPC:
    return DistributedMPC(net, iterations=400, tolerance_abs=1e-4, tolerance_rel=1e-5, **chosen)


def gap_to_the_optimum(mpc: DistributedMPC, state: State, forecast: Forecast) -> float:
    """How much dearer the next plan is than the best one, as a share."""
    problems, timing = [agent.problem for agent in mpc.agents], mpc.timing()
    best, _ = optimum(problems, state, forecast, timing)
    reached, _ = optimum(problems, state, forecast, timing, all_greens(mpc.plan(state, forecast)))
    return (reached - best) / abs(best)


@pytest.mark.parametrize("seed", range(2))
def test_many_iterations_reach_the_optimum_of_the_whole_problem(net: Network, cost: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    gap = gap_to_the_optimum(patient(net, cost=cost), random_state(net, rng), some_forecast(net, rng))
    assert -1e-6 <= gap <= 1e-3


@pytest.mark.parametrize("step_s", [60.0, 30.0])
def test_so_they_do_with_a_finer_model_step_and_with_mixed_cycles(mixed: Network, cost: str, step_s: float) -> None:
    rng = np.random.default_rng(17)
    mpc = patient(mixed, cost=cost, horizon=2, step_s=step_s)
    gap = gap_to_the_optimum(mpc, random_state(mixed, rng), some_forecast(mixed, rng, 2))
    assert -1e-6 <= gap <= 1e-3


def test_a_plan_answers_to_the_present_state_and_not_to_an_earlier_one(net: Network, cost: str) -> None:
    rng = np.random.default_rng(13)
    mpc = patient(net, cost=cost)
    for _ in range(3):
        assert gap_to_the_optimum(mpc, random_state(net, rng), some_forecast(net, rng)) <= 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_time_spent_is_never_saved_by_filling_a_link_beyond_its_storage(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    problems = problems_of(utn17, HORIZON)
    timing = Timing.of(LinkModel(utn17, utn17.control_step_s), random_greens(utn17, rng))
    _, solutions = optimum(problems, random_state(utn17, rng), some_forecast(utn17, rng), timing)
    for problem, solution in zip(problems, solutions, strict=True):
        assert solution[problem.layout.over_storage].max(initial=0) < 1e-3


def test_a_better_plan_than_the_equal_split_is_found(utn17: Network) -> None:
    rng = np.random.default_rng(3)
    state, forecast = random_state(utn17, rng), some_forecast(utn17, rng)
    mpc = DistributedMPC(utn17)
    problems, timing = [agent.problem for agent in mpc.agents], mpc.timing()
    greens, equal = all_greens(mpc.plan(state, forecast)), np.tile(utn17.equal_split().green_s, (4, 1))
    found, split = (optimum(problems, state, forecast, timing, plan)[0] for plan in (greens, equal))
    assert found < split


def time_spent(net: Network, state: State, forecast: Forecast, greens: Floats) -> float:
    """Vehicles in the network and waiting outside, summed over the horizon by the model at its finest, in cycles."""
    model = LinkModel(net, net.sample_s)
    now, total = at_start(model, state), 0.0
    for step, demand in enumerate(forecast.demand_veh):
        windows = green_windows(net, greens[min(step, len(greens) - 1)], model.step_s)
        for shown, end in zip(windows.shown_s, windows.end_s, strict=True):
            now, _ = model.step(now, shown, demand / net.samples, state.fraction, end)
            total += now.x_veh.sum() + now.source_queue_veh.sum()
    return total / net.samples


def test_a_finer_model_step_saves_as_much_time_as_the_whole_cycle_at_least(utn17: Network) -> None:
    equal = utn17.equal_split().green_s[None]
    planners = {step_s: DistributedMPC(utn17, step_s=step_s) for step_s in (120.0, 60.0)}
    spent = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        state, forecast = random_state(utn17, rng), some_forecast(utn17, rng)
        plans = [equal, *(all_greens(mpc.plan(state, forecast)) for mpc in planners.values())]
        spent.append([time_spent(utn17, state, forecast, greens) for greens in plans])
        assert spent[-1][2] < spent[-1][0]
    split, whole, finer = np.sum(spent, axis=0)
    assert finer <= whole < 0.95 * split


def free_greens(cost: str) -> dict[str, Any]:
    """Settings of a cost by which greens as such hardly cost anything."""
    return {"cost": cost} if cost == "tts" else {"cost": cost, "r": 1e-4}


def test_the_longer_queue_gets_the_longer_green(utn17: Network, cost: str) -> None:
    q = np.where(utn17.turn_link == utn17.link_index("6"), 90.0, 0.0) * utn17.fraction
    mpc = DistributedMPC(utn17, **free_greens(cost))
    green = mpc.plan(quiet_state(utn17, q=q), Forecast(np.zeros((HORIZON, 17)))).green_s
    junction = utn17.junctions[2]
    assert green[junction.stages[0]] > green[junction.stages[1]]


def test_green_goes_where_the_turning_fractions_let_traffic_out(utn17: Network, cost: str) -> None:
    # Links 6 and 7 meet at J3: both turn to link 4, which is full, or out of the network.
    from_6, from_7 = (utn17.turn_link == utn17.link_index(link) for link in ("6", "7"))
    leaves = utn17.turn_next == EXIT
    x = np.zeros(17)
    x[[utn17.link_index(link) for link in ("4", "6", "7")]] = utn17.storage_veh[3], 80.0, 80.0
    mpc = DistributedMPC(utn17, horizon=2, **free_greens(cost))
    longer = []
    for out, blocked in ((from_6, from_7), (from_7, from_6)):
        fraction = np.where(out, np.where(leaves, 0.95, 0.05), utn17.fraction)
        fraction = np.where(blocked, np.where(leaves, 0.05, 0.95), fraction)
        # 80 vehicles that nobody has seen turn yet.
        state = replace(quiet_state(utn17, x), fraction=fraction)
        green = mpc.plan(state, Forecast(np.zeros((2, 17)))).green_s
        first, second = (green[np.flatnonzero(utn17.serves[:, turns].any(axis=1))].item() for turns in (out, blocked))
        longer.append(first - second)
    assert min(longer) > 10


def test_who_is_expected_to_come_amid_a_link_gets_green_there(utn17: Network, cost: str) -> None:
    rng = np.random.default_rng(8)
    forecast, link = some_forecast(utn17, rng), int(np.flatnonzero(~utn17.is_source)[0])
    disturbance = np.zeros((HORIZON, 17))
    disturbance[:, link] = 40.0
    greens = [
        DistributedMPC(utn17, cost=cost).plan(quiet_state(utn17), each).green_s
        for each in (forecast, replace(forecast, disturbance_veh=disturbance))
    ]
    serving = [s for s, stage in enumerate(utn17.stages) if {utn17.turns[t].link for t in stage.turns} == {link}]
    assert (greens[1] - greens[0])[serving].sum() > 1.0


@pytest.mark.parametrize("step_s", [None, 40.0])
@given(seed=SEEDS)
@limits(max_examples=25)
def test_no_disturbance_leaves_the_controller_without_a_plan(utn17: Network, step_s: float | None, seed: int) -> None:
    case = HARD["disturbed"](utn17, np.random.default_rng(seed), 3)
    assert_admissible(utn17, DistributedMPC(utn17, horizon=3, step_s=step_s).plan(*case))


def test_who_reaches_the_queue_after_its_green_leaves_a_step_later(utn17: Network) -> None:
    demand = np.zeros((3, 17))
    demand[0] = 24.0 * utn17.is_source
    mpc = DistributedMPC(utn17, horizon=3)
    problems, timing = [agent.problem for agent in mpc.agents], Timing.of(LinkModel(utn17, 120.0), equal_s(utn17))
    _, solutions = optimum(problems, quiet_state(utn17), Forecast(demand), timing)
    # One vehicle every five seconds, each as long on the way as the free road takes.
    in_time = (np.maximum(timing.end_s[0] - utn17.free_time_s[utn17.turn_link], 0) / 5) * utn17.fraction
    for problem, solution in zip(problems, solutions, strict=True):
        from_outside = utn17.is_source[utn17.turn_link[problem.place.turns]]
        turns = problem.place.turns[from_outside]
        leaving = solution[problem.layout.leaving][:, from_outside]
        assert leaving[0] == pytest.approx(in_time[turns], abs=0.01)
        assert leaving[1] == pytest.approx(24 * utn17.fraction[turns] - in_time[turns], abs=0.01)
    assert in_time.min() < 0.2 * 24 * utn17.fraction[in_time.argmin()]


def test_the_green_is_expected_where_the_last_plan_foresaw_it(utn17: Network) -> None:
    mpc, model = DistributedMPC(utn17, step_s=60.0, horizon=2), LinkModel(utn17, 60.0)
    foreseen = utn17.equal_split().green_s
    for _ in range(3):
        whole = Timing.of(model, foreseen)
        for agent in mpc.agents:
            timing, expected = mpc.timing().part(agent.place), whole.part(agent.place)
            assert timing.shown == pytest.approx(expected.shown)
            assert timing.end_s == pytest.approx(expected.end_s)
            assert timing.opening == pytest.approx(expected.opening)
        foreseen = all_greens(ask(mpc))[1]


@pytest.mark.parametrize("step_s", [120.0, 60.0, 30.0])
def test_green_that_may_stand_anywhere_is_as_much_and_nobody_comes_too_late_for_it(
    utn17: Network, step_s: float
) -> None:
    rng, model = np.random.default_rng(7), LinkModel(utn17, step_s)
    green = random_greens(utn17, rng)
    placed, anywhere = Timing.of(model, green), Timing.anywhere(model, green)
    assert anywhere.shown.sum(axis=0) == pytest.approx(placed.shown.sum(axis=0))
    assert np.ptp(anywhere.shown, axis=0) == pytest.approx(0, abs=1e-12)
    demand = np.zeros((3, 17))
    demand[0] = 12.0 * utn17.is_source
    problems = problems_of(utn17, 3, step_s=step_s)
    _, solutions = optimum(problems, quiet_state(utn17), Forecast(demand), anywhere)
    # The first vehicles that come from outside leave as soon as they have driven up: in shares of a model step.
    late = utn17.free_time_s / step_s
    came = np.interp(np.arange(1, 121 / step_s) - late[:, None], (0, 120 / step_s), (0, 12))
    for problem, solution in zip(problems, solutions, strict=True):
        left = solution[problem.layout.leaving][: len(came.T)].cumsum(axis=0).T
        for turn, total in zip(problem.place.turns, left, strict=True):
            if utn17.is_source[utn17.turn_link[turn]]:
                assert total == pytest.approx(utn17.fraction[turn] * came[utn17.turn_link[turn]], abs=0.02)


def test_a_controller_that_is_told_so_expects_green_anywhere(utn17: Network) -> None:
    model = LinkModel(utn17, 120.0)
    expected = Timing.anywhere(model, equal_s(utn17))
    assert DistributedMPC(utn17, greens="anywhere").timing().end_s == pytest.approx(expected.end_s)
    assert not np.allclose(DistributedMPC(utn17).timing().end_s, expected.end_s)


@given(seed=SEEDS)
@limits(max_examples=3)
def test_every_problem_is_convex(any_net: Network, cost: str, seed: int) -> None:
    net, rng = any_net, np.random.default_rng(seed)
    state, forecast = random_state(net, rng), some_forecast(net, rng, 3)
    timing = Timing.of(LinkModel(net, 60.0), random_greens(net, rng))
    problems = problems_of(net, 3, cost, 60.0, control_horizon=2)
    for program in programs(problems, state, forecast, timing):
        assert program.hessian == pytest.approx(program.hessian.T, abs=1e-12)
        assert np.linalg.eigvalsh(program.hessian).min() > -1e-9
        assert (program.lower <= program.upper).all()


def equal_s(net: Network) -> Floats:
    return net.equal_split().green_s


PROBLEMS: dict[tuple[Any, ...], list[JunctionProblem]] = {}


def problems_of(
    net: Network, horizon: int, cost: str = "tts", step_s: float | None = None, control_horizon: int = 1
) -> list[JunctionProblem]:
    """The problems of all junctions."""
    key = net.name, horizon, cost, step_s, control_horizon
    if key not in PROBLEMS:
        chosen: dict[str, Any] = {"control_horizon": control_horizon, "cost": cost, "step_s": step_s}
        settings = Settings(horizon=horizon, **chosen)
        PROBLEMS[key] = [JunctionProblem(place, settings) for place in places(net)]
    return PROBLEMS[key]


class ConstantDelay(LinkModel):
    """The exact model but for the delay, which stays what it is at the start, as it does in the problem."""

    def __init__(self, net: Network, step_s: float, state: State):
        super().__init__(net, step_s)
        self.constant_s = super().delay_s(self.leaves @ state.q_veh)

    def delay_s(self, queue_veh: Any) -> Any:
        return self.constant_s


def at_start(model: LinkModel, state: State) -> ModelState:
    past = model.history(state.past_inflow_veh, model.network.sample_s)
    return ModelState(state.x_veh, state.q_veh, state.source_queue_veh, past)


@dataclass(frozen=True)
class Run:
    """A model's way over the horizon under greens that stay the same, one entry for each model step."""

    states: list[ModelState]
    """With the one at the start, and so one more."""
    flows: list[StepFlows]

    @classmethod
    def of(cls, model: LinkModel, state: State, green: Floats, forecast: Forecast) -> Run:
        windows = green_windows(model.network, green, model.step_s)
        states, flows = [at_start(model, state)], []
        for demand in forecast.demand_veh / len(windows.shown_s):
            for shown, end in zip(windows.shown_s, windows.end_s, strict=True):
                after, moved = model.step(states[-1], shown, demand, state.fraction, end)
                states.append(after)
                flows.append(moved)
        return cls(states, flows)


def decision(problem: JunctionProblem, green: Floats, run: Run) -> Floats:
    """The model's flows as this junction's decision vector."""
    z = np.zeros(problem.layout.size)
    z[problem.layout.green] = green[problem.place.stages]
    z[problem.layout.leaving] = [flows.leaving_veh[problem.place.turns] for flows in run.flows]
    z[problem.layout.inflow] = [flows.inflow_veh[problem.place.links] for flows in run.flows]
    return z


def excess(program: QuadraticProgram, z: Floats) -> float:
    """How far a decision is beyond the constraints; 0 if it is feasible."""
    rows = np.concatenate([z, program.matrix @ z])
    return float(np.maximum(program.lower - rows, rows - program.upper).max(initial=0))


def assert_feasible_and_the_most(
    problems: list[JunctionProblem], model: LinkModel, state: State, green: Floats, forecast: Forecast
) -> None:
    """The model's flows are feasible, and neither more could leave the network nor more come in than there is room."""
    net, timing, run = model.network, Timing.of(model, green), Run.of(model, state, green, forecast)
    shown = green_windows(net, green, model.step_s).shown_s
    for problem, program in zip(problems, programs(problems, state, forecast, timing), strict=True):
        z = decision(problem, green, run)
        assert excess(program, z) < 1e-6
        for step, (before, flows) in enumerate(zip(run.states, run.flows, strict=False)):
            for position in np.flatnonzero(net.turn_next[problem.place.turns] == EXIT):
                more = z.copy()
                more[problem.layout.leaving[step, position]] += 0.1
                assert excess(program, more) > 0.09
            end = timing.end_s[step % len(shown)]
            opened = model.opening(shown[step % len(shown)] @ net.serves, end) * flows.leaving_veh
            room = model.room_veh(before.x_veh) + model.leaves @ opened
            for position in np.flatnonzero(~net.is_source[problem.place.links]):
                crowded = z.copy()
                crowded[problem.layout.inflow[step, position]] = room[problem.place.links[position]] + 0.1
                assert excess(program, crowded) > 0.09


@given(seed=SEEDS)
def test_flows_of_the_exact_model_are_feasible_and_the_most_that_may_leave(any_net: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, green, forecast = random_state(any_net, rng), random_greens(any_net, rng), some_forecast(any_net, rng, 1)
    model = LinkModel(any_net, any_net.control_step_s)
    assert_feasible_and_the_most(problems_of(any_net, 1), model, state, green, forecast)


@pytest.mark.parametrize("step_s", [120.0, 60.0, 30.0])
@given(seed=SEEDS)
@limits(max_examples=15)
def test_while_the_delay_stands_so_they_are_in_every_model_step_of_the_horizon(
    any_net: Network, step_s: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    state, green, forecast = random_state(any_net, rng), random_greens(any_net, rng), some_forecast(any_net, rng, 3)
    model = ConstantDelay(any_net, step_s, state)
    assert_feasible_and_the_most(problems_of(any_net, 3, step_s=step_s), model, state, green, forecast)


@given(seed=SEEDS)
def test_so_they_are_where_a_control_step_has_several_cycles_and_model_steps(motley: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, green, forecast = random_state(motley, rng), random_greens(motley, rng), some_forecast(motley, rng, 2)
    model = ConstantDelay(motley, 120.0, state)
    assert_feasible_and_the_most(problems_of(motley, 2, step_s=120.0), model, state, green, forecast)


@pytest.mark.parametrize(("horizon", "step_s"), [(1, None), (3, 60.0), (3, 30.0)])
@given(seed=SEEDS)
@limits(max_examples=5)
def test_the_cost_of_a_plan_is_what_the_exact_model_spends(
    any_net: Network, cost: str, horizon: int, step_s: float | None, seed: int
) -> None:
    net, rng = any_net, np.random.default_rng(seed)
    state, green, forecast = random_state(net, rng), random_greens(net, rng), some_forecast(net, rng, horizon)
    model = ConstantDelay(net, step_s or net.control_step_s, state)
    run = Run.of(model, state, green, forecast)
    x, waiting = (np.array([getattr(s, name) for s in run.states[1:]]) for name in ("x_veh", "source_queue_veh"))
    if cost == "tts":
        per_step = (x + waiting + x**2 / net.storage_veh).sum(axis=1)
        expected = 1e-4 * (green**2).sum() + remaining_steps(net) @ (x[-1] + waiting[-1])
    else:
        per_step = 0.1 * (x**2 + waiting**2).sum(axis=1)
        expected = 0.3 * (green**2).sum()
    expected += per_step.sum() * model.step_s / net.control_step_s
    expected += REGULARISATION / 2 * sum((f.leaving_veh**2).sum() + (f.inflow_veh**2).sum() for f in run.flows)
    found: Any = 0.0
    timing = Timing.of(model, green)
    problems = problems_of(net, horizon, cost, step_s)
    for problem, program in zip(problems, programs(problems, state, forecast, timing), strict=True):
        z = decision(problem, green, run)
        found += program.cost(z)
    assert found == pytest.approx(expected, rel=1e-9)


# A known weakness and no promise yet. A bound alone is no cure: who gets more green must also see where the rest goes.
@pytest.mark.xfail(reason="Timing.shown scales without end: 100 s of green fit into a step of 60 s", strict=True)
@pytest.mark.parametrize("step_s", [60.0, 30.0])
def test_no_model_step_lets_out_more_than_green_all_through_it_would(utn17: Network, step_s: float) -> None:
    link = utn17.link_index("6")
    q = np.where(utn17.turn_link == link, 100.0, 0.0) * utn17.fraction
    problems = problems_of(utn17, 2, step_s=step_s)
    timing = Timing.of(LinkModel(utn17, step_s), utn17.equal_split().green_s)
    state = quiet_state(utn17, q=q)
    _, solutions = optimum(problems, state, Forecast(np.zeros((2, 17))), timing)
    problem, solution = problems[utn17.links[link].junction], solutions[utn17.links[link].junction]
    leaving = solution[problem.layout.leaving][:, utn17.turn_link[problem.place.turns] == link].sum(axis=1)
    assert leaving.max() <= utn17.saturation_flow_veh_s[link] * step_s + 1e-3


@pytest.mark.parametrize(
    ("chosen", "greens"),
    [
        ({"horizon": 1}, 1),
        ({"horizon": 3}, 3),
        ({"horizon": 7, "control_horizon": 7}, 7),
        ({"horizon": 12}, 4),
        ({"horizon": 12, "control_horizon": 1}, 1),
        ({"horizon": 1, "step_s": 60}, 1),
        ({"horizon": 5, "control_horizon": 2, "step_s": 40}, 2),
        ({"horizon": 2, "step_s": 10}, 2),
    ],
)
def test_any_horizon_gives_a_plan_for_its_control_horizon(utn17: Network, chosen: dict[str, int], greens: int) -> None:
    rng = np.random.default_rng(7)
    plan = DistributedMPC(utn17, **chosen).plan(random_state(utn17, rng), some_forecast(utn17, rng, chosen["horizon"]))
    assert len(all_greens(plan)) == greens
    assert_admissible(utn17, plan)


@pytest.mark.parametrize("step_s", [60.0, 30.0])
def test_a_finer_model_step_gives_admissible_plans(any_net: Network, cost: str, step_s: float) -> None:
    rng = np.random.default_rng(23)
    mpc = DistributedMPC(any_net, cost=cost, step_s=step_s, horizon=3)
    for _ in range(3):
        assert_admissible(any_net, mpc.plan(random_state(any_net, rng), some_forecast(any_net, rng, 3)))


@pytest.mark.parametrize("step_s", [50.0, 240.0])
def test_a_model_step_that_does_not_divide_the_control_step_is_refused(utn17: Network, step_s: float) -> None:
    with pytest.raises(SettingError, match=rf"'step_s' is {step_s:g}: it must divide the control step of 120 s"):
        DistributedMPC(utn17, step_s=step_s)


def test_the_model_step_must_divide_the_common_cycle_and_not_each_one(mixed: Network) -> None:
    assert mixed.control_step_s == 120
    ask(DistributedMPC(mixed, step_s=120.0, horizon=2))
    common = retimed(mixed, "common", (60, 0))
    with pytest.raises(SettingError, match="'step_s' is 120: it must divide the control step of 60 s"):
        DistributedMPC(common, step_s=120.0)


def test_junctions_with_cycles_of_their_own_get_plans_that_fill_them(mixed: Network, cost: str) -> None:
    rng, mpc = np.random.default_rng(29), DistributedMPC(mixed, cost=cost)
    for _ in range(5):
        plan = mpc.plan(random_state(mixed, rng), some_forecast(mixed, rng))
        assert_admissible(mixed, plan)
        for junction in mixed.junctions:
            lost = sum(mixed.stages[stage].clearance_s for stage in junction.stages)
            for green_s in all_greens(plan):
                assert green_s[list(junction.stages)].sum() + lost == pytest.approx(junction.cycle_s, abs=1e-3)


@pytest.mark.parametrize("step_s", [None, 90.0])
def test_cycles_whose_common_multiple_is_long_are_planned_for_too(motley: Network, step_s: float | None) -> None:
    assert motley.control_step_s == 360
    assert_admissible(motley, ask(DistributedMPC(motley, horizon=2, step_s=step_s)))


@pytest.mark.parametrize("step_s", [None, 30.0])
def test_a_miscount_of_few_vehicles_never_leaves_the_controller_without_a_plan(
    any_net: Network, step_s: float | None
) -> None:
    past = np.zeros((any_net.delay_samples, 17))
    past[0] = 20.0
    mpc = DistributedMPC(any_net, horizon=3, step_s=step_s)
    for lost_veh in (0.1, 1.0, 3.0, 20.0):
        state = replace(quiet_state(any_net, np.full(17, 20.0 - lost_veh)), past_inflow_veh=past)
        assert_admissible(any_net, mpc.plan(state, Forecast(np.tile(20.0 * any_net.is_source, (3, 1)))))


def test_more_vehicles_than_a_link_holds_never_leave_the_controller_without_a_plan(utn17: Network, cost: str) -> None:
    state = random_state(utn17, np.random.default_rng(0))
    x = 1.2 * utn17.storage_veh
    crowded = replace(state, x_veh=x, q_veh=(x[utn17.turn_link] * utn17.fraction))
    for step_s in (None, 30.0):
        mpc = DistributedMPC(utn17, cost=cost, horizon=3, step_s=step_s)
        assert_admissible(utn17, mpc.plan(crowded, Forecast(np.full((3, 17), 60.0))))


@pytest.mark.parametrize("step_s", [None, 30.0])
def test_an_empty_network_is_planned_for_too(any_net: Network, cost: str, step_s: float | None) -> None:
    mpc = DistributedMPC(any_net, cost=cost, horizon=2, step_s=step_s)
    assert_admissible(any_net, mpc.plan(quiet_state(any_net), Forecast(np.zeros((2, 17)))))


def test_a_lone_junction_is_planned_without_neighbours(utn17: Network) -> None:
    part = utn17.part(0)
    lone = replace(part, links=tuple(replace(link, is_source=True) for link in part.links))
    rng = np.random.default_rng(2)
    plan = DistributedMPC(lone).plan(random_state(lone, rng), some_forecast(lone, rng))
    assert plan.facts["bytes_exchanged"] == 0
    assert_admissible(lone, plan)


@pytest.mark.parametrize(("step_s", "steps"), [(None, 1), (60.0, 2), (40.0, 3)])
def test_every_step_starts_from_what_was_agreed_in_the_last_one_shifted_and_its_last_repeated(
    utn17: Network, step_s: float | None, steps: int
) -> None:
    mpc = DistributedMPC(utn17, step_s=step_s, horizon=2)
    ask(mpc)
    region = mpc.crew.regions[0]
    agreed = region.target.copy(), region.price.copy()
    state, forecast = quiet_state(utn17), Forecast(np.zeros((2, 17)))
    assert region.begin(state, forecast) == {}
    for before, after in zip(agreed, (region.target, region.price), strict=True):
        assert after[:, :-steps].tolist() == before[:, steps:].tolist()
        assert after[:, -steps:].tolist() == before[:, -steps:].tolist()


@pytest.mark.parametrize("step_s", [120.0, 60.0])
def test_a_warm_start_saves_iterations(utn17: Network, step_s: float) -> None:
    rng = np.random.default_rng(11)
    chosen = {"iterations": 400, "horizon": 4, "step_s": step_s}
    warm, model = DistributedMPC(utn17, **chosen), LinkModel(utn17, step_s)
    forecast = Forecast(np.tile(20.0 * utn17.is_source, (4, 1)))
    state, saved = random_state(utn17, rng), []
    for step in range(5):
        plan = warm.plan(state, forecast)
        if step > 0:
            cold = DistributedMPC(utn17, **chosen).plan(state, forecast)
            saved.append(cold.facts["iterations"] - plan.facts["iterations"])
        after = Run.of(model, state, plan.green_s, Forecast(forecast.demand_veh[:1])).states[-1]
        state = replace(
            state,
            x_veh=after.x_veh,
            q_veh=after.q_veh,
            source_queue_veh=after.source_queue_veh,
            past_inflow_veh=np.array(after.past_inflow_veh),
        )
    assert sum(saved) > 0


def test_what_the_coordination_did_is_told(utn17: Network) -> None:
    rng = np.random.default_rng(1)
    facts = DistributedMPC(utn17, iterations=3).plan(random_state(utn17, rng), some_forecast(utn17, rng)).facts
    assert facts["iterations"] == 3
    assert not facts["converged"]
    # SPEC 4: at each of nine interactions both sides send Kp numbers of eight bytes.
    assert facts["bytes_exchanged"] == 3 * 2 * 9 * HORIZON * 8
    assert facts["primal_veh"] > 0


def test_a_finer_model_step_exchanges_a_number_for_each(utn17: Network) -> None:
    facts = ask(DistributedMPC(utn17, iterations=3, horizon=2, step_s=30.0)).facts
    assert facts["bytes_exchanged"] == 3 * 2 * 9 * 2 * 4 * 8


class Solver:
    """DAQP, but for what a test makes it answer."""

    setup_flag: int | None = None
    bad_solves = 0
    bad_flag = -1
    spoilt = False
    lasts = 10**9
    """Solves after which it answers no numbers any more."""

    def __init__(self) -> None:
        self.real = REAL()
        self.solves = 0

    def setup(self, *arguments: Any) -> Any:
        answer = self.real.setup(*arguments)
        return answer if Solver.setup_flag is None else (Solver.setup_flag, 0.0)

    def update(self, **arguments: Any) -> Any:
        return self.real.update(**arguments)

    def solve(self) -> Any:
        solution, value, flag, info = self.real.solve()
        self.solves += 1
        if Solver.spoilt or self.solves > Solver.lasts:
            return np.full_like(solution, np.nan), value, flag, info
        if Solver.bad_solves > 0:
            Solver.bad_solves -= 1
            return solution, value, Solver.bad_flag, info
        return solution, value, flag, info


REAL = daqp.Model


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> type[Solver]:
    monkeypatch.setattr(daqp, "Model", Solver)
    for name, value in {"setup_flag": None, "bad_solves": 0, "bad_flag": -1, "spoilt": False, "lasts": 10**9}.items():
        monkeypatch.setattr(Solver, name, value)
    return Solver


def ask(mpc: DistributedMPC) -> Plan:
    rng = np.random.default_rng(5)
    return mpc.plan(random_state(mpc.network, rng), some_forecast(mpc.network, rng, mpc.horizon))


@pytest.mark.parametrize("flag", [-1, -2, -3, -4, -5, -6, 0])
def test_no_answer_of_a_solver_that_found_no_optimum_is_used(utn17: Network, solver: type[Solver], flag: int) -> None:
    solver.bad_solves, solver.bad_flag = 10, flag
    with pytest.raises(ControllerError, match=rf"utn17:J1.*flag {flag}"):
        ask(DistributedMPC(utn17))


def test_no_answer_that_is_not_a_number_is_used(utn17: Network, solver: type[Solver]) -> None:
    solver.spoilt = True
    with pytest.raises(ControllerError, match="utn17:J1"):
        ask(DistributedMPC(utn17))


def test_a_problem_that_the_solver_refuses_is_told(utn17: Network, solver: type[Solver]) -> None:
    solver.setup_flag = -5
    with pytest.raises(ControllerError, match=r"utn17:J1.*refused.*flag -5"):
        ask(DistributedMPC(utn17))


def test_one_failed_solve_is_tried_again_cold(utn17: Network, solver: type[Solver]) -> None:
    expected = ask(DistributedMPC(utn17)).green_s
    solver.bad_solves = 1
    assert ask(DistributedMPC(utn17)).green_s == pytest.approx(expected, abs=1e-6)
    assert solver.bad_solves == 0


def test_a_solver_that_has_lost_its_numbers_is_set_up_anew(utn17: Network, solver: type[Solver]) -> None:
    expected = ask(DistributedMPC(utn17)).green_s
    solver.lasts = 5
    assert ask(DistributedMPC(utn17)).green_s == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("share", [-1e-6, -1e-7])
def test_a_given_inflow_a_tolerance_under_none_is_none(utn17: Network, share: float) -> None:
    agent = DistributedMPC(utn17, coordination="sensitivity").agents[4]
    assert isinstance(agent, Agent)
    empty, forecast = HARD["empty"](utn17, np.random.default_rng(1), HORIZON)
    agent.prepare(empty.part(agent.place.links, agent.place.turns), forecast.part(agent.place.links), 0.2)
    given = np.zeros(agent.problem.layout.size)
    expected = agent.solve(given)
    given[agent.problem.layout.inflow] = share
    assert agent.solve(given) == pytest.approx(expected, abs=1e-6)


def test_a_controller_that_failed_plans_again_in_the_next_step(utn17: Network, solver: type[Solver]) -> None:
    mpc = DistributedMPC(utn17)
    solver.bad_solves = 2
    with pytest.raises(ControllerError):
        ask(mpc)
    assert_admissible(utn17, ask(mpc))


def test_a_solver_that_refused_once_is_asked_again(utn17: Network, solver: type[Solver]) -> None:
    mpc = DistributedMPC(utn17)
    solver.setup_flag = -5
    for _ in range(2):
        with pytest.raises(ControllerError, match="refused"):
            ask(mpc)
    solver.setup_flag = None
    assert_admissible(utn17, ask(mpc))


@pytest.mark.parametrize("controller", [DistributedMPC, CentralizedMPC])
def test_one_road_whose_turns_have_stages_of_their_own_is_planned_for(
    street_of: Callable[[Callable[[Path], Path]], Network], controller: type[DistributedMPC | CentralizedMPC]
) -> None:
    network = street_of(odd_nets.one_road)
    assert (len(network.links), len(network.turns), len(network.stages)) == (1, 2, 2)
    rng = np.random.default_rng(1)
    plan = controller(network).plan(random_state(network, rng), random_forecast(network, rng, HORIZON))
    assert_admissible(network, plan)


@pytest.mark.parametrize("settings", [{"horizon": 3.0}, {"rho": 1e300}, {"q": 1e300}, {"terminal": 1e9}])
def test_a_setting_that_no_solver_can_work_with_is_refused_by_its_own_name(settings: dict[str, float]) -> None:
    [name] = settings
    with pytest.raises(ValidationError, match=rf"1 validation error.*\n{name}\n"):
        Settings(**settings)  # type: ignore[arg-type]


def test_no_more_is_expected_to_come_in_than_the_road_lets_in(utn17: Network) -> None:
    source, other = utn17.links_of[3][:2]
    links = [replace(link, entry_flow_veh_s=0.05) if at == source else link for at, link in enumerate(utn17.links)]
    net, waiting = replace(utn17, links=tuple(links)), np.zeros(len(links))
    waiting[[source, other]] = 60
    state = replace(quiet_state(net), source_queue_veh=waiting)
    agent_of = {}
    for name, each in (("free", utn17), ("narrow", net)):
        mpc = DistributedMPC(each)
        mpc.plan(state, Forecast(np.tile(net.is_source * 20.0, (HORIZON, 1))))
        agent = mpc.agents[3]
        agent_of[name] = agent.solution[agent.problem.layout.inflow]
    most_veh = 0.05 * net.control_step_s
    assert agent_of["narrow"][:, 0].max() <= most_veh + 1e-6
    assert agent_of["free"][:, 0].max() > 5 * most_veh


def test_the_way_that_is_left_shrinks_by_a_link_at_every_turn(any_net: Network) -> None:
    net, remaining = any_net, remaining_steps(any_net)
    own = (net.free_time_s + net.cycle_s[net.link_junction] / 2) / net.control_step_s
    for link in range(len(net.links)):
        turns = [turn for turn in net.turns if turn.link == link and turn.next_link != EXIT]
        onward = sum(turn.fraction * remaining[turn.next_link] for turn in turns)
        assert remaining[link] == pytest.approx(own[link] + onward)
