"""Agents solved side by side answer as they would one by one, and together they plan as well."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

from nets import one_way_grid
from utn_controllers.mpc.agent import NOWHERE, Agent
from utn_controllers.mpc.batch import LANES, Batch, nearest_split
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.ldl import Factorisation, factorise, substitute
from utn_controllers.mpc.place import places
from utn_controllers.mpc.problem import JunctionProblem
from utn_controllers.mpc.receding import RecedingProblem
from utn_controllers.mpc.whole import optimum
from utn_sumo import signals
from utn_sumo.contract import Floats, Ints, Network, Plan
from utn_sumo.errors import ControllerError
from utn_sumo.testing import HARD, random_forecast, random_state

HORIZON, RHO = 7, 0.2
SEEDS = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def grid() -> Network:
    """Junctions of a few structures, more than enough of the commonest to be batched."""
    return one_way_grid(6, 7)


def side_by_side(part: Network, copies: int) -> Network:
    """So many junctions like that of a network of one, with nothing between them."""
    links, turns, groups, stages = len(part.links), len(part.turns), len(part.groups), len(part.stages)
    each = range(copies)
    return replace(
        part,
        links=tuple(replace(a, id=f"{a.id}#{n}", junction=n) for n in each for a in part.links),
        turns=tuple(replace(a, link=a.link + n * links, group=a.group + n * groups) for n in each for a in part.turns),
        groups=tuple(replace(a, link=a.link + n * links) for n in each for a in part.groups),
        lane_sets=tuple(
            replace(a, group=a.group + n * groups, turns=tuple(turn + n * turns for turn in a.turns))
            for n in each
            for a in part.lane_sets
        ),
        stages=tuple(
            replace(a, junction=n, turns=tuple(turn + n * turns for turn in a.turns)) for n in each for a in part.stages
        ),
        junctions=tuple(
            replace(
                a,
                id=f"{a.id}#{n}",
                stages=tuple(stage + n * stages for stage in a.stages),
                signal_turns=tuple(tuple(turn + n * turns for turn in own) for own in a.signal_turns),
            )
            for n in each
            for a in part.junctions
        ),
    )


def test_many_junctions_with_nothing_to_agree_on_answer_at_once_and_for_ever(utn17: Network) -> None:
    alone = side_by_side(utn17.part(3), 9)
    mpc, rng = DistributedMPC(alone), np.random.default_rng(0)
    for _ in range(3):
        plan = mpc.plan(random_state(alone, rng), random_forecast(alone, rng, HORIZON))
        signals.admit(plan, alone)
        assert (plan.facts["iterations"], plan.facts["converged"]) == (1, True)


def test_numbers_that_no_agent_could_bear_do_not_come_back(grid: Network) -> None:
    mpc, rng = DistributedMPC(grid), np.random.default_rng(0)
    forecast, state = random_forecast(grid, rng, HORIZON), random_state(grid, rng)
    mpc.plan(state, forecast)
    with pytest.raises(ControllerError), np.errstate(all="ignore"):
        mpc.plan(replace(state, x_veh=np.full(len(grid.links), 1e200)), forecast)
    signals.admit(mpc.plan(state, forecast), grid)


def all_greens(plan: Plan) -> Floats:
    return np.vstack([plan.green_s, np.asarray(plan.ahead_s)])


@given(size=st.integers(1, 25), rows=st.integers(1, 25), lanes=st.integers(1, 5), seed=SEEDS)
@limits(max_examples=30)
def test_quasi_definite_systems_of_any_pattern_are_solved(size: int, rows: int, lanes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    length, stacks = size + rows, 2
    pattern = np.zeros((length, length), dtype=np.bool_)
    pattern[:size, :size] = rng.random((size, size)) < 0.2
    pattern[size:, :size] = rng.random((rows, size)) < 0.2
    pattern |= pattern.T
    matrices = rng.normal(size=(stacks * lanes, length, length)) * pattern
    matrices += matrices.swapaxes(1, 2)
    # Definite where the variables are, negative where the rows are.
    sign = np.repeat([1.0, -1.0], [size, rows])
    matrices[:, range(length), range(length)] = sign * (np.abs(matrices).sum(axis=2) + 1)

    def stacked(numbers: Floats) -> Floats:
        return np.ascontiguousarray(numbers.reshape(stacks, lanes, -1).swapaxes(1, 2))

    found = Factorisation(pattern)
    order = np.argsort(found.position)
    first, second = np.nonzero(np.tril(pattern, -1))
    below = np.zeros((len(matrices), len(found.rows)))
    below[:, found.places(first, second)] = matrices[:, first, second]
    factor, inverse = stacked(below), stacked(matrices[:, range(length), range(length)][:, order])
    factorise(factor, inverse, found.starts, found.targets)
    right = rng.normal(size=(len(matrices), length))
    solution = stacked(right[:, order])
    for stack in range(stacks):
        substitute(factor[stack], inverse[stack], found.starts, found.rows, solution[stack])
    by_system = solution.swapaxes(1, 2).reshape(len(matrices), length)[:, found.position]
    assert by_system == pytest.approx(np.linalg.solve(matrices, right[..., None])[..., 0], abs=1e-9)


def test_it_works_where_nothing_can_be_kept_on_disk() -> None:
    code = (
        "import numba.core.caching as caching; caching.CacheImpl._locator_classes = [];"
        "import numpy as np; from utn_controllers.mpc.ldl import Factorisation, factorise;"
        "found = Factorisation(np.ones((2, 2), dtype=bool)); diagonal = np.full((1, 2, 1), 2.0);"
        "factorise(np.ones((1, 1, 1)), diagonal, found.starts, found.targets); print(diagonal.ravel())"
    )
    answer = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert answer.stdout.split() == ["[0.5", "0.66666667]"]


@given(stages=st.integers(1, 6), seed=SEEDS)
def test_the_nearest_split_fills_the_cycle_and_no_other_is_nearer(stages: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    least = rng.uniform(0, 20, stages)
    budget = least.sum() + rng.uniform(0, 60)
    green = rng.normal(30, 40, (3, stages))
    found = nearest_split(green, least, np.array(budget))
    assert found.sum(axis=1) == pytest.approx(budget)
    assert (found >= least).all()
    # Of a convex set, the nearest point has every other point behind it.
    other = least + (budget - least.sum()) * rng.dirichlet(np.ones(stages), (50, 1))
    assert ((green - found) * (other - found)).sum(axis=-1).max() <= 1e-6
    assert nearest_split(found, least, np.array(budget)) == pytest.approx(found)


def batched(mpc: DistributedMPC) -> list[Batch]:
    return [agent for agent in mpc.agents if isinstance(agent, Batch)]


def test_alike_junctions_are_batched_and_the_rest_are_alone(grid: Network) -> None:
    mpc = DistributedMPC(grid)
    assert batched(mpc)
    assert any(isinstance(agent, Agent) for agent in mpc.agents)
    found = sorted(junction for agent in mpc.agents for junction in agent.place.stages.tolist())
    assert found == list(range(len(grid.stages)))
    assert not batched(DistributedMPC(grid, coordination="sensitivity"))


def test_given_time_a_batch_answers_as_its_agents_do(grid: Network, cost: str) -> None:
    rng = np.random.default_rng(2)
    state, forecast = random_state(grid, rng), random_forecast(grid, rng, HORIZON)
    mpc = DistributedMPC(grid, cost=cost)
    for batch in batched(mpc):
        junctions = [grid.link_junction[links[0]] for links in np.split(batch.place.links, batch.problem.count)]
        linear = np.where(batch.shared == NOWHERE, 0.0, rng.normal(size=batch.shared.shape))
        batch.prepare(state.part(batch.place.links, batch.place.turns), forecast.part(batch.place.links), RHO)
        for _ in range(2000):
            batch.solve(linear)
        answers, terms, shared = (by_agent(batch, each) for each in (batch.solve(linear), linear, batch.shared))
        for place, own, term, answer in zip(
            places(grid, [[j] for j in junctions]), shared, terms, answers, strict=True
        ):
            agent = Agent(RecedingProblem(place, mpc.settings), own[None], given=False)
            agent.prepare(state.part(place.links, place.turns), forecast.part(place.links), RHO)
            exact, green = agent.solve(term), agent.problem.layout.green.ravel()
            assert np.delete(answer, green) == pytest.approx(np.delete(exact, green), abs=0.02)
            # Where no queue waits for them greens hardly matter: they are close, and cost the same.
            assert answer[green] == pytest.approx(exact[green], abs=1.0)
        assert batch.residual < 1e-4


def by_agent(batch: Batch, vector: Floats | Ints) -> Floats:
    """(agents, n) of a vector in the order of the solver."""
    size = batch.problem.layout.size
    stacks = -(-batch.problem.count // LANES)
    return np.asarray(vector.reshape(stacks, size, -1).swapaxes(1, 2).reshape(-1, size)[: batch.problem.count])


@pytest.mark.parametrize("seed", range(3))
def test_at_the_default_stop_plans_are_within_a_thousandth_of_the_best(grid: Network, cost: str, seed: int) -> None:
    mpc = DistributedMPC(grid, cost=cost)
    problems = [JunctionProblem(place, mpc.settings) for place in places(grid)]
    rng = np.random.default_rng(seed)
    for _ in range(3):
        state, forecast = random_state(grid, rng), random_forecast(grid, rng, HORIZON)
        timing = mpc.timing()
        plan = mpc.plan(state, forecast)
        best, _ = optimum(problems, state, forecast, timing)
        reached, _ = optimum(problems, state, forecast, timing, all_greens(plan))
        assert reached <= best * (1 + 1e-3)


@pytest.mark.parametrize("case", HARD)
def test_there_is_a_plan_for_every_hard_case(grid: Network, cost: str, case: str) -> None:
    mpc = DistributedMPC(grid, cost=cost)
    for seed in range(2):
        for green_s in all_greens(mpc.plan(*HARD[case](grid, np.random.default_rng(seed), HORIZON))):
            signals.admit(Plan(green_s), grid)


def test_a_state_that_is_no_number_is_refused_by_name_and_forgotten(grid: Network) -> None:
    mpc, rng = DistributedMPC(grid), np.random.default_rng(1)
    state, forecast = random_state(grid, rng), random_forecast(grid, rng, HORIZON)
    link = int(batched(mpc)[0].place.links[-1])
    x = state.x_veh.copy()
    x[link] = np.nan
    with pytest.raises(ControllerError, match=rf"{grid.junctions[grid.links[link].junction].id}\b.*not finite"):
        mpc.plan(replace(state, x_veh=x), forecast)
    again = DistributedMPC(grid).plan(state, forecast)
    assert mpc.plan(state, forecast).green_s == pytest.approx(again.green_s, abs=1.0)


def test_regions_batch_their_own_and_plan_as_well(grid: Network) -> None:
    mpcs = [DistributedMPC(grid, workers=workers) for workers in (1, 3)]
    problems = [JunctionProblem(place, mpcs[0].settings) for place in places(grid)]
    rng, timing = np.random.default_rng(4), mpcs[0].timing()
    state, forecast = random_state(grid, rng), random_forecast(grid, rng, HORIZON)
    one, other = (optimum(problems, state, forecast, timing, all_greens(m.plan(state, forecast)))[0] for m in mpcs)
    assert other == pytest.approx(one, rel=5e-4)
