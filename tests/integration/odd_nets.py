"""Small scenarios, each with something about it that nets of other people have and the shipped ones have not.

A function writes one into a folder and returns its .sumocfg. Streets are named after their ends ("W-C" leads from W
to C), crossroads after a letter, their arms "nC" and "sC". A crossroads of single lanes has twelve signal letters:
right, ahead, left from the north, then from the east, the south and the west.
"""

from __future__ import annotations

import gzip
import math
import subprocess
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from utn_sumo.sumo_tools import sumo_binary

Phases = Iterable[tuple[float, str]]
Make = Callable[[Path], Path]

NO_TURNAROUNDS = "--no-turnarounds"
ARM_M = 200
NET = "net.net.xml"
NORTH_SOUTH, EAST_WEST = "GGgrrrGGgrrr", "rrrGGgrrrGGg"
DARK = "r" * 12
TWO_STAGES = (
    (25, NORTH_SOUTH),
    (3, "yyyrrryyyrrr"),
    (2, DARK),
    (25, EAST_WEST),
    (3, "rrryyyrrryyy"),
    (2, DARK),
)
"""A minute of a crossroads of single lanes."""


class Streets:
    """Nodes, edges and connections in netconvert's plain XML."""

    def __init__(self) -> None:
        self.parts = {name: ET.Element(name) for name in ("nodes", "edges", "connections")}

    def node(self, name: str, x: float, y: float, kind: str = "priority", **more: Any) -> None:
        _add(self.parts["nodes"], "node", id=name, x=x, y=y, type=kind, **more)

    def one_way(
        self, start: str, end: str, lanes: int = 1, *, only: Mapping[int, str] | None = None, **more: Any
    ) -> None:
        """An edge; `only` says which lanes are for whom, "bus" or "bicycle"."""
        said = {"from": start, "to": end, "numLanes": lanes, "speed": 13.89} | more
        edge = _add(self.parts["edges"], "edge", id=f"{start}-{end}", **said)
        for lane, users in (only or {}).items():
            _add(edge, "lane", index=lane, allow=users)

    def road(self, one: str, other: str, lanes: int = 1, **more: Any) -> None:
        """An edge each way."""
        self.one_way(one, other, lanes, **more)
        self.one_way(other, one, lanes, **more)

    def without(self, *edges: str) -> Streets:
        """The same with these edges taken out."""
        every = self.parts["edges"]
        every[:] = [edge for edge in every if edge.attrib["id"] not in edges]
        return self

    def connection(self, start: str, end: str, **more: Any) -> None:
        _add(self.parts["connections"], "connection", **{"from": start, "to": end}, **more)

    def net(self, folder: Path, *options: str) -> Path:
        """What netconvert makes of them."""
        command = [str(sumo_binary("netconvert")), "--tls.cycle.time", "60", *options, "-o", str(folder / NET)]
        for (name, root), flag in zip(self.parts.items(), ("-n", "-e", "-x"), strict=True):
            file = folder / f"{name}.xml"
            ET.ElementTree(root).write(file)
            command += [flag, str(file)]
        subprocess.run(command, check=True, capture_output=True, text=True)
        return folder / NET


def _add(parent: ET.Element, tag: str, **attributes: Any) -> ET.Element:
    return ET.SubElement(parent, tag, {name: str(value) for name, value in attributes.items()})


def row(names: str, kind: str = "traffic_light", gap_m: float = 250, arm_m: float = ARM_M, **more: Any) -> Streets:
    """Crossroads side by side from W to E, each with an arm to the north and one to the south."""
    streets = Streets()
    for place, name in enumerate(names):
        streets.node(name, place * gap_m, 0, kind)
        for arm, y in ((f"n{name}", arm_m), (f"s{name}", -arm_m)):
            streets.node(arm, place * gap_m, y)
            streets.road(arm, name, **more)
    streets.node("W", -arm_m, 0)
    streets.node("E", (len(names) - 1) * gap_m + arm_m, 0)
    along = ["W", *names, "E"]
    for before, after in pairwise(along):
        streets.road(before, after, **more)
    return streets


def tl_logic(signal: str, phases: Phases, program: str = "0", offset: float = 0) -> ET.Element:
    """A signal programme."""
    logic = ET.Element("tlLogic", {"id": signal, "type": "static", "programID": program, "offset": f"{offset:g}"})
    for seconds, state in phases:
        _add(logic, "phase", duration=f"{seconds:g}", state=state)
    return logic


def text_of(*elements: ET.Element) -> str:
    return "".join(ET.tostring(element, encoding="unicode") for element in elements)


def retime(net: Path, *logics: ET.Element) -> Path:
    """The net with these programmes in place of what netconvert thought of for their signals."""
    tree = ET.parse(net)
    root = tree.getroot()
    named = {logic.attrib["id"] for logic in logics}
    old = [logic for logic in root.iter("tlLogic") if logic.attrib["id"] in named]
    place = list(root).index(old[0])
    for logic in old:
        root.remove(logic)
    for logic in reversed(logics):
        root.insert(place, logic)
    tree.write(net)
    return net


def flow(name: str, here: str, there: str, **more: Any) -> str:
    """Vehicles from one edge to another, every 15 s unless told otherwise."""
    said = {"id": name, "from": here, "to": there, "begin": 0, "end": 240} | more
    if not {"period", "probability", "vehsPerHour", "number"} & said.keys():
        said["period"] = 15
    return text_of(ET.Element("flow", {key: str(value) for key, value in said.items()}))


def traffic(names: str, **more: Any) -> str:
    """Flows along a row of crossroads, across each, and some that turn left or right."""
    first, last = names[0], names[-1]
    ways = [("W", first, last, "E"), ("E", last, first, "W"), (f"s{first}", first, last, "E")]
    ways += [(f"{a}{name}", name, name, f"{b}{name}") for name in names for a, b in ("ns", "sn")]
    ways += [(f"n{last}", last, last, "E"), ("W", first, first, f"n{first}")]
    ways.sort()
    return "".join(flow(f"{a}_{d}", f"{a}-{b}", f"{c}-{d}", **more) for a, b, c, d in ways)


def case(
    folder: Path,
    routes: str,
    additional: str = "",
    options: Mapping[str, str] | None = None,
    *,
    begin: str = "0",
    end: str | None = "300",
) -> Path:
    """Routes, additional file and configuration beside the folder's net."""
    file = folder / "odd.sumocfg"
    root = ET.fromstring(f"<routes>{routes}</routes>")
    root[:] = sorted(root, key=_departs_s)
    ET.ElementTree(root).write(folder / "odd.rou.xml")
    said = {"net-file": NET, "route-files": "odd.rou.xml", "begin": begin, **(options or {})}
    if end is not None:
        said["end"] = end
    if additional:
        (folder / "odd.add.xml").write_text(f"<additional>{additional}</additional>", encoding="utf-8")
        said["additional-files"] = "odd.add.xml"
    lines = "\n".join(f'  <{name} value="{value}"/>' for name, value in said.items())
    file.write_text(f"<configuration>\n{lines}\n</configuration>\n", encoding="utf-8")
    return file


