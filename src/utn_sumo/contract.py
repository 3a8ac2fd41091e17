"""The nouns of the bench: what flows round the loop, frozen, in numpy arrays of a stated shape.

    plant -> Measurement -> State -> Forecast -> Plan -> (checked) -> plant

Counts are in veh, times in s, lengths in m, rates in veh/s unless a name says otherwise. Index
spaces: Z links, M turns (one per link and next link or exit), G lane groups, L lane sets, S stages, J junctions, C
callers, R side roads, Kp and Kc horizons.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

EXIT = -1
CAR_ACCELERATION_M_S2 = 2.6
"""That of SUMO's passenger cars."""
MOST_CYCLES = 3
"""Longest cycles between two decisions that junctions with different cycles make necessary."""
AREA_REACH_M = 200.0
"""Lane-area detectors see this far upstream of the stop line: the reach of a camera on the mast."""
ZONES_M = (22.0, 50.0, 85.0, 130.0, AREA_REACH_M)
"""How far from the stop line the zones end in which they say where vehicles are: the nearer the finer."""
CLOSE_ZONES = 2
"""Who is in these, up to 50 m, is at the stop line within a few seconds."""
WITHIN_VEH = 2.0
"""Roads from one node with a signal to another that hold fewer vehicles a lane are within a junction: who waits there
is in the way."""
SAMPLE_S = 10.0
"""Longest time between two readings of the entry loops (the paper's sampling interval)."""
LEAST_PAUSE_S = 1.0
"""Least time between two decisions of an execution."""


@dataclass(frozen=True)
class Link:
    """A road that leads to a signalled junction: the unit of state of the macroscopic model."""

    id: str
    edges: tuple[str, ...]
    """SUMO edges from its entry to its stop line."""
    junction: int
    lanes: int
    length_m: float
    free_speed_m_s: float
    storage_veh: float
    queue_spacing_m: float
    """Length of the link that one more queued vehicle takes up, on all its lanes together (l_veh / N_lane)."""
    saturation_flow_veh_s: float
    """Of all its lanes together (mu_z)."""
    is_source: bool
    """Whether traffic from outside enters here."""
    turning_worth_veh: float
    """Vehicles that its known turning fractions are worth against what is seen turning."""
    joining: tuple[str, ...] = ()
    """SUMO lanes, inside nodes without signals, over which traffic comes onto the link amid it."""
    parting: tuple[str, ...] = ()
    """Those over which it leaves amid it."""
    parting_m: tuple[float, ...] = ()
    """How far before the stop line each of those begins."""
    waiting: tuple[tuple[str, float], ...] = ()
    """SUMO lanes, and their lengths [m], inside the node before a last edge that is too short to stand on."""
    begins_amid: bool = False
    """Whether it begins amid the net without another link that leads to it: nobody sees who waits behind its queue."""
    entry_flow_veh_s: float = np.inf
    """Most that comes from outside however much room there is: where its vehicles are inserted is not the road's."""

    @property
    def lane_room_veh(self) -> float:
        """Vehicles that stand on a lane along its whole length, however short: `storage_veh` is never so few."""
        return self.length_m / (self.queue_spacing_m * self.lanes)


@dataclass(frozen=True)
class LaneGroup:
    """Lanes before a stop line that the same turns share: one queue (a turn's pocket is another than the others')."""

    link: int
    lanes: tuple[int, ...]
    """Numbers of the lanes of the link's last edge."""


@dataclass(frozen=True)
class LaneSet:
    """Lanes of a lane group from which the same turns go by the same signals: who stands there moves alike."""

    group: int
    lanes: tuple[int, ...]
    """Numbers of the lanes of the link's last edge."""
    turns: tuple[int, ...]
    letters: tuple[tuple[int, ...], ...]
    """The letters of its junction by which each turn goes from these lanes: none where no signal stops it."""
    is_reserved: bool = False
    """Whether they are closed to cars, as lanes for buses."""


@dataclass(frozen=True)
class Turn:
    """A sub-stream of a link: the traffic that goes on to one next link, or leaves the network."""

    link: int
    to_edge: str
    next_link: int
    """Index of the link fed, or EXIT."""
    fraction: float
    """beta_{z,d}: share of the link's traffic that takes this turn."""
    via_lanes: tuple[str, ...]
    """SUMO lanes inside the junction that carry this turn and no other."""
    from_lanes: tuple[int, ...]
    """Number of the lane of the link's last edge that each of these begins at."""
    group: int
    """Lane group that its traffic queues in."""
    crossing_m: float = 0.0
    """How far it is across the junction for who gives way, from where he waits amid it or before it."""


