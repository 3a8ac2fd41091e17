"""Agents live where they like: only their own state and their neighbours' messages reach them, plans are the same."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from utn_controllers.mpc.crew import Processes
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.interactions import Message
from utn_controllers.mpc.place import places
from utn_controllers.mpc.region import SUMS, Region
from utn_controllers.mpc.settings import Settings
from utn_sumo.contract import EXIT, Forecast, Network, State
from utn_sumo.errors import ControllerError
from utn_sumo.testing import random_forecast, random_state

ALONE = 8
"""Regions in which every junction of utn17 is alone."""


def neighbours(net: Network) -> dict[int, set[int]]:
    """Junctions that a link joins."""
    joined: dict[int, set[int]] = {junction: set() for junction in range(len(net.junctions))}
    for turn in net.turns:
        if turn.next_link != EXIT:
            here, there = net.links[turn.link].junction, net.links[turn.next_link].junction
            joined[here].add(there)
            joined[there].add(here)
    return joined


def hops(net: Network, start: int) -> dict[int, int]:
    """Distance of every junction from one of them."""
    found, edge, joined = {start: 0}, [start], neighbours(net)
    while edge:
        here = edge.pop(0)
        for there in sorted(joined[here] - set(found)):
            found[there] = found[here] + 1
            edge.append(there)
    return found


def lone_regions(net: Network, settings: Settings) -> list[Region]:
    """One region a junction."""
    found = places(net)
    at: dict[int, list[int]] = {}
    for junction, place in enumerate(found):
        for side in place.sides:
            at.setdefault(side.link, []).append(junction)
    return [
        Region([place], {link: [j for j in at[link] if j != own] for link in at if own in at[link]}, settings)
        for own, place in enumerate(found)
    ]


def inboxes(outboxes: list[dict[int, Message]]) -> list[list[Message]]:
    return [[outbox[region] for outbox in outboxes if region in outbox] for region in range(len(outboxes))]


def run_rounds(regions: list[Region], state: State, forecast: Forecast, rounds: int) -> list[list[np.ndarray]]:
    """Every agent's answer in every round, the agreement taken as it is."""
    net_places = [region.agents[0].place for region in regions]
    greetings = [
        region.begin(state.part(place.links, place.turns), forecast.part(place.links))
        for region, place in zip(regions, net_places, strict=True)
    ]
    for region, inbox in zip(regions, inboxes(greetings), strict=True):
        region.greet(inbox)
    answers = []
    for _ in range(rounds):
        told = inboxes([region.solve() for region in regions])
        answers.append([region.agents[0].solution.copy() for region in regions])
        for region, inbox in zip(regions, told, strict=True):
            products = region.agree(inbox)
            if len(products) > len(SUMS):
                region.mix(np.eye(len(products) - len(SUMS))[-1])
    return answers


@pytest.mark.parametrize("coordination", ["admm", "sensitivity"])
def test_messages_go_to_neighbours_alone_and_speak_of_the_links_between_them(utn17: Network, coordination: str) -> None:
    rng = np.random.default_rng(3)
    regions = lone_regions(utn17, Settings(coordination=coordination))
    run_rounds(regions, random_state(utn17, rng), random_forecast(utn17, rng, 7), 1)
    joined = neighbours(utn17)
    for here, region in enumerate(regions):
        outbox = region.solve()
        assert set(outbox) == joined[here]
        for there, message in outbox.items():
            for link in message.links:
                feeds = {utn17.links[turn.link].junction for turn in utn17.turns if turn.next_link == link}
                assert {utn17.links[link].junction} | feeds == {here, there}
            assert message.numbers.shape == (len(message.links), 7)


@pytest.mark.parametrize("coordination", ["admm", "sensitivity"])
def test_what_happens_at_a_junction_is_known_one_junction_further_with_every_round(
    utn17: Network, coordination: str
) -> None:
    rng = np.random.default_rng(5)
    state, forecast, settings = (
        random_state(utn17, rng),
        random_forecast(utn17, rng, 7),
        Settings(coordination=coordination),
    )
    at = 7
    distance, links = hops(utn17, at), utn17.links_of[at]
    x = state.x_veh.copy()
    x[links] = 0.5 * (x[links] + utn17.storage_veh[links])
    other = replace(state, x_veh=x)
    before, after = (run_rounds(lone_regions(utn17, settings), each, forecast, 5) for each in (state, other))
    assert max(distance.values()) == 3
    for round_number, (answers, changed) in enumerate(zip(before, after, strict=True)):
        for junction, hop in distance.items():
            same = np.array_equal(answers[junction], changed[junction])
            # The answer of the first round is the junction's own; every later round brings word from one hop further.
            assert same or hop <= round_number, (junction, hop, round_number)
        assert not np.array_equal(answers[at], changed[at])
    assert any(not np.array_equal(before[-1][j], after[-1][j]) for j, hop in distance.items() if hop >= 2)