def _departs_s(element: ET.Element) -> float:
    """When somebody first departs, as SUMO wants them in that order; types come before everybody."""
    if element.tag == "vType":
        return -1
    said = element.get("begin", element.get("depart", "0"))
    return 0 if said == "triggered" else float(said)


def pockets() -> Streets:
    """A crossroads whose arms have a second lane, for left turns, on the last 50 m before it."""
    streets = row("C").without("W-C", "E-C", "nC-C", "sC-C")
    for start, x, y in (("W", -50, 0), ("E", 50, 0), ("nC", 0, 50), ("sC", 0, -50)):
        streets.node(f"p{start}", x, y)
        streets.one_way(start, f"p{start}")
        streets.one_way(f"p{start}", "C", lanes=2)
    return streets


def _through_pockets() -> str:
    ways = (("W", "E"), ("E", "W"), ("nC", "sC"), ("sC", "W"), ("nC", "E"), ("W", "nC"))
    return "".join(flow(f"{a}_{b}", f"{a}-p{a}", f"C-{b}", period=10) for a, b in ways)


def lefts_that_meet(folder: Path) -> Path:
    """A stage with protected greens for two left turns whose ways cross, as netconvert has it: not one of `CASES`.

    From the south they have a lane of their own, from the north none.
    """
    streets = row("C").without("sC-C")
    streets.one_way("sC", "C", lanes=2)
    streets.net(folder, NO_TURNAROUNDS)
    lefts = flow("north", "nC-C", "C-E", period=8) + flow("south", "sC-C", "C-W", period=8)
    return case(folder, traffic("C") + lefts)


def plain(folder: Path) -> Path:
    """Nothing odd: what the others differ from."""
    row("C").net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("C"))


def two_lanes(folder: Path) -> Path:
    """Two lanes a road, left turns in the gaps of their opposites from the inner one."""
    row("C", lanes=2).net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("C"))


# Who is on the road


def walkers(here: str, there: str, arrival: str = "max", **more: str) -> str:
    """People who walk from one street to another, one every 10 s."""
    said = {"id": f"walk_{here}_{there}", "begin": "0", "end": "200", "period": "10"} | more
    root = ET.Element("personFlow", said)
    _add(root, "walk", **{"from": here, "to": there, "arrivalPos": arrival})
    return text_of(root)


def pedestrians(folder: Path) -> Path:
    """Sidewalks and crossings at signals; netconvert gives each crossing 5 s of red before its street's yellow."""
    row("C").net(folder, NO_TURNAROUNDS, "--sidewalks.guess", "--crossings.guess")
    return case(folder, traffic("C") + walkers("W-C", "C-E") + walkers("nC-C", "C-sC") + walkers("sC-C", "C-W"))


CROSSING_LEAST_S, CROSSING_CLEARS_S = 8, 6


def protected_crossings(folder: Path) -> Path:
    """Crossings whose programme says how long they are green at least (minDur) and how long they clear.

    Crossings are the letters 12 to 15: of the northern arm, the eastern, the southern, the western.
    """
    net = row("C").net(folder, NO_TURNAROUNDS, "--sidewalks.guess", "--crossings.guess")
    logic = tl_logic("C", [])
    for cars, walk in (("GGgrrrGGgrrr", "rGrG"), ("rrrGGgrrrGGg", "GrGr")):
        least, clears = CROSSING_LEAST_S, CROSSING_CLEARS_S
        _add(logic, "phase", duration=20, state=cars + walk, minDur=least, maxDur=40)
        _add(logic, "phase", duration=clears, state=cars + "rrrr", minDur=clears, maxDur=clears)
        _add(logic, "phase", duration=3, state=cars.replace("G", "y").replace("g", "y") + "rrrr", minDur=3, maxDur=3)
        _add(logic, "phase", duration=1, state="r" * 16, minDur=1, maxDur=1)
    retime(net, logic)
    return case(folder, traffic("C") + walkers("W-C", "C-E") + walkers("nC-C", "C-sC"))


def crossing_amid_a_street(folder: Path) -> Path:
    """A signal M for pedestrians only, where a street has no other junction, beside an ordinary one."""
    streets = row("C")
    for name, x in (("M", ARM_M + 200), ("F", ARM_M + 400)):
        streets.node(name, x, 0, "traffic_light" if name == "M" else "priority")
    streets.road("E", "M")
    streets.road("M", "F")
    streets.parts["connections"].append(
        ET.Element("crossing", {"node": "M", "edges": "E-M M-E", "priority": "1", "width": "4"})
    )
    streets.net(folder, NO_TURNAROUNDS, "--sidewalks.guess")
    people = walkers("E-M", "M-E", "30", id="across", end="120", departPos="150") + walkers("W-C", "M-F")
    return case(folder, traffic("C") + flow("out", "W-C", "M-F") + flow("in", "F-M", "C-W") + people)


def bicycle_lanes(folder: Path) -> Path:
    """Lanes of their own for bicycles, which ride with the cars' signals."""
    row("C").net(folder, NO_TURNAROUNDS, "--bikelanes.guess")
    bike = '<vType id="bike" vClass="bicycle"/>'
    riders = (flow("b1", "W-C", "C-E", type="bike"), flow("b2", "nC-C", "C-E", type="bike"))
    return case(folder, bike + traffic("C") + "".join(riders))


def arm_by_arm(folder: Path, *, main_every_s: float = 12, side_every_s: float = 24, end_s: int = 300) -> Path:
    """A stage for each arm, of two lanes from the west and the east and one from the others."""
    streets = row("C", lanes=2).without("nC-C", "sC-C")
    for arm in ("nC", "sC"):
        streets.one_way(arm, "C")
    streets.net(folder, NO_TURNAROUNDS, "--tls.layout", "incoming")
    ends = "W", "E", "nC", "sC"
    ways = [(a, b, main_every_s if a in "WE" else side_every_s) for a in ends for b in ends if a != b]
    flows = "".join(
        flow(f"{a}_{b}", f"{a}-C", f"C-{b}", period=f"exp({1 / every_s:g})", end=end_s) for a, b, every_s in ways
    )
    return case(folder, flows, end=str(end_s))


