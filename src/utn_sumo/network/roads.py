"""How edges of a SUMO net make up links: chained upstream through nodes without signals, lanes by what uses them.

A link is the main road to a stop line. It goes on upstream through a node without signals where the main road in and
the main road out name each other; side roads at such a node bring traffic onto the link, or take it off, amid it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from utn_sumo.errors import NetworkError
from utn_sumo.xml_files import opened

MOTOR = (
    "passenger", "taxi", "bus", "coach", "delivery", "truck", "trailer", "motorcycle", "moped", "emergency", "private",
    "hov", "evehicle", "custom1", "custom2",
)  # fmt: skip
"""SUMO's vehicle classes that a lane for motor vehicles has one of, at least."""
TURNAROUND = "t"
STRAIGHT = "s"
STANDS_M = 1.0
"""SUMO has vehicles stand so far before a stop line."""
RARE_LANES = 0.05
"""What a turnaround, or a turn for buses alone, counts as where nothing says how many take it."""


def motor_lanes(edge: Any) -> tuple[int, ...]:
    """Numbers of the lanes of a sumolib edge for motor vehicles."""
    return tuple(lane.getIndex() for lane in edge.getLanes() if _admits_motors(lane))


def reserved_lanes(edge: Any) -> frozenset[int]:
    """Numbers of its lanes for motor vehicles that no car may use, as those for buses."""
    return frozenset(index for index in motor_lanes(edge) if not edge.getLane(index).allows("passenger"))


def free_s(edge: Any) -> float:
    """Time that a motor vehicle drives on an edge (sumolib), by the leftmost lane for it."""
    lanes = motor_lanes(edge)
    speed_m_s = edge.getLane(lanes[-1]).getSpeed() if lanes else edge.getSpeed()
    return float(edge.getLength() / speed_m_s)


def _admits_motors(lane: Any) -> bool:
    return any(lane.allows(vehicle) for vehicle in MOTOR)


def for_motors(connections: Iterable[Any]) -> list[Any]:
    """The connections between lanes for motor vehicles."""
    return [each for each in connections if _admits_motors(each.getFromLane()) and _admits_motors(each.getToLane())]


class Inside(NamedTuple):
    """Lanes inside a net's nodes, which sumolib leaves out here."""

    length_m: Mapping[str, float]
    """By lane."""
    onward: Mapping[str, str]
    """The lane that one leads onto who has waited at its end, amid the junction."""

    @classmethod
    def of(cls, path: Path) -> Inside:
        """Those of a net file."""
        from defusedxml import ElementTree  # noqa: PLC0415

        length_m: dict[str, float] = {}
        onward: dict[str, str] = {}
        with opened(path) as file:
            for _, element in ElementTree.iterparse(file, forbid_dtd=True):
                if element.tag == "lane" and element.get("id", "").startswith(":"):
                    length_m[element.get("id")] = _length_m(path, element)
                if element.tag == "connection" and element.get("via") and element.get("from", "").startswith(":"):
                    onward[f"{element.get('from')}_{element.get('fromLane')}"] = element.get("via")
                if element.tag in ("junction", "connection", "edge", "tlLogic"):
                    element.clear()
        return cls(length_m, onward)

    def crossing_m(self, lane: str) -> float:
        """How far it is across the junction for who gives way on a lane, from where he waits."""
        lanes = [self.onward.get(lane, lane)]
        while (after := self.onward.get(lanes[-1])) and after not in lanes:
            lanes.append(after)
        return sum(self.length_m.get(each, 0.0) for each in lanes)


def _length_m(path: Path, lane: Any) -> float:
    try:
        length_m = float(lane.get("length", ""))
    except ValueError:
        length_m = math.nan
    if not 0 <= length_m < math.inf:
        raise NetworkError(
            f"net {str(path)!r}: lane {lane.get('id')!r} is {lane.get('length')!r} m long: give a .net.xml written by "
            "netconvert"
        )
    return length_m


