"""Of a link that is seen in part nobody is thought hidden who can't be, nor anybody forgotten who must be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.contract import AREA_REACH_M, Floats, Network
from utn_sumo.plant.hidden import FAST, LATE_S, SLOW, Hidden

EVERY_S = 2.0


def hidden(net: Network, *, aside: bool = False) -> Hidden:
    return Hidden(net, np.full(len(net.links), aside))


def after(seen: Hidden, came_veh: Floats) -> tuple[float, Floats]:
    """The time and who has come in all, when so many (T, Z) came in the steps until then."""
    so_far, time_s = np.zeros(came_veh.shape[1]), 0.0
    seen.note(time_s, so_far)
    for came in came_veh:
        time_s, so_far = time_s + EVERY_S, so_far + came
        seen.note(time_s, so_far)
    return time_s, so_far


def to_sight_s(net: Network) -> Floats:
    return np.array([max(link.length_m - AREA_REACH_M, 0.0) / link.free_speed_m_s for link in net.links])


def room_veh(net: Network) -> Floats:
    return np.asarray(net.storage_veh - net.watched_veh)


@given(
    counted_veh=st.floats(0, 300),
    came=st.lists(st.integers(0, 2), min_size=1, max_size=200),
    far=st.floats(0, 50),
    seen_veh=st.floats(0, 30),
)
def test_as_many_are_on_a_link_as_are_seen_and_fit_on_the_rest(
    counted_veh: float, came: list[int], far: float, seen_veh: float, utn17_long: Network
) -> None:
    net, links = utn17_long, len(utn17_long.links)
    follower = hidden(net)
    time_s, so_far = after(follower, np.tile(np.array(came, dtype=float)[:, None], (1, links)))
    nobody_more = np.full(links, counted_veh)
    veh = follower.correct(time_s, so_far, nobody_more, np.full(links, seen_veh), np.full(links, far))
    lanes = np.array([link.lanes for link in net.links])
    assert (veh >= max(seen_veh, 0.0) - lanes - 1e-9).all()
    assert (veh <= seen_veh + room_veh(net) + lanes + 1e-9).all()


def test_where_traffic_flows_who_came_long_ago_is_not_hidden_and_who_came_just_now_is(utn17_long: Network) -> None:
    net, links = utn17_long, len(utn17_long.links)
    unseen = FAST * to_sight_s(net) > EVERY_S
    assert unseen.any()
    nobody, long_s = np.zeros(links), SLOW * to_sight_s(net).max() + LATE_S
    idle = np.zeros((int(long_s / EVERY_S) + 2, links))
    early, late = hidden(net), hidden(net)
    # Counted are as many that never left, or none at all though three have come.
    time_s, so_far = after(early, np.vstack([np.full((1, links), 3.0), idle]))
    assert early.correct(time_s, so_far, nobody + 20, nobody, nobody) == pytest.approx(0.0)
    time_s, so_far = after(late, np.vstack([idle, np.full((1, links), 3.0)]))
    assert late.correct(time_s, so_far, nobody, nobody, nobody)[unseen] == pytest.approx(3.0)
    # Of a queue that reaches beyond sight there is no telling.
    crowded = hidden(net)
    time_s, so_far = after(crowded, np.vstack([np.full((1, links), 3.0), idle]))
    full = net.watched_veh
    there = crowded.correct(time_s, so_far, full + np.minimum(20, room_veh(net)), full, full)
    assert there == pytest.approx(full + np.minimum(20, room_veh(net)))


def test_where_others_go_onto_a_link_amid_it_nobody_is_hidden_for_having_come(utn17_long: Network) -> None:
    net, nobody = utn17_long, np.zeros(len(utn17_long.links))
    follower = hidden(net, aside=True)
    time_s, so_far = after(follower, np.vstack([nobody, nobody + 3]))
    assert follower.correct(time_s, so_far, nobody, nobody, nobody) == pytest.approx(0.0)


def test_what_a_link_loses_of_those_who_come_is_known_when_it_stands_full(utn17_long: Network) -> None:
    """Half of those who come end as they come in sight: counted, they would pile up behind a queue."""
    net, links = utn17_long, len(utn17_long.links)
    follower, x_veh, so_far = hidden(net), np.zeros(links), np.zeros(links)
    until_sight_s, roomy = 1.2 * to_sight_s(net), room_veh(net) > 20
    assert roomy.any()
    for time_s in range(0, 3600, 10):
        goes_on = 2.0 * (time_s > until_sight_s)
        so_far = so_far + 4
        follower.note(time_s, so_far)
        x_veh = follower.correct(time_s, so_far, x_veh + 4 - goes_on, goes_on, np.zeros(links))
    full = net.watched_veh
    there = follower.correct(3600, so_far + 16, full + 16, full, full)
    assert there[roomy] == pytest.approx(full[roomy] + 8, abs=2)
