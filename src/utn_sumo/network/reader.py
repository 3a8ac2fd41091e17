"""A SUMO net read into links, turns, lane groups, stages and junctions.

A link is the road that leads to a signalled junction, chained upstream through nodes without signals (`roads`).
Stages and clearances come from the signal programmes (`programmes`), conflicts from the net's own right-of-way matrix
(`streams`). Lanes, signals and edges that no motor vehicle uses are read for their letters' sake alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import utn_network
from utn_sumo.contract import EXIT, SAMPLE_S, Junction, LaneGroup, LaneSet, Link, Network, Stage, Turn
from utn_sumo.errors import NetworkError, did_you_mean
from utn_sumo.network import programmes
from utn_sumo.network.lanes import lane_groups, lane_sets
from utn_sumo.network.programmes import MIN_GREEN_S, SHORT_GREEN_S, Block, Phase
from utn_sumo.network.roads import (
    Chain,
    Inside,
    Roads,
    for_motors,
    free_s,
    leads_on,
    motor_lanes,
    reserved_lanes,
    usual_weight,
)
from utn_sumo.network.sides import side_roads
from utn_sumo.network.streams import Signal, crossings
from utn_sumo.network.ways import Traffic, turned_veh
from utn_sumo.xml_files import opened, stem

SPACE_PER_VEHICLE_M = 7.5
"""A standing vehicle and its gap: SUMO's default 5 m + 2.5 m (SPEC 1: 2 * 400 / 7.5 = 106)."""
SATURATION_FLOW_VEH_S_LANE = 0.435
"""Queue discharge per second of green and lane. Measured on eight links of `utn17`: 0.42-0.45, with an intercept
of 0 +- 0.8 veh a cycle, so that what start-up loses the yellow gives back."""
GIVEN_TURNING_VEH, USUAL_TURNING_VEH = 200.0, 10.0
"""Vehicles that turning fractions are worth which are given, and which are only guessed from the lanes."""
LEAST_STORAGE_VEH_LANE = SATURATION_FLOW_VEH_S_LANE * SAMPLE_S
"""What passes in a step of the model: a road that is shorter, amid a junction, holds nobody up by what it stores."""
STARTUP_LAG_S = 3.0
"""From green to a moving queue, before calibration."""


def load(
    name: str,
    left_alone: Mapping[str, str] | None = None,
    additional: Sequence[Path] = (),
    traffic: Traffic | None = None,
    usual_green_s: float = MIN_GREEN_S,
) -> Network:
    """The shipped network `name`, or the one in the .net.xml file that `name` is a path of.

    Signals in `left_alone` keep the net's own programme, for the reason given there. Signal programmes in `additional`
    files stand for the net's own, the last one read for each signal, as in SUMO. A stage for which the net names no
    least green has `usual_green_s`.

    Turning fractions are read from NAME.turns.xml beside the net (SUMO's edgeRelations), else counted in the `traffic`
    that will drive here, if that is known; else every lane-to-lane connection of a link is taken to carry the same
    share. What room a vehicle takes is the traffic's too.
    """
    if name in utn_network.names():
        return read(utn_network.net_file(name), name, usual_green_s=usual_green_s)
    path = Path(name)
    if not path.is_file():
        known = did_you_mean(name, utn_network.names())
        raise NetworkError(f"net {name!r}: neither a shipped net nor a file; {known}")
    if "," in str(path.resolve()):
        raise NetworkError(f"net {name!r} lies under a name with a comma, which SUMO parts lists at: rename it")
    return read(path, stem(path), left_alone, additional, traffic, usual_green_s=usual_green_s)


