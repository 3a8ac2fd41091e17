"""A link that several junctions feed, its own among them: all that comes in is agreed on, wherever the agents live."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nets import one_way_grid
from utn_controllers.mpc.batch import Batch
from utn_controllers.mpc.central import CentralizedMPC
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.place import places
from utn_controllers.mpc.problem import JunctionProblem
from utn_controllers.mpc.whole import optimum
from utn_sumo import signals
from utn_sumo.contract import EXIT, Floats, Forecast, Network, Plan, State
from utn_sumo.testing import HARD, random_forecast, random_state

HORIZON = 7


def rerouted(net: Network, onto: dict[int, int]) -> Network:
    """The network with these turns feeding other links than they did, which somebody feeds already."""
    turns = [replace(turn, next_link=onto.get(index, turn.next_link)) for index, turn in enumerate(net.turns)]
    return replace(net, name=f"{net.name} merging", turns=tuple(turns))


def producers(net: Network) -> dict[int, set[int]]:
    """Junctions that feed each link."""
    found: dict[int, set[int]] = {}
    for turn in net.turns:
        if turn.next_link != EXIT:
            found.setdefault(turn.next_link, set()).add(net.links[turn.link].junction)
    return found


@pytest.fixture(scope="module")
def merging(utn17: Network) -> Network:
    """utn17 but that J2's and J4's exits lead onto link 10 too, which J1 feeds, and J5's onto its own link 11."""
    onto = {1: "10", 3: "10", 4: "11"}
    exits = np.flatnonzero(utn17.turn_next == EXIT)
    chosen = {turn: onto.get(utn17.links[utn17.turns[turn].link].junction) for turn in exits.tolist()}
    return rerouted(utn17, {turn: utn17.link_index(link) for turn, link in chosen.items() if link})


@pytest.fixture(scope="module")
def merging_grid() -> Network:
    """A grid in which every seventh link is fed by a junction from anywhere too; enough are alike to be batched."""
    net, rng = one_way_grid(6, 7), np.random.default_rng(3)
    fed, many = np.flatnonzero(~net.is_source), np.flatnonzero(np.bincount(net.turn_next + 1)[1:] > 1)
    first = [int(np.flatnonzero(net.turn_next == link)[0]) for link in many[::7]]
    return rerouted(net, {turn: int(rng.choice(fed)) for turn in first})


def all_greens(plan: Plan) -> Floats:
    return np.vstack([plan.green_s, np.asarray(plan.ahead_s)])


def some(net: Network, seed: int) -> tuple[State, Forecast]:
    rng = np.random.default_rng(seed)
    return random_state(net, rng), random_forecast(net, rng, HORIZON)


def gap(net: Network, mpc: DistributedMPC, state: State, forecast: Forecast) -> float:
    """How much dearer the next plan is than the best one, as a share."""
    problems = [JunctionProblem(place, mpc.settings) for place in places(net)]
    timing = mpc.timing()
    greens = all_greens(mpc.plan(state, forecast))
    best, reached = (optimum(problems, state, forecast, timing, each)[0] for each in (None, greens))
    return (reached - best) / abs(best)


def test_the_networks_are_what_they_are_meant_to_be(merging: Network, merging_grid: Network) -> None:
    fed_by = producers(merging)
    assert fed_by[merging.link_index("10")] == {0, 1, 3}
    assert fed_by[merging.link_index("11")] == {3, 4}
    assert sum(len(each) > 1 for each in producers(merging_grid).values()) >= 5
    batches = [agent for agent in DistributedMPC(merging_grid).agents if isinstance(agent, Batch)]
    alike = [{merging_grid.links[link].junction for link in batch.place.links} for batch in batches]
    # Two of one batch feed one link.
    assert any(len(own & each) > 1 for own in alike for each in producers(merging_grid).values())


@pytest.mark.parametrize("seed", range(4))
def test_at_the_default_stop_plans_are_within_a_thousandth_of_the_best(merging: Network, cost: str, seed: int) -> None:
    mpc = DistributedMPC(merging, cost=cost)
    for each in (seed, seed + 100):
        assert -1e-6 <= gap(merging, mpc, *some(merging, each)) <= 1e-3


