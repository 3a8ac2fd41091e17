"""Greens that go on through a clearance: where they stand in a step, what they let out, and what a plan leaves them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from utn_sumo.contract import EXIT, Floats, Junction, Network, Stage
from utn_sumo.model import LinkModel, ModelState, green_windows
from utn_sumo.testing import random_greens

StreetOf = Callable[[Callable[[Path], Any]], Network]
SEEDS = st.integers(0, 2**32 - 1)


def cleared_anyhow(net: Network, rng: np.random.Generator, cycles_s: tuple[float, ...] = (120.0,)) -> Network:
    """The network with other clearances, in parts of which some turns are green, and other cycles and offsets."""

    def cleared(stage: Stage) -> Stage:
        parts = tuple((stage.state, float(seconds)) for seconds in rng.integers(1, 6, rng.integers(0, 4)))
        own = net.turns_of[stage.junction].tolist()
        held = tuple(tuple(turn for turn in own if rng.random() < 0.3) for _ in parts)
        return replace(stage, clearance=parts, held=held, min_green_s=5.0)

    def timed(junction: Junction) -> Junction:
        cycle_s = float(rng.choice(cycles_s))
        return replace(junction, cycle_s=cycle_s, offset_s=float(rng.integers(-200, 200)))

    return replace(
        net,
        stages=tuple(map(cleared, net.stages)),
        junctions=tuple(map(timed, net.junctions)),
        startup_lag_s=float(rng.integers(0, 5)),
    )


def whole_greens(net: Network, rng: np.random.Generator) -> Floats:
    """Greens in whole seconds that fill every cycle."""
    green = np.floor(random_greens(net, rng))
    for junction, budget in zip(net.junctions, net.green_budget_s, strict=True):
        green[junction.stages[0]] += budget - green[list(junction.stages)].sum()
    return green


def second_by_second(net: Network, green_s: Floats) -> tuple[Floats, Floats]:
    """(seconds, S) which stage, (seconds, M) which turns in a clearance, discharge in each second of a step."""
    seconds = round(net.control_step_s)
    shown, held = np.zeros((seconds, len(net.stages))), np.zeros((seconds, len(net.turns)))
    for junction in net.junctions:
        cycle: list[tuple[int, tuple[int, ...]]] = []
        for index in junction.stages:
            stage = net.stages[index]
            cycle += [(index, ())] * round(green_s[index])
            for (_, lasts_s), turns in zip(stage.clearance, stage.held, strict=True):
                cycle += [(-1, turns)] * round(lasts_s)
        assert len(cycle) == junction.cycle_s
        for second in range(seconds):
            index, turns = cycle[round(second - net.startup_lag_s - junction.offset_s) % len(cycle)]
            if index >= 0:
                shown[second, index] = 1
            held[second, list(turns)] = 1
    return shown, held


def by_step(seconds: Floats, step_s: int) -> Floats:
    return seconds.reshape(-1, step_s, seconds.shape[-1])


@given(seed=SEEDS, step_s=st.sampled_from([10, 60, 120]), cycles_s=st.sampled_from([(120.0,), (60.0, 120.0)]))
def test_windows_are_where_the_greens_stand_second_by_second(
    utn17: Network, seed: int, step_s: int, cycles_s: tuple[float, ...]
) -> None:
    rng = np.random.default_rng(seed)
    net = replace(cleared_anyhow(utn17, rng, cycles_s), whole_step_s=120.0)
    green_s = whole_greens(net, rng)
    windows = green_windows(net, green_s, step_s)
    shown, held = second_by_second(net, green_s)
    assert windows.shown_s == pytest.approx(by_step(shown, step_s).sum(axis=1))
    assert windows.held_s == pytest.approx(by_step(held, step_s).sum(axis=1))
    green = by_step(np.maximum(shown @ net.serves, held), step_s)
    last = np.max(green * np.arange(1, step_s + 1)[:, None], axis=1)
    assert windows.end_s == pytest.approx(last)


@given(seed=SEEDS, step_s=st.sampled_from([10, 120]))
def test_cycles_that_do_not_divide_the_step_show_in_it_what_they_show_on_average(
    utn17: Network, seed: int, step_s: int
) -> None:
    rng = np.random.default_rng(seed)
    net = replace(cleared_anyhow(utn17, rng, (70.0, 90.0, 110.0, 120.0)), whole_step_s=120.0)
    green_s = whole_greens(net, rng)
    windows = green_windows(net, green_s, step_s)
    cycles = 120.0 / net.cycle_s
    assert windows.shown_s.sum(axis=0) == pytest.approx(green_s * cycles[net.stage_junction])
    held = np.zeros(len(net.turns))
    for each in net.held_greens:
        held[list(each.turns)] += each.duration_s * cycles[net.stage_junction[each.stage]]
    assert windows.held_s.sum(axis=0) == pytest.approx(held)
    assert (windows.end_s <= step_s).all()


@given(seed=SEEDS)
def test_windows_of_many_plans_are_those_of_each(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    net = cleared_anyhow(utn17, rng)
    greens = np.array([[whole_greens(net, rng) for _ in range(2)] for _ in range(3)])
    together = green_windows(net, greens, 10.0)
    for place in np.ndindex(3, 2):
        alone = green_windows(net, greens[place], 10.0)
        for name in ("shown_s", "held_s", "end_s"):
            np.testing.assert_allclose(getattr(together, name)[place], getattr(alone, name))


def test_turns_that_no_signal_stops_have_all_of_every_step(street_of: StreetOf) -> None:
    net = street_of(odd_nets.slip_lanes)
    free = {
        (net.links[turn.link].id, turn.to_edge) for turn, own in zip(net.turns, net.unsignalled, strict=True) if own
    }
    assert free == {("nC-C", "C-W"), ("W-C", "C-sC")}
    windows = green_windows(net, net.equal_split().green_s, 10.0)
    assert (windows.held_s[:, net.unsignalled] == 10).all()
    assert (windows.end_s[:, net.unsignalled] == 10).all()
    assert not windows.held_s[:, ~net.unsignalled].any()


def test_the_turns_green_in_a_clearance_are_read_off_its_letters(street_of: StreetOf) -> None:
    """While the south clears, the north stays green."""
    net = street_of(odd_nets.lagging_green)
    north = {index for index, turn in enumerate(net.turns) if net.links[turn.link].id == "nC-C"}
    assert [(each.stage, each.after_s, each.duration_s) for each in net.held_greens] == [(0, 0, 3), (0, 3, 2)]
    assert all(set(each.turns) == north for each in net.held_greens)
    assert [len(stage.held) == len(stage.clearance) for stage in net.stages] == [True] * 3


def test_each_turns_windows_are_its_stages_and_then_its_held_greens(utn17: Network) -> None:
    net = cleared_anyhow(utn17, np.random.default_rng(4))
    window, starts, turns = net.turn_windows
    found = {turn: set(own) for turn, own in zip(turns.tolist(), np.split(window, starts[1:]), strict=True)}
    served = [stage.turns for stage in net.stages] + [each.turns for each in net.held_greens]
    for turn in range(len(net.turns)):
        assert found.get(turn, set()) == {index for index, own in enumerate(served) if turn in own}


def queued(model: LinkModel, share: float = 0.9) -> ModelState:
    """Every link full to a share of its storage, all of it queued as the traffic turns."""
    net = model.network
    x = share * net.storage_veh
    nothing = np.zeros(len(net.links))
    return ModelState(x, net.fraction * x[net.turn_link], nothing, (nothing,) * model.lags)


@given(seed=SEEDS)
def test_a_queued_turn_that_is_held_green_lets_out_its_saturation_flow_for_those_seconds_more(
    utn17: Network, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    # Nobody is held up ahead: every turn leads out.
    net = replace(utn17, turns=tuple(replace(turn, next_link=EXIT) for turn in utn17.turns))
    model = LinkModel(net, 120.0)
    green_s, held_s = rng.uniform(10, 30, len(net.stages)), rng.uniform(0, 15, len(net.turns))
    nobody = np.zeros(len(net.links))
    flows, held = (model.step(queued(model), green_s, nobody, net.fraction, held_s=each)[1] for each in (0.0, held_s))
    saturation = net.fraction * net.saturation_flow_veh_s[net.turn_link]
    assert held.leaving_veh - flows.leaving_veh == pytest.approx(saturation * held_s)
    assert flows.leaving_veh == pytest.approx(saturation * (green_s @ net.serves))


def test_who_is_held_green_without_a_queue_leaves_no_faster_than_they_come(utn17: Network) -> None:
    model, nobody = LinkModel(utn17, 120.0), np.zeros(len(utn17.links))
    empty = replace(queued(model, 0.0), x_veh=nobody)
    _, flows = model.step(empty, np.full(len(utn17.stages), 10.0), nobody, utn17.fraction, held_s=100.0)
    assert not flows.leaving_veh.any()


@given(seed=SEEDS)
def test_with_held_greens_vehicles_are_conserved_and_queues_fit(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    net = cleared_anyhow(utn17, rng)
    model = LinkModel(net, 10.0)
    windows = green_windows(net, whole_greens(net, rng), 10.0)
    state = queued(model, 0.7)
    for shown, held, end in zip(windows.shown_s, windows.held_s, windows.end_s, strict=True):
        demand = 4 * rng.random(len(net.links)) * net.is_source
        before = (state.x_veh + state.source_queue_veh).sum()
        state, flows = model.step(state, shown, demand, net.fraction, end, held_s=held)
        gone = flows.leaving_veh[net.turn_next == EXIT].sum()
        assert (state.x_veh + state.source_queue_veh).sum() == pytest.approx(before + demand.sum() - gone)
        assert (flows.leaving_veh[end == 0] <= 1e-9).all()
        assert state.q_veh.min() >= -1e-9
        assert (model.by_link(state.q_veh) <= state.x_veh + 1e-9).all()
        assert (state.x_veh <= net.storage_veh + 1e-9).all()


def test_a_part_keeps_groups_held_greens_and_what_each_letter_opens(street_of: StreetOf) -> None:
    for make in (odd_nets.turning_pockets, odd_nets.lagging_green, odd_nets.side_streets, odd_nets.slip_lanes):
        net = street_of(make)
        for index, junction in enumerate(net.junctions):
            assert named(net.part(index), 0) == named(net, index)
            assert net.part(index).junctions[0].conflicts == junction.conflicts
            assert net.part(index).junctions[0].without_yellow == junction.without_yellow


def test_a_part_of_several_junctions_in_any_order_keeps_each_ones_own(street_of: StreetOf) -> None:
    net = street_of(odd_nets.side_streets)
    part = net.part(1, 0)
    assert [named(part, 0), named(part, 1)] == [named(net, 1), named(net, 0)]
    assert part.control_step_s == net.control_step_s
    assert {link.id: (link.joining, link.parting) for link in part.links} == {
        link.id: (link.joining, link.parting) for link in net.links
    }


def named(net: Network, index: int) -> dict[str, Any]:
    """A junction's turns, groups and held greens by names instead of numbers."""

    def name(turn: int) -> tuple[str, str]:
        return net.links[net.turns[turn].link].id, net.turns[turn].to_edge

    junction = net.junctions[index]
    stages = [net.stages[stage] for stage in junction.stages]
    groups = {
        (net.links[group.link].id, group.lanes): {name(turn) for turn in np.flatnonzero(net.turn_group == place)}
        for place, group in enumerate(net.groups)
        if net.links[group.link].junction == index
    }
    of_group = net.group_saturation_flow_veh_s[net.groups_of[index]].tolist()
    return {
        "letters": [[name(turn) for turn in turns] for turns in junction.signal_turns],
        "groups": groups,
        "saturation": of_group,
        "served": [[name(turn) for turn in stage.turns] for stage in stages],
        "held": [[[name(turn) for turn in turns] for turns in stage.held] for stage in stages],
        "free": {name(turn) for turn in net.turns_of[index] if net.unsignalled[turn]},
    }