def one_road(folder: Path) -> Path:
    """A signal of one road alone, each of whose two turns has a lane and a stage of its own."""
    streets = Streets()
    for name, x, y, kind in (("W", -400, 0, ""), ("C", 0, 0, "traffic_light"), ("E", 300, 0, ""), ("N", 0, 300, "")):
        streets.node(name, x, y, kind or "priority")
    streets.one_way("W", "C", 2)
    for end in ("E", "N"):
        streets.one_way("C", end)
    for lane, end in enumerate(("C-E", "C-N")):
        streets.connection("W-C", end, fromLane=lane, toLane=0)
    retime(streets.net(folder, NO_TURNAROUNDS), tl_logic("C", [(25, "Gr"), (5, "yr"), (25, "rG"), (5, "ry")]))
    return case(folder, flow("a", "W-C", "C-E", period=6) + flow("b", "W-C", "C-N", period=9))


def bus_lanes(folder: Path) -> Path:
    """Two lanes, the right one for buses, which call at a stop 60 m before the signal and at one behind it."""
    row("C", lanes=2, only={0: "bus bicycle"}).net(folder, NO_TURNAROUNDS)
    halts = "".join(
        f'<busStop id="{edge}" lane="{edge}_0" startPos="{at}" endPos="{at + 25}"/>'
        for edge, at in (("W-C", 110), ("C-E", 40))
    )
    stops = '<stop busStop="W-C" duration="20"/><stop busStop="C-E" duration="20"/>'
    line = flow("bus", "W-C", "C-E", type="line", period=60, departLane=0).replace("/>", f">{stops}</flow>")
    bus = '<vType id="line" vClass="bus"/>'
    return case(folder, bus + traffic("C") + line, halts)


def bus_stage(folder: Path, *, cars_every_s: float = 8, end_s: int = 300) -> Path:
    """A bus lane whose stage is its own, beside cars that have another one."""
    streets = Streets()
    for name, x, y, kind in (("C", 0, 0, "traffic_light"), ("W", -300, 0, ""), ("E", 200, 0, ""), ("N", 0, 300, "")):
        streets.node(name, x, y, kind or "priority")
    streets.node("S", 0, -ARM_M)
    for start, end in (("W", "C"), ("C", "E")):
        streets.one_way(start, end, 2, only={0: "bus"})
    for start, end in (("N", "C"), ("C", "S")):
        streets.one_way(start, end)
    for lane in (0, 1):
        streets.connection("W-C", "C-E", fromLane=lane, toLane=lane)
    streets.connection("N-C", "C-S")
    greens = ((20, "Grr"), (20, "rrG"), (10, "rGr"))
    shown = [
        phase for seconds, state in greens for phase in ((seconds, state), (3, state.replace("G", "y")), (2, "rrr"))
    ]
    retime(streets.net(folder, NO_TURNAROUNDS), tl_logic("C", shown))
    cars = (flow(name, *way, period=cars_every_s, end=end_s) for name, way in CROSSING.items())
    buses = flow("bus", "W-C", "C-E", type="line", period=60, end=end_s, departLane=0)
    return case(folder, '<vType id="line" vClass="bus"/>' + "".join(cars) + buses, end=str(end_s))


CROSSING = {"along": ("W-C", "C-E"), "across": ("N-C", "C-S")}


def tram_stage(folder: Path) -> Path:
    """A crossroads, and a road that trams cross in a stage of their own."""
    streets = row("A")
    streets.node("T", ARM_M, 0, "traffic_light")
    streets.without("A-E", "E-A")
    streets.road("A", "T")
    streets.road("T", "E2")
    streets.node("E2", 2 * ARM_M, 0)
    for name, y in (("TN", ARM_M), ("TS", -ARM_M)):
        streets.node(name, ARM_M, y)
    streets.one_way("TN", "T", allow="tram")
    streets.one_way("T", "TS", allow="tram")
    streets.net(folder, NO_TURNAROUNDS)
    line = flow("tram", "TN-T", "T-TS", type="tram", period=60)
    cars = flow("in", "E2-T", "A-W") + flow("out", "W-A", "T-E2") + flow("across", "nA-A", "A-sA")
    return case(folder, '<vType id="tram" vClass="tram"/>' + cars + line)


def short_arrow(folder: Path, *, end_s: int = 300) -> Path:
    """Left turns of one road have an arrow of four seconds, and no other green; nobody comes from the other road."""
    shown = (
        *((25, "rrrGGrrrrGGr"), (3, "rrryyrrrryyr"), (2, DARK), (4, "rrrrrGrrrrrG"), (3, "rrrrryrrrrry"), (2, DARK)),
        *((25, NORTH_SOUTH), (3, "yyyrrryyyrrr"), (2, DARK)),
    )
    retime(pockets().net(folder, NO_TURNAROUNDS), tl_logic("C", shown))
    ways = (("W", "E", 10), ("E", "W", 10), ("W", "nC", 30))
    flows = "".join(flow(f"{a}_{b}", f"{a}-p{a}", f"C-{b}", period=period, end=end_s) for a, b, period in ways)
    return case(folder, flows, end=str(end_s))


def ending_amid(folder: Path, *, green_s: float, end_s: int = 300) -> Path:
    """Half of those who come onto the road between two signals park amid it."""
    shown = [(green_s if "G" in state else seconds, state) for seconds, state in TWO_STAGES]
    retime(row("AB", gap_m=150).net(folder, NO_TURNAROUNDS), tl_logic("A", shown), tl_logic("B", shown))
    ways = (("W-A", "B-E", 20), ("nA-A", "A-sA", 8), ("nB-B", "B-sB", 8))
    through = "".join(flow(start, start, end, period=period, end=end_s) for start, end, period in ways)
    parking = flow("in", "W-A", "A-B", period=15, end=end_s, arrivalPos=60)
    return case(folder, through + parking, options={"time-to-teleport": "-1"}, end=str(end_s))


def lorries(folder: Path) -> Path:
    """Half of what drives is 12 to 25 m long and slow to start."""
    row("C").net(folder, NO_TURNAROUNDS)
    types = (
        '<vType id="lorry" vClass="truck" length="12"/><vType id="train" vClass="trailer" length="25.25" accel="0.7"/>'
    )
    mixed = flow("l1", "W-C", "C-E", type="lorry") + flow("l2", "E-C", "C-sC", type="train", period=30)
    return case(folder, types + traffic("C", period=25) + mixed)


