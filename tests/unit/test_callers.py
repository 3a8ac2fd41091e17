"""Who walks, rides or takes a tram says that he is there: by whom he is heard, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.views import allowed, scene
from utn_controllers.actuated import Actuated
from utn_controllers.scheduled.calling import Calling
from utn_controllers.scheduled.execution import Scheduled
from utn_controllers.scheduled.sides import Sides
from utn_controllers.scheduled.streams import Streams
from utn_sumo import callers
from utn_sumo.contract import Execution, Network, Plan
from utn_sumo.detectors import ids
from utn_sumo.plant.buttons import Buttons
from utn_sumo.plant.patience import LOOK_S, MOST_PATIENCE_S, Patience
from utn_sumo.testing import random_state

Make = Callable[[Path], Path]
StreetOf = Callable[[Make], Network]


class People:
    """A libsumo with people before crossings, and with detectors on which somebody is."""

    def __init__(self, wants: dict[str, list[str]], covered: set[str]):
        """`wants` has by walking area the crossings that those there go to."""
        self.wants, self.covered = wants, covered
        self.edge = self.person = self.lanearea = self

    def getLastStepPersonIDs(self, edge: str) -> tuple[str, ...]:  # noqa: N802 - SUMO's names
        return tuple(f"{edge}/{number}" for number in range(len(self.wants.get(edge, ()))))

    def getNextEdge(self, person: str) -> str:  # noqa: N802
        area, number = person.rsplit("/", 1)
        return self.wants[area][int(number)]

    def getLastStepVehicleNumber(self, detector: str) -> int:  # noqa: N802
        return int(detector in self.covered)


def test_each_crossing_has_a_button_at_either_end(street_of: StreetOf) -> None:
    network = street_of(odd_nets.pedestrians)
    [junction] = network.junctions
    assert [caller.letter for caller in junction.callers] == list(junction.without_yellow)
    buttons = [button for caller in junction.callers for button in caller.buttons]
    assert len(set(buttons)) == len(buttons) == 2 * len(junction.callers)
    # Four corners, from each of which two crossings lead.
    assert len({area for area, _ in buttons}) == 4
    assert not any(caller.lanes for caller in junction.callers)


def test_lanes_for_bicycles_are_seen_and_no_car_calls(street_of: StreetOf) -> None:
    network = street_of(odd_nets.bicycle_lanes)
    assert all(caller.lanes and not caller.buttons for _, caller in network.callers)
    assert not street_of(odd_nets.plain).callers


def path_off_a_street(folder: Path) -> Path:
    """From the west's only lane bicycles may turn onto a path of theirs."""
    drawn = odd_nets.row("C")
    drawn.node("P", 200, 60)
    drawn.one_way("C", "P", allow="bicycle")
    return drawn.net(folder, odd_nets.NO_TURNAROUNDS)


def test_cars_on_a_lane_from_which_bicycles_turn_onto_a_path_do_not_call_as_if_they_were_some(
    street_of: StreetOf,
) -> None:
    network = street_of(path_off_a_street)
    assert network.callers
    assert not any(caller.lanes for _, caller in network.callers)


def test_a_button_is_pressed_by_who_wants_to_go_over_its_crossing_and_by_nobody_else(street_of: StreetOf) -> None:
    network = street_of(odd_nets.pedestrians)
    (area, crossing), (other, _) = network.callers[1][1].buttons
    buttons = Buttons(network, ids(network).calling, People({area: [crossing, crossing, "home"]}, set()))
    assert buttons.read().tolist() == [0, 1, 0, 0]
    both = Buttons(network, ids(network).calling, People({area: [crossing], other: ["home", crossing]}, set()))
    assert both.read().tolist() == [0, 2, 0, 0]
    letter = network.callers[1][1].letter
    letters = ["r"] * len(network.junctions[0].signal_turns)
    assert not buttons.pressed(0, "".join(letters))
    letters[letter] = "G"
    assert buttons.pressed(0, "".join(letters))
    going_home = Buttons(network, ids(network).calling, People({area: ["home"], other: []}, set()))
    assert not going_home.pressed(0, "".join(letters))


def test_who_is_close_on_a_lane_of_his_own_calls(street_of: StreetOf) -> None:
    network = street_of(odd_nets.bicycle_lanes)
    named = ids(network).calling
    seen = Buttons(network, named, People({}, {named[0][0]})).read()
    assert seen[0] == 1
    assert seen.sum() == sum(named[0][0] in names for names in named)


def test_who_calls_is_served_before_he_waits_too_long_and_who_does_not_call_is_not(street_of: StreetOf) -> None:
    network = street_of(odd_nets.pedestrians)
    first = network.junctions[0].stages[0]
    who = np.flatnonzero(~callers.served(network)[first])[0]
    for pressed in (0.0, 1.0):
        patience = Patience(network, np.zeros(1))
        for time_s in np.arange(0, MOST_PATIENCE_S + LOOK_S, LOOK_S):
            calling = np.where(np.arange(len(network.callers)) == who, pressed, 0.0)
            now = replace(scene(network, float(time_s)), calling=calling)
            led_on = allowed(patience, now.stage, now)[0] != first
            assert led_on == bool(pressed and time_s >= MOST_PATIENCE_S)


