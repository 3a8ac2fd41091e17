"""What the letters of a signal stand for: streams of vehicles and pedestrian crossings, and which of them conflict."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from pathlib import Path
from typing import Any

from utn_sumo.contract import Caller
from utn_sumo.errors import NetworkError
from utn_sumo.network.programmes import Programme
from utn_sumo.network.roads import STANDS_M, STRAIGHT, for_motors
from utn_sumo.xml_files import opened


class Signal:
    """One signal of a net: what its letters stand for, and its programme."""

    def __init__(self, net: Any, tls: Any, programme: Programme | None, crossings: Sequence[Crossing]):
        self.id = str(tls.getID())
        self.programme = programme
        self.connections: list[tuple[Any, int]] = []
        """Connections between lanes for vehicles, and their letters."""
        for from_lane, to_lane, index in tls.getConnections():
            self.connections += [(each, index) for each in from_lane.getOutgoing() if each.getToLane() is to_lane]
        self.of_vehicles = frozenset(index for _, index in self.connections)
        self.of_motors = frozenset(index for connection, index in self.connections if for_motors([connection]))
        self.beside_motors = self.of_vehicles - self.of_motors
        """Letters of trams and bicycles alone."""
        self._walked = crossings
        self._net = net
        used = [*self.of_vehicles, *(index for crossing in crossings for index in crossing.letters)]
        self.used_letters = 1 + max(used, default=-1)
        self.letters = self.used_letters if programme is None else len(programme.phases[0].state)

    @cached_property
    def callers(self) -> tuple[Caller, ...]:
        """Who has letters of his own and is no motor traffic."""
        buttons: dict[int, set[tuple[str, str]]] = {}
        for crossing in self._walked:
            for letter in crossing.letters:
                buttons.setdefault(letter, set()).update((area, crossing.id) for area in crossing.areas)
        motors: dict[Any, set[int]] = defaultdict(set)
        for connection, letter in self.connections:
            if for_motors([connection]):
                motors[connection.getFromLane()].add(letter)
        lanes: dict[int, set[str]] = {}
        for connection, letter in self.connections:
            # Who stands on a lane of motor traffic that has green with him may be anybody, and is seen with it.
            if not self._go_together(letter, motors[connection.getFromLane()]):
                lanes.setdefault(letter, set()).update(_stood_on(connection.getFromLane()))
        return tuple(
            Caller(letter, tuple(sorted(buttons.get(letter, ()))), tuple(sorted(lanes.get(letter, ()))))
            for letter in sorted((buttons.keys() | self.beside_motors) - self.of_motors)
            if letter < self.letters
        )

    def _go_together(self, letter: int, others: set[int]) -> bool:
        """Whether some phase gives green to a letter and to any of the others."""
        phases = self.programme.phases if self.programme else ()
        return any(letter in phase.green and not phase.green.isdisjoint(others) for phase in phases)

    @cached_property
    def approaches(self) -> list[str]:
        """Edges with motor traffic that it stops."""
        return sorted({each.getFrom().getID() for each in for_motors(connection for connection, _ in self.connections)})

    @cached_property
    def conflicts(self) -> tuple[tuple[bool, ...], ...]:
        """Which letters' streams conflict, by the net's right-of-way matrix.

        None do that come from one road and go into one lane, or cross each other's way where neither gives way;
        nor do pedestrians and who turns onto their street, who always gives way to them.
        """
        matrix = [[False] * self.letters for _ in range(self.letters)]
        streams = [
            (node := connection.getFrom().getToNode(), node.getLinkIndex(connection), letter, connection)
            for connection, letter in self.connections
        ]
        for node, request, a, connection in streams:
            foes = [
                (b, other.getFrom() is connection.getFrom() and _side_by_side(node, connection, other))
                for node_b, request_b, b, other in streams
                if node_b is node and _are_foes(node, request, request_b)
            ]
            turns, leaves = connection.getDirection() != STRAIGHT, connection.getFrom().getID()
            foes += [
                (b, turns and leaves not in crossing.edges)
                for crossing in self._walked
                for b in crossing.letters
                if crossing.node == node.getID() and _are_foes(node, request, crossing.request)
            ]
            for b, at_peace in foes:
                if a != b and not at_peace:
                    matrix[a][b] = matrix[b][a] = True
        return tuple(tuple(row) for row in matrix)

    def second(self) -> set[tuple[int, int]]:
        """Pairs of letters that conflict and have protected greens together, of which the first gives way.

        By the net's right-of-way matrix. Some turn: netconvert gives opposite left turns such a stage even where they
        meet, amid a skew or wide junction. Others join the second one's road or come from it, and meet nobody else who
        has way.
        """
        phases = self.programme.phases if self.programme else ()
        together = {
            (a, b)
            for a, b in permutations(range(self.letters), 2)
            if self.conflicts[a][b] and any(phase.state[a] == phase.state[b] == "G" for phase in phases)
        }
        turning, sharing = (
            {(a, b) for a, b in together if self._gives_way(a, b, how) and not self._gives_way(b, a, how)}
            for how in (_turns, _shares)
        )
        settled = {pair for a, b in turning | sharing for pair in ((a, b), (b, a))}
        return turning | {(a, b) for a, b in sharing if all(pair in settled for pair in together if pair[0] == a)}

    def _gives_way(self, a: int, b: int, how: Callable[[Any, Any], bool]) -> bool:
        """Whether all of letter `a` whom anybody of letter `b` comes in the way of move so, and must give way to him.

        `how` tells it of connections of the two.
        """
        before = [
            how(connection, other) and node.forbids(other, connection)
            for connection, letter in self.connections
            for other, other_letter in self.connections
            if (letter, other_letter) == (a, b)
            and (node := connection.getFrom().getToNode()) is other.getFrom().getToNode()
            and _are_foes(node, node.getLinkIndex(connection), node.getLinkIndex(other))
        ]
        return bool(before) and all(before)


def _turns(connection: Any, _other: Any) -> bool:
    return bool(connection.getDirection() != STRAIGHT)


def _shares(connection: Any, other: Any) -> bool:
    return connection.getTo() is other.getTo() or connection.getFrom() is other.getFrom()


def _side_by_side(node: Any, one: Any, other: Any) -> bool:
    """Whether two who come from one road go into one lane, or see to it among themselves who goes first."""
    return one.getToLane() is other.getToLane() or not (node.forbids(one, other) or node.forbids(other, one))


def _are_foes(node: Any, one: int, other: int) -> bool:
    """Whether two of a node's streams conflict. Raises NetworkError if the net does not say."""
    try:
        return bool(node.areFoes(one, other))
    except (KeyError, IndexError) as error:
        raise NetworkError(
            f"the net has no right of way of stream {one} at junction {node.getID()!r} (<request>): give a .net.xml "
            "written by netconvert"
        ) from error


