"""Nets of our own to find settings on, so that other people's and the shipped ones stay for judging them.

    python tools/tuning_nets.py FOLDER     writes FOLDER/<name>/<name>.sumocfg for each

Each has half an hour of traffic that swells and ebbs, and ten minutes to drain; at demand 1.0 its peak is near what its
junctions can take, 0.5 is light, 1.4 too much. The same files on any machine, but for netconvert's header.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import click
import numpy as np

from utn_sumo import recording, sumo_tools
from utn_sumo.errors import UtnError

DEPARTURES_S, WINDOW_S = 1800.0, 2400.0
SWELL = ((0, 0.35), (450, 0.6), (900, 1.0), (1350, 0.6), (1800, 0.3))
"""(time in s, share of the peak) of the departures, straight lines between."""
SIGNALS = ("--default-junction-type", "traffic_light")
NO_STREET = (1, "S")
WIDE = 3
SEED = 1


@dataclass(frozen=True)
class TuningNet:
    """How a net is made, and its traffic at demand 1.0."""

    words: tuple[str, ...]
    """Of netgenerate; none for the street that `_street` writes for netconvert."""
    veh_h: float
    """At the peak."""
    walkers_h: float = 0.0


def _grid(across: int, up: int, length_m: float, lanes: int, *more: str) -> tuple[str, ...]:
    sizes = {"x-number": across, "y-number": up, "length": length_m, "attach-length": max(length_m, 200)}
    words = [word for name, value in sizes.items() for word in (f"--grid.{name}", str(value))]
    return ("--grid", *words, "--default.lanenumber", str(lanes), *SIGNALS, *more)


TUNING_NETS: Mapping[str, TuningNet] = {
    # Single lanes that all turns share.
    "lanes": TuningNet(_grid(3, 3, 200, 1), 4500),
    # Left turns have a pocket and, where netconvert gives them one, a stage.
    "pockets": TuningNet(
        _grid(3, 3, 300, 2, "--turn-lanes", "1", "--turn-lanes.length", "60", "--tls.left-green.time", "6"), 9000
    ),
    # Queues reach back to the junction before: 13 vehicles fill a street.
    "blocks": TuningNet(_grid(4, 3, 100, 1, "--no-turnarounds"), 5500),
    # One approach after the other, four stages with their clearances.
    "turns": TuningNet(_grid(3, 2, 250, 2, "--tls.layout", "incoming", "--no-turnarounds"), 5500),
    # Two lanes with small side streets, 160 to 400 m apart.
    "street": TuningNet((), 4500),
    # Junctions of three and four arms, most without signals, so that the edges before a signal are short.
    "town": TuningNet(
        (
            *("--rand", "--rand.iterations", "60", "--rand.max-distance", "200", "--rand.min-distance", "90"),
            *("--rand.neighbor-dist1", "3", "--rand.neighbor-dist3", "6", "--rand.neighbor-dist4", "6"),
            *("--default-junction-type", "priority", "--tls.guess", "--tls.guess.threshold", "54", "--no-turnarounds"),
        ),
        5000,
    ),
    # People cross, who have least greens and right of way.
    "walkers": TuningNet(_grid(3, 2, 200, 2, "--sidewalks.guess", "--crossings.guess", "--no-turnarounds"), 5500, 1200),
}


def write(name: str, folder: Path) -> Path:
    """Build a net of `TUNING_NETS` in `folder`, with its traffic; its .sumocfg. Raises UtnError."""
    chosen = TUNING_NETS[name]
    recording.new_folder(folder, "")
    net = folder / f"{name}.net.xml"
    words = chosen.words or _street(folder)
    run("netgenerate" if chosen.words else "netconvert", *words, "--no-turnarounds.fringe", "-o", str(net))
    return drive(net, chosen.veh_h, chosen.walkers_h, SEED)


def drive(net: Path, veh_h: float, walkers_h: float, seed: int) -> Path:
    """Write traffic for NAME.net.xml, so many at the peak, beside it; its .sumocfg. Raises UtnError."""
    trips, routes, configuration = (
        net.with_name(net.name.replace("net.xml", kind)) for kind in ("trips.xml", "rou.xml", "sumocfg")
    )
    ET.ElementTree(_traffic(net, veh_h, walkers_h, seed)).write(trips)
    # Of ways that are much alike each vehicle takes its own. Where streets are one-way, some trips have none.
    words = ["-n", str(net), "-r", str(trips), "-o", str(routes), "--weights.random-factor", "1.5", "--ignore-errors"]
    run("duarouter", *words)
    root = ET.Element("configuration")
    for key, value in {"net-file": net.name, "route-files": routes.name, "begin": "0", "end": f"{WINDOW_S:g}"}.items():
        ET.SubElement(root, key, value=value)
    ET.ElementTree(root).write(configuration)
    return configuration


def run(binary: str, *words: str, seed: int = SEED) -> None:
    """Run one of SUMO's binaries. Raises UtnError."""
    sumo_tools.run_program(binary, [str(sumo_tools.sumo_binary(binary)), *words, "--seed", str(seed)])


