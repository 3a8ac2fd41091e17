"""What the letters of a signal stand for: streams of vehicles and pedestrian crossings, and which of them conflict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from utn_sumo.network.programmes import Programme
from utn_sumo.network.roads import for_motors
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
        self._walked = crossings
        self._net = net
        used = [*self.of_vehicles, *(index for crossing in crossings for index in crossing.letters)]
        self.used_letters = 1 + max(used, default=-1)
        self.letters = self.used_letters if programme is None else len(programme.phases[0].state)

    @property
    def approaches(self) -> list[str]:
        """Edges with motor traffic that it stops."""
        return sorted({each.getFrom().getID() for each in for_motors(connection for connection, _ in self.connections)})

    def conflicts(self) -> tuple[tuple[bool, ...], ...]:
        """Which letters' streams cross, or come from two roads into one lane, by the net's right-of-way matrix."""
        matrix = [[False] * self.letters for _ in range(self.letters)]
        streams = []
        for connection, index in self.connections:
            node = connection.getFrom().getToNode()
            merging = connection.getFrom().getID(), connection.getToLane().getID()
            streams.append((node, node.getLinkIndex(connection), index, merging))
        for crossing in self._walked:
            node = self._net.getNode(crossing.node)
            streams += [(node, crossing.request, index, (crossing.lane, "")) for index in crossing.letters]
        for node_a, request_a, a, merging_a in streams:
            for node_b, request_b, b, merging_b in streams:
                if node_a is node_b and a != b and merging_a != merging_b and node_a.areFoes(request_a, request_b):
                    matrix[a][b] = matrix[b][a] = True
        return tuple(tuple(row) for row in matrix)


@dataclass(frozen=True)
class Crossing:
    """A pedestrian crossing with a signal."""

    node: str
    lane: str
    request: int
    """Its number in the node's right-of-way matrix."""
    letters: tuple[int, ...]


def crossings(path: Path) -> dict[str, list[Crossing]]:
    """Pedestrian crossings by their signal."""
    from defusedxml import ElementTree  # noqa: PLC0415

    with opened(path) as file:
        if b'function="crossing"' not in file.read():
            return {}
    inside: dict[str, tuple[str, int]] = {}
    letters: dict[tuple[str, str], tuple[int, ...]] = {}
    with opened(path) as file:
        for _, element in ElementTree.iterparse(file, forbid_dtd=True):
            if element.tag == "junction":
                lanes = (element.get("intLanes") or "").split()
                inside.update({lane: (element.get("id"), number) for number, lane in enumerate(lanes)})
            elif element.tag == "connection" and element.get("tl") and (element.get("to") or "").startswith(":"):
                names = [element.get(name) for name in ("linkIndex", "linkIndex2")]
                used = tuple(int(name) for name in names if name and int(name) >= 0)
                letters.setdefault((element.get("tl"), f"{element.get('to')}_0"), used)
            if element.tag in ("junction", "connection", "edge", "tlLogic"):
                element.clear()
    found: dict[str, list[Crossing]] = {}
    for (signal, lane), used in letters.items():
        if lane in inside:
            node, request = inside[lane]
            found.setdefault(signal, []).append(Crossing(node, lane, request, used))
    return found