def read(
    path: Path,
    name: str,
    excluded: Mapping[str, str] | None = None,
    additional: Sequence[Path] = (),
    traffic: Traffic | None = None,
    *,
    usual_green_s: float = MIN_GREEN_S,
) -> Network:
    """Read one net file. Raises NetworkError with one line if it can't be used."""
    import sumolib  # noqa: PLC0415 - heavy, and only this door needs it

    _refuse_entities(path)
    try:
        net = sumolib.net.readNet(
            str(path), withPrograms=True, withLatestPrograms=True, withFoes=True, withInternal=False
        )
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise NetworkError(
            f"net {str(path)!r} can't be read ({reason}): give a .net.xml written by netconvert"
        ) from error
    if not net.getEdges():
        raise NetworkError(
            f"net {str(path)!r} holds no roads: give a .net.xml written by netconvert, or a scenario as .sumocfg"
        )
    still = next((lane.getID() for edge in net.getEdges() for lane in edge.getLanes() if not lane.getSpeed() > 0), None)
    if still is not None:
        raise NetworkError(f"net {str(path)!r}: lane {still!r} has a speed of 0: give it one above")
    lights = sorted(net.getTrafficLights(), key=lambda tls: _natural(tls.getID()))
    if not lights:
        raise NetworkError(f"net {str(path)!r} has no traffic lights: there is nothing to control")
    known = programmes.added(additional, {tls.getID(): programmes.own(tls) for tls in lights})
    foreign = programmes.switched_elsewhere(additional)
    walked = crossings(path)
    signals = [Signal(net, tls, known[tls.getID()], walked.get(tls.getID(), [])) for tls in lights]
    reasons_of = {
        signal.id: (excluded or {}).get(signal.id) or foreign.get(signal.id) or _why_left_alone(signal)
        for signal in signals
    }
    left_alone = {signal: reason for signal, reason in reasons_of.items() if reason}
    left_alone |= _sharing_approaches([signal for signal in signals if signal.id not in left_alone])
    controlled = [signal for signal in signals if signal.id not in left_alone]
    if not controlled:
        alike: dict[str, list[str]] = {}
        for signal, reason in left_alone.items():
            alike.setdefault(reason, []).append(signal)
        reasons = "; ".join(f"{', '.join(own)}: {reason}" for reason, own in alike.items())
        raise NetworkError(f"net {str(path)!r} has no signals that can be controlled ({reasons})")
    reader = _Reader(net, controlled, _read_fractions(path), traffic, usual_green_s, inside=Inside.of(path))
    return reader.network(path.resolve(), name, left_alone)


def _why_left_alone(signal: Signal) -> str:
    if not signal.approaches:
        return "no motor traffic passes it"
    return programmes.why_left_alone(signal.programme, signal.used_letters, signal.of_motors)


def _sharing_approaches(signals: Sequence[Signal]) -> dict[str, str]:
    """Signals that stop traffic of a road of which another stops more, and why they are left alone: a link has one."""
    found: dict[str, str] = {}
    taken: dict[str, str] = {}
    for signal in sorted(signals, key=lambda signal: -len(signal.connections)):
        approaches = signal.approaches
        shared = [edge for edge in approaches if edge in taken]
        if shared:
            found[signal.id] = f"it shares the road {shared[0]!r} with signal {taken[shared[0]]!r}, which is controlled"
        else:
            taken |= dict.fromkeys(approaches, signal.id)
    return found


def shapes(path: Path) -> dict[str, list[tuple[float, float]]]:
    """The course of every road of a net file [m], by its edge, for drawing."""
    import sumolib  # noqa: PLC0415 - heavy, and only this door needs it

    return {edge.getID(): list(edge.getShape()) for edge in sumolib.net.readNet(str(path)).getEdges()}


def _refuse_entities(path: Path) -> None:
    """Raise NetworkError for a file that declares a document type: nets have none, and entities can blow up."""
    from defusedxml import ElementTree  # noqa: PLC0415
    from defusedxml.common import DefusedXmlException  # noqa: PLC0415

    try:
        with opened(path) as file:
            next(ElementTree.iterparse(file, events=("start",), forbid_dtd=True))
    except DefusedXmlException as error:
        raise NetworkError(
            f"net {str(path)!r} declares a document type, which may hide entities: give one that netconvert wrote"
        ) from error
    except (ElementTree.ParseError, OSError, EOFError, StopIteration) as error:
        reason = str(error) or "it is empty"
        raise NetworkError(
            f"net {str(path)!r} can't be read ({reason}): give a .net.xml written by netconvert"
        ) from error