def tram(folder: Path) -> Path:
    """A tram on rails of its own through the signalled node, with a halt before it."""
    streets = row("C")
    for name, x in (("TW", -ARM_M), ("TE", ARM_M)):
        streets.node(name, x, -40)
    streets.one_way("TW", "C", allow="tram")
    streets.one_way("C", "TE", allow="tram")
    streets.connection("TW-C", "C-TE")
    streets.net(folder, NO_TURNAROUNDS)
    halt = '<busStop id="halt" lane="TW-C_0" startPos="80" endPos="120"/>'
    line = flow("tram", "TW-C", "C-TE", type="tram", period=60).replace(
        "/>", '><stop busStop="halt" duration="15"/></flow>'
    )
    return case(folder, '<vType id="tram" vClass="tram"/>' + traffic("C") + line, halt)


def railway(folder: Path) -> Path:
    """Ordinary signals C, a rail signal R and a level crossing X in the street east of them."""
    streets = row("C")
    for name, x, y, kind in (
        ("X", ARM_M + 100, 0, "rail_crossing"),
        ("F", ARM_M + 300, 0, "priority"),
        ("T0", ARM_M + 100, 900, "priority"),
        ("R", ARM_M + 100, 500, "rail_signal"),
        ("T1", ARM_M + 100, -500, "priority"),
    ):
        streets.node(name, x, y, kind)
    streets.road("E", "X")
    streets.road("X", "F")
    for start, end in (("T0", "R"), ("R", "X"), ("X", "T1")):
        streets.one_way(start, end, allow="rail", speed=27)
    streets.net(folder, NO_TURNAROUNDS)
    rail = '<vType id="train" vClass="rail" length="120"/>'
    trains = flow("train", "T0-R", "X-T1", type="train", period=90, begin=20)
    return case(folder, rail + trains + traffic("C") + flow("out", "W-C", "X-F") + flow("in", "F-X", "C-W"))


# What the signals' programmes are like


def one_stage(folder: Path) -> Path:
    """A meter M that lets traffic pass for some seconds at a time, and one that is always green, beside signals."""
    streets = row("C")
    for name, x in (("M", ARM_M + 150), ("F", ARM_M + 300), ("G", ARM_M + 450)):
        streets.node(name, x, 0, "priority" if name == "G" else "traffic_light")
    for start, end in (("E", "M"), ("M", "F"), ("F", "G")):
        streets.one_way(start, end)
    net = streets.net(folder, NO_TURNAROUNDS)
    retime(net, tl_logic("M", ((4, "G"), (2, "y"), (4, "r"))))
    retime(net, tl_logic("F", ((90, "G"),)))
    return case(folder, traffic("C") + flow("out", "W-C", "F-G", period=20))


def joined(folder: Path) -> Path:
    """Two nodes, 40 m apart, under one programme, with the street between them inside it."""
    streets = row("AB", gap_m=40)
    for node in streets.parts["nodes"]:
        if node.attrib["id"] in "AB":
            node.set("tl", "J")
    streets.net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("AB"))


def carriageways(
    folder: Path, apart_m: float = 14, left_veh_h: float = 110, end_s: int = 300, *, signals: str = "JJ"
) -> Path:
    """A main road whose carriageways are apart and a street across it, under these signals: a road within the junction.

    Who turns left off a carriageway waits amid the junction until the street has green.
    """
    streets = Streets()
    for name, y, signal in zip("ab", (0.0, apart_m), signals, strict=True):
        streets.node(name, 0, y, "traffic_light", tl=signal)
    for name, x, y in (("W", -1, 0), ("F", 1, 0), ("E", 1, apart_m), ("V", -1, apart_m)):
        streets.node(name, x * ARM_M, y)
    for start, end in (("W", "a"), ("a", "F"), ("E", "b"), ("b", "V")):
        streets.one_way(start, end, 2)
    for name, y in (("S", -ARM_M), ("N", apart_m + ARM_M)):
        streets.node(name, 0, y)
    for start, end in (("S", "a"), ("a", "b"), ("b", "N")):
        streets.road(start, end)
    streets.net(folder, NO_TURNAROUNDS)
    ways = [("W-a", "a-F", 500), ("E-b", "b-V", 500), ("S-a", "b-N", 150), ("N-b", "a-S", 150)]
    ways += [("W-a", "b-N", left_veh_h), ("E-b", "a-S", left_veh_h), ("S-a", "b-V", 30), ("N-b", "a-F", 30)]
    flows = "".join(
        flow(f"f{place}", start, end, end=end_s - 60, period=f"exp({rate / 3600:.5f})", departLane="best")
        for place, (start, end, rate) in enumerate(ways)
    )
    return case(folder, flows, end=str(end_s))


def ring(folder: Path, arm_veh_h: float = 300, end_s: int = 300) -> Path:
    """A ring of two lanes and four arms, with signals where they come onto it: half of its traffic leaves before."""
    streets = Streets()
    for arm in range(4):
        for name, degrees, radius_m, kind in (
            (f"x{arm}", 90 * arm - 18, 45, "priority"),
            (f"e{arm}", 90 * arm + 18, 45, "traffic_light"),
            (f"O{arm}", 90 * arm - 2, ARM_M, "priority"),
            (f"I{arm}", 90 * arm + 2, ARM_M, "priority"),
        ):
            angle = math.radians(degrees)
            streets.node(name, round(radius_m * math.cos(angle), 1), round(radius_m * math.sin(angle), 1), kind)
        for start, end in ((f"I{arm}", f"e{arm}"), (f"x{arm}", f"O{arm}"), (f"x{arm}", f"e{arm}")):
            streets.one_way(start, end, 2)
        streets.one_way(f"e{arm}", f"x{(arm + 1) % 4}", 2)
    streets.net(folder, NO_TURNAROUNDS)
    flows = "".join(
        flow(
            f"f{arm}{turn}",
            f"I{arm}-e{arm}",
            f"x{(arm + turn) % 4}-O{(arm + turn) % 4}",
            end=end_s - 60,
            period=f"exp({arm_veh_h / 3 / 3600:.5f})",
            departLane="best",
        )
        for arm in range(4)
        for turn in (1, 2, 3)
    )
    return case(folder, flows, end=str(end_s))


def actuated(folder: Path) -> Path:
    """SUMO's own gap-out actuation, with phases between minDur and maxDur."""
    options = ("--tls.default-type", "actuated", "--tls.min-dur", "6", "--tls.max-dur", "40")
    row("AB").net(folder, NO_TURNAROUNDS, *options)
    return case(folder, traffic("AB"))