def leads_on(edge: Any) -> bool:
    """Whether the road that an edge (sumolib) is of comes from elsewhere in the net, and not from its end."""
    before = [other for other, each in edge.getIncoming().items() if for_motors(each)]
    return any(other.getFromNode() is not edge.getToNode() for other in before)


def usual_weight(connections: Iterable[Any]) -> float:
    """How much of an edge's traffic takes the turn that these connections make up, by their lanes; relative."""
    return sum(
        1.0 if each.getDirection() != TURNAROUND and each.getFromLane().allows("passenger") else RARE_LANES
        for each in connections
    )


@dataclass(frozen=True)
class Chain:
    """The edges of a link, its stop line's last, and where traffic joins and parts amid it: lanes inside nodes."""

    edges: tuple[str, ...]
    joining: tuple[str, ...]
    parting: tuple[str, ...]
    parting_m: tuple[float, ...]
    """How far before the stop line each of those is."""
    waiting: tuple[str, ...]
    """Lanes inside the node before the last edge, if vehicles stand there because that is too short."""


class Roads:
    """Follows the main roads of a net (sumolib) upstream."""

    def __init__(self, net: Any, approaches: Collection[str]):
        """`approaches` are the edges that end at a signal's stop line."""
        self._net = net
        self._approaches = approaches

    def chain(self, approach: str) -> Chain:
        """The link that ends with the edge `approach`."""
        edges, joining, parting, to_line_m = [approach], list[str](), list[tuple[str, float]](), 0.0
        while True:
            edge = self._net.getEdge(edges[0])
            before = self._main_before(edge)
            if before is None or before.getID() in edges:
                parting.sort()
                lanes, places_m = tuple(lane for lane, _ in parting), tuple(place_m for _, place_m in parting)
                return Chain(tuple(edges), tuple(sorted(joining)), lanes, places_m, self._waiting(approach))
            onto = [c for other, each in edge.getIncoming().items() if other is not before for c in for_motors(each)]
            off = [c for other, each in before.getOutgoing().items() if other is not edge for c in for_motors(each)]
            joining += [each.getViaLaneID() for each in onto]
            to_line_m += edge.getLength()
            parting += [(each.getViaLaneID(), to_line_m) for each in off]
            edges.insert(0, before.getID())

    def _waiting(self, approach: str) -> tuple[str, ...]:
        edge = self._net.getEdge(approach)
        if edge.getLength() > STANDS_M:
            return ()
        onto = (each for connections in edge.getIncoming().values() for each in for_motors(connections))
        # Who stands amid a junction with signals is seen there.
        return tuple(sorted(each.getViaLaneID() for each in onto if each.getViaLaneID() and not each.getTLSID()))

    def _main_before(self, edge: Any) -> Any | None:
        """The edge that the main road comes from, through a node without signals that can be watched; else None."""
        incoming = {other: for_motors(each) for other, each in edge.getIncoming().items()}
        if any(each.getTLSID() for connections in edge.getIncoming().values() for each in connections):
            return None
        before = main_road(incoming)
        if before is None or before.getID() in self._approaches:
            return None
        outgoing = {other: for_motors(each) for other, each in before.getOutgoing().items()}
        sides = [each for other, connections in incoming.items() if other is not before for each in connections]
        sides += [each for other, connections in outgoing.items() if other is not edge for each in connections]
        return before if main_road(outgoing) is edge and all(each.getViaLaneID() for each in sides) else None


def main_road(sides: Mapping[Any, list[Any]]) -> Any | None:
    """The main one of the roads that meet another at a node: straight on, then by lanes, then by the road's rank."""
    able = [(edge, connections) for edge, connections in sides.items() if usual_weight(connections) > RARE_LANES]
    if not able:
        return None

    def rank(side: tuple[Any, list[Any]]) -> tuple[Any, ...]:
        edge, connections = side
        straight = any(each.getDirection() == STRAIGHT for each in connections)
        return straight, usual_weight(connections), edge.getPriority(), edge.getID()

    return max(able, key=rank)[0]
