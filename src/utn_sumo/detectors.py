"""Loops and lane-area detectors of a network, as a SUMO additional file.

Every lane for motor vehicles of a link has a loop at its entry, one at its stop line, and a lane-area detector on the
last 200 m before it; where side roads meet the link amid it, loops count who comes and who goes. What leaves is
counted by loops just behind the stop line, on the lanes on which the turns part: a loop before the line misses a
vehicle that changes lanes in the very step in which it crosses (38 of 42,900 in 4 h of `utn17`), and could not tell
turns apart. All report once a control step, which is when they are read: interval counts, never sums of steps (SPEC
6).

Where an execution decides within the control step, more lane-area detectors cut the same 200 m into zones, and some see
who waits amid a junction because their green gives way to others, or behind these, or who is amid it late where people
walk, or bicycles and trams on lanes of their own, or who waits at the end of a side road; loops count who leaves that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from utn_sumo.clearances import GIVES_WAY
from utn_sumo.contract import (
    AREA_REACH_M,
    CLOSE_ZONES,
    EXIT,
    ZONES_M,
    Floats,
    LaneSet,
    Link,
    Measurement,
    Network,
    Turn,
)

ENTRY_M = 1.0
"""Entry loops stand this far into the first edge."""
STOP_LINE_M = -1.0
"""Stop-line loops stand this far before the end of the last edge."""
TURN_M = 1.0
"""Turn loops stand this far behind the stop line."""
CREEPING_M_S = 3.0
"""Who is slower amid a junction has not got away from it: with whom he stood behind gone, he may stop for others."""
CALLING_M = ZONES_M[CLOSE_ZONES - 1]
"""Bicycles and trams on lanes of their own are seen so far before the stop line."""
CAR_M = 5.0
"""The detector of a zone ends so much before the zone: it sees a car until its back has gone by."""
INTO_M = 0.5
"""The zone next to the line ends so far into the shortest vehicle there, where that is shorter than a car."""
LEAST_M = 0.1
"""Shortest detector that SUMO takes."""
ROUNDING = 1e-6
"""By how much a number of centimetres may be off."""
NEARLY_M = -0.01
"""Detectors on lanes amid a junction end so much before the lane does, from where SUMO counts what is below 0."""


@dataclass(frozen=True)
class DetectorIds:
    """Where each count comes from: detector ids by link (Z) or by turn (M)."""

    entry: tuple[tuple[str, ...], ...]
    stop_line: tuple[tuple[str, ...], ...]
    turn: tuple[tuple[str, ...], ...]
    area: tuple[tuple[str, ...], ...]
    group: tuple[tuple[str, ...], ...]
    """(G,) of the lane-area detectors those on a lane group."""
    set_area: tuple[tuple[str, ...], ...]
    """(L,) of the lane-area detectors those on a lane set."""
    group_stop_line: tuple[tuple[str, ...], ...]
    """(G,) of the loops at the stop line those on a lane group."""
    set_stop_line: tuple[tuple[str, ...], ...]
    """(L,) of the loops at the stop line those on a lane set."""
    upstream: tuple[tuple[str, ...], ...]
    """(Z,) of the lane-area detectors those before the lane groups part."""
    joining: tuple[tuple[str, ...], ...]
    parting: tuple[tuple[str, ...], ...]
    set_zone: tuple[tuple[tuple[str, ...], ...], ...]
    """(L, zones) of the detectors of zones those on a lane set."""
    upstream_zone: tuple[tuple[tuple[str, ...], ...], ...]
    """(Z, zones) those before the lane groups part."""
    amid: tuple[tuple[str, ...], ...]
    """(M,) of the lane-area detectors amid junctions those on which each turn may wait, else none."""
    calling: tuple[tuple[str, ...], ...]
    """(C,) of the lane-area detectors those on the lanes of each caller."""
    side_area: tuple[tuple[str, ...], ...]
    side_line: tuple[tuple[str, ...], ...]
    """(R,) the lane-area detectors at the end of each side road, and the loops behind it."""


def ids(network: Network) -> DetectorIds:
    """The ids under which `write` puts the detectors of `network` into a file."""

    def on(kind: str, edge: str) -> tuple[str, ...]:
        return tuple(_named(kind, f"{edge}_{lane}") for lane in network.edge_lanes[edge])

    def last_edge(link: int) -> str:
        return network.links[link].edges[-1]

    def at_line(kind: str, link: int, lanes: Sequence[int]) -> tuple[str, ...]:
        return tuple(_named(kind, f"{last_edge(link)}_{lane}") for lane in lanes)

    pieces = [_zones(network, link) for link in network.links]

    def in_zones(link: int, edge_lanes: Callable[[str], Sequence[int]]) -> tuple[tuple[str, ...], ...]:
        return tuple(
            tuple(
                _named(f"zone{zone}", f"{edge}_{lane}")
                for edge, of, _, _ in pieces[link]
                if of == zone
                for lane in edge_lanes(edge)
            )
            for zone in range(len(ZONES_M))
        )

    def waiting(kind: str, index: int) -> tuple[str, ...]:
        return tuple(_named(kind, lane) for lane, _ in _waiting(network, kind, index))

    def before(link: Link) -> Callable[[str], Sequence[int]]:
        return lambda edge: () if edge == link.edges[-1] else network.edge_lanes[edge]

    def of_set(link: int, lane_set: LaneSet) -> Callable[[str], Sequence[int]]:
        return lambda edge: lane_set.lanes if edge == last_edge(link) else ()

    groups = network.groups
    sets = list(zip(network.set_link.tolist(), network.lane_sets, strict=True))

    return DetectorIds(
        entry=tuple(on("entry", link.edges[0]) for link in network.links),
        stop_line=tuple(on("stop", link.edges[-1]) for link in network.links),
        turn=tuple(tuple(_named("turn", lane) for lane in turn.via_lanes) for turn in network.turns),
        area=tuple(
            (*(name for edge, _ in network.watched(link) for name in on("area", edge)), *waiting("area", index))
            for index, link in enumerate(network.links)
        ),
        group=tuple(at_line("area", group.link, group.lanes) for group in groups),
        set_area=tuple(at_line("area", link, lane_set.lanes) for link, lane_set in sets),
        group_stop_line=tuple(at_line("stop", group.link, group.lanes) for group in groups),
        set_stop_line=tuple(at_line("stop", link, lane_set.lanes) for link, lane_set in sets),
        upstream=tuple(
            (
                *(name for edge, _ in network.watched(link) if edge != link.edges[-1] for name in on("area", edge)),
                *waiting("area", index),
            )
            for index, link in enumerate(network.links)
        ),
        joining=tuple(tuple(_named("side", lane) for lane in link.joining) for link in network.links),
        parting=tuple(tuple(_named("side", lane) for lane in link.parting) for link in network.links),
        set_zone=tuple(in_zones(link, of_set(link, lane_set)) for link, lane_set in sets),
        upstream_zone=tuple(
            ((*zones[0], *waiting("zone0", index)), *zones[1:])
            for index, link in enumerate(network.links)
            for zones in [in_zones(index, before(link))]
        ),
        amid=tuple(tuple(_named("amid", lane) for lane in lanes) for lanes in _amid(network)),
        calling=tuple(tuple(_named("call", lane) for lane in caller.lanes) for _, caller in network.callers),
        side_area=tuple(on("wait", side.edge) for side in network.side_roads),
        side_line=tuple(tuple(_named("side", lane) for lane in side.via_lanes) for side in network.side_roads),
    )


def _amid(network: Network) -> list[tuple[str, ...]]:
    """(M,) lanes amid junctions on which each turn waits that gives way in some stage, or behind one that does.

    Or before a road within the junction. All where people walk.
    """
    waiting = {
        turn
        for junction in network.junctions
        for letter, turns in enumerate(junction.signal_turns)
        if junction.is_walked or any(network.stages[stage].state[letter] == GIVES_WAY for stage in junction.stages)
        for turn in turns
    }
    waiting |= set(np.flatnonzero((network.turn_next != EXIT) & network.within[network.turn_next]).tolist())
    shared = {(network.turns[turn].link, lane) for turn in waiting for lane in network.turns[turn].from_lanes}

    def is_seen(index: int, turn: Turn) -> bool:
        # All of its lanes: amid the junction too, who is behind somebody moves over to the next one.
        return index in waiting or any((turn.link, lane) in shared for lane in turn.from_lanes)

    return [turn.via_lanes if is_seen(index, turn) else () for index, turn in enumerate(network.turns)]


def _named(kind: str, lane: str) -> str:
    """The id of a detector: none that other people's files have."""
    return f"utn_{kind}_{lane}"


