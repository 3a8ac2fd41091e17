"""Who has green and does not go is found, later where it can but wait for a gap and a change costs much."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.views import scene
from utn_controllers.scheduled.standstill import COSTLY_S, MOST_TIMES, QUICK_S, Standstill
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import Floats, Network

StreetOf = Callable[[Callable[[Path], Path]], Network]
AFTER_S = 8.0


@dataclass
class Green:
    """Queues before the first stage of every junction, or another; from some links somebody goes."""

    network: Network
    place: int = 0

    def __post_init__(self) -> None:
        self.streams = Streams(self.network)
        self.standstill = Standstill(self.network, self.streams, AFTER_S)
        self.present = self.streams.first_stage[:-1] + self.place
        junction = self.network.link_junction[self.streams.link]
        self.open = self.streams.serves[self.present[junction], np.arange(len(junction))]
        self.links = sorted(set(self.streams.link[self.open].tolist()))

    def stuck(self, time_s: float, going: Sequence[int] = (), x_veh: Floats | float = 0.0) -> set[int]:
        """Links that stand, when from those `going` somebody has gone in every second until then.

        All that there is on the links is `x_veh` (Z,).
        """
        view = replace(scene(self.network), x_veh=np.zeros(len(self.network.links)) + x_veh)
        left = np.zeros(len(self.network.groups))
        found = np.zeros(len(self.open), dtype=np.bool_)
        for now in np.arange(0.0, time_s + 1):
            left = left + np.isin(self.network.group_link, going)
            seen = replace(view, time_s=float(now), left_veh=left)
            found = self.standstill.look(seen, self.present, np.ones(len(self.open)))
        assert not found[~self.open].any()
        return set(self.streams.link[found].tolist())


def test_a_queue_from_which_nobody_goes_stands_after_a_while(utn17: Network) -> None:
    assert Green(utn17).stuck(AFTER_S - 1) == set()
    links = Green(utn17).links
    assert Green(utn17).stuck(AFTER_S, links[:2]) == set(links[2:])


def test_nobody_stands_where_nobody_waits(utn17: Network) -> None:
    green = Green(utn17)
    for now in np.arange(0.0, 60.0):
        seen = replace(scene(utn17), time_s=float(now))
        assert not green.standstill.look(seen, green.present, np.zeros(len(green.open))).any()


def pair(folder: Path) -> Path:
    """Two crossroads, whose left turns give way in both of their stages, with 6 s of all-red after the yellow."""
    odd_nets.row("CD").net(folder, odd_nets.NO_TURNAROUNDS, "--tls.allred.time", "6", "--tls.left-green.time", "0")
    return folder


GAP_S = AFTER_S * MOST_TIMES


@pytest.fixture(scope="session")
def two(street_of: StreetOf) -> Network:
    network = street_of(pair)
    assert len(network.junctions) == 2
    assert all("g" in stage.state for stage in network.stages)
    assert (network.clearance_s >= COSTLY_S).all()
    return network


def test_who_may_wait_for_a_gap_has_as_much_longer_as_a_change_costs(two: Network) -> None:
    assert Green(two).stuck(GAP_S - 1) == set()
    assert Green(two).stuck(GAP_S) == set(Green(two).links)
    quick = replace(two, stages=tuple(replace(stage, clearance=stage.clearance[:1]) for stage in two.stages))
    assert (quick.clearance_s <= QUICK_S).all()
    assert Green(quick).stuck(AFTER_S - 1) == set()
    assert Green(quick).stuck(AFTER_S) == set(Green(quick).links)


def test_who_gives_way_to_nobody_can_wait_for_no_gap(two: Network) -> None:
    stages = tuple(replace(stage, state=stage.state.replace("g", "G")) for stage in two.stages)
    green = Green(replace(two, stages=stages))
    assert green.stuck(AFTER_S) == set(green.links)


def test_before_a_road_that_is_full_nobody_waits_for_a_gap(two: Network) -> None:
    between = np.flatnonzero(np.isin(np.arange(len(two.links)), two.turn_next))
    for link in between.tolist():
        feeding = set(two.turn_link[two.turn_next == link].tolist())
        veh = np.where(np.arange(len(two.links)) == link, 0.4 * two.storage_veh, 0.0)
        assert Green(two).stuck(AFTER_S, x_veh=veh) == feeding & set(Green(two).links)


def test_who_holds_up_others_behind_its_link_has_no_longer(two: Network) -> None:
    between = np.isin(np.arange(len(two.links)), two.turn_next)
    place = next(place for place in range(2) if between[Green(two, place).links].any())
    # Each of the two roads between is before one junction, and ahead of who comes from outside at the other.
    for link in np.flatnonzero(between).tolist():
        veh = np.where(np.arange(len(two.links)) == link, two.storage_veh, 0.0)
        stuck = Green(two, place).stuck(AFTER_S, x_veh=veh)
        assert link in stuck
        assert not between[list(stuck - {link})].any()
    outer = two.storage_veh * ~between
    assert Green(two, place).stuck(AFTER_S, x_veh=outer) == set()


@pytest.mark.parametrize("begin_s", [0.0, 20.0])
def test_the_time_before_a_green_does_not_count(utn17: Network, begin_s: float) -> None:
    green = Green(utn17)
    view = scene(utn17)
    for now in np.arange(0.0, begin_s + AFTER_S + 1):
        seen = replace(view, time_s=float(now), begin_s=view.begin_s + begin_s)
        found = green.standstill.look(seen, green.present, np.ones(len(green.open)))
        assert found.any() == (now >= begin_s + AFTER_S)