def actuated_with_offsets(folder: Path) -> Path:
    """The same with offsets, at which its cycles do not begin: its greens end as it thinks best."""
    net = row("AB").net(folder, NO_TURNAROUNDS, "--tls.default-type", "actuated", "--tls.min-dur", "6")
    tree = ET.parse(net)
    for logic in tree.getroot().iter("tlLogic"):
        logic.set("offset", "25")
    tree.write(net)
    return case(folder, traffic("AB"))


def actuated_by_delay(folder: Path) -> Path:
    """SUMO's other actuation, by the time that vehicles lose."""
    row("AB").net(folder, NO_TURNAROUNDS, "--tls.default-type", "delay_based", "--tls.min-dur", "6")
    return case(folder, traffic("AB"))


def actuated_left_turns(folder: Path) -> Path:
    """The same with arrows for left turns, which may be as short as 5 s."""
    options = ("--tls.default-type", "actuated", "--tls.min-dur", "5", "--tls.left-green.time", "6")
    pockets().net(folder, NO_TURNAROUNDS, *options)
    return case(folder, _through_pockets())


def dual_ring(folder: Path) -> Path:
    """A NEMA controller at C, which runs two rings of phases side by side; H is as usual."""
    net = row("CH", lanes=2).net(folder, NO_TURNAROUNDS, "--tls.default-type", "NEMA")
    shown = ((27, 2 * "GGGgrrrr"), (3, 2 * "yyyyrrrr"), (27, 2 * "rrrrGGGg"), (3, 2 * "rrrryyyy"))
    retime(net, tl_logic("H", shown))
    return case(folder, traffic("CH"))


def slow_and_fast(folder: Path) -> Path:
    """A cycle of 400 s, longer than the window, beside one of 40 s."""
    slow = [(195 if "G" in state else seconds, state) for seconds, state in TWO_STAGES]
    fast = [(15 if "G" in state else seconds, state) for seconds, state in TWO_STAGES]
    retime(row("AB").net(folder, NO_TURNAROUNDS), tl_logic("A", slow, offset=130), tl_logic("B", fast))
    return case(folder, traffic("AB"))


def short_greens(folder: Path) -> Path:
    """A cycle of 42 s with arrows of 5 s for the left turns: ten seconds for each of four stages do not fit in."""
    shown = (
        *((10, NORTH_SOUTH), (3, "yygrrryygrrr"), (5, "rrGrrrrrGrrr"), (3, "rryrrrrryrrr")),
        *((10, EAST_WEST), (3, "rrryygrrryyg"), (5, "rrrrrGrrrrrG"), (3, "rrrrryrrrrry")),
    )
    retime(pockets().net(folder, NO_TURNAROUNDS), tl_logic("C", shown))
    return case(folder, _through_pockets())


def several_programmes(folder: Path) -> Path:
    """Three programmes in the net; SUMO runs the last one that it reads, of 80 s with offset 7."""
    longer = ((45, NORTH_SOUTH), *TWO_STAGES[1:])
    logics = [tl_logic("C", TWO_STAGES, program) for program in ("morning", "noon")]
    retime(row("C").net(folder, NO_TURNAROUNDS), *logics, tl_logic("C", longer, "evening", offset=7))
    return case(folder, traffic("C"))


def programmes_by_the_clock(folder: Path) -> Path:
    """A WAUT that changes to C's longer programme at 120 s and back at 240 s; D as usual."""
    longer = ((45, NORTH_SOUTH), *TWO_STAGES[1:])
    logics = (tl_logic("C", longer, "long"), tl_logic("C", TWO_STAGES, "short"), tl_logic("D", TWO_STAGES))
    retime(row("CD").net(folder, NO_TURNAROUNDS), *logics)
    switches = "".join(f'<wautSwitch time="{time}" to="{name}"/>' for time, name in ((120, "long"), (240, "short")))
    waut = f'<WAUT refTime="0" id="clock" startProg="short">{switches}</WAUT>'
    return case(folder, traffic("CD"), waut + '<wautJunction wautID="clock" junctionID="C"/>')


def phases_that_are_skipped(folder: Path) -> Path:
    """At A a stage that the programme never comes to, since the phase before it leads back to the first; B as usual."""
    logic = tl_logic("A", (*TWO_STAGES, (20, "GGGrrrrrrrrr"), (3, "yyyrrrrrrrrr")))
    list(logic)[5].set("next", "0")
    retime(row("AB").net(folder, NO_TURNAROUNDS), logic, tl_logic("B", TWO_STAGES))
    return case(folder, traffic("AB"))


OFFSETS_S = {"A": -25, "B": 200, "D": 12}


def offsets(folder: Path) -> Path:
    """Offsets that are negative, or longer than the cycle of a minute."""
    net = row("ABD").net(folder, NO_TURNAROUNDS)
    retime(net, *(tl_logic(name, TWO_STAGES, offset=offset) for name, offset in OFFSETS_S.items()))
    return case(folder, traffic("ABD"))


def hardly_an_edge(folder: Path) -> Path:
    """A last edge of 0.3 m, as OpenStreetMap's nets have them: whoever waits stands inside the node before it."""
    streets = row("A", lanes=2).without("W-A")
    streets.node("p", -20, 0)
    streets.one_way("W", "p", lanes=2)
    streets.one_way("p", "A", lanes=3, length=0.3)
    streets.net(folder, NO_TURNAROUNDS)
    # He comes while the others go, and they stop coming.
    lone = '<trip id="lone" depart="60" from="W-p" to="A-E"/>'
    others = [flow(f"from_{arm}", f"{arm}A-A", f"A-{to}A", period=2, end=80) for arm, to in ("ns", "sn")]
    return case(folder, "".join([lone, *others]))


def coordinated(folder: Path) -> Path:
    """Offsets as tlsCoordinator writes them: programmes without phases in an additional file."""
    net = row("AB").net(folder, NO_TURNAROUNDS)
    retime(net, *(tl_logic(name, TWO_STAGES, offset=10) for name in "AB"))
    moved = (f'<tlLogic id="{name}" programID="0" offset="{offset}"/>' for name, offset in (("A", 30), ("B", 50)))
    return case(folder, traffic("AB"), "".join(moved))


def fractions_of_seconds(folder: Path) -> Path:
    """Clearances of 2.5 s and an offset of 4.5 s at A, in a cycle of whole seconds; B is as usual."""
    shown = [(2.5 if "G" not in state else seconds, state) for seconds, state in TWO_STAGES]
    net = row("AB").net(folder, NO_TURNAROUNDS)
    retime(net, tl_logic("A", shown, offset=4.5), tl_logic("B", TWO_STAGES))
    return case(folder, traffic("AB"))