def _zones(network: Network, link: Link) -> list[tuple[str, int, float, float]]:
    """(edge, zone, metres from the edge's begin, to) of each piece of a zone on an edge."""
    pieces, to_stop_m = [], 0.0
    for edge, seen_m in network.watched(link):
        near_m = 0.0
        for zone, far_m in enumerate(ZONES_M):
            low_m, high_m = max(near_m, to_stop_m), min(far_m, to_stop_m + seen_m)
            if low_m < high_m:
                end_m = network.edge_length_m[edge] + to_stop_m
                pieces.append((edge, zone, end_m - high_m, end_m - low_m))
            near_m = far_m
        to_stop_m += seen_m
    return pieces


def _waiting(network: Network, kind: str, link: int) -> list[tuple[str, float]]:
    """(lane, metres from its begin) of detectors where vehicles wait inside the node before a link's last edge.

    Of the whole area that of vehicles whose back has come off the edge before, where they are counted until then. Zones
    have none on roads within a junction: who waits there is let out as such.
    """
    from_m = CAR_M if kind == "area" else 0.0
    if kind == "zone0" and network.within[link]:
        return []
    return [(lane, from_m) for lane, length_m in network.links[link].waiting if length_m >= from_m + LEAST_M]


def _loops(network: Network, *, within_step: bool) -> Iterator[tuple[str, str, float]]:
    """(kind, lane, metres from its begin, or to its end below 0) of the loops."""
    for link in network.links:
        for kind, edge, position_m in (("entry", link.edges[0], ENTRY_M), ("stop", link.edges[-1], STOP_LINE_M)):
            for lane in network.edge_lanes[edge]:
                yield kind, f"{edge}_{lane}", position_m
    turning = [via for turn in network.turns for via in turn.via_lanes]
    # One link's traffic may part onto another's: one loop then counts for both. So it does for links and side roads.
    beside = {via for link in network.links for via in (*link.joining, *link.parting)}
    beside |= {via for side in network.side_roads for via in side.via_lanes if within_step}
    for kind, lanes in (("turn", turning), ("side", sorted(beside))):
        for via in lanes:
            yield kind, via, TURN_M