@pytest.mark.parametrize("coordination", ["admm", "sensitivity", "none"])
@pytest.mark.parametrize("workers", [2, 3, ALONE])
def test_plans_do_not_depend_on_how_the_agents_are_parted_into_regions(
    utn17: Network, coordination: str, workers: int
) -> None:
    together, parted = (DistributedMPC(utn17, workers=n, coordination=coordination) for n in (1, workers))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, 7)
        one, other = together.plan(state, forecast), parted.plan(state, forecast)
        assert other.green_s == pytest.approx(one.green_s, abs=1e-4)
        assert other.ahead_s == pytest.approx(np.asarray(one.ahead_s), abs=1e-4)
        assert other.facts["iterations"] == one.facts["iterations"]
        assert other.facts["bytes_exchanged"] == one.facts["bytes_exchanged"]


def test_a_pool_of_processes_plans_alike_and_outlives_a_state_that_is_no_number(utn17: Network) -> None:
    here, pool = DistributedMPC(utn17), DistributedMPC(utn17, agents="processes", workers=2)
    rng = np.random.default_rng(1)
    state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, 7)
    assert pool.plan(state, forecast).green_s == pytest.approx(here.plan(state, forecast).green_s, abs=1e-4)
    with pytest.raises(ControllerError, match="not finite"):
        pool.plan(replace(state, x_veh=np.full(17, np.nan)), forecast)
    again = random_state(utn17, rng)
    budget = pool.plan(again, forecast).green_s @ (utn17.stage_junction[:, None] == np.arange(8))
    assert budget == pytest.approx(utn17.green_budget_s, abs=1e-3)


def test_when_a_process_has_died_every_plan_says_so_and_no_answer_is_left_over(utn17: Network) -> None:
    mpc = DistributedMPC(utn17, agents="processes", workers=2)
    crew, rng = mpc.crew, np.random.default_rng(1)
    assert isinstance(crew, Processes)
    crew.workers[1].kill()
    crew.workers[1].join()
    for _ in range(3):
        with pytest.raises(ControllerError, match="a process of the agents has ended"):
            mpc.plan(random_state(utn17, rng), random_forecast(utn17, rng, 7))
    assert not crew.pipes[0].poll(0.2)


@pytest.mark.parametrize("spoilt", [{"x_veh": np.nan}, {"past_inflow_veh": 1e20}])
def test_after_a_failure_all_regions_begin_anew_together(utn17: Network, spoilt: dict[str, float]) -> None:
    rng = np.random.default_rng(1)
    state, again = random_state(utn17, rng), random_state(utn17, rng)
    forecast = random_forecast(utn17, rng, 7)
    # One region fails, and the others do not; or none in the first step, in which all tell each other what they expect.
    last = (np.arange(len(utn17.links)) == len(utn17.links) - 1) | ("x_veh" not in spoilt)
    bad = replace(state, **{name: np.where(last, value, getattr(state, name)) for name, value in spoilt.items()})
    greens = []
    for workers in (1, 3):
        mpc = DistributedMPC(utn17, workers=workers)
        with pytest.raises(ControllerError):
            mpc.plan(bad, forecast)
        mpc.plan(state, forecast)
        with pytest.raises(ControllerError) if "x_veh" in spoilt else nullcontext():
            mpc.plan(bad, forecast)
        plan = mpc.plan(again, forecast)
        assert plan.facts["converged"]
        greens.append(plan.green_s)
    assert greens[1] == pytest.approx(greens[0], abs=1e-4)


def test_a_region_that_can_not_be_built_is_told_of_by_its_process() -> None:
    with pytest.raises(TypeError, match="Region"):
        Processes([partial(Region)])


@pytest.mark.long
def test_dask_actors_plan_alike(utn17: Network) -> None:
    here, actors = DistributedMPC(utn17), DistributedMPC(utn17, agents="dask", workers=2)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, 7)
        assert actors.plan(state, forecast).green_s == pytest.approx(here.plan(state, forecast).green_s, abs=1e-4)