def least(net: Network, least_s: list[int], cycle_s: list[int]) -> Network:
    """The network with other least greens by stage and cycles by junction, no shorter than they need."""
    stages = tuple(replace(s, min_green_s=float(own)) for s, own in zip(net.stages, least_s, strict=True))
    junctions = []
    for junction, wished_s in zip(net.junctions, cycle_s, strict=True):
        needed_s = sum(stages[s].min_green_s + stages[s].clearance_s for s in junction.stages)
        junctions.append(replace(junction, cycle_s=max(float(wished_s), needed_s)))
    return replace(net, stages=stages, junctions=tuple(junctions))


LEASTS = st.lists(st.integers(1, 60), min_size=17, max_size=17)
CYCLES = st.lists(st.integers(30, 240), min_size=8, max_size=8)


@given(least_s=LEASTS, cycle_s=CYCLES)
def test_the_equal_split_fills_the_cycle_and_keeps_the_leasts(
    utn17: Network, least_s: list[int], cycle_s: list[int]
) -> None:
    net = least(utn17, least_s, cycle_s)
    green_s = net.equal_split().green_s
    assert np.bincount(net.stage_junction, green_s) == pytest.approx(net.green_budget_s)
    assert (green_s >= net.min_green_s).all()
    assert (green_s == np.round(green_s)).all()
    # Who has more than its least has, to a second, what the others have that have more than theirs; nobody has less.
    for junction in net.junctions:
        own = list(junction.stages)
        shared = [stage for stage in own if green_s[stage] > net.min_green_s[stage]]
        if shared:
            assert np.ptp(green_s[shared]) <= 1
            assert green_s[own].min() >= green_s[shared].min() - 1


@given(cycle_s=CYCLES, least_s=st.integers(1, 5))
def test_where_no_least_binds_the_equal_split_is_equal(utn17: Network, cycle_s: list[int], least_s: int) -> None:
    net = least(utn17, [least_s] * 17, cycle_s)
    green_s = net.equal_split().green_s
    for junction, budget in zip(net.junctions, net.green_budget_s, strict=True):
        share, rest = divmod(round(budget), len(junction.stages))
        expected = [share + (position < rest) for position in range(len(junction.stages))]
        assert green_s[list(junction.stages)].tolist() == expected