@dataclass(frozen=True)
class Stage:
    """A set of signals that are green together, and the clearance that follows it."""

    junction: int
    state: str
    """SUMO signal letters while green."""
    clearance: tuple[tuple[str, float], ...]
    """(letters, seconds) shown in turn after it: yellow, all-red."""
    turns: tuple[int, ...]
    """Turns that it serves."""
    min_green_s: float
    """Of a plan."""
    least_green_s: float
    """Where an execution ends it: the net's own least, else what SUMO's own signals keep."""
    held: tuple[tuple[int, ...], ...] = ()
    """Turns that are green in each part of the clearance: still from this stage, or already for the next."""

    @property
    def clearance_s(self) -> float:
        return sum(duration for _, duration in self.clearance)


@dataclass(frozen=True)
class Caller:
    """Who has letters of a signal and is no motor traffic: people, bicycles, trams. They call for green themselves."""

    letter: int
    buttons: tuple[tuple[str, str], ...] = ()
    """Walking area and crossing, SUMO's edges: in the one a button stands for who wants to go over the other."""
    lanes: tuple[str, ...] = ()
    """Lanes that end at the stop line, or lead to one on which nobody can stand: for bicycles or trams alone, or shared
    with motor traffic that never has green with them."""


@dataclass(frozen=True)
class Junction:
    """A signalled junction: its stages in the order of its cycle, and which signals conflict."""

    id: str
    stages: tuple[int, ...]
    cycle_s: float
    offset_s: float
    signal_turns: tuple[tuple[int, ...], ...]
    """Turns of each signal letter: none where it stops no motor traffic, several where streams share it."""
    conflicts: tuple[tuple[bool, ...], ...]
    """conflicts[a][b]: the streams of letters a and b cross, or come from two roads into one lane."""
    without_yellow: tuple[int, ...] = ()
    """Letters that need none: pedestrian crossings', and those of no stream."""
    made_to_yield: tuple[int, ...] = ()
    """Letters that give way (g) in stages in which the net itself protects them (G) beside others that they meet."""
    given_yellow: tuple[int, ...] = ()
    """Letters that have yellow at the end of greens that in the net itself end in red at once."""
    kept_waiting: tuple[int, ...] = ()
    """Letters that have way when whom they meet is cleared; in the net itself they have it sooner."""
    callers: tuple[Caller, ...] = ()
    """In the order of their letters."""

    @property
    def crossings(self) -> tuple[int, ...]:
        """Letters of streams that no motor traffic is part of and that cross others: people walk there."""
        letters = enumerate(zip(self.signal_turns, self.conflicts, strict=True))
        return tuple(letter for letter, (turns, conflicts) in letters if not turns and any(conflicts))

    @property
    def is_mended(self) -> bool:
        """Whether its stages and clearances are not quite those of the net's own programme."""
        return bool(self.made_to_yield or self.given_yellow or self.kept_waiting)

    @property
    def is_walked(self) -> bool:
        """Whether people walk here."""
        return len(self.crossings) > 0


@dataclass(frozen=True)
class SideRoad:
    """A road without signals that waits for gaps in what signals let onto the road that it meets."""

    edge: str
    """SUMO edge that ends there."""
    via_lanes: tuple[str, ...]
    """SUMO lanes inside the node over which it is left."""
    behind: tuple[tuple[int, str, float], ...]
    """(junction, edge that its traffic goes on to, seconds of free driving from there to where the side road ends)."""


@dataclass(frozen=True)
class HeldGreen:
    """A part of a clearance in which some turns are green."""

    stage: int
    after_s: float
    """From the stage's end to its begin."""
    duration_s: float
    turns: tuple[int, ...]


