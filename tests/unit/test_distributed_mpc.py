"""The agents' plans are feasible and, given iterations, as good as those of the whole problem solved at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import daqp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

from utn_controllers.distributed_mpc import DistributedMPC, Settings
from utn_controllers.distributed_mpc.coordination import Consensus
from utn_controllers.distributed_mpc.problem import REGULARISATION, JunctionProblem, QuadraticProgram, remaining_steps
from utn_controllers.distributed_mpc.whole import optimum
from utn_sumo import signals
from utn_sumo.contract import EXIT, Floats, Forecast, Network, Plan, State
from utn_sumo.errors import ControllerError
from utn_sumo.model import LinkModel, ModelState, StepFlows

SEEDS = st.integers(0, 2**32 - 1)
HORIZON = 7


@pytest.fixture(params=["utn17", "utn17-long"], scope="module")
def net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network) -> Network:
    return utn17 if request.param == "utn17" else utn17_long


@pytest.fixture(params=["tts", "paper"], scope="module")
def cost(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def levels(rng: np.random.Generator, *shape: int) -> Floats:
    """Numbers from 0 to 1, both ends among them."""
    return np.clip(rng.uniform(-0.3, 1.3, shape), 0, 1)


def some_state(net: Network, rng: np.random.Generator) -> State:
    """Queues within x, x within storage, and past inflows that can still be on their way."""
    links, turns = len(net.links), len(net.turns)
    x = rng.uniform(0, 1) * levels(rng, links) * net.storage_veh
    queue = levels(rng, links) * x
    weight = levels(rng, turns) + 1e-3
    share = weight / np.bincount(net.turn_link, weight)[net.turn_link]
    return State(
        cycle=0,
        time_s=0.0,
        x_veh=x,
        q_veh=share * queue[net.turn_link],
        source_queue_veh=net.is_source * levels(rng, links) * 30,
        past_inflow_veh=levels(rng, net.delay_steps, links) * (x - queue) / net.delay_steps,
        turned_veh=np.zeros(turns),
    )


def some_forecast(net: Network, rng: np.random.Generator, horizon: int = HORIZON) -> Forecast:
    return Forecast(net.is_source * 40 * levels(rng, horizon, len(net.links)))


def some_greens(net: Network, rng: np.random.Generator) -> Floats:
    green = net.min_green_s.copy()
    for junction, budget in zip(net.junctions, net.green_budget_s, strict=True):
        stages = list(junction.stages)
        green[stages] += (budget - green[stages].sum()) * rng.dirichlet(np.ones(len(stages)))
    return green


def all_greens(plan: Plan) -> Floats:
    return plan.green_s[None] if plan.ahead_s is None else np.vstack([plan.green_s, plan.ahead_s])


def assert_admissible(net: Network, plan: Plan) -> None:
    for green_s in all_greens(plan):
        signals.admit(Plan(green_s), net)


@given(seed=SEEDS)
@limits(max_examples=10)
def test_greens_fill_every_cycle_and_keep_every_least(net: Network, cost: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = DistributedMPC(net, cost=cost).plan(some_state(net, rng), some_forecast(net, rng))
    assert plan.green_s.shape == (17,)
    assert plan.ahead_s is not None
    assert plan.ahead_s.shape == (3, 17)
    assert_admissible(net, plan)


@pytest.mark.parametrize("seed", range(4))
def test_many_iterations_reach_the_optimum_of_the_whole_problem(net: Network, cost: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, forecast = some_state(net, rng), some_forecast(net, rng)
    mpc = DistributedMPC(net, cost=cost, iterations=400, tolerance_abs=1e-4, tolerance_rel=1e-5)
    greens = all_greens(mpc.plan(state, forecast))
    problems = [agent.problem for agent in mpc.agents]
    best, _ = optimum(problems, state, forecast)
    reached, _ = optimum(problems, state, forecast, greens)
    assert -1e-6 * abs(best) <= reached - best <= 1e-3 * abs(best)


def test_a_plan_answers_to_the_present_state_and_not_to_an_earlier_one(net: Network, cost: str) -> None:
    rng = np.random.default_rng(13)
    mpc = DistributedMPC(net, cost=cost, iterations=400, tolerance_abs=1e-4, tolerance_rel=1e-5)
    problems = [agent.problem for agent in mpc.agents]
    for _ in range(3):
        state, forecast = some_state(net, rng), some_forecast(net, rng)
        best, _ = optimum(problems, state, forecast)
        reached, _ = optimum(problems, state, forecast, all_greens(mpc.plan(state, forecast)))
        assert reached - best <= 1e-3 * abs(best)


@pytest.mark.parametrize("seed", range(4))
def test_time_spent_is_never_saved_by_filling_a_link_beyond_its_storage(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    problems = [JunctionProblem(utn17, junction, Settings()) for junction in range(8)]
    _, solutions = optimum(problems, some_state(utn17, rng), some_forecast(utn17, rng))
    for problem, solution in zip(problems, solutions, strict=True):
        assert solution[problem.layout.over_storage].max() < 1e-3


def test_a_better_plan_than_the_equal_split_is_found(utn17: Network) -> None:
    rng = np.random.default_rng(3)
    state, forecast = some_state(utn17, rng), some_forecast(utn17, rng)
    mpc = DistributedMPC(utn17)
    greens = all_greens(mpc.plan(state, forecast))
    problems = [agent.problem for agent in mpc.agents]
    costs = [
        optimum(problems, state, forecast, plan)[0] for plan in (greens, np.tile(utn17.equal_split().green_s, (4, 1)))
    ]
    assert costs[0] < costs[1]


def test_the_longer_queue_gets_the_longer_green(utn17: Network, cost: str) -> None:
    state = some_state(utn17, np.random.default_rng(0))
    q = np.where(utn17.turn_link == utn17.link_index("6"), 90.0, 0.0) * utn17.fraction
    x = np.bincount(utn17.turn_link, q)
    state = replace(state, x_veh=x, q_veh=q, source_queue_veh=np.zeros(17), past_inflow_veh=np.zeros((2, 17)))
    mpc = DistributedMPC(utn17, cost=cost, r=1e-4)
    green = mpc.plan(state, Forecast(np.zeros((HORIZON, 17)))).green_s
    junction = utn17.junctions[2]
    assert green[junction.stages[0]] > green[junction.stages[1]]


@given(seed=SEEDS)
@limits(max_examples=3)
def test_every_problem_is_convex(net: Network, cost: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, forecast = some_state(net, rng), some_forecast(net, rng)
    for agent in mpc_of(net, cost).agents:
        program = agent.problem.program(state, forecast)
        assert program.hessian == pytest.approx(program.hessian.T, abs=1e-12)
        assert np.linalg.eigvalsh(program.hessian).min() > -1e-9
        assert (program.lower <= program.upper).all()


BUILT: dict[tuple[str, str], DistributedMPC] = {}


def mpc_of(net: Network, cost: str) -> DistributedMPC:
    return BUILT.setdefault((net.name, cost), DistributedMPC(net, cost=cost))


ONE_STEP: dict[tuple[str, str], list[JunctionProblem]] = {}


def one_step_problems(net: Network, cost: str) -> list[JunctionProblem]:
    chosen = Settings(horizon=1, control_horizon=1, cost=cost, crowding=1.0, q=0.1, r=0.3)
    if (net.name, cost) not in ONE_STEP:
        ONE_STEP[net.name, cost] = [JunctionProblem(net, junction, chosen) for junction in range(8)]
    return ONE_STEP[net.name, cost]


def exact_step(net: Network, state: State, green: Floats, forecast: Forecast) -> tuple[ModelState, StepFlows]:
    before = ModelState(state.x_veh, state.q_veh, state.source_queue_veh, tuple(state.past_inflow_veh))
    return LinkModel(net, net.control_step_s).step(before, green, forecast.demand_veh[0], net.fraction)


def decision(problem: JunctionProblem, green: Floats, flows: StepFlows) -> Floats:
    """The exact model's flows as this junction's decision vector."""
    z = np.zeros(problem.layout.size)
    z[problem.layout.green[0]] = green[problem.stages]
    z[problem.layout.leaving[0]] = flows.leaving_veh[problem.turns]
    z[problem.layout.inflow[0]] = flows.inflow_veh[problem.links]
    return z


def excess(program: QuadraticProgram, z: Floats) -> float:
    """How far a decision is beyond the constraints; 0 if it is feasible."""
    rows = np.concatenate([z, program.matrix @ z])
    return float(np.maximum(program.lower - rows, rows - program.upper).max(initial=0))


@given(seed=SEEDS)
@limits(max_examples=15)
def test_flows_of_the_exact_model_are_feasible_and_the_most_that_may_leave(net: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, green, forecast = some_state(net, rng), some_greens(net, rng), some_forecast(net, rng, 1)
    _, flows = exact_step(net, state, green, forecast)
    for problem in one_step_problems(net, "tts"):
        program, z = problem.program(state, forecast), decision(problem, green, flows)
        assert excess(program, z) < 1e-6
        for position in np.flatnonzero(net.turn_next[problem.turns] == EXIT):
            more = z.copy()
            more[problem.layout.leaving[0, position]] += 0.1
            assert excess(program, more) > 0.09
        for position in np.flatnonzero(~net.is_source[problem.links]):
            room = problem.part.storage_veh[position] - state.x_veh[problem.links[position]]
            crowded = z.copy()
            crowded[problem.layout.inflow[0, position]] = room + 0.1
            assert excess(program, crowded) > 0.09


@given(seed=SEEDS)
@limits(max_examples=15)
def test_the_cost_of_a_step_is_what_the_exact_model_spends(net: Network, cost: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, green, forecast = some_state(net, rng), some_greens(net, rng), some_forecast(net, rng, 1)
    after, flows = exact_step(net, state, green, forecast)
    x, waiting = after.x_veh, after.source_queue_veh
    if cost == "tts":
        expected = x.sum() + waiting.sum() + (x**2 / net.storage_veh).sum() + 1e-4 * (green**2).sum()
        expected += remaining_steps(net) @ (x + waiting)
    else:
        expected = 0.1 * ((x**2).sum() + (waiting**2).sum()) + 0.3 * (green**2).sum()
    expected += REGULARISATION / 2 * ((flows.leaving_veh**2).sum() + (flows.inflow_veh**2).sum())
    found = 0.0
    for problem in one_step_problems(net, cost):
        program, z = problem.program(state, forecast), decision(problem, green, flows)
        found += z @ program.hessian @ z / 2 + program.gradient @ z + program.constant
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("chosen", "greens"),
    [
        ({"horizon": 1}, 1),
        ({"horizon": 3}, 3),
        ({"horizon": 7, "control_horizon": 7}, 7),
        ({"horizon": 12}, 4),
        ({"horizon": 12, "control_horizon": 1}, 1),
    ],
)
def test_any_horizon_gives_a_plan_for_its_control_horizon(utn17: Network, chosen: dict[str, int], greens: int) -> None:
    rng = np.random.default_rng(7)
    plan = DistributedMPC(utn17, **chosen).plan(some_state(utn17, rng), some_forecast(utn17, rng, chosen["horizon"]))
    assert len(all_greens(plan)) == greens
    assert_admissible(utn17, plan)


@pytest.mark.parametrize("lost_veh", [0.1, 1.0, 3.0])
def test_a_miscount_of_few_vehicles_never_leaves_the_controller_without_a_plan(net: Network, lost_veh: float) -> None:
    past = np.zeros((net.delay_steps, 17))
    past[0] = 20.0
    state = replace(
        some_state(net, np.random.default_rng(0)),
        x_veh=np.full(17, 20.0 - lost_veh),
        q_veh=np.zeros(35),
        past_inflow_veh=past,
    )
    plan = DistributedMPC(net).plan(state, Forecast(20.0 * np.tile(net.is_source, (HORIZON, 1))))
    assert_admissible(net, plan)


def test_more_vehicles_than_a_link_holds_never_leave_the_controller_without_a_plan(utn17: Network, cost: str) -> None:
    state = some_state(utn17, np.random.default_rng(0))
    x = 1.2 * utn17.storage_veh
    crowded = replace(state, x_veh=x, q_veh=(x[utn17.turn_link] * utn17.fraction))
    assert_admissible(utn17, DistributedMPC(utn17, cost=cost).plan(crowded, Forecast(np.full((HORIZON, 17), 60.0))))


def test_an_empty_network_is_planned_for_too(net: Network, cost: str) -> None:
    nothing = replace(
        some_state(net, np.random.default_rng(0)),
        x_veh=np.zeros(17),
        q_veh=np.zeros(35),
        source_queue_veh=np.zeros(17),
        past_inflow_veh=np.zeros((net.delay_steps, 17)),
    )
    assert_admissible(net, DistributedMPC(net, cost=cost).plan(nothing, Forecast(np.zeros((HORIZON, 17)))))


def test_a_lone_junction_is_planned_without_neighbours(utn17: Network) -> None:
    part = utn17.part(0)
    lone = replace(part, links=tuple(replace(link, is_source=True) for link in part.links))
    rng = np.random.default_rng(2)
    plan = DistributedMPC(lone).plan(some_state(lone, rng), some_forecast(lone, rng))
    assert plan.facts["bytes_exchanged"] == 0
    assert_admissible(lone, plan)


def test_a_shift_moves_what_was_agreed_one_step_up_and_repeats_the_last() -> None:
    consensus = Consensus(np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, 5.0, 6.0]]), rho=0.1)
    consensus.shift()
    assert consensus.mean.tolist() == [[2, 3, 3]]
    assert consensus.price.tolist() == [[5, 6, 6]]


def test_every_step_starts_from_what_was_agreed_in_the_last_one_shifted(
    utn17: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    shifted: list[Consensus] = []

    def shift(consensus: Consensus) -> None:
        shifted.append(consensus)

    monkeypatch.setattr(Consensus, "shift", shift)
    mpc = DistributedMPC(utn17)
    counts = []
    for _ in range(3):
        ask(mpc)
        counts.append(len(shifted))
    assert counts == [0, 1, 2]


def test_a_warm_start_saves_iterations(utn17: Network) -> None:
    rng = np.random.default_rng(11)
    warm = DistributedMPC(utn17, iterations=400)
    demand = 20.0 * np.tile(utn17.is_source, (HORIZON, 1))
    state, saved = some_state(utn17, rng), []
    for cycle in range(5):
        plan = warm.plan(state, Forecast(demand))
        if cycle > 0:
            cold = DistributedMPC(utn17, iterations=400).plan(state, Forecast(demand))
            saved.append(cold.facts["iterations"] - plan.facts["iterations"])
        after, _ = exact_step(utn17, state, plan.green_s, Forecast(demand))
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
    facts = DistributedMPC(utn17, iterations=3).plan(some_state(utn17, rng), some_forecast(utn17, rng)).facts
    assert facts["iterations"] == 3
    assert not facts["converged"]
    # SPEC 4: at each of nine interactions both sides send Kp numbers of eight bytes.
    assert facts["bytes_exchanged"] == 3 * 2 * 9 * HORIZON * 8
    assert facts["primal_veh"] > 0


class Solver:
    """DAQP, but for what a test makes it answer."""

    setup_flag: int | None = None
    bad_solves = 0
    bad_flag = -1
    spoilt = False

    def __init__(self) -> None:
        self.real = REAL()

    def setup(self, *arguments: Any) -> Any:
        answer = self.real.setup(*arguments)
        return answer if Solver.setup_flag is None else (Solver.setup_flag, 0.0)

    def update(self, **arguments: Any) -> Any:
        return self.real.update(**arguments)

    def solve(self) -> Any:
        solution, value, flag, info = self.real.solve()
        if Solver.spoilt:
            return np.full_like(solution, np.nan), value, flag, info
        if Solver.bad_solves > 0:
            Solver.bad_solves -= 1
            return solution, value, Solver.bad_flag, info
        return solution, value, flag, info


REAL = daqp.Model


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> type[Solver]:
    monkeypatch.setattr(daqp, "Model", Solver)
    for name, value in {"setup_flag": None, "bad_solves": 0, "bad_flag": -1, "spoilt": False}.items():
        monkeypatch.setattr(Solver, name, value)
    return Solver


def ask(mpc: DistributedMPC) -> Plan:
    rng = np.random.default_rng(5)
    return mpc.plan(some_state(mpc.network, rng), some_forecast(mpc.network, rng))


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


def test_a_controller_that_failed_plans_again_in_the_next_step(utn17: Network, solver: type[Solver]) -> None:
    mpc = DistributedMPC(utn17)
    solver.bad_solves = 2
    with pytest.raises(ControllerError):
        ask(mpc)
    assert_admissible(utn17, ask(mpc))


def test_the_way_that_is_left_shrinks_by_a_link_at_every_turn(net: Network) -> None:
    remaining = remaining_steps(net)
    own = net.free_time_s / net.control_step_s + 0.5
    for link in range(len(net.links)):
        turns = [turn for turn in net.turns if turn.link == link and turn.next_link != EXIT]
        onward = sum(turn.fraction * remaining[turn.next_link] for turn in turns)
        assert remaining[link] == pytest.approx(own[link] + onward)