class _Reader:
    """Builds the index spaces in the order links, turns, lane groups, stages, junctions."""

    def __init__(
        self,
        net: Any,
        signals: Sequence[Signal],
        fractions: Mapping[tuple[str, str], float],
        traffic: Traffic | None,
        usual_green_s: float,
        *,
        inside: Inside,
    ):
        self.net = net
        self.inside = inside
        self.signals = signals
        self.fractions = fractions
        self.usual_green_s = usual_green_s
        self.coming_veh = None if traffic is None else _coming_veh(net, traffic)
        self.space_m = SPACE_PER_VEHICLE_M if traffic is None else traffic.space_m
        self.shortest_m = Network.shortest_m if traffic is None else traffic.shortest_m
        self.acceleration_m_s2 = Network.acceleration_m_s2 if traffic is None else traffic.acceleration_m_s2
        # Approach edge -> position of the junction that it enters.
        self.junction_of = {edge: position for position, signal in enumerate(signals) for edge in signal.approaches}
        self.approaches = sorted(self.junction_of, key=_natural)
        self.link_of = {edge: index for index, edge in enumerate(self.approaches)}
        roads = Roads(net, self.junction_of)
        self.chains = [roads.chain(edge) for edge in self.approaches]
        self.link_from = {chain.edges[0]: index for index, chain in enumerate(self.chains)}

    def network(self, path: Path, name: str, left_alone: Mapping[str, str]) -> Network:
        turns, groups, lanes_of = self._turns()
        fed = {turn.next_link for turn in turns}
        links = tuple(self._link(chain, index in fed) for index, chain in enumerate(self.chains))
        turn_index = {(turn.link, turn.to_edge): index for index, turn in enumerate(turns)}
        stages: list[Stage] = []
        junctions: list[Junction] = []
        for position, signal in enumerate(self.signals):
            assert signal.programme is not None
            second = signal.second()
            bare = signal.programme.without_yellow(signal.of_vehicles)
            programme = signal.programme.yielding(second).cleared(bare)
            too_soon = programme.too_soon(signal.conflicts)
            programme = programme.waiting(too_soon)
            signal_turns = self._signal_turns(signal, turn_index)
            first = len(stages)
            walked = set(range(signal.letters)) - signal.of_vehicles
            stages += [_stage(block, position, signal_turns, self.usual_green_s) for block in programme.blocks]
            junctions.append(
                Junction(
                    id=signal.id,
                    stages=tuple(range(first, len(stages))),
                    cycle_s=programme.cycle_s,
                    offset_s=programme.offset_s + programme.begin_s,
                    signal_turns=signal_turns,
                    conflicts=signal.conflicts,
                    without_yellow=tuple(sorted(walked)),
                    made_to_yield=tuple(sorted({letter for letter, _ in second})),
                    given_yellow=tuple(sorted(bare)),
                    kept_waiting=tuple(sorted({letter for _, letter in too_soon})),
                    callers=signal.callers,
                )
            )
        of_links = {edge for link in links for edge in link.edges}
        fed_roads = {(links[turn.link].junction, turn.to_edge) for turn in turns}
        sides = side_roads(self.net, fed_roads, of_links)
        edges = sorted(of_links | {turn.to_edge for turn in turns} | {side.edge for side in sides})
        return Network(
            name,
            path,
            links,
            tuple(turns),
            tuple(groups),
            tuple(self._lane_sets(groups, turns, lanes_of, turn_index, stages)),
            tuple(stages),
            tuple(junctions),
            edge_lanes={edge: motor_lanes(self.net.getEdge(edge)) for edge in edges},
            edge_length_m={edge: self.net.getEdge(edge).getLength() for edge in edges},
            startup_lag_s=STARTUP_LAG_S,
            shortest_m=self.shortest_m,
            acceleration_m_s2=self.acceleration_m_s2,
            left_alone=left_alone,
            side_roads=sides,
        )

    def _link(self, chain: Chain, fed: bool) -> Link:
        edges = [self.net.getEdge(member) for member in chain.edges]
        lanes = [len(motor_lanes(edge)) for edge in edges]
        lane_m = sum(edge.getLength() * count for edge, count in zip(edges, lanes, strict=True))
        length = sum(edge.getLength() for edge in edges)
        return Link(
            id=chain.edges[-1],
            edges=chain.edges,
            junction=self.junction_of[chain.edges[-1]],
            lanes=lanes[-1],
            length_m=length,
            free_speed_m_s=length / sum(map(free_s, edges)),
            storage_veh=max(lanes[-1] * LEAST_STORAGE_VEH_LANE, lane_m / self.space_m),
            queue_spacing_m=self.space_m * length / lane_m,
            saturation_flow_veh_s=lanes[-1] * SATURATION_FLOW_VEH_S_LANE,
            is_source=not fed,
            begins_amid=not fed and leads_on(edges[0]),
            turning_worth_veh=self._worth_veh(chain.edges[-1]),
            joining=chain.joining,
            parting=chain.parting,
            parting_m=chain.parting_m,
            waiting=tuple((lane, self.inside.length_m[lane]) for lane in chain.waiting),
        )

    def _turns(self) -> tuple[list[Turn], list[LaneGroup], list[tuple[int, ...]]]:
        """Turns, lane groups, and the lanes of each turn."""
        turns: list[Turn] = []
        lanes_of: list[tuple[int, ...]] = []
        groups: list[LaneGroup] = []
        for index, edge_id in enumerate(self.approaches):
            outgoing = {edge: for_motors(each) for edge, each in self.net.getEdge(edge_id).getOutgoing().items()}
            targets = sorted((edge for edge, each in outgoing.items() if each), key=lambda edge: _natural(edge.getID()))
            shares = self._shares(edge_id, {edge.getID(): outgoing[edge] for edge in targets})
            lanes = [tuple(sorted({each.getFromLane().getIndex() for each in outgoing[edge]})) for edge in targets]
            inside = {edge: _via_lanes(outgoing[edge]) for edge in targets}
            found = lane_groups(zip((edge.getID() for edge in targets), lanes, strict=True))
            lanes_of += lanes
            group_of = {name: len(groups) + place for place, (_, names) in enumerate(found) for name in names}
            groups += [LaneGroup(index, lanes) for lanes, _ in found]
            turns += [
                Turn(
                    link=index,
                    to_edge=edge.getID(),
                    next_link=self.link_from.get(edge.getID(), EXIT),
                    fraction=share,
                    via_lanes=tuple(via for via, _ in inside[edge]),
                    from_lanes=tuple(lane for _, lane in inside[edge]),
                    crossing_m=max(self.inside.crossing_m(via) for via, _ in inside[edge]),
                    group=group_of[edge.getID()],
                )
                for edge, share in zip(targets, shares, strict=True)
            ]
        return turns, groups, lanes_of

    def _lane_sets(
        self,
        groups: Sequence[LaneGroup],
        turns: Sequence[Turn],
        lanes_of: Sequence[Sequence[int]],
        turn_index: Mapping[tuple[int, str], int],
        stages: Sequence[Stage],
    ) -> list[LaneSet]:
        """The lanes of each group, parted where they do not move alike."""
        letters: dict[tuple[int, int], set[int]] = {}
        for signal in self.signals:
            for connection, letter in signal.connections:
                link = self.link_of.get(connection.getFrom().getID(), -1)
                turn = turn_index.get((link, connection.getTo().getID()))
                if turn is not None:
                    letters.setdefault((turn, connection.getFromLane().getIndex()), set()).add(letter)
        ways: list[dict[int, dict[int, set[int]]]] = [{lane: {} for lane in group.lanes} for group in groups]
        for index, (each, lanes) in enumerate(zip(turns, lanes_of, strict=True)):
            for lane in lanes:
                ways[each.group][lane][index] = letters.get((index, lane), set())
        states: list[list[str]] = [[] for _ in self.signals]
        for stage in stages:
            states[stage.junction].append(stage.state)
        shown = [states[self.junction_of[self.approaches[group.link]]] for group in groups]
        reserved = [reserved_lanes(self.net.getEdge(self.approaches[group.link])) for group in groups]
        share = {index: turn.fraction for index, turn in enumerate(turns)}
        return [
            LaneSet(
                group,
                lanes,
                tuple(own),
                tuple(tuple(sorted(each)) for each in own.values()),
                is_reserved=lanes[0] in reserved[group],
            )
            for group, (by_lane, of_junction) in enumerate(zip(ways, shown, strict=True))
            for lanes, own in lane_sets(by_lane, of_junction, share, reserved[group])
        ]

    def _shares(self, edge_id: str, connections: Mapping[str, list[Any]]) -> list[float]:
        """Turning fractions of an approach edge: as given, else by lanes, and by the traffic that will turn there.

        That way lanes are worth one vehicle.
        """
        given = [self.fractions.get((edge_id, to_edge)) for to_edge in connections]
        usual = [usual_weight(each) for each in connections.values()]
        coming = [(self.coming_veh or {}).get((edge_id, to_edge), 0.0) for to_edge in connections]
        weights = [veh + weight / sum(usual) for veh, weight in zip(coming, usual, strict=True)]
        if any(value is not None for value in given):
            weights = [value or 0.0 for value in given]
        total = sum(weights)
        if total <= 0:
            raise NetworkError(f"link {edge_id!r}: its turning fractions sum to {total}: give it some")
        return [weight / total for weight in weights]

    def _worth_veh(self, edge_id: str) -> float:
        """How much the turning fractions of an approach edge are worth."""
        targets = [edge.getID() for edge in self.net.getEdge(edge_id).getOutgoing()]
        if self.coming_veh is None:
            given = any((edge_id, to_edge) in self.fractions for to_edge in targets)
            return GIVEN_TURNING_VEH if given else USUAL_TURNING_VEH
        coming = sum(self.coming_veh.get((edge_id, to_edge), 0.0) for to_edge in targets)
        return min(GIVEN_TURNING_VEH, USUAL_TURNING_VEH + coming)

    def _signal_turns(self, signal: Signal, turn_index: Mapping[tuple[int, str], int]) -> tuple[tuple[int, ...], ...]:
        found: list[set[int]] = [set() for _ in range(signal.letters)]
        for connection, letter in signal.connections:
            link = self.link_of.get(connection.getFrom().getID(), -1)
            turn = turn_index.get((link, connection.getTo().getID()))
            if turn is not None:
                found[letter].add(turn)
        return tuple(tuple(sorted(turns)) for turns in found)


