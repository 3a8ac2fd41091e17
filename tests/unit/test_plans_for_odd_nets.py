"""Controllers have a plan for whatever net is read: pockets, side roads, free turns, tiny links, turns nobody takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.integration.odd_nets import row
from utn_controllers.cyclic import CyclicMaxPressure, Proportional
from utn_controllers.mpc.central import CentralizedMPC
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.tuc import TUC
from utn_sumo import signals
from utn_sumo.contract import EXIT, Network
from utn_sumo.testing import HARD

StreetOf = Callable[[Callable[[Path], Any]], Network]


def turning_round_only(folder: Path) -> Path:
    """From the west one may only turn round at A."""
    streets = row("AB")
    streets.connection("W-A", "A-W")
    return streets.net(folder)


NETS = [
    odd_nets.side_streets,
    odd_nets.turning_pockets,
    odd_nets.slip_lanes,
    odd_nets.joined,
    odd_nets.stubs,
    odd_nets.roundabout,
    odd_nets.lagging_green,
    odd_nets.right_on_red,
    turning_round_only,
]


def with_turns_out_of_use(net: Network) -> Network:
    """The network in which nobody takes the first turn of a link, where it has another."""
    first = np.unique(net.turn_link, return_index=True)[1]
    idle = np.zeros(len(net.turns), dtype=bool)
    idle[first] = (np.bincount(net.turn_link) > 1)[net.turn_link[first]]
    weight = np.where(idle, 0.0, net.fraction)
    share = weight / np.bincount(net.turn_link, weight)[net.turn_link]
    turns = zip(net.turns, share.tolist(), strict=True)
    return replace(net, turns=tuple(replace(turn, fraction=own) for turn, own in turns))


@pytest.mark.parametrize("kind", [CentralizedMPC, DistributedMPC, TUC, Proportional, CyclicMaxPressure])
@pytest.mark.parametrize("make", NETS, ids=lambda make: make.__name__)
@pytest.mark.parametrize("idle", [False, True], ids=["", "idle"])
def test_there_is_a_plan_for_every_hard_state(street_of: StreetOf, make: Any, kind: Any, idle: bool) -> None:
    net = with_turns_out_of_use(street_of(make)) if idle else street_of(make)
    controller = kind(net)
    for case in HARD.values():
        state, forecast = case(net, np.random.default_rng(1), controller.horizon)
        if idle:
            state = replace(state, fraction=net.fraction)
        signals.admit(controller.plan(state, forecast), net)


def test_a_link_from_which_one_may_only_turn_round_has_one_turn(street_of: StreetOf) -> None:
    net = street_of(turning_round_only)
    (turn,) = (turn for turn in net.turns if net.links[turn.link].id == "W-A")
    assert (turn.to_edge, turn.fraction, turn.next_link) == ("A-W", 1.0, EXIT)
