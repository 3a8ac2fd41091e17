"""Who has green and does not go is found, sooner where a road ahead may be full than where it can but be a gap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.views import scene
from utn_controllers.scheduled.standstill import FOR_A_GAP, Standstill
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import EXIT, Network

StreetOf = Callable[[Callable[[Path], Path]], Network]
AFTER_S = 8.0


@dataclass
class Green:
    """Queues before the first stage of every junction, from whose links somebody goes or nobody does."""

    network: Network

    def __post_init__(self) -> None:
        self.streams = Streams(self.network)
        self.standstill = Standstill(self.network, self.streams, AFTER_S)
        self.present = np.array([self.streams.first_stage[j] for j in range(len(self.network.junctions))])
        junction = self.network.link_junction[self.streams.link]
        self.open = self.streams.serves[self.present[junction], np.arange(len(junction))]
        self.links = sorted(set(self.streams.link[self.open].tolist()))

    def stuck(self, time_s: float, going: Sequence[int]) -> set[int]:
        """Links that stand, when from those `going` somebody has gone in every second until then."""
        view = scene(self.network)
        left = np.zeros(len(self.network.groups))
        found = np.zeros(len(self.open), dtype=np.bool_)
        for now in np.arange(0.0, time_s + 1):
            left = left + np.isin(self.network.group_link, going)
            seen = replace(view, time_s=float(now), left_veh=left)
            found = self.standstill.look(seen, self.present, np.ones(len(self.open)))
        assert not found[~self.open].any()
        return set(self.streams.link[found].tolist())

    def leading_on(self) -> set[int]:
        turn_link, inside = self.network.turn_link, self.network.turn_next != EXIT
        return set(turn_link[inside].tolist()) & set(self.links)


def test_a_queue_from_which_nobody_goes_stands_after_a_while(utn17: Network) -> None:
    assert Green(utn17).stuck(AFTER_S - 1, []) == set()
    green = Green(utn17)
    assert green.stuck(AFTER_S, green.links[:2]) >= green.leading_on() - set(green.links[:2])
    assert not green.stuck(AFTER_S, green.links[:2]) & set(green.links[:2])


def test_nobody_stands_where_nobody_waits(utn17: Network) -> None:
    green = Green(utn17)
    for now in np.arange(0.0, 60.0):
        seen = replace(scene(utn17), time_s=float(now))
        assert not green.standstill.look(seen, green.present, np.zeros(len(green.open))).any()


def test_who_leads_on_is_not_waited_for_longer_while_others_go(utn17: Network) -> None:
    green = Green(utn17)
    onward = green.leading_on()
    assert onward
    for link in onward:
        others = [other for other in green.links if other != link]
        assert link in Green(utn17).stuck(AFTER_S, others)


def test_who_can_but_wait_for_a_gap_has_longer_while_others_go(street_of: StreetOf) -> None:
    network = street_of(odd_nets.actuated_left_turns)
    assert (network.turn_next == EXIT).all()
    link, *others = Green(network).links
    assert others
    assert Green(network).stuck(FOR_A_GAP * AFTER_S - 1, others) == set()
    assert Green(network).stuck(FOR_A_GAP * AFTER_S, others) == {link}


def test_where_nobody_at_a_junction_goes_none_has_longer(street_of: StreetOf) -> None:
    green = Green(street_of(odd_nets.actuated_left_turns))
    assert green.stuck(AFTER_S - 1, []) == set()
    assert green.stuck(AFTER_S, []) == set(green.links)


@pytest.mark.parametrize("begin_s", [0.0, 20.0])
def test_the_time_before_a_green_does_not_count(utn17: Network, begin_s: float) -> None:
    green = Green(utn17)
    view = scene(utn17)
    for now in np.arange(0.0, begin_s + AFTER_S + 1):
        seen = replace(view, time_s=float(now), begin_s=view.begin_s + begin_s)
        found = green.standstill.look(seen, green.present, np.ones(len(green.open)))
        assert found.any() == (now >= begin_s + AFTER_S)