def _coming_veh(net: Any, traffic: Traffic) -> dict[tuple[str, str], float]:
    """Vehicles that will go on from edge to edge, on their own ways or on those that SUMO will find."""
    total = dict(traffic.turned_veh)
    for turn, veh in turned_veh(net, traffic.trips_veh).items():
        total[turn] = total.get(turn, 0.0) + veh
    return total


def _stage(block: Block, junction: int, signal_turns: Sequence[Sequence[int]], usual_green_s: float) -> Stage:
    """A stage of a junction, with the turns that it and each part of its clearance open."""

    def served(phase: Phase) -> tuple[int, ...]:
        return tuple(sorted({turn for signal in phase.green for turn in signal_turns[signal]}))

    return Stage(
        junction=junction,
        state=block.stage.state,
        clearance=tuple((phase.state, phase.duration_s) for phase in block.clearance),
        turns=served(block.stage),
        min_green_s=block.min_green_s(usual_green_s),
        # Who walks has five seconds to set out, and the clearance to arrive; a walk with no vehicles beside it lasts.
        least_green_s=block.least_green_s(SHORT_GREEN_S if served(block.stage) else usual_green_s),
        held=tuple(served(phase) for phase in block.clearance),
    )


def _via_lanes(connections: list[Any]) -> list[tuple[str, int]]:
    """The lane inside the junction that each of a turn's connections takes, and the number of that it begins at."""
    lanes = [(connection.getViaLaneID(), connection.getFromLane().getIndex()) for connection in connections]
    if not all(via for via, _ in lanes):
        edge = connections[0].getFrom().getID()
        raise NetworkError(f"link {edge!r} has no lanes inside its junction: build the net with internal links")
    return sorted(lanes)


def _read_fractions(net_path: Path) -> dict[tuple[str, str], float]:
    """Turning fractions by (from edge, to edge) from the file beside the net, empty without one."""
    from defusedxml import ElementTree  # noqa: PLC0415
    from defusedxml.common import DefusedXmlException  # noqa: PLC0415

    path = net_path.with_name(f"{stem(net_path)}.turns.xml")
    if not path.is_file():
        return {}
    try:
        relations = ElementTree.parse(path).iter("edgeRelation")
        fractions = {(r.get("from"), r.get("to")): float(r.get("probability")) for r in relations}
    except (ElementTree.ParseError, DefusedXmlException, TypeError, ValueError) as error:
        raise NetworkError(
            f"turning fractions {str(path)!r} can't be read ({error}): give edgeRelations with from, to and probability"
        ) from error
    for (start, end), value in fractions.items():
        if not 0 <= value < math.inf:
            raise NetworkError(f"turning fractions {str(path)!r}: {start} to {end} is {value:g}: give 0 or more")
    return fractions


def _natural(text: str) -> tuple[int, int, str]:
    """Sort key that puts '2' before '10' and numbers before names."""
    return (0, int(text), "") if text.isdecimal() else (1, 0, text)