def fraction_in_the_cycle(folder: Path) -> Path:
    """A cycle of 61.5 s at A beside one of 60 s at B."""
    net = row("AB").net(folder, NO_TURNAROUNDS)
    retime(net, tl_logic("A", ((26.5, NORTH_SOUTH), *TWO_STAGES[1:])), tl_logic("B", TWO_STAGES))
    return case(folder, traffic("AB"))


def right_on_red(folder: Path) -> Path:
    """Right turns at C may pass at red after a stop: letter s."""
    row("C", kind="traffic_light_right_on_red", lanes=2).net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("C") + flow("right", "nC-C", "C-W", period=8))


def unused_letters(folder: Path) -> Path:
    """Programmes with letters at their end that no stream has, as left behind by an editor."""
    shown = [(seconds, state + "Gr"[index % 2] + "G") for index, (seconds, state) in enumerate(TWO_STAGES)]
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", shown))
    return case(folder, traffic("C"))


def letters_without_a_stream(folder: Path) -> Path:
    """A letter amid the others that no stream has: its connection was removed, the programme was not changed."""
    net = row("C").net(folder, NO_TURNAROUNDS)
    tree = ET.parse(net)
    for connection in tree.iter("connection"):
        if connection.get("tl") and int(connection.attrib["linkIndex"]) >= 3:
            connection.set("linkIndex", str(int(connection.attrib["linkIndex"]) + 1))
    tree.write(net)
    retime(net, tl_logic("C", [(seconds, state[:3] + "r" + state[3:]) for seconds, state in TWO_STAGES]))
    return case(folder, traffic("C"))


def slip_lanes(folder: Path) -> Path:
    """Right turns from the north and the west pass the signals by, from a lane of their own."""
    streets = row("C", lanes=2)
    for start, right in (("nC", "W"), ("W", "sC")):
        streets.connection(f"{start}-C", f"C-{right}", fromLane=0, toLane=0, uncontrolled="true")
        for end in {"nC", "sC", "W", "E"} - {start, right}:
            streets.connection(f"{start}-C", f"C-{end}", fromLane=1, toLane=1)
    streets.net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("C") + flow("slip", "nC-C", "C-W", period=8))


def shared_letters(folder: Path) -> Path:
    """Streams that are always green together share a letter."""
    row("AB", lanes=2).net(folder, NO_TURNAROUNDS, "--tls.group-signals")
    return case(folder, traffic("AB"))


def leading_green(folder: Path) -> Path:
    """The north is green first, then north and south, with nothing between: the north has one green in two stages."""
    leading = ((12, "GGGrrrrrrrrr"), (18, NORTH_SOUTH), *TWO_STAGES[1:])
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", leading))
    return case(folder, traffic("C"))


def lagging_green(folder: Path) -> Path:
    """While the south clears the north stays green, and has the junction for itself after that."""
    lagging = (
        *((20, NORTH_SOUTH), (3, "GGgrrryyyrrr"), (2, "GGgrrrrrrrrr"), (12, "GGGrrrrrrrrr")),
        *((3, "yyyrrrrrrrrr"), (2, DARK), *TWO_STAGES[3:]),
    )
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", lagging))
    return case(folder, traffic("C"))


def red_and_amber(folder: Path) -> Path:
    """Two seconds of red and amber, letter u, before each green."""
    amber = {2: "rrruuurrruuu", 5: "uuurrruuurrr"}
    shown = [(seconds, amber.get(place, state)) for place, (seconds, state) in enumerate(TWO_STAGES)]
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", shown))
    return case(folder, traffic("C"))


def green_beside_amber(folder: Path) -> Path:
    """Right turns may pass on while all others clear, and clear while the street across is red and amber."""
    shown = (
        *((25, NORTH_SOUTH), (3, "gyyrrrgyyrrr"), (2, "yrrrrryrrrrr"), (1, "yrruuuyrruuu"), (1, "rrruuurrruuu")),
        *((23, EAST_WEST), (3, "rrryyyrrryyy"), (2, "uuurrruuurrr")),
    )
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", shown))
    return case(folder, traffic("C"))


def no_yellow(folder: Path) -> Path:
    """Greens at A end in red at once; B is as usual."""
    bare = [(seconds, state.replace("y", "r")) for seconds, state in TWO_STAGES]
    retime(row("AB").net(folder, NO_TURNAROUNDS), tl_logic("A", bare), tl_logic("B", TWO_STAGES))
    return case(folder, traffic("AB"))


def yellow_forgotten(folder: Path) -> Path:
    """The north's green goes on beyond its street's, and ends in red at once."""
    phases = (
        *((20, NORTH_SOUTH), (3, "GGgrrryyyrrr"), (12, "GGgrrrrrrrrr"), (2, DARK)),
        *((20, EAST_WEST), (3, "rrryyyrrryyy"), (2, DARK)),
    )
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", phases, offset=40))
    return case(folder, traffic("C"))


def green_too_soon(folder: Path) -> Path:
    """The street across has way in the last of three seconds of yellow."""
    phases = (
        *((25, NORTH_SOUTH), (2, "yyyrrryyyrrr"), (1, "yyyGGgyyyGGg"), (20, EAST_WEST)),
        *((3, "rrryyyrrryyy"), (2, DARK)),
    )
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", phases, offset=40))
    return case(folder, traffic("C"))


def switched_off(folder: Path) -> Path:
    """A blinks, B is dark, D is switched off by an additional file; H alone works."""
    net = row("ABDH", gap_m=120).net(folder, NO_TURNAROUNDS)
    retime(net, tl_logic("A", ((60, "o" * 12),)))
    retime(net, tl_logic("B", ((60, "O" * 12),)))
    return case(folder, traffic("ABDH", period=30), '<tlLogic id="D" type="static" programID="off"/>')


def blinking_at_night(folder: Path) -> Path:
    """An additional file turns C to blinking; H works."""
    row("CH").net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("CH", period=20), text_of(tl_logic("C", ((60, "o" * 12),), "night")))


# What streets are like


def turning_pockets(folder: Path) -> Path:
    """Lanes and arrows for left turns, which have green before the arrow and stay green until it comes."""
    pockets().net(folder, NO_TURNAROUNDS)
    return case(folder, _through_pockets())


def side_streets(folder: Path) -> Path:
    """Between two signals two T nodes without any, at which traffic comes and goes."""
    streets = row("AB", gap_m=400).without("A-B", "B-A")
    for name, x in (("t", 150), ("u", 280)):
        streets.node(name, x, 0)
        streets.node(f"s{name}", x, -ARM_M)
        streets.road(f"s{name}", name, priority=1)
    for start, end in (("A", "t"), ("t", "u"), ("u", "B")):
        streets.road(start, end, priority=5)
    streets.net(folder, NO_TURNAROUNDS)
    aside = flow("on", "st-t", "B-E") + flow("off", "W-A", "u-su") + flow("over", "su-u", "t-st", period=30)
    return case(folder, traffic("AB") + aside)


