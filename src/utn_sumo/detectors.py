"""Loops and lane-area detectors of a network, as a SUMO additional file.

Every lane of a link has a loop at its entry and one at its stop line, and a lane-area detector on the last 200 m
before it; every road that leads away has entry loops too, so that turns can be told apart. All report once a control
step, which is when they are read: interval counts, never sums of steps (SPEC 6).
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


AREA_REACH_M = 200.0
"""Lane-area detectors see this far upstream of the stop line: the reach of a camera on the mast."""


@dataclass(frozen=True)
class DetectorIds:
    """Where each count comes from: detector ids by link (Z) or by turn (M)."""

    entry: tuple[tuple[str, ...], ...]
    stop_line: tuple[tuple[str, ...], ...]
    area: tuple[tuple[str, ...], ...]
    to_edge: tuple[tuple[str, ...], ...]


def ids(network: Network) -> DetectorIds:
    """The ids under which `write` puts the detectors of `network` into a file."""

    def on(kind: str, edge: str) -> tuple[str, ...]:
        return tuple(f"{kind}_{edge}_{lane}" for lane in range(network.edge_lanes[edge]))

    return DetectorIds(
        entry=tuple(on("entry", link.edges[0]) for link in network.links),
        stop_line=tuple(on("stop", link.edges[-1]) for link in network.links),
        area=tuple(
            tuple(name for edge, _ in _watched(network, link) for name in on("area", edge)) for link in network.links
        ),
        to_edge=tuple(on("entry", turn.to_edge) for turn in network.turns),
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
    entries = {link.edges[0] for link in network.links} | {turn.to_edge for turn in network.turns}

    def loops(kind: str, edge: str, position_m: float) -> None:
        for lane in range(network.edge_lanes[edge]):
            ET.SubElement(
                root,
                "inductionLoop",
                id=f"{kind}_{edge}_{lane}",
                lane=f"{edge}_{lane}",
                pos=f"{position_m:g}",
                period=f"{period_s:g}",
                file="NUL",
                friendlyPos="true",
            )

    for edge in sorted(entries):
        loops("entry", edge, ENTRY_M)
    for link in network.links:
        loops("stop", link.edges[-1], STOP_LINE_M)
        for edge, seen_m in _watched(network, link):
            for lane in range(network.edge_lanes[edge]):
                ET.SubElement(
                    root,
                    "laneAreaDetector",
                    id=f"area_{edge}_{lane}",
                    lane=f"{edge}_{lane}",
                    pos=f"{network.edge_length_m[edge] - seen_m:g}",
                    endPos=f"{network.edge_length_m[edge]:g}",
                    period=f"{period_s:g}",
                    file="NUL",
                    friendlyPos="true",
                )
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