def test_many_iterations_reach_the_optimum_of_the_whole_problem(merging: Network, cost: str) -> None:
    patient = DistributedMPC(merging, cost=cost, iterations=400, tolerance_abs=1e-4, tolerance_rel=1e-5)
    assert -1e-6 <= gap(merging, patient, *some(merging, 7)) <= 2e-5


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_so_are_those_of_agents_that_are_solved_side_by_side(merging_grid: Network, cost: str, seed: int) -> None:
    mpc = DistributedMPC(merging_grid, cost=cost)
    for each in (seed, seed + 100):
        assert -1e-6 <= gap(merging_grid, mpc, *some(merging_grid, each)) <= 1e-3


@pytest.mark.parametrize("coordination", ["admm", "sensitivity", "none"])
@pytest.mark.parametrize("workers", [2, 3, 8])
def test_plans_do_not_depend_on_where_the_agents_live(merging: Network, coordination: str, workers: int) -> None:
    together, parted = (DistributedMPC(merging, workers=n, coordination=coordination) for n in (1, workers))
    for seed in range(3):
        one, other = (mpc.plan(*some(merging, seed)) for mpc in (together, parted))
        assert all_greens(other) == pytest.approx(all_greens(one), abs=1e-4)
        assert other.facts["iterations"] == one.facts["iterations"]
        assert other.facts["bytes_exchanged"] == one.facts["bytes_exchanged"]


def test_batches_plan_as_well_in_several_regions(merging_grid: Network) -> None:
    state, forecast = some(merging_grid, 4)
    gaps = [gap(merging_grid, DistributedMPC(merging_grid, workers=n), state, forecast) for n in (1, 2, 3)]
    assert max(gaps) <= 1e-3


def test_a_price_on_what_is_fed_is_better_than_none(merging: Network, cost: str) -> None:
    gaps: dict[str, list[float]] = {"admm": [], "sensitivity": [], "none": []}
    for seed in range(5):
        for mode, found in gaps.items():
            found.append(gap(merging, DistributedMPC(merging, cost=cost, coordination=mode), *some(merging, seed)))
    admm, sensitivity, none = (np.mean(found) for found in gaps.values())
    assert admm < sensitivity < 0.5 * none


@pytest.mark.parametrize("coordination", ["admm", "sensitivity", "none"])
@pytest.mark.parametrize("case", HARD)
def test_there_is_a_plan_for_every_hard_case(merging: Network, coordination: str, case: str) -> None:
    chosen: dict[str, Any] = {"coordination": coordination}
    mpc = DistributedMPC(merging, **chosen)
    for seed in range(3):
        plan = mpc.plan(*HARD[case](merging, np.random.default_rng(seed), HORIZON))
        for green_s in all_greens(plan):
            signals.admit(Plan(green_s), merging)


def test_a_junction_that_feeds_its_own_link_tells_nobody(utn17: Network) -> None:
    alone = utn17.part(4)
    # Its exit leads round onto the second of its links, which then is no source.
    lone = rerouted(alone, {int(np.flatnonzero(alone.turn_next == EXIT)[0]): 1})
    lone = replace(lone, links=(replace(lone.links[0], is_source=True), lone.links[1]))
    mpc = DistributedMPC(lone)
    plan = mpc.plan(*some(lone, 1))
    assert plan.facts["bytes_exchanged"] == 0
    assert plan.facts["iterations"] > 1
    assert -1e-6 <= gap(lone, mpc, *some(lone, 2)) <= 1e-3


@pytest.mark.parametrize("controller", [DistributedMPC, CentralizedMPC])
def test_a_network_that_nobody_leaves_is_planned_too(utn17: Network, controller: Any) -> None:
    fed = np.flatnonzero(~utn17.is_source)
    exits = np.flatnonzero(utn17.turn_next == EXIT)
    closed = rerouted(utn17, dict(zip(exits.tolist(), np.resize(fed, len(exits)).tolist(), strict=True)))
    mpc = controller(closed)
    for case in HARD.values():
        plan = mpc.plan(*case(closed, np.random.default_rng(1), HORIZON))
        for green_s in all_greens(plan):
            signals.admit(Plan(green_s), closed)
