"""Nobody waits too long, whatever is wished; and nobody is served before it is needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.views import allowed, scene
from utn_sumo.contract import SAMPLE_S, Floats, Network
from utn_sumo.plant.heads import Heads
from utn_sumo.plant.patience import LONGEST_RED_S, LOOK_S, MOST_PATIENCE_S, PAUSE_S, STARTING_S, Patience, longest_red_s

StreetOf = Callable[[Callable[[Path], Path]], Network]


def no_holds(network: Network) -> Floats:
    return np.zeros(len(network.junctions))


def test_who_waits_too_long_comes_next_and_who_does_not_wait_does_not(utn17: Network) -> None:
    patience = Patience(utn17, no_holds(utn17))
    for waiting, forced in ((1.0, True), (0.0, False)):
        patience = Patience(utn17, no_holds(utn17))
        for time_s in np.arange(0, MOST_PATIENCE_S + 5, 5):
            now = scene(utn17, float(time_s), veh=waiting)
            kept = allowed(patience, now.stage, now)
            if time_s < MOST_PATIENCE_S - 1:
                assert (kept == now.stage).all()
        assert (kept != now.stage).all() == forced


def test_who_creeps_on_for_a_moment_waits_still_and_who_has_gone_does_not(utn17: Network) -> None:
    for unseen_s, forced in ((LOOK_S, True), (PAUSE_S, True), (PAUSE_S + LOOK_S, False)):
        patience = Patience(utn17, no_holds(utn17))
        for time_s in np.arange(0, MOST_PATIENCE_S + LOOK_S, LOOK_S):
            stands = not 60 <= time_s < 60 + unseen_s
            now = scene(utn17, float(time_s), veh=float(stands))
            kept = allowed(patience, now.stage, now)
        assert (kept != now.stage).all() == forced


def test_whom_each_sample_of_a_report_sees_wait_has_green_within_the_longest_red(utn17: Network) -> None:
    patience, decision_s = Patience(utn17, no_holds(utn17)), 2.0
    for time_s in np.arange(0, LONGEST_RED_S, decision_s):
        # Between two samples nobody stands.
        now = scene(utn17, float(time_s), veh=float(time_s % SAMPLE_S == 0))
        kept = allowed(patience, now.stage, now)
    assert (kept != now.stage).all()


def test_who_has_had_green_in_one_stage_does_not_call_for_another(utn17: Network) -> None:
    first, second, last = utn17.junctions[0].stages
    states = zip(utn17.stages[second].state, utn17.stages[last].state, strict=True)
    green = "".join("G" if "G" in letters else letters[1] for letters in states)
    both = replace(utn17.stages[last], state=green)
    stages = tuple(both if index == last else stage for index, stage in enumerate(utn17.stages))
    net = replace(utn17, stages=stages)
    patience, present = Patience(net, no_holds(net)), scene(net).stage
    for time_s in np.arange(0, 400.0, LOOK_S):
        # The last stage, which serves the second's traffic too, has been shown meanwhile.
        present[0] = last if time_s == 100 else first
        now = scene(net, float(time_s), present, veh=1.0)
        kept = allowed(patience, now.stage, now)[0]
        assert (kept == last) == (time_s == 100 or time_s >= 100 + MOST_PATIENCE_S)


def test_where_green_and_clearance_are_long_who_waits_comes_sooner(utn17: Network) -> None:
    junction = utn17.junctions[0]
    stages = [replace(stage, least_green_s=45.0) if stage.junction == 0 else stage for stage in utn17.stages]
    net = replace(utn17, stages=tuple(stages))
    patience = Patience(net, no_holds(net))
    # Of the two others one has to be shown before the other.
    sooner_s = LONGEST_RED_S - LOOK_S - 45.0 - 2 * utn17.stages[junction.stages[0]].clearance_s
    for time_s in np.arange(0, sooner_s + LOOK_S, LOOK_S):
        now = scene(utn17, float(time_s), veh=1.0)
        kept = allowed(patience, now.stage, now)
        assert (kept != now.stage)[0] == (time_s > sooner_s)
        assert (kept == now.stage)[1:].all()


@pytest.fixture(scope="session")
def four_stages(street_of: StreetOf) -> Network:
    network = street_of(odd_nets.actuated_left_turns)
    assert len(network.stages) == 4
    return network


def with_times(network: Network, least_s: list[float], red_s: list[float]) -> Network:
    """The network with other least greens, and longer clearances."""
    stages = zip(network.stages, least_s, red_s, strict=True)
    changed = tuple(
        replace(
            stage,
            least_green_s=least,
            min_green_s=max(stage.min_green_s, least),
            clearance=(*stage.clearance[:-1], (stage.clearance[-1][0], stage.clearance[-1][1] + red)),
        )
        for stage, least, red in stages
    )
    return replace(network, stages=changed)


@given(
    least_s=st.lists(st.sampled_from([5.0, 10.0, 25.0, 40.0]), min_size=4, max_size=4),
    red_s=st.lists(st.sampled_from([0.0, 2.0, 6.0, 13.0]), min_size=4, max_size=4),
    wishes=st.tuples(st.sampled_from([2, 5]), st.sampled_from([0.02, 0.2, 1.0]), st.integers(0, 2**32 - 1)),
    teleport_s=st.sampled_from([-1.0, 120.0, 150.0, 300.0]),
)
def test_whatever_is_wished_nobody_waits_longer_than_the_longest_red(
    four_stages: Network,
    least_s: list[float],
    red_s: list[float],
    wishes: tuple[int, float, int],
    teleport_s: float,
) -> None:
    every_s, keenness, seed = wishes
    network = with_times(four_stages, least_s, red_s)
    longest_s = longest_red_s(teleport_s)
    # Where one after the other takes longer it can't be kept.
    assume((network.least_green_s + network.clearance_s.max()).sum() <= longest_s - LOOK_S)
    rng = np.random.default_rng(seed)
    heads = Heads(network, lambda index, state: None, longest_red_s=longest_s)
    heads.start(0.0)
    last_green_s = np.zeros(len(network.turns))
    for now in np.arange(0.0, 1200.0):
        heads.advance(now)
        if now % every_s == 0 and heads.free(now)[0]:
            wish = np.array([rng.integers(4)]) if rng.random() < keenness else heads.stage
            kept = allowed(heads.patience, wish, scene(network, now, heads.stage, veh=1.0))
            if kept[0] != heads.stage[0]:
                heads.switch(0, int(kept[0]), now)
        if now >= heads.begin_s[0]:
            last_green_s[network.serves[heads.stage[0]]] = now
        # By decisions every few seconds it may come a little later than is aimed at.
        assert (now - last_green_s).max() <= min(LONGEST_RED_S, longest_s + STARTING_S / 2)


@pytest.mark.parametrize(
    ("teleport_s", "longest_s"), [(-1, 180), (0, 180), (300, 180), (190, 180), (120, 110), (60, 90)]
)
def test_green_comes_before_sumo_takes_off_the_road_who_stands_if_it_can(teleport_s: float, longest_s: float) -> None:
    assert longest_red_s(teleport_s) == longest_s


def test_one_who_waits_alone_is_not_served_sooner_for_stages_that_nobody_needs(four_stages: Network) -> None:
    network = with_times(four_stages, [30.0] * 4, [2.0] * 4)
    patience = Patience(network, no_holds(network))
    who = network.turn_group[np.flatnonzero(~network.serves[0])[-1]]
    veh = network.set_group == who
    view = scene(network, 0.0)
    for time_s in np.arange(0.0, MOST_PATIENCE_S + LOOK_S, LOOK_S):
        now = replace(view, time_s=float(time_s), set_waiting_veh=veh.astype(float))
        assert (allowed(patience, now.stage, now)[0] != now.stage[0]) == (time_s >= MOST_PATIENCE_S)


def test_a_junction_does_not_go_where_it_could_not_be_back_from_in_time(four_stages: Network) -> None:
    network = with_times(four_stages, [5.0, 5.0, 5.0, 40.0], [2.0] * 4)
    patience = Patience(network, no_holds(network))
    others, long = np.flatnonzero(network.serves[2] & ~network.serves[[0, 3]].any(axis=0)), 3
    assert len(others)
    view = scene(network, 0.0)
    veh = np.isin(network.set_group, network.turn_group[others]).astype(float)
    refused_s = []
    for time_s in np.arange(0.0, MOST_PATIENCE_S, LOOK_S):
        now = replace(view, time_s=float(time_s), set_waiting_veh=veh)
        assert (allowed(patience, now.stage, now) == now.stage).all()
        if allowed(patience, np.array([long]), now)[0] != long:
            refused_s.append(time_s)
    clears_s = network.clearance_s[0] + network.clearance_s[long]
    assert refused_s[0] == pytest.approx(LONGEST_RED_S - LOOK_S - 40.0 - clears_s, abs=LOOK_S)
