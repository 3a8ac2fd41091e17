"""Towns drawn by chance as OpenStreetMap has them, and imported as people import it, for judging.

    python tools/drawn_towns.py FOLDER --seed 7 --count 20     writes FOLDER/t00/t00.sumocfg and so on

Main roads and side streets that cross, carriageways apart, one-way streets, lanes for left turns shortly before
signals, crossings with signals amid a road, many nodes without signals. Made into nets by netconvert with the options
that SUMO's osmWebWizard.py gives it. At demand 1.0 the busiest junction with signals has as much traffic at the peak
as in `drawn_nets.py`; nodes without signals may take less.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET  # only for writing

import click
import numpy as np

import drawn_nets
import tuning_nets
from utn_sumo import network, recording, sumo_tools
from utn_sumo.errors import UtnError

KINDS = {"primary": 3, "secondary": 2, "tertiary": 1, "residential": 0}
"""OpenStreetMap's `highway` of the streets, and how much each matters: two that sum up to SIGNALLED have signals."""
SIGNALLED = 3
SHARES = (0.25, 0.35, 0.2, 0.2)
SOUTH_WEST = 52.0, 13.0
"""Latitude and longitude of the town's corner [degrees]."""
DEGREE_M = 111_195.0
"""Of latitude."""
POCKET_M, LEAST_PIECE_M = 50.0, 140.0
"""Lanes for left turns begin so far before signals, on pieces of street that are long enough."""
IMPORT = (
    *("--geometry.remove", "--ramps.guess", "--roundabouts.guess", "--junctions.join", "--tls.join"),
    *("--tls.guess-signals", "--tls.discard-simple", "--tls.default-type", "actuated"),
    *("--keep-edges.by-vclass", "passenger"),
)
TYPES = ("osmNetconvert.typ.xml", "osmNetconvertUrbanDe.typ.xml")
"""SUMO's own: lanes and speeds of the kinds of streets."""


@dataclass(frozen=True)
class Street:
    """A street through the whole town, along x or along y."""

    kind: str
    lanes: int
    """Of a direction."""
    carriageways: tuple[tuple[float, int], ...]
    """(metres beside its middle, direction: 1 along the axis, -1 against it, 0 both) of each."""

    @classmethod
    def drawn(cls, rng: np.random.Generator, *, along_x: bool) -> Street:
        """One by chance, with traffic on the right."""
        kind = str(rng.choice(list(KINDS), p=SHARES))
        lanes = {"primary": 2, "secondary": int(rng.integers(1, 3))}.get(kind, 1)
        if kind == "primary" and rng.uniform() < 0.5:  # noqa: PLR2004 - one of two
            beside_m = float(rng.uniform(5, 10)) * (-1 if along_x else 1)
            return cls(kind, lanes, ((beside_m, 1), (-beside_m, -1)))
        return cls(kind, lanes, ((0.0, int(rng.choice([0, 1, -1], p=[0.84, 0.08, 0.08]))),))


@dataclass
class Map:
    """OpenStreetMap's nodes and ways, in metres."""

    nodes: list[tuple[float, float, dict[str, str]]] = field(default_factory=list)
    ways: list[tuple[list[int], dict[str, str]]] = field(default_factory=list)

    def node(self, x_m: float, y_m: float, **tags: str) -> int:
        """A new one's number."""
        self.nodes.append((x_m, y_m, tags))
        return len(self.nodes) - 1

    def is_signal(self, node: int) -> bool:
        """Whether it has signals."""
        return "highway" in self.nodes[node][2]

    def between(self, start: int, end: int, share: float, **tags: str) -> int:
        """A new node on the line from one to another."""
        (x, y, _), (other_x, other_y, _) = self.nodes[start], self.nodes[end]
        return self.node(x + share * (other_x - x), y + share * (other_y - y), **tags)

    def distance_m(self, start: int, end: int) -> float:
        """From one node to another."""
        return math.dist(self.nodes[start][:2], self.nodes[end][:2])

    def write(self, file: Path) -> None:
        """As OpenStreetMap's XML."""
        root = ET.Element("osm", version="0.6")
        south, west = SOUTH_WEST
        for number, (x_m, y_m, tags) in enumerate(self.nodes, start=1):
            lat, lon = south + y_m / DEGREE_M, west + x_m / DEGREE_M / math.cos(math.radians(south))
            _tagged(ET.SubElement(root, "node", id=str(number), lat=f"{lat:.8f}", lon=f"{lon:.8f}", version="1"), tags)
        for number, (nodes, tags) in enumerate(self.ways, start=1):
            way = ET.SubElement(root, "way", id=str(number), version="1")
            for node in nodes:
                ET.SubElement(way, "nd", ref=str(node + 1))
            _tagged(way, tags)
        ET.ElementTree(root).write(file)


def _tagged(element: ET.Element, tags: dict[str, str]) -> None:
    for key, value in tags.items():
        ET.SubElement(element, "tag", k=key, v=value)


