"""Who stands amid the way with green before him is not waited for; everybody else is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_controllers.scheduled.parked import AFTER_S, Parked
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import ZONES_M, Floats, Network

SET = 0
STEP_S = 2.0


class Watched:
    """A lane set of `utn17` of which the zones are shown every two seconds; the others are empty."""

    def __init__(self, network: Network):
        self.network, self.streams = network, Streams(network)
        self.parked = Parked(network, self.streams)
        self.time_s = 0.0
        own = self.streams.lane_set == SET
        junction = network.link_junction[network.set_link[SET]]
        rows = np.arange(*self.streams.first_stage[junction : junction + 2])
        serves = self.streams.serves[rows][:, own].any(axis=1)
        self.green, self.red = int(rows[serves][0]), int(rows[~serves][0])
        self.present = self.streams.first_stage[:-1].copy()
        self.junction = int(junction)

    def shown(self, veh: list[float], *, green: bool = True, free: bool = True) -> Floats:
        """(zones,) who is left of those that are seen."""
        self.time_s += STEP_S
        self.present[self.junction] = self.green if green else self.red
        zones = np.zeros((len(self.network.lane_sets), len(ZONES_M)))
        zones[SET] = veh
        asked = np.ones(len(self.network.junctions), dtype=bool)
        asked[self.junction] = free
        self.parked.leave_out(self.time_s, asked, self.present, zones)
        return zones[SET]


@pytest.mark.parametrize("zone", range(1, len(ZONES_M)))
def test_who_has_green_and_nobody_before_him_for_long_is_left_out_until_he_has_gone(utn17: Network, zone: int) -> None:
    watched, parked = Watched(utn17), np.zeros(len(ZONES_M))
    parked[zone] = 1.0
    seen = [watched.shown(parked.tolist())[zone] for _ in range(12)]
    assert seen == [1.0] * int(AFTER_S / STEP_S) + [0.0] * (12 - int(AFTER_S / STEP_S))
    # Nor does he call for green, and others beside him are seen.
    assert watched.shown(parked.tolist(), green=False)[zone] == 0
    assert watched.shown((3 * parked).tolist(), green=False)[zone] == 2
    watched.shown((0 * parked).tolist())
    assert watched.shown(parked.tolist())[zone] == 1


def test_short_greens_add_up_for_who_has_stayed_meanwhile(utn17: Network) -> None:
    watched = Watched(utn17)
    for _ in range(5):
        for _ in range(3):
            watched.shown([0, 1, 0, 0, 0])
        for _ in range(4):
            last = watched.shown([2, 1, 0, 0, 0], green=False)
    assert last.tolist() == [2, 0, 0, 0, 0]


def test_two_who_stand_one_behind_the_other_are_both_left_out(utn17: Network) -> None:
    watched = Watched(utn17)
    left = [watched.shown([0, 1, 0, 1, 0]) for _ in range(20)]
    assert left[-1].sum() == 0


@given(data=st.data())
def test_a_queue_with_red_or_behind_somebody_at_the_line_is_never_left_out(utn17: Network, data: st.DataObject) -> None:
    watched = Watched(utn17)
    for _ in range(30):
        veh = data.draw(st.lists(st.integers(0, 4).map(float), min_size=5, max_size=5))
        at_line = data.draw(st.booleans())
        veh[0] = float(at_line) + veh[0] * at_line
        left = watched.shown(veh, green=at_line)
        assert left.tolist() == veh


def test_who_drives_by_as_others_come_is_seen_and_time_without_a_look_is_none(utn17: Network) -> None:
    watched = Watched(utn17)
    for turn in range(40):
        # Slow, from zone to zone, somebody always on the way.
        veh = np.zeros(len(ZONES_M))
        veh[4 - turn // 3 % 5] = 1.0
        assert watched.shown(veh.tolist()).sum() == 1
    for _ in range(20):
        assert watched.shown([0, 0, 0, 0, 0], free=False).sum() == 0
