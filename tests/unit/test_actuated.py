"""Greens that end early: never beyond the plan, never before their least, and not while somebody comes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.unit.views import Scene, scene
from utn_controllers.actuated import Actuated
from utn_sumo.contract import Network, Plan
from utn_sumo.plant.heads import Heads
from utn_sumo.signals import whole_seconds

BUSY = 5.0


@dataclass
class Street:
    """The signals of `utn17` under the execution; `veh` says who is before each lane group, `gap_s` who comes."""

    network: Network
    execution: Actuated
    now_s: float = 0.0
    shown: list[tuple[float, int, int]] = field(default_factory=list)
    """(time, junction, stage) of every begin of a stage."""

    def __post_init__(self) -> None:
        self.heads = Heads(self.network, lambda index, state: None)
        self.heads.start(0.0)
        self.shown = [(0.0, index, int(stage)) for index, stage in enumerate(self.heads.stage)]

    def run(self, seconds: int, veh: Any, gap_s: Any) -> None:
        for _ in range(seconds):
            free = self.heads.free(self.now_s)
            now = scene(self.network, self.now_s, self.heads.stage.copy())
            now = replace(now, begin_s=self.heads.begin_s.copy(), free=free, near_veh=veh + now.near_veh)
            now = replace(now, gap_s=gap_s + now.gap_s)
            wish = self.execution.wish(now)
            for index in np.flatnonzero(free & (wish != self.heads.stage)):
                self.heads.switch(int(index), int(wish[index]), self.now_s)
                self.shown.append((float(self.heads.begin_s[index]), int(index), int(wish[index])))
            self.heads.advance(self.now_s)
            self.now_s += 1

    def greens_s(self, index: int) -> list[tuple[int, float]]:
        """(stage, green) of each stage of a junction that has ended."""
        begins = [(time_s, stage) for time_s, junction, stage in self.shown if junction == index]
        clear_s = self.network.clearance_s
        return [(stage, then_s - time_s - clear_s[stage]) for (time_s, stage), (then_s, _) in pairwise(begins)]


def street(network: Network, plan: Plan | None = None, **settings: float) -> Street:
    execution = Actuated(network, **settings)
    execution.begin(plan or network.equal_split(), None)  # type: ignore[arg-type]
    return Street(network, execution)


def test_where_everybody_comes_all_the_time_the_plan_is_carried_out_to_the_second(utn17: Network) -> None:
    plan = utn17.equal_split()
    road = street(utn17, plan)
    road.run(600, BUSY, 0.0)
    for index in range(len(utn17.junctions)):
        greens = road.greens_s(index)
        assert len(greens) > 8
        assert all(green_s == plan.green_s[stage] for stage, green_s in greens)


@given(seed=st.integers(0, 10_000))
def test_no_cycle_is_longer_than_the_plans_and_no_green_shorter_than_its_least(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)

    def plan() -> Plan:
        green_s = utn17.min_green_s.copy()
        for junction, budget_s in zip(utn17.junctions, utn17.green_budget_s, strict=True):
            stages = list(junction.stages)
            share = rng.dirichlet(np.ones(len(stages)))
            green_s[stages] += share * (budget_s - green_s[stages].sum())
        return Plan(whole_seconds(utn17, green_s))

    road = street(utn17, plan())
    for _ in range(6):
        for _ in range(12):
            # Somebody is before every stage, and comes or does not.
            road.run(10, BUSY, rng.choice([0.0, 10.0], len(utn17.groups)))
        road.execution.begin(plan(), None)  # type: ignore[arg-type]
    for index, junction in enumerate(utn17.junctions):
        greens = road.greens_s(index)
        assert all(green_s >= utn17.least_green_s[stage] for stage, green_s in greens)
        # In the order of the plan, none left out.
        assert [stage for stage, _ in greens] == [
            junction.stages[place % len(junction.stages)] for place in range(len(greens))
        ]
        firsts = [time_s for time_s, at, stage in road.shown if at == index and stage == junction.stages[0]]
        assert max(np.diff(firsts)) <= junction.cycle_s


def test_a_green_that_nobody_uses_ends_with_its_least(utn17: Network) -> None:
    road = street(utn17)
    road.run(120, BUSY, 10.0)
    for index in range(len(utn17.junctions)):
        assert all(green_s == utn17.least_green_s[stage] for stage, green_s in road.greens_s(index))


def test_what_a_stage_leaves_the_next_one_has(utn17: Network) -> None:
    plan, junction = utn17.equal_split(), utn17.junctions[0]
    first, second, *_ = junction.stages
    gap_s = np.zeros(len(utn17.groups))
    gap_s[[utn17.turns[turn].group for turn in utn17.stages[first].turns]] = 10.0
    road = street(utn17, plan)
    road.run(130, BUSY, gap_s)
    greens = dict(reversed(road.greens_s(0)))
    assert greens[first] == utn17.least_green_s[first]
    assert greens[second] == plan.green_s[second] + plan.green_s[first] - greens[first]


@pytest.mark.parametrize("gap_s", [2.0, 5.0])
def test_a_green_ends_when_the_gap_is_as_long_as_it_is_set(utn17: Network, gap_s: float) -> None:
    for seen_s, ends in ((gap_s - 1, False), (gap_s, True)):
        execution = street(utn17, gap_s=gap_s).execution
        now = scene(utn17, 20.0, veh=BUSY, gap_s=seen_s)
        assert ((execution.wish(now) != now.stage) == ends).all()


def test_with_nobody_elsewhere_a_green_rests(utn17: Network) -> None:
    road = street(utn17)
    road.run(400, 0.0, 0.0)
    assert len(road.shown) == len(utn17.junctions)
    # Who goes on coming has the rest of their green once somebody is elsewhere, and no more.
    road.run(60, BUSY, 0.0)
    plan = utn17.equal_split()
    for index in range(len(utn17.junctions)):
        (stage, green_s), *_ = road.greens_s(index)
        assert 400 < green_s <= 400 + plan.green_s[stage]


def test_stages_that_nobody_is_before_are_left_out(utn17: Network) -> None:
    junction = utn17.junctions[0]
    first, second, third = junction.stages
    veh = np.full(len(utn17.groups), BUSY)
    veh[[utn17.turns[turn].group for turn in utn17.stages[second].turns]] = 0.0
    road = street(utn17)
    road.run(300, veh, 0.0)
    assert {stage for stage, _ in road.greens_s(0)} == {first, third}


class Watched:
    """A scene that writes down what is asked of it."""

    def __init__(self, inner: Scene):
        self._inner = inner
        self.asked: list[str] = []

    def __getattr__(self, name: str) -> Any:
        self.asked.append(name)
        return getattr(self._inner, name)


def test_it_reads_nothing_of_junctions_that_are_not_free_or_have_to_wait_for_a_gap(utn17: Network) -> None:
    execution = street(utn17).execution
    busy = Watched(replace(scene(utn17, 20.0, veh=BUSY), free=np.zeros(len(utn17.junctions), dtype=bool)))
    execution.wish(busy)
    assert not {"near_one_veh", "gap_one_s"} & set(busy.asked)
    first, second = (Watched(scene(utn17, time_s, veh=BUSY)) for time_s in (20.0, 21.0))
    execution.wish(first)
    assert {"near_one_veh", "gap_one_s"} <= set(first.asked)
    execution.wish(second)
    assert not {"near_one_veh", "gap_one_s", "near_veh", "waiting_veh", "x_veh"} & set(second.asked)


@pytest.mark.parametrize("settings", [{"gap_s": 0}, {"gap_s": "long"}, {"gaps": 1}])
def test_bad_settings_are_refused(utn17: Network, settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Actuated(utn17, **settings)
