"""Side roads: who waits at nodes without signals for gaps in what signals let onto the road that he meets there."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import Any

from utn_sumo.contract import SideRoad
from utn_sumo.network.roads import for_motors, free_s, main_road

REACH_M = 300.0
"""As far behind a signal as its platoons, and the gaps between them, last."""
GIVES_WAY = frozenset("m=ws")
"""SUMO's states of connections without signals, from which somebody waits for others."""


def side_roads(net: Any, fed: Iterable[tuple[int, str]], links: Collection[str]) -> tuple[SideRoad, ...]:
    """The side roads of a net (sumolib), in the order of their edges.

    `fed` are junctions and the edges that their traffic goes on to, `links` all edges that links are made of.
    """
    behind: dict[str, list[tuple[int, str, float]]] = {}
    main = set(links)
    for junction, to_edge in sorted(set(fed)):
        for edge, waiting, after_s in _along(net.getEdge(to_edge)):
            main.add(edge)
            for side in waiting:
                behind.setdefault(side, []).append((junction, to_edge, after_s))
    return tuple(
        SideRoad(edge, _via_lanes(net.getEdge(edge)), tuple(found))
        for edge, found in sorted(behind.items())
        if edge not in main
    )


def _via_lanes(edge: Any) -> tuple[str, ...]:
    return tuple(sorted({via for each in _connections(edge) if (via := each.getViaLaneID())}))


def _along(edge: Any) -> Iterator[tuple[str, list[str], float]]:
    """The edges of the road that begins with `edge` (sumolib), as far as who is on them is let go by no signal.

    With the side roads that end where each does, and the seconds of free driving to there.
    """
    seen: set[str] = set()
    after_m = after_s = 0.0
    while edge is not None and edge.getID() not in seen:
        seen.add(edge.getID())
        after_m += edge.getLength()
        after_s += free_s(edge)
        onward = {other: for_motors(each) for other, each in edge.getOutgoing().items()}
        if after_m > REACH_M or any(each.getTLSID() for connections in onward.values() for each in connections):
            yield edge.getID(), [], after_s
            return
        ahead = main_road(onward)
        sides = [] if ahead is None else [other for other in edge.getToNode().getIncoming() if other is not edge]
        yield edge.getID(), [side.getID() for side in sides if _gives_way(side)], after_s
        edge = ahead


def _gives_way(edge: Any) -> bool:
    """Whether somebody from it waits for others."""
    return any(each.getState() in GIVES_WAY for each in _connections(edge))


def _connections(edge: Any) -> list[Any]:
    return [each for connections in edge.getOutgoing().values() for each in for_motors(connections)]
