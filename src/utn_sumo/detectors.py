"""Loops and lane-area detectors of a network, as a SUMO additional file.

Every lane of a link has a loop at its entry, one at its stop line, and a lane-area detector on the last 200 m
before it. What leaves is counted by loops just behind the stop line, on the lanes on which the turns part: a loop
before the line misses a vehicle that changes lanes in the very step in which it crosses (38 of 42,900 in 4 h of
`utn17`), and could not tell turns apart. All report once a control step, which is when they are read: interval
counts, never sums of steps (SPEC 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

from utn_sumo.contract import Link, Network

ENTRY_M = 1.0
"""Entry loops stand this far into the first edge."""
STOP_LINE_M = -1.0
"""Stop-line loops stand this far before the end of the last edge."""
TURN_M = 1.0
"""Turn loops stand this far behind the stop line."""


AREA_REACH_M = 200.0
"""Lane-area detectors see this far upstream of the stop line: the reach of a camera on the mast."""


@dataclass(frozen=True)
class DetectorIds:
    """Where each count comes from: detector ids by link (Z) or by turn (M)."""

    entry: tuple[tuple[str, ...], ...]
    stop_line: tuple[tuple[str, ...], ...]
    turn: tuple[tuple[str, ...], ...]
    area: tuple[tuple[str, ...], ...]


def ids(network: Network) -> DetectorIds:
    """The ids under which `write` puts the detectors of `network` into a file."""

    def on(kind: str, edge: str) -> tuple[str, ...]:
        return tuple(f"{kind}_{edge}_{lane}" for lane in range(network.edge_lanes[edge]))

    return DetectorIds(
        entry=tuple(on("entry", link.edges[0]) for link in network.links),
        stop_line=tuple(on("stop", link.edges[-1]) for link in network.links),
        turn=tuple(tuple(f"turn_{lane}" for lane in turn.via_lanes) for turn in network.turns),
        area=tuple(
            tuple(name for edge, _ in _watched(network, link) for name in on("area", edge)) for link in network.links
        ),
    )


def _watched(network: Network, link: Link) -> list[tuple[str, float]]:
    """(edge, metres of it seen) from the stop line upstream, as far as the lane-area detectors reach."""
    watched, rest = [], AREA_REACH_M
    for edge in reversed(link.edges):
        if rest <= 0:
            break
        seen = min(rest, network.edge_length_m[edge])
        watched.append((edge, seen))
        rest -= seen
    return watched


def write(network: Network, path: Path, period_s: float) -> None:
    """Write the additional file; its detectors report every `period_s` seconds."""
    root = ET.Element("additional")
    report = {"period": f"{period_s:g}", "file": "NUL", "friendlyPos": "true"}

    def loop(name: str, lane: str, position_m: float) -> None:
        ET.SubElement(root, "inductionLoop", {"id": name, "lane": lane, "pos": f"{position_m:g}", **report})

    for link in network.links:
        for kind, edge, position_m in (("entry", link.edges[0], ENTRY_M), ("stop", link.edges[-1], STOP_LINE_M)):
            for lane in range(network.edge_lanes[edge]):
                loop(f"{kind}_{edge}_{lane}", f"{edge}_{lane}", position_m)
        for watched, seen_m in _watched(network, link):
            length_m = network.edge_length_m[watched]
            for lane in range(network.edge_lanes[watched]):
                place = {
                    "id": f"area_{watched}_{lane}",
                    "lane": f"{watched}_{lane}",
                    "pos": f"{length_m - seen_m:g}",
                    "endPos": f"{length_m:g}",
                }
                ET.SubElement(root, "laneAreaDetector", {**place, **report})
    for turn in network.turns:
        for via in turn.via_lanes:
            loop(f"turn_{via}", via, TURN_M)
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
