"""Fixed programmes by SUMO's own tools, from the traffic of the case that they are for.

`tlsCycleAdaptation.py` finds cycles and splits by Webster's formula from the flows of the busiest hour,
`tlsCoordinator.py` offsets from the ways between signals. They get a net with our stages and clearances, and give
greens and offsets: clearances stay the net's. Both know every vehicle that is going to come.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as ET  # only for files that SUMO has just written, or has read

import numpy as np

from utn_sumo import case, signals, sumo_tools
from utn_sumo.case import Case
from utn_sumo.contract import Floats, Network
from utn_sumo.errors import PlantError
from utn_sumo.routes import WHENEVER
from utn_sumo.xml_files import opened

HOUR_S = 3600.0
"""What the tool takes flows of."""
PROGRAM = "utn"
"""programID of what stands for the net's own programmes."""
ADAPTATION, COORDINATION = "tlsCycleAdaptation.py", "tlsCoordinator.py"
NOBODY = "nobody passes it: it keeps the net's own programme"


@dataclass(frozen=True)
class Wanted:
    """Options of tlsCycleAdaptation.py."""

    min_green_s: int
    min_cycle_s: int
    max_cycle_s: int
    lost_time_s: int
    """Green that a stage loses to start-up and clearance."""
    headway_s: float
    """Between vehicles that leave a queue on one lane."""


def timed(network: Network, chosen: Case, wanted: Wanted, *, coordinated: bool) -> tuple[Network, Floats]:
    """The network with cycles and offsets as the tools have them, and its greens (S,) [s].

    Coordinated junctions have one cycle, the longest that any of them wants. Whom nobody passes is left alone. Raises
    PlantError where SUMO's tools are not installed, or break off.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        routes, net_file, output = folder / "routes.rou.xml", folder / "net.net.xml", folder / "found.add.xml"
        _route(chosen, routes)
        _write_net(chosen.net_file, network, network.equal_split().green_s, net_file)
        begin_s, headway_s = _busiest_hour(chosen, routes, wanted.headway_s)
        words = {
            "net-file": str(net_file),
            "route-files": str(routes),
            "output-file": str(output),
            "begin": case.in_digits(begin_s),
            "saturation-headway": f"{headway_s:.6f}",
            "min-cycle": str(wanted.min_cycle_s),
            "max-cycle": str(wanted.max_cycle_s),
            "min-green": str(wanted.min_green_s),
            "lost-time": str(wanted.lost_time_s),
            "yellow-time": str(round(network.clearance_s.mean())),
            "skip": ",".join(network.left_alone),
        }
        flags = ["--restrict-cyclelength", *(["--unified-cycle"] if coordinated else [])]
        sumo_tools.run_tool(ADAPTATION, [*(f"--{name}={value}" for name, value in words.items()), *flags])
        network, green_s = _greens(network, output)
        if not coordinated:
            return _with_cycles(network, green_s, chosen.begin_s), green_s
        network, green_s = _in_step(network, green_s)
        _write_net(chosen.net_file, network, green_s, net_file)
        sumo_tools.run_tool(COORDINATION, ["-n", str(net_file), "-r", str(routes), "-o", str(output)])
        offsets_s = {logic.attrib["id"]: float(logic.attrib["offset"]) for logic in ET.parse(output).iter("tlLogic")}
    junctions = (
        replace(junction, offset_s=(round(offsets_s.get(junction.id, 0.0)) - chosen.begin_s) % junction.cycle_s)
        for junction in network.junctions
    )
    return replace(network, junctions=tuple(junctions)), green_s


def _route(chosen: Case, output: Path) -> None:
    """Write every vehicle of the case's window with its whole way: as it has it, else the fastest on empty roads."""
    words = {"net-file": str(chosen.net_file), "output-file": str(output), "begin": case.in_digits(chosen.begin_s)}
    words |= {"alternatives-output": "NUL", "scale": f"{chosen.scale:g}"}
    words |= {} if chosen.end_s is None else {"end": case.in_digits(chosen.end_s)}
    for name, files in (("route-files", chosen.route_files), ("additional-files", chosen.additional_files)):
        words |= {name: ",".join(map(str, files))} if files else {}
    duarouter = str(sumo_tools.sumo_binary("duarouter"))
    flags = ["--skip-new-routes", "--ignore-errors", "--no-warnings", "--no-step-log"]
    sumo_tools.run_program("duarouter", [duarouter, *(f"--{name}={value}" for name, value in words.items()), *flags])