@dataclass(frozen=True)
class Crossing:
    """A pedestrian crossing with a signal."""

    node: str
    request: int
    """Its number in the node's right-of-way matrix."""
    letters: tuple[int, ...]
    edges: frozenset[str]
    """Roads that it crosses."""
    id: str
    """SUMO's edge."""
    areas: tuple[str, ...]
    """Walking areas at its ends, SUMO's edges."""


def _stood_on(lane: Any) -> set[str]:
    """A lane, and before one so short that nobody stands on it those inside the node that lead onto it."""
    if lane.getLength() > STANDS_M:
        return {str(lane.getID())}
    onto = (each for connections in lane.getEdge().getIncoming().values() for each in connections)
    inside = {str(each.getViaLaneID()) for each in onto if each.getToLane() is lane and each.getViaLaneID()}
    return {str(lane.getID()), *inside}


def _letters(connection: Any) -> tuple[int, ...]:
    """Those that a connection onto a crossing names."""
    names = [connection.get(name) for name in ("linkIndex", "linkIndex2")]
    return tuple(int(name) for name in names if name and int(name) >= 0)


def crossings(path: Path) -> dict[str, list[Crossing]]:
    """Pedestrian crossings by their signal."""
    from defusedxml import ElementTree  # noqa: PLC0415

    with opened(path) as file:
        if b'function="crossing"' not in file.read():
            return {}
    inside: dict[str, tuple[str, int]] = {}
    letters: dict[tuple[str, str], tuple[int, ...]] = {}
    edges: dict[str, frozenset[str]] = {}
    beside: dict[str, set[str]] = defaultdict(set)
    with opened(path) as file:
        for _, element in ElementTree.iterparse(file, forbid_dtd=True):
            if element.tag == "junction" and element.get("type") != "internal":
                lanes = (element.get("intLanes") or "").split()
                inside.update({lane: (element.get("id"), number) for number, lane in enumerate(lanes)})
            elif element.tag == "edge" and element.get("function") == "crossing":
                edges[element.get("id")] = frozenset((element.get("crossingEdges") or "").split())
            elif element.tag == "connection":
                start, end = element.get("from"), element.get("to") or ""
                if element.get("tl") and end.startswith(":"):
                    letters.setdefault((element.get("tl"), end), _letters(element))
                beside[end].add(start)
                beside[start].add(end)
            if element.tag in ("junction", "connection", "edge", "tlLogic"):
                element.clear()
    found: dict[str, list[Crossing]] = {}
    for (signal, edge), used in letters.items():
        if f"{edge}_0" in inside:
            node, request = inside[f"{edge}_0"]
            ends = tuple(sorted(beside[edge]))
            crossing = Crossing(node, request, used, edges.get(edge, frozenset()), edge, ends)
            found.setdefault(signal, []).append(crossing)
    return found
