"""From any stage to any other: nobody meets, and the net's own times are kept."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from utn_sumo import clearances, monitor
from utn_sumo.clearances import Times, between
from utn_sumo.contract import Junction, Network
from utn_sumo.plant.heads import Heads


def ways(network: Network, junction: Junction) -> dict[tuple[int, int], clearances.Phases]:
    times = Times.of(network, junction)
    return {pair: between(network, junction, times, *pair) for pair in permutations(junction.stages, 2)}


def test_to_the_stage_that_follows_it_is_the_nets_own(utn17: Network) -> None:
    for junction in utn17.junctions:
        found = ways(utn17, junction)
        for first, then in zip(junction.stages, (*junction.stages[1:], junction.stages[0]), strict=True):
            assert found[first, then] == utn17.stages[first].clearance


def test_to_another_stage_everybody_has_the_same_yellow_and_all_red(utn17: Network) -> None:
    junction = utn17.junctions[0]
    first, _, last = junction.stages
    (yellow, yellow_s), (red, red_s) = between(utn17, junction, Times.of(utn17, junction), first, last)
    assert (yellow_s, red_s) == (3, 2)
    assert yellow == utn17.stages[first].state.replace("G", "y")
    assert set(red) == {"r"}


def test_who_has_green_in_both_stages_keeps_it(utn17: Network) -> None:
    junction = utn17.junctions[0]
    first, _, last = junction.stages
    state = utn17.stages[last].state
    kept = utn17.stages[first].state.index("G")
    both = replace(utn17.stages[last], state=state[:kept] + "G" + state[kept + 1 :])
    net = replace(utn17, stages=tuple(both if i == last else each for i, each in enumerate(utn17.stages)))
    for shown, _ in between(net, junction, Times.of(net, junction), first, last):
        assert shown[kept] == "G"


def shown_by(network: Network, seed: int, duration_s: int) -> list[tuple[int, str, str]]:
    """(second, junction, letters) of every change under wishes drawn at random."""
    rng, seen = np.random.default_rng(seed), []
    now = 0
    heads = Heads(network, lambda index, state: seen.append((now, network.junctions[index].id, state)))
    heads.start(0.0)
    for now in range(duration_s):
        heads.advance(now)
        for index in np.flatnonzero(heads.free(now)):
            wish = int(rng.choice(network.junctions[index].stages))
            if wish != heads.stage[index] and rng.uniform() < 0.3:
                heads.switch(int(index), wish, now)
    return seen


@pytest.mark.parametrize("seed", range(5))
def test_the_monitor_has_nothing_to_say_against_any_order_of_stages(utn17: Network, tmp_path, seed: int) -> None:
    changes = shown_by(utn17, seed, 1200)
    lines = [
        f'<tlsState time="{second}.00" id="{name}" programID="x" phase="0" state="{state}"/>'
        for second, name, state in changes
    ]
    (tmp_path / "signals.xml").write_text(f"<tlsStates>{''.join(lines)}</tlsStates>", encoding="utf-8")
    verdict = monitor.watch(utn17, tmp_path / "signals.xml", 1200, in_order=False)
    assert verdict.reasons == []
    assert len(changes) > 100
