"""Nets drawn by chance, for judging: no setting was found on those that a new seed draws.

    python tools/drawn_nets.py FOLDER --seed 7 --count 20     writes FOLDER/n00/n00.sumocfg and so on

Grids, spiders and random nets of one to three lanes, some with pockets, people, stages for left turns, all-red or
traffic on the left. At demand 1.0 the busiest junction has as much traffic at the peak as its stages can serve within
cycles of 90 s, where nobody has to give way. The same files on any machine, but for netgenerate's header.
"""

from __future__ import annotations

import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET  # only for files that SUMO has just written

import click
import numpy as np
from scipy.optimize import linprog

import tuning_nets
from utn_sumo import network, recording
from utn_sumo.contract import Floats, Network
from utn_sumo.errors import UtnError

TRIAL_VEH_H = 3000.0
"""Traffic by which it is seen how busy junctions are."""
TRIAL_MEAN = 0.55
"""Its mean over the departures, in shares of the peak (tuning_nets.SWELL)."""
CYCLE_S = 90.0
WALKED, WALKERS = 0.35, 0.25
"""Share of the nets in which people walk, and there people to vehicles."""
LEAST_ENDS = 4
"""Edges that lead in from the rim, and out: a net with fewer is drawn again."""


def write(name: str, folder: Path, rng: np.random.Generator) -> Path:
    """Draw a net into `folder`, with its traffic; its .sumocfg. Raises UtnError."""
    net = recording.new_folder(folder, "", "FOLDER") / f"{name}.net.xml"
    while True:
        words, people = _words(rng)
        seed = int(rng.integers(1, 1_000_000))
        tuning_nets.run("netgenerate", *words, "-o", str(net), seed=seed)
        found = network.load(str(net))
        if ends(net) >= LEAST_ENDS and found.junctions:
            return fill(net, found, seed, people=people)


def fill(net: Path, found: Network, seed: int, *, people: bool) -> Path:
    """Write traffic for NAME.net.xml beside it, as much at demand 1.0 as its busiest junction can serve; its .sumocfg.

    Raises UtnError.
    """
    tuning_nets.drive(net, TRIAL_VEH_H, 0.0, seed)
    veh_h = TRIAL_VEH_H / busy(found, net.with_name(net.name.replace("net.xml", "rou.xml")))
    return tuning_nets.drive(net, veh_h, WALKERS * veh_h * people, seed)


def _words(rng: np.random.Generator) -> tuple[list[str], bool]:
    """Words of netgenerate, and whether people walk."""
    kind, lanes = str(rng.choice(["grid", "spider", "rand"])), int(rng.choice([1, 2, 3], p=[0.4, 0.35, 0.25]))
    length_m, people = float(rng.uniform(120, 350)), bool(rng.uniform() < WALKED)
    attach_m = f"{max(length_m, 200):g}"
    signals = ["--default-junction-type", "traffic_light"]
    if kind == "grid":
        sizes = {"x-number": str(rng.integers(1, 5)), "y-number": str(rng.integers(1, 5))}
        sizes |= {"length": f"{length_m:g}", "attach-length": attach_m}
    elif kind == "spider":
        sizes = {"arm-number": str(rng.integers(4, 7)), "circle-number": str(rng.integers(1, 4))}
        sizes |= {"space-radius": f"{length_m:g}", "attach-length": attach_m}
    else:
        sizes = {"iterations": str(rng.integers(30, 80)), "max-distance": f"{1.5 * length_m:g}"}
        sizes |= {"min-distance": f"{0.75 * length_m:g}", "neighbor-dist1": "3", "neighbor-dist3": "6"}
        signals = ["--default-junction-type", "priority", "--tls.guess", "--tls.guess.threshold", "54"]
    words = [f"--{kind}", *(word for size, value in sizes.items() for word in (f"--{kind}.{size}", value))]
    words += ["--default.lanenumber", str(lanes), *signals]
    for share, more in (
        (0.4, ["--turn-lanes", "1", "--turn-lanes.length", f"{rng.uniform(30, 80):.0f}"]),
        (0.3, ["--tls.layout", "incoming"]),
        (0.3, ["--tls.left-green.time", "6"]),
        (0.3, ["--tls.allred.time", str(rng.integers(1, 4))]),
        (0.2, ["--lefthand"]),
        (0.8, ["--no-turnarounds"]),
    ):
        words += more if rng.uniform() < share else []
    words += ["--sidewalks.guess", "--crossings.guess"] if people else []
    return [*words, "--no-turnarounds.fringe"], people


def ends(net: Path) -> int:
    """Edges of the rim: that lead in or that lead out, whichever are fewer."""
    import sumolib  # noqa: PLC0415 - slow

    edges = sumolib.net.readNet(str(net)).getEdges()
    return min(sum(not edge.getIncoming() for edge in edges), sum(not edge.getOutgoing() for edge in edges))


def busy(found: Network, routes: Path) -> float:
    """Traffic over what its stages can serve within a cycle, of the junction where that is most."""
    ways = (route.attrib["edges"].split() for route in ET.parse(routes).iter("route"))
    passed = Counter(pair for way in ways for pair in pairwise(way))
    turned = np.array([passed[found.links[turn.link].edges[-1], turn.to_edge] for turn in found.turns])
    peak_veh_s = turned / (tuning_nets.DEPARTURES_S * TRIAL_MEAN)
    group_veh_s = np.bincount(found.turn_group, peak_veh_s, len(found.groups))
    need = (group_veh_s / found.group_saturation_flow_veh_s)[found.turn_group]
    return max(_share(found, junction.stages, need) for junction in found.junctions)


def _share(found: Network, stages: tuple[int, ...], need: Floats) -> float:
    """Least share of a cycle in which stages give every turn the green that it needs, over what clearances leave."""
    serves = found.serves[list(stages)]
    turns = np.flatnonzero(serves.any(axis=0))
    least = linprog(np.ones(len(stages)), A_ub=-serves[:, turns].T.astype(float), b_ub=-need[turns])
    lost = float(found.clearance_s[list(stages)].sum()) / CYCLE_S
    return float(least.fun) / max(1 - lost, 0.2)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--seed", type=click.IntRange(0), default=7, show_default=True, help="What is drawn.")
@click.option("--count", type=click.IntRange(1), default=20, show_default=True, help="How many nets.")
def main(folder: Path, seed: int, count: int) -> None:
    """Draw nets into FOLDER, a new folder each; print their .sumocfg."""
    for number in range(count):
        name = f"n{number:02d}"
        click.echo(write(name, folder / name, np.random.default_rng([seed, number])))


if __name__ == "__main__":
    try:
        main()
    except UtnError as error:
        click.echo(f"drawn_nets: {error}", err=True)
        sys.exit(2)