def drawn(rng: np.random.Generator) -> Map:
    """A town by chance."""
    town = Map()
    columns = [Street.drawn(rng, along_x=False) for _ in range(rng.integers(2, 5))]
    rows = [Street.drawn(rng, along_x=True) for _ in range(rng.integers(2, 5))]
    apart_m, bent_m = rng.uniform(90, 230), rng.uniform(0, 15)
    x_m, y_m = (np.cumsum(rng.uniform(0.6, 1.4, len(each)) * apart_m) for each in (columns, rows))
    pockets, crossings = rng.uniform() < 0.5, rng.uniform() < 0.3  # noqa: PLR2004 - shares of towns
    at: dict[tuple[int, int, int, int], int] = {}
    for (a, column), (b, row) in ((one, other) for one in enumerate(columns) for other in enumerate(rows)):
        tags = {"highway": "traffic_signals"} if KINDS[column.kind] + KINDS[row.kind] >= SIGNALLED else {}
        x, y = x_m[a] + rng.uniform(-bent_m, bent_m), y_m[b] + rng.uniform(-bent_m, bent_m)
        for i, (beside_x, _) in enumerate(column.carriageways):
            for j, (beside_y, _) in enumerate(row.carriageways):
                at[a, b, i, j] = town.node(x + beside_x, y + beside_y, **tags)
    for streets, others, along_x in ((columns, rows, False), (rows, columns, True)):
        for place, street in enumerate(streets):
            for nth, (_, direction) in enumerate(street.carriageways):
                met = [
                    at[(c, place, k, nth) if along_x else (place, c, nth, k)]
                    for c, other in enumerate(others)
                    for k in _in_order(other)
                ]
                ends = [
                    _end(town, met[side], along_x, sign * rng.uniform(150, 300)) for side, sign in ((0, -1), (-1, 1))
                ]
                for start, end in pairwise([ends[0], *met, ends[1]]):
                    way = (end, start) if direction < 0 else (start, end)
                    crossing = crossings and rng.uniform() < 0.5  # noqa: PLR2004 - one of two
                    _lay(town, *way, street, both=direction == 0, pockets=pockets, crossing=crossing)
    return town


def _in_order(street: Street) -> Iterator[int]:
    """Its carriageways from the west to the east, from the south to the north."""
    yield from sorted(range(len(street.carriageways)), key=lambda nth: street.carriageways[nth])


def _end(town: Map, node: int, along_x: bool, far_m: float) -> int:
    x, y, _ = town.nodes[node]
    return town.node(x + far_m, y) if along_x else town.node(x, y + far_m)


def _lay(town: Map, start: int, end: int, street: Street, *, both: bool, pockets: bool, crossing: bool) -> None:
    """Add the ways of a piece of street."""
    length_m, is_main = town.distance_m(start, end), KINDS[street.kind] > 1
    has_pocket = [
        pockets and is_main and length_m > LEAST_PIECE_M and town.is_signal(node) and arrives
        for node, arrives in ((start, both), (end, True))
    ]
    nodes = [start, end]
    if crossing and both and is_main and length_m > LEAST_PIECE_M and not any(has_pocket):
        nodes.insert(1, town.between(start, end, 0.5, highway="traffic_signals", crossing="traffic_signals"))
    if has_pocket[0]:
        nodes.insert(1, town.between(start, end, POCKET_M / length_m))
        town.ways.append((nodes[:2], _lanes(street, both=both, towards=-1)))
        nodes = nodes[1:]
    if has_pocket[1]:
        nodes.insert(-1, town.between(start, end, 1 - POCKET_M / length_m))
        town.ways.append((nodes[-2:], _lanes(street, both=both, towards=1)))
        nodes = nodes[:-1]
    town.ways.append((nodes, _lanes(street, both=both, towards=0)))


def _lanes(street: Street, *, both: bool, towards: int) -> dict[str, str]:
    """Tags of a way, with a lane for left turns along it (`towards` 1), against it (-1), or with none (0)."""
    lanes = street.lanes
    tags = {"highway": street.kind, "lanes": str((2 if both else 1) * lanes + abs(towards))}
    if not both:
        tags["oneway"] = "yes"
    if towards:
        turns = "|".join(["left", *["through"] * (lanes - 1), "through;right"])
        if both:
            one, other = ("forward", "backward") if towards > 0 else ("backward", "forward")
            tags |= {f"lanes:{one}": str(lanes + 1), f"lanes:{other}": str(lanes), f"turn:lanes:{one}": turns}
        else:
            tags["turn:lanes"] = turns
    return tags


def imported(osm: Path, net: Path, seed: int, *, people: bool) -> None:
    """Make a net of OpenStreetMap's data, with sidewalks and crossings where people walk. Raises UtnError."""
    types = ",".join(str(sumo_tools.data_file(f"typemap/{each}")) for each in TYPES)
    words = ["--osm-files", str(osm), "--type-files", types, *IMPORT, "-o", str(net)]
    words += ["--sidewalks.guess", "--crossings.guess"] if people else []
    tuning_nets.run("netconvert", *words, seed=seed)


def write(name: str, folder: Path, rng: np.random.Generator) -> Path:
    """Draw a town into `folder`, with its traffic; its .sumocfg. Raises UtnError."""
    folder = recording.new_folder(folder, "", "FOLDER")
    osm, net = folder / f"{name}.osm.xml", folder / f"{name}.net.xml"
    while True:
        town = drawn(rng)
        seed, people = int(rng.integers(1, 1_000_000)), bool(rng.uniform() < drawn_nets.WALKED)
        if not any(map(town.is_signal, range(len(town.nodes)))):
            continue
        town.write(osm)
        imported(osm, net, seed, people=people)
        if drawn_nets.ends(net) >= drawn_nets.LEAST_ENDS:
            return drawn_nets.fill(net, network.load(str(net)), seed, people=people)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--seed", type=click.IntRange(0), default=7, show_default=True, help="What is drawn.")
@click.option("--count", type=click.IntRange(1), default=20, show_default=True, help="How many towns.")
def main(folder: Path, seed: int, count: int) -> None:
    """Draw towns into FOLDER, a new folder each; print their .sumocfg."""
    for number in range(count):
        name = f"t{number:02d}"
        click.echo(write(name, folder / name, np.random.default_rng([seed, number])))


if __name__ == "__main__":
    try:
        main()
    except UtnError as error:
        click.echo(f"drawn_towns: {error}", err=True)
        sys.exit(2)