@pytest.mark.parametrize("kind", [Scheduled, Actuated])
def test_on_empty_roads_who_presses_a_button_has_green_at_once(street_of: StreetOf, kind: type[Execution]) -> None:
    network = street_of(odd_nets.pedestrians)
    execution = kind(network)
    first, second = network.junctions[0].stages
    green = callers.served(network)
    plan = Plan(network.equal_split().green_s)
    execution.begin(plan, random_state(network, np.random.default_rng(0)))
    for who in range(len(network.callers)):
        now = replace(scene(network, gap_s=60.0), calling=np.eye(len(network.callers))[who])
        assert execution.wish(now).tolist() == [first if green[first, who] else second]
    nobody = scene(network, gap_s=60.0)
    assert execution.wish(nobody).tolist() == [first]


def test_a_main_road_in_full_flow_is_not_stopped_for_one_who_has_just_pressed_a_button(street_of: StreetOf) -> None:
    network = street_of(odd_nets.pedestrians)
    first, second = network.junctions[0].stages
    calling = (callers.served(network)[second] & ~callers.served(network)[first]).astype(float)
    main = network.serves[first][[turn for each in network.lane_sets for turn in each.turns[:1]]]
    now = replace(scene(network, veh=10.0), calling=calling)
    busy = replace(now, set_zone_veh=np.where(main[:, None], now.set_zone_veh, 0.0))
    assert Scheduled(network).wish(busy).tolist() == [first]


def test_who_is_counted_on_a_lane_of_his_own_weighs_as_a_vehicle_whatever_ways_lead_from_it(
    street_of: StreetOf,
) -> None:
    network = street_of(odd_nets.bicycle_lanes)
    lane = network.callers[0][1].lanes[0]
    seen = np.array([3.0 * (lane in each.lanes) for _, each in network.callers])
    assert (seen > 0).sum() > 1
    streams = Streams(network)
    calling = Calling(network, streams, Sides(network, streams, 2))
    nobody = np.zeros(len(streams.link))
    joined = calling.join(
        seen, np.zeros(0), np.zeros(len(network.junctions)), nobody, nobody[:, None], nobody, nobody, nobody, nobody
    )
    assert joined[0].sum() == pytest.approx(3)


def test_trams_call_from_inside_the_node_before_a_lane_on_which_none_can_stand(street_of: StreetOf) -> None:
    def short(folder: Path) -> Path:
        drawn = odd_nets.row("A")
        for name, y in (("p", 15), ("TN", 150), ("TS", -150)):
            drawn.node(name, 30, y)
        drawn.one_way("TN", "p", allow="tram")
        drawn.one_way("p", "A", allow="tram", length=0.3)
        drawn.one_way("A", "TS", allow="tram")
        return drawn.net(folder, odd_nets.NO_TURNAROUNDS)

    called = [each.lanes for _, each in street_of(short).callers if "p-A_0" in each.lanes]
    assert called
    assert all(any(lane.startswith(":p_") for lane in lanes) for lanes in called)


@pytest.mark.parametrize(
    "make", [odd_nets.pedestrians, odd_nets.tram_stage, odd_nets.crossing_amid_a_street, odd_nets.side_streets]
)
def test_streams_of_motor_traffic_keep_their_places_and_their_greens(street_of: StreetOf, make: Make) -> None:
    network = street_of(make)
    streams = Streams(network)
    sides = Sides(network, streams, 2)
    calling = Calling(network, streams, sides)
    own = streams.first[1:] - streams.first[:-1]
    for junction, (first, last) in enumerate(zip(calling.first[:-1], calling.first[1:], strict=True)):
        motors = np.arange(streams.first[junction], streams.first[junction + 1])
        assert np.arange(len(streams.link))[motors].tolist() == motors.tolist()
        assert (calling.serves[:, first : first + own[junction]] == streams.serves[:, motors]).all()
        assert calling.letters[first : first + own[junction]] == [streams.letters[stream] for stream in motors]
        asked = {letter for own_letters in calling.letters[first + own[junction] : last] for letter in own_letters}
        assert asked <= {caller.letter for caller in network.junctions[junction].callers}
    rng = np.random.default_rng(1)
    stand, worth, ends, kept, most = rng.random((5, len(streams.link)))
    come, pressed = rng.random((len(streams.link), 5)), rng.integers(0, 3, len(network.callers)).astype(float)
    waiting = rng.random(len(sides))
    joined = calling.join(pressed, waiting, np.full(len(network.junctions), 5.0), stand, come, worth, ends, kept, most)
    for whole, part in zip(joined, (stand, come, worth, ends, kept, most), strict=True):
        assert (whole[calling.motors] == part).all()
    assert joined[0].sum() == pytest.approx(stand.sum() + calling.weight_veh @ pressed + waiting.sum())
