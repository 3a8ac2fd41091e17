"""Acyclic rules by what they are worth by definition: waves of the traffic that has way, pressure by movements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.views import Scene, scene
from utn_controllers.acyclic import Acyclic, Pressure, Prices, Wave
from utn_sumo.contract import EXIT, Floats, Network

StreetOf = Callable[[Callable[[Path], Path]], Network]
RULES = [Wave, Pressure, Prices]


@pytest.fixture(scope="session")
def pockets(street_of: StreetOf) -> Network:
    """Left turns give way in one stage, from pockets of their own, and have way in the next one."""
    return street_of(odd_nets.actuated_left_turns)


def queues(network: Network, veh: Floats) -> Scene:
    """So many vehicles (G,) stand before each lane group."""
    on_link = np.bincount(network.group_link, veh, len(network.links))
    return replace(scene(network), waiting_veh=veh, near_veh=veh, x_veh=on_link)


def left_turns(network: Network) -> Floats:
    """(G,) lane groups that somebody gives way from, and nobody else is on."""
    first = network.stages[network.junctions[0].stages[0]]
    letters = zip(first.state, network.junctions[0].signal_turns, strict=True)
    giving = {turn for letter, turns in letters if letter == "g" for turn in turns}
    own = [
        {turn for turn, each in enumerate(network.turns) if each.group == group} for group in range(len(network.groups))
    ]
    return np.array([bool(turns) and turns <= giving for turns in own], dtype=float)


@pytest.mark.parametrize("rule", RULES)
def test_a_long_queue_for_a_left_turn_is_given_the_stage_in_which_it_has_way(
    pockets: Network, rule: type[Acyclic]
) -> None:
    left = left_turns(pockets)
    assert left.any()
    [wish] = rule(pockets).wish(queues(pockets, np.where(left > 0, 12.0, 1.0)))
    through, protected = pockets.junctions[0].stages[:2]
    assert (wish, through != protected) == (protected, True)


def _shared(folder: Path) -> Path:
    """Left turns give way in one stage and have way in the next, but share their road's only lane with all others."""
    phases = [(20, "GGgrrrGGgrrr"), (3, "yygrrryygrrr"), (6, "rrGrrrrrGrrr"), (3, "rryrrrrryrrr")]
    phases += [(20, "rrrGGgrrrGGg"), (3, "rrryyyrrryyy")]
    net = odd_nets.row("C").net(folder, odd_nets.NO_TURNAROUNDS)
    return odd_nets.retime(net, odd_nets.tl_logic("C", tuple(phases)))


@pytest.mark.parametrize("rule", RULES)
def test_where_left_turns_share_a_lane_their_own_stage_is_worth_no_more_than_the_one_for_all(
    street_of: StreetOf, rule: type[Acyclic]
) -> None:
    network = street_of(_shared)
    through, own = network.junctions[0].stages[:2]
    served = network.serves[through]
    veh = np.where(np.isin(np.arange(len(network.groups)), network.turn_group[served]), 12.0, 0.0)
    made = rule(network)
    # Most turn left: whoever does not stands in front of them before red if their own stage goes on.
    made.fraction = np.where(network.serves[own], 0.8, 0.1)
    [wish] = made.wish(replace(queues(network, veh), stage=np.array([through])))
    assert wish == through


@pytest.mark.parametrize("rule", RULES)
def test_with_nobody_anywhere_the_present_stage_stays(pockets: Network, rule: type[Acyclic]) -> None:
    for stage in pockets.junctions[0].stages:
        now = replace(queues(pockets, np.zeros(len(pockets.groups))), stage=np.array([stage]))
        assert rule(pockets).wish(now).tolist() == [stage]


def by_movements(network: Network, veh: Floats) -> Floats:
    """(S,) Varaiya's pressure: of each turn its flow times its lane's queue less what the turns of the next road have.

    A road's queues a lane, weighed by how its traffic turns there; none of a road that leads back to the same signal.
    """
    lanes = [len(group.lanes) for group in network.groups]
    taking = np.bincount(network.turn_group, network.fraction, len(lanes))
    worth = np.zeros(len(network.stages))
    first = [
        {
            turn
            for letter, turns in zip(shown.state, network.junctions[shown.junction].signal_turns, strict=True)
            for turn in turns
            if letter == "G"
        }
        for shown in network.stages
    ]
    for stage, shown in enumerate(network.stages):
        # Who gives way counts if he never goes first.
        for turn in first[stage] | (set(shown.turns) - set().union(*first)):
            each = network.turns[turn]
            weight = veh[each.group] / lanes[each.group]
            if each.next_link != EXIT and network.links[each.next_link].junction != shown.junction:
                ahead = [other for other in network.turns if other.link == each.next_link]
                weight -= sum(other.fraction * veh[other.group] / lanes[other.group] for other in ahead)
            share = each.fraction / taking[each.group]
            worth[stage] += share * network.group_saturation_flow_veh_s[each.group] * weight
    return worth


@given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("make", [None, odd_nets.joined])
def test_pressure_is_what_it_is_by_its_definition(
    utn17: Network, street_of: StreetOf, make: Callable[[Path], Path] | None, seed: int
) -> None:
    network = street_of(make) if make else utn17
    veh = np.random.default_rng(seed).integers(0, 40, len(network.groups)).astype(float)
    assert Pressure(network).worth(queues(network, veh)) == pytest.approx(by_movements(network, veh), abs=1e-9)