def _busiest_hour(chosen: Case, routes: Path, headway_s: float) -> tuple[float, float]:
    """When the hour with most departures begins [s], and the headway [s] that makes up for an hour that is not full.

    The tool multiplies the flow of a part of an hour by one and the missing part, where it should divide it by what
    is there. A flow too small by some factor under a headway too long by it is the same load.
    """
    departs = [each.attrib["depart"] for each in case.elements(routes) if each.tag == "vehicle"]
    departs_s = np.sort([case.seconds(depart) for depart in departs if depart not in WHENEVER])
    if not departs_s.size:
        raise PlantError(f"scenario {str(chosen.file)!r} has no vehicles to time signals by: use another controller")
    busiest = int(np.argmax(np.searchsorted(departs_s, departs_s + HOUR_S) - np.arange(departs_s.size)))
    begin_s, last_s = float(departs_s[busiest]), float(departs_s[-1])
    end_s = last_s if chosen.end_s is None else chosen.end_s
    by_tool = 1 + max(0.0, begin_s + HOUR_S - 1 - last_s) / HOUR_S
    return begin_s, headway_s * max(1.0, HOUR_S / max(1.0, end_s - begin_s)) / by_tool


def _write_net(source: Path, network: Network, green_s: Floats, target: Path) -> None:
    """Write a net with programmes of the network's stages under these greens (S,), and one for each other signal.

    For the tools whatever shows a green and no yellow is a stage: in clearances, where vehicles go on while who walks
    is cleared, it is yellow for them.
    """
    with opened(source) as file:
        root = ET.parse(file).getroot()
    logics = root.findall("tlLogic")
    others = {logic.attrib["id"]: logic for logic in logics}
    place = list(root).index(logics[0]) if logics else len(root)
    for logic in logics:
        root.remove(logic)
    own = {logic.attrib["id"]: logic for logic in fixed(network, green_s, 0.0)}
    for junction in network.junctions:
        phases = own[junction.id].iter("phase")
        for stage in junction.stages:
            next(phases)
            for _ in network.stages[stage].clearance:
                cleared = next(phases)
                cleared.set("state", re.sub("[Gg]", "y", cleared.attrib["state"]))
    for logic in (others | own).values():
        root.insert(place, logic)
    ET.ElementTree(root).write(target, encoding="utf-8")


def fixed(network: Network, green_s: Floats, begin_s: float) -> list[ET.Element]:
    """Static programmes of the junctions under these greens (S,); their offsets count from `begin_s`."""
    logics = []
    for index, junction in enumerate(network.junctions):
        offset = case.in_digits(begin_s + junction.offset_s)
        given = {"id": junction.id, "type": "static", "programID": PROGRAM, "offset": offset}
        logic = ET.Element("tlLogic", given)
        for state, seconds in signals.cycle_phases(network, index, green_s):
            ET.SubElement(logic, "phase", duration=case.in_digits(seconds), state=state)
        logics.append(logic)
    return logics


def _greens(network: Network, output: Path) -> tuple[Network, Floats]:
    """The part of the network that the tool found programmes for, and its greens (S,), none under its least."""
    found = {
        logic.attrib["id"]: [float(phase.attrib["duration"]) for phase in logic]
        for logic in ET.parse(output).iter("tlLogic")
    }
    kept = [index for index, junction in enumerate(network.junctions) if junction.id in found]
    if not kept:
        raise PlantError(f"SUMO's {ADAPTATION} found nobody who passes a signal: use another controller")
    idle = {junction.id: NOBODY for junction in network.junctions if junction.id not in found}
    part = replace(network.part(*kept), left_alone={**network.left_alone, **idle})
    green_s = np.zeros(len(part.stages))
    for junction in part.junctions:
        durations_s = iter(found[junction.id])
        for stage in junction.stages:
            green_s[stage] = max(next(durations_s), part.stages[stage].min_green_s)
            for _ in part.stages[stage].clearance:
                next(durations_s)
    return part, green_s


def _with_cycles(network: Network, green_s: Floats, begin_s: float) -> Network:
    """The network with the cycles that these greens (S,) make, and the net's own offsets on SUMO's clock."""
    lasts_s = np.bincount(network.stage_junction, green_s + network.clearance_s)
    junctions = (
        replace(each, cycle_s=cycle_s, offset_s=((each.offset_s + begin_s) % each.cycle_s - begin_s) % cycle_s)
        for each, cycle_s in zip(network.junctions, lasts_s.tolist(), strict=True)
    )
    return replace(network, junctions=tuple(junctions))


def _in_step(network: Network, green_s: Floats) -> tuple[Network, Floats]:
    """The network with one cycle, the longest that these greens (S,) make, and greens in proportion that fill it."""
    cycle_s = float(np.bincount(network.stage_junction, green_s + network.clearance_s).max())
    network = replace(network, junctions=tuple(replace(junction, cycle_s=cycle_s) for junction in network.junctions))
    total_s = np.bincount(network.stage_junction, green_s)
    return network, signals.whole_seconds(network, green_s * (network.green_budget_s / total_s)[network.stage_junction])