def roundabout(folder: Path) -> Path:
    """A roundabout between two signals, with a street to the south of its own."""
    streets = row("AB", gap_m=400).without("A-B", "B-A")
    ring = (("rw", 180, 0), ("rs", 200, -20), ("re", 220, 0), ("rn", 200, 20))
    for name, x, y in ring:
        streets.node(name, x, y)
    for (start, *_), (end, *_) in zip(ring, (*ring[1:], ring[0]), strict=True):
        streets.one_way(start, end, speed=8)
    streets.node("R", 200, -ARM_M)
    for start, end in (("A", "rw"), ("re", "B"), ("R", "rs")):
        streets.road(start, end)
    streets.net(folder, NO_TURNAROUNDS, "--roundabouts.guess")
    return case(folder, traffic("AB") + flow("in", "R-rs", "B-E") + flow("out", "E-B", "rs-R"))


def dead_ends(folder: Path) -> Path:
    """Streets at whose ends vehicles turn round, as they may at the signals."""
    row("C").net(folder)
    back = '<flow id="back" begin="0" end="240" period="20"><route edges="W-C C-E E-C C-W"/></flow>'
    return case(folder, traffic("C") + back + flow("round", "nC-C", "C-nC", period=30))


def left_hand(folder: Path) -> Path:
    """Traffic on the left."""
    row("AB", lanes=2).net(folder, NO_TURNAROUNDS, "--lefthand")
    return case(folder, traffic("AB"))


def stubs(folder: Path) -> Path:
    """Two signals with a street of some metres between them, and one arm that is shorter than a car."""
    streets = row("AB", gap_m=22)
    streets.node("Z", 22 + ARM_M + 9, 0)
    streets.road("E", "Z")
    streets.node("V", -ARM_M - 60, 0, "traffic_light")
    streets.road("V", "W")
    streets.node("vn", -ARM_M - 60, 14)
    streets.node("vs", -ARM_M - 60, -100)
    for arm in ("vn", "vs"):
        streets.road(arm, "V")
    streets.net(folder, NO_TURNAROUNDS)
    more = flow("down", "vn-V", "V-vs", period=30) + flow("up", "vs-V", "V-W") + flow("far", "Z-E", "A-W")
    return case(folder, traffic("AB") + more)


def nodes_beside_zone_ends(folder: Path) -> Path:
    """Nodes a few centimetres nearer to the stop line than zones end, and lengths in tenths of millimetres."""
    streets = row("C").without("W-C", "E-C")
    for start, node, x, before_m, after_m in (("W", "w", -50, 1234.5678, 49.96), ("E", "e", 22, 1e4 + 0.0678, 21.9712)):
        streets.node(node, x, 0)
        streets.one_way(start, node, length=before_m)
        streets.one_way(node, "C", length=after_m)
    streets.net(folder, NO_TURNAROUNDS, "--precision", "4")
    flows = flow("right", "W-w", "C-E") + flow("left", "E-e", "C-W") + flow("south", "nC-C", "C-sC")
    return case(folder, flows)


def names_as_in_openstreetmap(folder: Path) -> Path:
    """Ids with signs, hashes, slashes and brackets in them, and a letter beyond ASCII."""
    net = row("C").net(folder, NO_TURNAROUNDS)
    text = net.read_text(encoding="utf-8")
    names = {"nC-C": "-4082054#3", "C-nC": "4082054#3", "W-C": "straße_1_0", "C-E": "a/b(c)"}
    routes = case(folder, traffic("C")).with_name("odd.rou.xml")
    said = routes.read_text(encoding="utf-8")
    for old, new in names.items():
        text = text.replace(f'"{old}', f'"{new}').replace(f" {old}_", f" {new}_")
        said = said.replace(f'"{old}"', f'"{new}"')
    signal = "joinedS_1234#2*GS_7"
    for word in ('tl="', 'tlLogic id="'):
        text = text.replace(f'{word}C"', f'{word}{signal}"')
    net.write_text(text, encoding="utf-8")
    routes.write_text(said, encoding="utf-8")
    return folder / "odd.sumocfg"


# What files and windows are like


def zipped(folder: Path) -> Path:
    """Net and routes as .gz."""
    file = row("C").net(folder, NO_TURNAROUNDS)
    config = case(folder, traffic("C"))
    for plain_file in (file, folder / "odd.rou.xml"):
        with gzip.open(plain_file.with_name(f"{plain_file.name}.gz"), "wb") as target:
            target.write(plain_file.read_bytes())
        plain_file.unlink()
    text = config.read_text(encoding="utf-8").replace('net.xml"', 'net.xml.gz"').replace('rou.xml"', 'rou.xml.gz"')
    config.write_text(text, encoding="utf-8")
    return config


def sundry_trips(folder: Path) -> Path:
    """Flows by chance and by the hour, trips without routes or by way of an edge, from amid a street to amid another,
    parking, a stop on the road, and people who ride.
    """
    row("AB").net(folder, NO_TURNAROUNDS)
    flows = (
        flow("chance", "W-A", "B-E", probability="0.1"),
        flow("poisson", "E-B", "A-W", period="exp(0.05)"),
        flow("hourly", "nA-A", "A-sA", vehsPerHour=200),
        flow("some", "sB-B", "B-nB", number=12),
    )
    trips = (
        '<trip id="t1" depart="30" from="A-B" to="B-nB" departPos="120" arrivalPos="60"/>'
        '<trip id="t2" depart="31" from="W-A" to="B-E" departPos="random" arrivalPos="30" departSpeed="max"/>'
        '<trip id="t3" depart="32" from="nA-A" to="B-sB" via="A-B"/>'
        '<trip id="t4" depart="33" from="W-A" to="B-E"><stop parkingArea="park" duration="60"/></trip>'
        '<trip id="t5" depart="34" from="E-B" to="A-W"><stop lane="B-A_0" endPos="150" duration="25"/></trip>'
        '<trip id="t6" depart="triggered" from="W-A" to="B-E"/>'
        '<person id="p1" depart="40"><ride from="W-A" to="B-E" lines="t6"/></person>'
    )
    parking = '<parkingArea id="park" lane="A-B_0" startPos="80" endPos="140" roadsideCapacity="3"/>'
    return case(folder, "".join(flows) + trips, parking)