def _street(folder: Path) -> tuple[str, ...]:
    """Plain XML of a main street over five junctions, the second without a street to the south; netconvert's words."""
    nodes, edges = ET.Element("nodes"), ET.Element("edges")

    def node(name: str, x: float, y: float, kind: str = "priority") -> None:
        ET.SubElement(nodes, "node", id=name, x=f"{x:g}", y=f"{y:g}", type=kind)

    def road(one: str, other: str, lanes: int, speed_m_s: float) -> None:
        for start, end in ((one, other), (other, one)):
            said = {"numLanes": str(lanes), "priority": str(lanes), "speed": f"{speed_m_s:g}"}
            ET.SubElement(edges, "edge", {"id": f"{start}-{end}", "from": start, "to": end, **said})

    places = (0, 250, 410, 810, 1110)
    for number, x in enumerate(places):
        node(f"J{number}", x, 0, "traffic_light")
        for side, y in (("N", 250), ("S", -250)):
            if (number, side) != NO_STREET:
                node(f"{side}{number}", x, y)
                road(f"{side}{number}", f"J{number}", 2 if number == WIDE else 1, 13.89)
    node("W", -300, 0)
    node("E", 1500, 0)
    for one, other in pairwise(["W", *(f"J{number}" for number in range(len(places))), "E"]):
        road(one, other, 2, 16.67)
    files = folder / "nodes.xml", folder / "edges.xml"
    for file, root in zip(files, (nodes, edges), strict=True):
        ET.ElementTree(root).write(file)
    return "-n", str(files[0]), "-e", str(files[1]), "--no-turnarounds"


def _traffic(net: Path, veh_h: float, walkers_h: float, seed: int) -> ET.Element:
    """Trips from edge to edge of the net's rim, with uneven weights that are drawn; walkers likewise."""
    import sumolib  # noqa: PLC0415 - slow

    rng = np.random.default_rng(seed)
    found = sumolib.net.readNet(str(net))
    rim = sorted((edge for edge in found.getEdges() if edge.is_fringe()), key=lambda edge: str(edge.getID()))
    ends = {True: [e for e in rim if not e.getIncoming()], False: [e for e in rim if not e.getOutgoing()]}
    root = ET.Element("routes")
    departures = []
    for kind, rate_h in (("trip", veh_h), ("person", walkers_h)):
        weights = {side: rng.uniform(0.5, 1.5, len(edges)) for side, edges in ends.items()}
        times, shares = np.transpose(SWELL)
        count = int(rng.poisson(rate_h * np.trapezoid(shares, times) / 3600))
        due = np.interp(rng.uniform(size=count), *_cumulated(times, shares))
        for depart_s in due:
            start, end = (rng.choice(ends[side], p=weights[side] / weights[side].sum()) for side in (True, False))
            while end.getToNode() is start.getFromNode():
                end = rng.choice(ends[False])
            departures.append((float(depart_s), kind, str(start.getID()), str(end.getID())))
    for number, (depart_s, kind, start, end) in enumerate(sorted(departures)):
        made = ET.SubElement(root, kind, id=str(number), depart=f"{depart_s:.1f}")
        way = {"from": start, "to": end}
        if kind == "trip":
            made.attrib.update({**way, "departLane": "best", "departSpeed": "max"})
        else:
            ET.SubElement(made, "walk", way)
    return root


def _cumulated(times: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of the departures until each second, and the seconds."""
    every = np.arange(times[0], times[-1] + 1)
    share = np.cumsum(np.interp(every, times, shares))
    return share / share[-1], every


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
def main(folder: Path) -> None:
    """Write every net into FOLDER, a new folder each; print their .sumocfg."""
    for name in TUNING_NETS:
        click.echo(write(name, folder / name))


if __name__ == "__main__":
    try:
        main()
    except UtnError as error:
        click.echo(f"tuning_nets: {error}", err=True)
        sys.exit(2)