def _areas(network: Network, *, within_step: bool) -> Iterator[tuple[str, str, float, float]]:
    """(kind, lane, metres from its begin, to) of the lane-area detectors."""
    length_m = network.edge_length_m
    for index, link in enumerate(network.links):
        pieces = [("area", edge, length_m[edge] - seen_m, length_m[edge]) for edge, seen_m in network.watched(link)]
        for edge, zone, from_m, to_m in _zones(network, link) if within_step else ():
            # Less of a zone than that on an edge begins before the zone does.
            begin_m = max(min(from_m, length_m[edge] - LEAST_M), 0.0)
            # By the line a shorter vehicle would never be seen.
            is_short = zone == 0 and network.shortest_m < CAR_M
            behind_m = max(network.shortest_m - INTO_M, INTO_M) if is_short else CAR_M
            pieces.append((f"zone{zone}", edge, begin_m, max(to_m - behind_m, begin_m + LEAST_M)))
        for kind, edge, from_m, to_m in pieces:
            for lane in network.edge_lanes[edge]:
                yield kind, f"{edge}_{lane}", from_m, to_m
        nearest = ("area", "zone0") if within_step else ("area",)
        yield from ((kind, *place, NEARLY_M) for kind in nearest for place in _waiting(network, kind, index))
    for via in (via for lanes in _amid(network) for via in lanes if within_step):
        yield "amid", via, 0.0, NEARLY_M
    for own in sorted({own for _, caller in network.callers for own in caller.lanes}) if within_step else ():
        yield "call", own, -CALLING_M, NEARLY_M
    for side in network.side_roads if within_step else ():
        end_m = length_m[side.edge]
        for lane in network.edge_lanes[side.edge]:
            yield "wait", f"{side.edge}_{lane}", max(end_m - AREA_REACH_M, 0.0), end_m


def write(network: Network, path: Path, period_s: float, *, within_step: bool = False) -> None:
    """Write the additional file; its detectors report every `period_s` seconds.

    With those by which an execution decides within the control step if they are wanted.
    """
    root = ET.Element("additional")
    report = {"period": f"{period_s:g}", "file": "NUL", "friendlyPos": "true"}
    for kind, lane, position_m in _loops(network, within_step=within_step):
        place = {"lane": lane, "pos": f"{position_m:g}"}
        ET.SubElement(root, "inductionLoop", {"id": _named(kind, lane), **place, **report})
    for kind, lane, from_m, to_m in _areas(network, within_step=within_step):
        place = {"lane": lane, "pos": _metres(from_m), "endPos": _metres(to_m)}
        halting = {"speedThreshold": f"{CREEPING_M_S:g}", "timeThreshold": "0"} if kind == "amid" else {}
        ET.SubElement(root, "laneAreaDetector", {"id": _named(kind, lane), **place, **halting, **report})
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


def _metres(position_m: float) -> str:
    """A position in centimetres, never rounded up: SUMO takes none beyond a lane's end, by however little."""
    return f"{math.floor(100 * position_m + ROUNDING) / 100:.12g}"


class Miscount:
    """Loops as they are on the street: each misses a share of its vehicles, or counts a share twice.

    The share is a loop's own for the whole run, normal about 0 with the standard deviation `loop_error`.
    """

    def __init__(self, network: Network, loop_error: float, seed: int):
        self._rng = np.random.default_rng([seed, 0x3D])
        self._exact = loop_error == 0
        self._entry = loop_error * self._rng.standard_normal(len(network.links))
        self._turn = loop_error * self._rng.standard_normal(len(network.turns))

    def distort(self, seen: Measurement) -> Measurement:
        """The measurement as such loops would have it."""
        if self._exact:
            return seen
        entered, turned = self._count(seen.entered_veh, self._entry), self._count(seen.turned_veh, self._turn)
        return replace(seen, entered_veh=entered, turned_veh=turned)

    def _count(self, veh: Floats, share: Floats) -> Floats:
        wrong = self._rng.binomial(
            np.round(veh).astype(np.int64), np.broadcast_to(np.minimum(np.abs(share), 1), veh.shape)
        )
        return np.asarray(veh + np.sign(share) * wrong)