def districts(folder: Path) -> Path:
    """Trips between districts, and a rerouter that closes a street."""
    row("AB").net(folder, NO_TURNAROUNDS)
    zones = (
        '<taz id="west"><tazSource id="W-A" weight="1"/><tazSink id="A-W" weight="1"/></taz>'
        '<taz id="east"><tazSource id="E-B" weight="1"/><tazSink id="B-E" weight="1"/></taz>'
        '<rerouter id="re" edges="W-A"><interval begin="0" end="120"><closingReroute id="B-nB"/></interval></rerouter>'
    )
    between = "".join(
        f'<flow id="{a}" fromTaz="{a}" toTaz="{b}" begin="0" end="240" period="8"/>'
        for a, b in (("east", "west"), ("west", "east"))
    )
    return case(folder, traffic("AB") + between, zones)


def detectors_like_ours(folder: Path) -> Path:
    """Detectors of the user's own, with ids that we might have thought of."""
    row("C").net(folder, NO_TURNAROUNDS)
    own = "".join(
        f'<inductionLoop id="{kind}_W-C_0" lane="W-C_0" pos="{at}" period="60" file="loops.xml"/>'
        for kind, at in (("entry", 5), ("stop", -5))
    )
    area = '<laneAreaDetector id="area_W-C_0" lane="W-C_0" pos="10" endPos="-5" period="60" file="areas.xml"/>'
    return case(folder, traffic("C"), own + area + '<timedEvent type="SaveTLSStates" source="C" dest="states.xml"/>')


def flat_configuration(folder: Path) -> Path:
    """Options without sections, outputs among them, a scale, a seed and a short name."""
    row("C").net(folder, NO_TURNAROUNDS)
    said = {"tripinfo-output": "theirs.xml", "summary-output": "sum.xml", "W": "true", "verbose": "true"}
    return case(folder, traffic("C"), options=said | {"log": "theirs.log", "scale": "0.5", "seed": "77"})


def side_by_side(folder: Path) -> Path:
    """The sublane model, with bicycles beside cars on one lane."""
    row("C").net(folder, NO_TURNAROUNDS)
    riders = '<vType id="bike" vClass="bicycle" latAlignment="right"/>' + flow("bikes", "W-C", "C-E", type="bike")
    return case(folder, riders + traffic("C"), options={"lateral-resolution": "0.8"})


def half_second_steps(folder: Path) -> Path:
    """Steps of half a second, in a window that begins between two seconds and is no multiple of the cycle."""
    row("C").net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("C"), options={"step-length": "0.5"}, begin="30.5", end="281")


def tenth_second_steps(folder: Path) -> Path:
    """Steps of a tenth of a second, with the ballistic update."""
    row("C").net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("C"), options={"step-length": "0.1", "step-method.ballistic": "true"}, end="130")


def folder_with_spaces(folder: Path) -> Path:
    """A scenario in a folder such as people have."""
    place = folder / "my town (north)"
    place.mkdir()
    row("C").net(place, NO_TURNAROUNDS)
    return case(place, traffic("C"), '<poi id="fountain" x="0" y="0"/>')


def late_begin(folder: Path) -> Path:
    """A window that begins amid a cycle, at 1:00:07, with departures before it."""
    row("AB").net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("AB", begin=3500, end=3800), begin="1:00:07", end="3900")


def no_end(folder: Path) -> Path:
    """No end: until everybody has arrived, or walked home round the corner, which takes some longer than any drive."""
    row("C").net(folder, NO_TURNAROUNDS, "--sidewalks.guess", "--walkingareas")
    return case(folder, traffic("C", end=120) + walkers("nC-C", "C-W", end="90"), end=None)


def teleports(folder: Path) -> Path:
    """Somebody stands before the signals for three minutes, who is behind is taken away after 30 s."""
    row("C").net(folder, NO_TURNAROUNDS)
    broken = '<trip id="broken" depart="1" from="W-C" to="C-E"><stop lane="W-C_0" endPos="150" duration="180"/></trip>'
    wished = {"time-to-teleport": "30", "collision.action": "teleport"}
    return case(folder, broken + traffic("C", period=6, begin=2), options=wished)


# What is refused


def no_internal_links(folder: Path) -> Path:
    """Vehicles jump over the junctions: there are no lanes inside them that could count turns."""
    row("C").net(folder, NO_TURNAROUNDS, "--no-internal-links")
    return case(folder, traffic("C"))


def no_signals(folder: Path) -> Path:
    """Nothing but priority junctions."""
    row("AB", kind="priority").net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("AB"))


def nothing_to_control(folder: Path) -> Path:
    """The only signal is always green."""
    retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", ((60, 12 * "g"),)))
    return case(folder, traffic("C"))


def mesoscopic(folder: Path) -> Path:
    """SUMO's mesoscopic model, which has no lane-area detectors."""
    row("C").net(folder, NO_TURNAROUNDS)
    return case(folder, traffic("C"), options={"mesosim": "true", "meso-junction-control": "true"})


CASES: tuple[Make, ...] = (
    plain,
    pedestrians,
    protected_crossings,
    crossing_amid_a_street,
    bicycle_lanes,
    one_road,
    bus_lanes,
    bus_stage,
    tram_stage,
    short_arrow,
    lorries,
    tram,
    railway,
    one_stage,
    joined,
    actuated,
    actuated_with_offsets,
    actuated_by_delay,
    actuated_left_turns,
    dual_ring,
    slow_and_fast,
    short_greens,
    several_programmes,
    programmes_by_the_clock,
    phases_that_are_skipped,
    offsets,
    coordinated,
    hardly_an_edge,
    fractions_of_seconds,
    fraction_in_the_cycle,
    right_on_red,
    unused_letters,
    letters_without_a_stream,
    slip_lanes,
    shared_letters,
    leading_green,
    lagging_green,
    yellow_forgotten,
    green_too_soon,
    red_and_amber,
    green_beside_amber,
    no_yellow,
    switched_off,
    blinking_at_night,
    turning_pockets,
    side_streets,
    carriageways,
    ring,
    roundabout,
    dead_ends,
    left_hand,
    stubs,
    nodes_beside_zone_ends,
    names_as_in_openstreetmap,
    zipped,
    sundry_trips,
    districts,
    detectors_like_ours,
    flat_configuration,
    side_by_side,
    half_second_steps,
    tenth_second_steps,
    folder_with_spaces,
    late_begin,
    no_end,
    teleports,
)
"""What every controller must be able to run."""
REFUSED: dict[Callable[[Path], Path], str] = {
    no_internal_links: "internal links",
    no_signals: "no traffic lights",
    nothing_to_control: "no signals that can be controlled",
    mesoscopic: "mesosim",
}
"""What only `native` runs, and what the others say."""