@dataclass(frozen=True)
class Network:
    """Links, turns, stages and junctions, as read from a SUMO net (SPEC 1)."""

    name: str
    net_file: Path
    links: tuple[Link, ...]
    turns: tuple[Turn, ...]
    groups: tuple[LaneGroup, ...]
    """In the order of their links."""
    lane_sets: tuple[LaneSet, ...]
    """In the order of their lane groups."""
    stages: tuple[Stage, ...]
    junctions: tuple[Junction, ...]
    edge_lanes: Mapping[str, tuple[int, ...]]
    """Numbers of the lanes for motor vehicles of every SUMO edge that a link or a turn names."""
    edge_length_m: Mapping[str, float]
    startup_lag_s: float
    """Time from the start of green until the queue moves over the stop line; the yellow gives it back at its end."""
    whole_step_s: float | None = None
    """Of a part: the control step of the network that it is a part of, which its own cycles need not tell."""
    shortest_m: float = 5.0
    """Length of the shortest vehicle that will drive; a car's where nobody says."""
    acceleration_m_s2: float = CAR_ACCELERATION_M_S2
    """How fast queues of those who will drive speed up (`Traffic.acceleration_m_s2`); a car's where nobody says."""
    left_alone: Mapping[str, str] = field(default_factory=dict)
    """Signals that are none of the junctions, and why: they keep the net's own programme."""
    side_roads: tuple[SideRoad, ...] = ()
    """In the order of their edges."""

    @cached_property
    def turn_link(self) -> Ints:
        """(M,) link of each turn."""
        return np.array([turn.link for turn in self.turns], dtype=np.int64)

    @cached_property
    def turn_next(self) -> Ints:
        """(M,) link that each turn feeds, or EXIT."""
        return np.array([turn.next_link for turn in self.turns], dtype=np.int64)

    @cached_property
    def fraction(self) -> Floats:
        """(M,) turning fractions beta; they sum to 1 over a link."""
        return np.array([turn.fraction for turn in self.turns])

    @cached_property
    def serves(self) -> Bools:
        """(S, M) whether a stage gives green to a turn."""
        matrix = np.zeros((len(self.stages), len(self.turns)), dtype=np.bool_)
        for index, stage in enumerate(self.stages):
            matrix[index, list(stage.turns)] = True
        return matrix

    @cached_property
    def turn_group(self) -> Ints:
        """(M,) lane group of each turn."""
        return np.array([turn.group for turn in self.turns], dtype=np.int64)

    @cached_property
    def group_link(self) -> Ints:
        """(G,) link of each lane group."""
        return np.array([group.link for group in self.groups], dtype=np.int64)

    @cached_property
    def set_group(self) -> Ints:
        """(L,) lane group of each lane set."""
        return np.array([lane_set.group for lane_set in self.lane_sets], dtype=np.int64)

    @cached_property
    def set_link(self) -> Ints:
        """(L,) link of each lane set."""
        return np.asarray(self.group_link[self.set_group])

    @cached_property
    def unsignalled(self) -> Bools:
        """(M,) turns that no signal stops."""
        free = np.ones(len(self.turns), dtype=np.bool_)
        for junction in self.junctions:
            free[[turn for turns in junction.signal_turns for turn in turns]] = False
        return free

    @cached_property
    def never_green(self) -> Mapping[str, list[int]]:
        """Letters of motor traffic that no phase of their junction's programme opens, by its id: nobody goes there."""
        found = {}
        for junction in self.junctions:
            stages = [self.stages[stage] for stage in junction.stages]
            shown = [state for stage in stages for state in (stage.state, *(each for each, _ in stage.clearance))]
            letters = [letter for letter, turns in enumerate(junction.signal_turns) if turns]
            if closed := [each for each in letters if not any(state[each] in "Gg" for state in shown)]:
                found[junction.id] = closed
        return found

    @cached_property
    def within(self) -> Bools:
        """(Z,) links from one node with a signal to another, of one junction or of two, that hold few vehicles.

        With fewer than WITHIN_VEH a lane both nodes are one junction in truth: who has to wait between stands amid it,
        in the way of all behind him.
        """
        within = np.zeros(len(self.links), dtype=np.bool_)
        within[self.turn_next[self.turn_next != EXIT]] = True
        return within & (np.array([link.lane_room_veh for link in self.links]) < WITHIN_VEH)

    @cached_property
    def callers(self) -> tuple[tuple[int, Caller], ...]:
        """(C,) those who call for green themselves, one junction's after the other's, and at which they do."""
        return tuple((index, caller) for index, junction in enumerate(self.junctions) for caller in junction.callers)

    @cached_property
    def held_greens(self) -> tuple[HeldGreen, ...]:
        """The parts of clearances in which some turn is green, in the order of the stages."""
        found = []
        for index, stage in enumerate(self.stages):
            after_s = 0.0
            for (_, seconds), turns in zip(stage.clearance, stage.held, strict=False):
                if turns:
                    found.append(HeldGreen(index, after_s, seconds, turns))
                after_s += seconds
        return tuple(found)

    @cached_property
    def turn_windows(self) -> tuple[Ints, Ints, Ints]:
        """Windows of green of each turn in turn: stages, then held greens, numbered on; where each turn's begin; the
        turns that have any.
        """
        served = [stage.turns for stage in self.stages] + [held.turns for held in self.held_greens]
        pairs = sorted((turn, index) for index, turns in enumerate(served) for turn in turns)
        turn, window = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        turns, starts = np.unique(turn, return_index=True)
        return window, starts, turns

    @cached_property
    def links_of(self) -> tuple[Ints, ...]:
        """(J,) links that enter each junction."""
        return _places(self.link_junction, len(self.junctions))

    @cached_property
    def turns_of(self) -> tuple[Ints, ...]:
        """(J,) turns of each junction's links."""
        return _places(self.link_junction[self.turn_link], len(self.junctions))

    @cached_property
    def groups_of(self) -> tuple[Ints, ...]:
        """(J,) lane groups of each junction's links."""
        return _places(self.link_junction[self.group_link], len(self.junctions))

    @cached_property
    def link_junction(self) -> Ints:
        """(Z,) junction that each link enters."""
        return np.array([link.junction for link in self.links], dtype=np.int64)

    @cached_property
    def stage_junction(self) -> Ints:
        """(S,) junction of each stage."""
        return np.array([stage.junction for stage in self.stages], dtype=np.int64)

    @cached_property
    def storage_veh(self) -> Floats:
        """(Z,) vehicles that fit on each link (C_z)."""
        return np.array([link.storage_veh for link in self.links])

    @cached_property
    def saturation_flow_veh_s(self) -> Floats:
        """(Z,) saturation flow mu_z of each link."""
        return np.array([link.saturation_flow_veh_s for link in self.links])

    @cached_property
    def set_saturation_flow_veh_s(self) -> Floats:
        """(L,) saturation flow of each lane set: its share of the link's lanes."""
        lanes = np.array([len(lane_set.lanes) for lane_set in self.lane_sets])
        return np.asarray(self.saturation_flow_veh_s[self.set_link] * lanes / self._lanes[self.set_link])

    @cached_property
    def group_saturation_flow_veh_s(self) -> Floats:
        """(G,) saturation flow of each lane group."""
        return np.bincount(self.set_group, self.set_saturation_flow_veh_s, len(self.groups)).astype(float)

    @cached_property
    def _lanes(self) -> Ints:
        return np.array([link.lanes for link in self.links], dtype=np.int64)

    @cached_property
    def entry_flow_veh_s(self) -> Floats:
        """(Z,) most that enters each link from outside."""
        return np.array([link.entry_flow_veh_s for link in self.links])

    @cached_property
    def is_source(self) -> Bools:
        """(Z,) whether traffic from outside enters the link."""
        return np.array([link.is_source for link in self.links], dtype=np.bool_)

    @cached_property
    def begins_amid(self) -> Bools:
        """(Z,) whether roads that are no links lead to the link, and no others."""
        return np.array([link.begins_amid for link in self.links], dtype=np.bool_)

    @cached_property
    def turning_worth_veh(self) -> Floats:
        """(Z,) vehicles that the known turning fractions of each link are worth."""
        return np.array([link.turning_worth_veh for link in self.links])

    @cached_property
    def free_time_s(self) -> Floats:
        """(Z,) free-flow travel time of each link."""
        return np.array([link.length_m / link.free_speed_m_s for link in self.links])

    @cached_property
    def watched_veh(self) -> Floats:
        """(Z,) vehicles that fit on what the lane-area detectors see of each link."""
        length_m = np.array([link.length_m for link in self.links])
        return np.asarray(self.storage_veh * np.minimum(1.0, AREA_REACH_M / length_m))

    def group_shares(self, fraction: Floats) -> Floats:
        """(G,) of a link's traffic what takes the lanes of each group, by the turning fractions (M,)."""
        share = np.bincount(self.turn_group, fraction, len(self.groups))
        whole = np.bincount(self.group_link, share, len(self.links))[self.group_link]
        return np.asarray(share / np.maximum(whole, 1e-9))

    @cached_property
    def queue_spacing_s_veh(self) -> Floats:
        """(Z,) by how much a queued vehicle shortens the way to the queue's tail, in time."""
        return np.array([link.queue_spacing_m / link.free_speed_m_s for link in self.links])

    def watched(self, link: Link) -> list[tuple[str, float]]:
        """(edge, metres of it seen) from the stop line upstream, as far as the lane-area detectors reach."""
        seen, rest = [], AREA_REACH_M
        for edge in reversed(link.edges):
            if rest <= 0:
                break
            metres = min(rest, self.edge_length_m[edge])
            seen.append((edge, metres))
            rest -= metres
        return seen

    @cached_property
    def watched_lane_m(self) -> tuple[Floats, Floats]:
        """Lane metres that the lane-area detectors see: (L,) by lane set, (Z,) of each link before its lanes part."""
        seen_m = [dict(self.watched(link)) for link in self.links]
        last_m = [seen[link.edges[-1]] for seen, link in zip(seen_m, self.links, strict=True)]
        sets = [len(lane_set.lanes) * last_m[self.groups[lane_set.group].link] for lane_set in self.lane_sets]
        before = [
            sum(metres * len(self.edge_lanes[edge]) for edge, metres in seen.items() if edge != link.edges[-1])
            for seen, link in zip(seen_m, self.links, strict=True)
        ]
        return np.array(sets), np.array(before, dtype=float)

    @cached_property
    def clearance_s(self) -> Floats:
        """(S,) clearance after each stage."""
        return np.array([stage.clearance_s for stage in self.stages])

    def cycle_starts_s(self, time_s: Floats | float = 0.0) -> Floats:
        """(..., R, S) starts of the cycles of each stage's junction, counted from the times `time_s` (...).

        As many as may show in a control step that begins then, the one under way first. Under way is what still moves:
        it starts and ends `startup_lag_s` after its signals.
        """
        cycle_s, offset_s = (
            np.array([getattr(junction, name) for junction in self.junctions])[self.stage_junction]
            for name in ("cycle_s", "offset_s")
        )
        repeats = np.arange(-1, int(np.ceil(self.control_step_s / cycle_s.min())))
        first_s = (offset_s - np.asarray(time_s)[..., None]) % cycle_s
        first_s = np.where(first_s + self.startup_lag_s > cycle_s, first_s - cycle_s, first_s)
        return np.asarray(first_s[..., None, :] + repeats[:, None] * cycle_s)

    def since_cycle_start_s(self, green_s: Floats) -> Floats:
        """(..., S) from the start of its junction's cycle to each stage's green, under the plan `green_s` (..., S)."""
        order, head = self._stage_order
        lasts = (green_s + self.clearance_s)[..., order]
        begins = np.cumsum(lasts, axis=-1) - lasts
        since = np.empty_like(lasts)
        since[..., order] = begins - begins[..., head]
        return since

    @cached_property
    def _stage_order(self) -> tuple[Ints, Ints]:
        """Stages in the order of their junctions' cycles; for each, where its junction's first one is in that order."""
        counts = [len(junction.stages) for junction in self.junctions]
        order = np.concatenate([junction.stages for junction in self.junctions]).astype(np.int64)
        return order, np.repeat(np.cumsum([0, *counts[:-1]]), counts)

    @cached_property
    def min_green_s(self) -> Floats:
        """(S,) shortest green of each stage."""
        return np.array([stage.min_green_s for stage in self.stages])

    @cached_property
    def least_green_s(self) -> Floats:
        """(S,) shortest green of each stage where an execution ends it."""
        return np.array([stage.least_green_s for stage in self.stages])

    @cached_property
    def cycle_s(self) -> Floats:
        """(J,) cycle of each junction."""
        return np.array([junction.cycle_s for junction in self.junctions])

    @cached_property
    def green_budget_s(self) -> Floats:
        """(J,) green that a cycle can give away: the cycle less the lost time L_j (SPEC 3)."""
        return np.array(
            [junction.cycle_s - sum(self.stages[s].clearance_s for s in junction.stages) for junction in self.junctions]
        )

    @cached_property
    def delay_samples(self) -> int:
        """Samples that the longest free-flow delay reaches back to: the H of State.past_inflow_veh."""
        return 1 + int(np.ceil(self.free_time_s.max() / self.sample_s))

    @property
    def control_step_s(self) -> float:
        """Time between two decisions: the least common multiple of the cycles (SPEC 2.7, N = 1).

        Where that is more than `MOST_CYCLES` times the longest cycle it is the longest cycle: plans are then handed
        over where each junction's cycle begins, wherever in the step that is.
        """
        # In whole numbers of any size: that of many cycles is beyond 64 bits.
        multiple, longest_s = math.lcm(*map(int, self.cycle_s)), float(self.cycle_s.max())
        return self.whole_step_s or (float(multiple) if multiple <= MOST_CYCLES * longest_s else longest_s)

    @property
    def samples(self) -> int:
        """Samples that a control step is divided into (P)."""
        return int(np.ceil(self.control_step_s / SAMPLE_S))

    @property
    def sample_s(self) -> float:
        """Length of a sample, in which the entry loops are counted."""
        return self.control_step_s / self.samples

    def part(self, *junctions: int) -> Network:
        """The network of some junctions alone, one's incoming links, turns and stages after the other's.

        Indices count within the part; a turn that leads to another junction ends in EXIT.
        """
        links = np.concatenate([self.links_of[junction] for junction in junctions]).tolist()
        groups = np.concatenate([self.groups_of[junction] for junction in junctions]).tolist()
        turns = np.concatenate([self.turns_of[junction] for junction in junctions]).tolist()
        bounds = np.searchsorted(self.set_group, [groups, np.add(groups, 1)]).T
        lane_sets = [lane_set for begin, end in bounds for lane_set in self.lane_sets[begin:end]]
        stages = [stage for junction in junctions for stage in self.junctions[junction].stages]
        link_place, turn_place, group_place, stage_place, junction_place = (
            {whole: position for position, whole in enumerate(each)}
            for each in (links, turns, groups, stages, junctions)
        )

        def ahead(turn: Turn) -> int:
            own = turn.next_link != EXIT and self.links[turn.next_link].junction == self.links[turn.link].junction
            return link_place[turn.next_link] if own else EXIT

        return Network(
            name=f"{self.name}:{self.junctions[junctions[0]].id}" + "+" * (len(junctions) > 1),
            net_file=self.net_file,
            links=tuple(
                replace(self.links[link], junction=junction_place[self.links[link].junction]) for link in links
            ),
            turns=tuple(
                replace(turn, link=link_place[turn.link], next_link=ahead(turn), group=group_place[turn.group])
                for turn in (self.turns[index] for index in turns)
            ),
            groups=tuple(
                replace(group, link=link_place[group.link]) for group in (self.groups[index] for index in groups)
            ),
            lane_sets=tuple(
                replace(
                    lane_set,
                    group=group_place[lane_set.group],
                    turns=tuple(turn_place[turn] for turn in lane_set.turns),
                )
                for lane_set in lane_sets
            ),
            stages=tuple(
                replace(
                    stage,
                    junction=junction_place[stage.junction],
                    turns=tuple(turn_place[turn] for turn in stage.turns),
                    held=tuple(tuple(turn_place[turn] for turn in turns) for turns in stage.held),
                )
                for stage in (self.stages[index] for index in stages)
            ),
            junctions=tuple(
                replace(
                    whole,
                    stages=tuple(stage_place[stage] for stage in whole.stages),
                    signal_turns=tuple(tuple(turn_place[turn] for turn in turns) for turns in whole.signal_turns),
                )
                for whole in (self.junctions[index] for index in junctions)
            ),
            edge_lanes=self.edge_lanes,
            edge_length_m=self.edge_length_m,
            startup_lag_s=self.startup_lag_s,
            acceleration_m_s2=self.acceleration_m_s2,
            whole_step_s=self.control_step_s,
        )

    def link_index(self, link_id: str) -> int:
        """Index of the link called `link_id`."""
        return next(index for index, link in enumerate(self.links) if link.id == link_id)

    def equal_split(self) -> Plan:
        """The backup plan: each junction's green shared equally among its stages, in whole seconds.

        A stage whose least is more than that has its least, and the others share the rest.
        """
        green = np.zeros(len(self.stages))
        for junction, budget in zip(self.junctions, self.green_budget_s, strict=True):
            by_least = sorted(junction.stages, key=lambda stage: -self.stages[stage].min_green_s)
            rest_s = round(budget)
            for position, stage in enumerate(by_least):
                equal_s = -(-rest_s // (len(by_least) - position))
                green[stage] = max(self.stages[stage].min_green_s, equal_s)
                rest_s -= int(green[stage])
        return Plan(green_s=green)


def _places(owner: Ints, owners: int) -> tuple[Ints, ...]:
    """For each owner the places at which `owner` names it, in order."""
    order = np.argsort(owner, kind="stable")
    return tuple(np.split(order, np.searchsorted(owner[order], np.arange(1, owners))))


@dataclass(frozen=True)
class Measurement:
    """What the detectors counted over one control step, and lane-area readings at its end."""

    time_s: float
    """End of the step."""
    entered_veh: Floats
    """(P, Z) over the loops at the link's entry, by sample, in the order of time."""
    turned_veh: Floats
    """(M,) over the loops just behind the stop line, where the turns part."""
    queue_veh: Floats
    """(Z,) standing in the lane-area detectors at the end."""
    group_queue_veh: Floats
    """(G,) of these, who stands on the lanes of each lane group."""
    group_seen_veh: Floats
    """(G,) in the lane-area detectors on the lanes of each lane group at the end, moving or not."""
    beside_veh: Floats
    """(Z,) counted onto the link amid it over the loops at side roads, less those counted off it."""
    uncounted_veh: Floats
    """(Z,) found on the link during the step and not counted onto it, less those counted and not to be found: of an
    execution that asks who is there (View.x_veh)."""
    seen_veh: Floats
    """(Z,) in the lane-area detectors at the end, moving or not."""
    entry_occupancy: Floats
    """(Z,) share of the step in which the entry loops were covered, 0 to 1."""
    stop_line_occupancy: Floats
    """(Z,) the same of the loops at the stop line."""


@dataclass(frozen=True)
class State:
    """The estimate that a controller works from: no SUMO object in it."""

    cycle: int
    time_s: float
    x_veh: Floats
    """(Z,) vehicles on each link."""
    q_veh: Floats
    """(M,) queued vehicles by turn; their sum over a link is at most its x."""
    source_queue_veh: Floats
    """(Z,) vehicles that wait outside a source link for room to enter."""
    past_inflow_veh: Floats
    """(H, Z) vehicles that entered in each of the last samples, newest first (f_in as in SPEC 2.5, finer)."""
    turned_veh: Floats
    """(M,) vehicles that made each turn in the last step; their sum over a link is what left it."""
    fraction: Floats
    """(M,) turning fractions as they are at present; they sum to 1 over a link."""
    disturbance_veh: Floats
    """(Z,) vehicles that came onto each link amid it in the last step, less those that ended there: e_z of SPEC 2.1."""

    def part(self, links: Ints, turns: Ints) -> State:
        """What of it concerns these links and turns."""
        return State(
            self.cycle,
            self.time_s,
            self.x_veh[links],
            self.q_veh[turns],
            self.source_queue_veh[links],
            self.past_inflow_veh[:, links],
            self.turned_veh[turns],
            self.fraction[turns],
            self.disturbance_veh[links],
        )


@dataclass(frozen=True)
class Forecast:
    """What is expected from outside over the horizon."""

    demand_veh: Floats
    """(Kp, Z) vehicles that will want to enter each source link in each step ahead."""
    disturbance_veh: Floats | None = None
    """(Kp, Z) vehicles that will come onto each link amid it, less those that will end there; None for none."""
    served: tuple[str, ...] = ()
    """(Z,) by what method each source link's demand was foretold, empty for the others."""

    @property
    def outside_veh(self) -> tuple[Floats, Floats]:
        """Demand and disturbance, (Kp, Z) each."""
        expected = np.zeros_like(self.demand_veh) if self.disturbance_veh is None else self.disturbance_veh
        return self.demand_veh, expected

    def part(self, links: Ints) -> Forecast:
        """What of it concerns these links."""
        return Forecast(
            self.demand_veh[:, links], None if self.disturbance_veh is None else self.disturbance_veh[:, links]
        )


@dataclass(frozen=True)
class Plan:
    """Greens for every stage, for the coming cycle and, where the controller has them, for later ones."""

    green_s: Floats
    """(S,)"""
    ahead_s: Floats | None = None
    """(n, S) greens of the n cycles after that: what a failing controller is followed by."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What the controller wants recorded: iterations, residuals, cost."""


class View(Protocol):
    """What is to be seen at one moment, for decisions within the cycle. Detectors are read when they are asked for.

    Its arrays are the execution's own to write into, which changes nothing on the road.
    """

    @property
    def time_s(self) -> float: ...

    @property
    def stage(self) -> Ints:
        """(J,) stage that each junction shows, or is on its way to."""
        ...

    @property
    def begin_s(self) -> Floats:
        """(J,) when it began, or will."""
        ...

    @property
    def free(self) -> Bools:
        """(J,) junctions whose stage has had its least green."""
        ...

    @property
    def waiting_veh(self) -> Floats:
        """(G,) standing in the lane-area detectors, by lane group."""
        ...

    @property
    def set_waiting_veh(self) -> Floats:
        """(L,) the same by lane set; who stands before the lanes part is before all that he may go to."""
        ...

    @property
    def near_veh(self) -> Floats:
        """(G,) in the lane-area detectors, moving or not, by lane group."""
        ...

    @property
    def x_veh(self) -> Floats:
        """(Z,) vehicles on each link: as estimated when the control step began, and counted since."""
        ...

    @property
    def entered_veh(self) -> Floats:
        """(Z,) vehicles that have come onto each link since the run began, but for who starts on it."""
        ...

    @property
    def left_veh(self) -> Floats:
        """(L,) vehicles that have left over the stop line of each lane set since the run began."""
        ...

    @property
    def parted_veh(self) -> Floats:
        """(Z,) vehicles that have left each link amid it since the run began."""
        ...

    @property
    def calling(self) -> Floats:
        """(C,) of each caller how many of its buttons are pressed, and how many are close on its lanes."""
        ...

    def zone_veh(self, junctions: Bools) -> tuple[Floats, Floats]:
        """Vehicles before some junctions (J,) by how far they are from the stop line (`ZONES_M`), none elsewhere.

        (L, zones) on the lanes of each lane set, (Z, zones) on each link before its lanes part.
        """
        ...

    def standing_amid_veh(self, turn: int) -> float:
        """Vehicles of one turn onto a link within a junction (`Network.within`) that stand or creep amid it."""
        ...

    def side_standing_veh(self, roads: Bools) -> Floats:
        """(R,) vehicles that stand at the end of some side roads (R,), none on others."""
        ...

    def side_left_veh(self, roads: Bools) -> Floats:
        """(R,) vehicles that have left some side roads (R,) since the run began; what others have is of no meaning."""
        ...

    def close_one_veh(self, lane_set: int) -> float:
        """Vehicles within 50 m of the stop line (CLOSE_ZONES) on one lane set, or before its lanes part from others."""
        ...

    def near_one_veh(self, group: int) -> float:
        """What `near_veh` has for one lane group, for whom the others are no matter."""
        ...

    def gap_one_s(self, group: int) -> float:
        """Time since a vehicle was last on the stop-line loops of one lane group."""
        ...


@runtime_checkable
class Execution(Protocol):
    """Whatever carries a plan out within the cycle, by what is to be seen at the moment.

    An execution is built as `Class(network, **settings)`. One that has `lets_out = True` wants red before a green to
    last until those can have gone who are left amid the junction (plant.inside).
    """

    every_s: float
    """Time until the next decision, read anew after each: a second or more (`is_pause`)."""

    def begin(self, plan: Plan, state: State) -> None:
        """Take up the plan of a new control step, and the state that it was made from."""
        ...

    def wish(self, view: View) -> Ints:
        """(J,) stage that each junction is to show from now on. Its least green and the clearance are kept anyway."""
        ...


def is_pause(every_s: object) -> bool:
    """Whether that may be the time between two decisions of an execution."""
    return isinstance(every_s, Real) and LEAST_PAUSE_S <= float(every_s) < np.inf


@runtime_checkable
class Controller(Protocol):
    """Whatever chooses greens once a control step.

    A controller is built as `Class(network, **settings)`.
    """

    horizon: int
    """Steps of forecast that it wants (Kp); 1 where it wants none."""

    def plan(self, state: State, forecast: Forecast) -> Plan:
        """Greens for the coming step. May raise: the supervisor then falls back and records it."""
        ...
