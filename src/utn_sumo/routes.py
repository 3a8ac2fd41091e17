"""What drives in other people's scenarios, read from their route files: the turns, the kinds, the room they take.

Vehicles, trips and flows are weighed by how many of them depart within the window; distributions of routes and types
by their probabilities. What SUMO finds the way of itself (trips, flows from edge to edge) turns nobody knows where.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from itertools import groupby, pairwise
from pathlib import Path
from typing import NamedTuple, NoReturn, TypeVar, overload
from xml.etree.ElementTree import Element

from utn_sumo import case as cases
from utn_sumo.case import Case
from utn_sumo.contract import CAR_ACCELERATION_M_S2
from utn_sumo.errors import SettingError
from utn_sumo.network import MOTOR, Traffic

LENGTH_AND_GAP_M = {
    "pedestrian": (0.215, 0.25),
    "emergency": (6.5, 2.5),
    "bus": (12.0, 2.5),
    "coach": (14.0, 2.5),
    "delivery": (6.5, 2.5),
    "truck": (7.1, 2.5),
    "trailer": (16.5, 2.5),
    "motorcycle": (2.2, 2.5),
    "moped": (2.1, 2.5),
    "bicycle": (1.6, 0.5),
    "tram": (22.0, 2.5),
    "rail_urban": (109.5, 5.0),
    "subway": (109.5, 5.0),
    "rail": (135.0, 5.0),
    "rail_electric": (200.0, 5.0),
    "rail_fast": (200.0, 5.0),
    "ship": (17.0, 2.5),
    "container": (6.096, 2.5),
    "aircraft": (72.7, 2.5),
    "wheelchair": (1.2, 0.5),
    "scooter": (1.2, 0.5),
    "drone": (0.5, 2.5),
}
"""Length and minGap by vClass where they are not a passenger car's. Source: sumo.dlr.de/docs/
Vehicle_Type_Parameter_Defaults.html; tests/unit/test_routes.py asks SUMO itself."""
ACCELERATION_M_S2 = {
    "pedestrian": 1.5,
    "bus": 1.2,
    "coach": 2.0,
    "truck": 1.3,
    "trailer": 1.1,
    "motorcycle": 6.0,
    "moped": 1.1,
    "bicycle": 1.2,
    "tram": 1.0,
    "rail_urban": 1.0,
    "rail": 0.25,
    "rail_electric": 0.5,
    "rail_fast": 0.5,
    "ship": 0.1,
    "wheelchair": 1.5,
    "scooter": 1.2,
}
"""Likewise `accel`, where it is not a passenger car's."""
SLOWEST_OF_VEH = 3
"""Those at the head of a queue: behind the slowest of them all the others start."""
CAR, CAR_M = "passenger", (5.0, 2.5)
DEFAULT_TYPE = "DEFAULT_VEHTYPE"
BUILT_IN = {
    DEFAULT_TYPE: CAR,
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_RAILTYPE": "rail",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_CONTAINERTYPE": "container",
}
"""Types that SUMO has without being told, and their vClass."""
DAY_S = 86400.0
"""How long SUMO lets a flow last that has no end, where the window has none either."""
WHENEVER = frozenset({"triggered", "containerTriggered", "split", "begin", "now"})
"""Departures that are no time: they are taken to be within the window."""
CALLED = WHENEVER - {"begin"}
"""Those that somebody has to call for: a person, a container, a train, a programme."""
ROUNDING_VEH = 1e-6
"""What the times of a flow's departures are uncertain by, in vehicles."""
MOST_VEH_S = 1e6
"""More than anybody means."""
PLACES = ("busStop", "trainStop", "parkingArea", "containerStop", "chargingStation")
"""Elements that a stop may name, in an attribute of the same name."""
DRIVES, WAYS = frozenset({"vehicle", "trip", "flow"}), frozenset({"route", "routeDistribution"})


def read(case: Case) -> Traffic:
    """The traffic of a case. Raises SettingError with one line that names file, element, value and remedy."""
    reader = _Reader(case)
    for path in (*case.additional_files, *case.route_files):
        reader.read(path)
    return reader.traffic()


def check(case: Case, traffic: Traffic) -> None:
    """Raise SettingError if somebody drives on an edge that the net has not, unless SUMO is told to put up with it."""
    if case.switches_on("ignore-route-errors"):
        return
    missing = dict(traffic.named_by)
    for element in cases.elements(case.net_file, "net-file"):
        if element.tag == "edge":
            missing.pop(element.get("id", ""), None)
    for edge, who in missing.items():
        raise SettingError(
            f"{who} drives on edge {edge!r}, which net {str(case.net_file)!r} has not: give routes of that net"
        )


class _Way(NamedTuple):
    edges: list[str]
    times: float
    """How often it is driven, one time after the other."""


class _Kind(NamedTuple):
    vclass: str
    length_m: float
    gap_m: float
    acceleration_m_s2: float
    scale: float = 1.0
    """How many of each of its vehicles drive."""


T = TypeVar("T")
Shares = list[tuple[T, float]]
"""Things and their shares, which sum to 1."""


class _Reader:
    """Adds up what departs, element by element; references are looked up at the end, wherever they are defined."""

    def __init__(self, case: Case):
        self.begin_s = case.begin_s
        self.end_s = math.inf if case.end_s is None else case.end_s
        self.scale = case.scale
        self.path = case.file
        self.ways: dict[str, Shares[_Way]] = {}
        self.kinds: dict[str, Shares[_Kind]] = {name: [(_usual(vclass), 1.0)] for name, vclass in BUILT_IN.items()}
        self.turned_veh: defaultdict[tuple[str, str], float] = defaultdict(float)
        self.trips_veh: defaultdict[tuple[str, ...], float] = defaultdict(float)
        self.named_by: dict[str, str] = {}
        self.called: set[str] = set()
        self.by_route: dict[str, tuple[float, str]] = {}
        """Vehicles on a named route, and who names it first."""
        self.by_type: dict[str, tuple[float, str]] = {}
        self.places: dict[str, str] = {}
        """Lanes of bus stops and the like, by id."""

    def read(self, path: Path) -> None:
        """Add a file."""
        self.path = path
        for element in cases.elements(path, "route file"):
            name = element.get("id", "")
            if element.tag in WAYS:
                self.ways[name] = self._ways(element)
            elif element.tag == "vType":
                self._kind(element)
            elif element.tag == "vTypeDistribution":
                self.kinds[name] = self._distribution(element, "vTypes", self.kinds, self._kind)
            elif element.tag in DRIVES:
                self._ride(element)
            elif element.tag in PLACES:
                self.places[name] = element.get("lane", "")

    def traffic(self) -> Traffic:
        """What has been read."""
        for name, (veh, who) in self.by_route.items():
            for way, share in _known(self.ways, name, who):
                self._drive(way, veh * share, who)
        by_class_veh: defaultdict[str, float] = defaultdict(float)
        space_veh_m, shortest_m = 0.0, CAR_M[0]
        by_acceleration_veh: defaultdict[float, float] = defaultdict(float)
        for name, (veh, who) in self.by_type.items():
            for kind, share in _known(self.kinds, name, who):
                driving_veh = veh * share * kind.scale
                by_class_veh[kind.vclass] += driving_veh
                if kind.vclass in MOTOR:
                    space_veh_m += driving_veh * (kind.length_m + kind.gap_m)
                    by_acceleration_veh[kind.acceleration_m_s2] += driving_veh
                if kind.vclass in (*MOTOR, "bicycle"):
                    shortest_m = min(shortest_m, kind.length_m)
        total_veh = sum(veh for vclass, veh in by_class_veh.items() if vclass in MOTOR)
        return Traffic(
            turned_veh=dict(self.turned_veh),
            space_m=space_veh_m / total_veh if total_veh else sum(CAR_M),
            by_class_veh=dict(by_class_veh),
            trips_veh=dict(self.trips_veh),
            shortest_m=shortest_m,
            acceleration_m_s2=_of_queues_m_s2(by_acceleration_veh) if total_veh else CAR_ACCELERATION_M_S2,
            named_by=self.named_by,
            called=frozenset(self.called),
        )

    def _ride(self, element: Element) -> None:
        """Count a vehicle, a trip or a flow by as many as depart within the window."""
        veh = self.scale * (self._flow_veh(element) if element.tag == "flow" else self._departs(element))
        if not veh:
            return
        who = self._name(element)
        kind, route = element.get("type", DEFAULT_TYPE), element.get("route")
        before, first = self.by_type.get(kind, (0.0, who))
        self.by_type[kind] = before + veh, first
        # Types stand before those who drive them, as a rule: SUMO may read one from another file in time.
        veh *= sum(share * each.scale for each, share in self.kinds[kind]) if kind in self.kinds else 1.0
        own = next((child for child in element if child.tag in WAYS), None)
        if own is not None:
            for way, share in self._ways(own):
                self._drive(way, veh * share, who)
        elif route is not None:
            before, first = self.by_route.get(route, (0.0, who))
            self.by_route[route] = before + veh, first
        else:
            via = [element.get("via", ""), *self._stops(element)]
            passed = " ".join([element.get("from", ""), *via, element.get("to", "")]).split()
            self.trips_veh[tuple(passed)] += veh
            for edge in passed:
                self.named_by.setdefault(edge, who)

    def _stops(self, element: Element) -> list[str]:
        """The edges on which somebody stops, as far as it is known where; one after the other once alone."""
        edges = []
        for stop in element.iter("stop"):
            place = next((stop.attrib[kind] for kind in PLACES if kind in stop.attrib), "")
            lane = stop.get("lane") or self.places.get(place, "")
            edges.append(stop.get("edge") or lane.rpartition("_")[0])
        return [edge for edge, _ in groupby(filter(None, edges))]

    def _drive(self, way: _Way, veh: float, who: str) -> None:
        for edge in way.edges:
            self.named_by.setdefault(edge, who)
        for turn in pairwise(way.edges):
            self.turned_veh[turn] += veh * way.times
        if way.times > 1:
            self.turned_veh[way.edges[-1], way.edges[0]] += veh * (way.times - 1)

    def _departs(self, element: Element) -> bool:
        if element.get("depart") in WHENEVER:
            if element.get("depart") in CALLED:
                self.called.add(element.get("id", ""))
            return True
        return self.begin_s <= self._time_s(element, "depart", None) < self.end_s

    def _flow_veh(self, element: Element) -> float:
        """Vehicles of a flow that depart within the window: on average, where they depart by chance."""
        begin_s = self._time_s(element, "begin", self.begin_s)
        # As SUMO has it: without an end of its own a flow lasts as long as the window, or a day.
        end_s = self._time_s(element, "end", self.end_s if self.end_s < math.inf else begin_s + DAY_S)
        rate_veh_s, number = self._rate_veh_s(element), self._number(element, "number", None)
        if rate_veh_s is None and number is None:
            self._refuse(element, "has neither number nor period nor vehsPerHour nor probability: give it one")
        if rate_veh_s == 0 or number == 0 or end_s <= begin_s:
            return 0.0
        if rate_veh_s is None:
            assert number is not None
            rate_veh_s = number / (end_s - begin_s)
        elif number is not None:
            end_s = begin_s + number / rate_veh_s
        if rate_veh_s > MOST_VEH_S:
            self._refuse(element, f"has more than {MOST_VEH_S:g} vehicles a second: give fewer")
        by_chance = "probability" in element.attrib or element.get("period", "").startswith("exp")

        def until_veh(time_s: float) -> float:
            """Vehicles that depart before a time; those at even distances do so at its start."""
            veh = rate_veh_s * max(0.0, min(time_s, end_s) - begin_s)
            return veh if by_chance else math.ceil(veh - ROUNDING_VEH)

        return max(0.0, until_veh(self.end_s) - until_veh(self.begin_s))

    def _rate_veh_s(self, element: Element) -> float | None:
        """Vehicles a second, if the flow says so in any of SUMO's ways."""
        period = element.get("period")
        if period is not None and period.startswith("exp(") and period.endswith(")"):
            return self._as_number(element, "period", period[4:-1])
        if period is not None:
            if (period_s := self._time_s(element, "period", None)) <= 0:
                self._refuse(element, f"has period {period!r}: give more than 0 s")
            return 1 / period_s
        for name in ("vehsPerHour", "perHour"):
            if name in element.attrib:
                return self._as_number(element, name, element.attrib[name]) / 3600
        return self._number(element, "probability", None)

    def _ways(self, element: Element) -> Shares[_Way]:
        """A route, or a distribution of routes."""
        if element.tag == "routeDistribution":
            return self._distribution(element, "routes", self.ways, self._ways)
        edges = element.get("edges", "").split()
        if not edges:
            self._refuse(element, "has no edges: give it some")
        return [(_Way(edges, 1 + self._number(element, "repeat", 0.0)), 1.0)]

    def _kind(self, element: Element) -> Shares[_Kind]:
        """A type, which goes by its own name too where it stands in a distribution."""
        usual = _usual(element.get("vClass", CAR))
        acceleration_m_s2 = self._number(element, "accel", usual.acceleration_m_s2)
        if not acceleration_m_s2 > 0:
            self._refuse(element, "has accel 0: give it more")
        own = _Kind(
            usual.vclass,
            self._number(element, "length", usual.length_m),
            self._number(element, "minGap", usual.gap_m),
            acceleration_m_s2,
            self._number(element, "scale", usual.scale),
        )
        kind = [(own, 1.0)]
        self.kinds[element.get("id", "")] = kind
        return kind

    def _distribution(
        self, element: Element, listed: str, known: Mapping[str, Shares[T]], define: Callable[[Element], Shares[T]]
    ) -> Shares[T]:
        """A distribution of the names in its attribute `listed`, and of its children."""
        names, words = element.get(listed, "").split(), element.get("probabilities", "").split()
        if words and len(words) != len(names):
            self._refuse(element, f"has {len(words)} probabilities for {len(names)} {listed}: give one for each")
        who = self._name(element)
        parts = [
            (_known(known, name, who), self._as_number(element, "probabilities", word))
            for name, word in zip(names, words or ["1"] * len(names), strict=True)
        ]
        for child in element:
            refers = child.get("refId")
            inside = define(child) if refers is None else _known(known, refers, who)
            parts.append((inside, self._number(child, "probability", 1.0)))
        total = sum(weight for _, weight in parts)
        if not total > 0:
            self._refuse(element, "has no probabilities above 0: give it some")
        return [(thing, share * weight / total) for inside, weight in parts for thing, share in inside]

    @overload
    def _number(self, element: Element, name: str, default: float) -> float: ...
    @overload
    def _number(self, element: Element, name: str, default: None) -> float | None: ...
    def _number(self, element: Element, name: str, default: float | None) -> float | None:
        text = element.get(name)
        return default if text is None else self._as_number(element, name, text)

    def _as_number(self, element: Element, name: str, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0 <= value < math.inf:
            self._refuse(element, f"has {name} {text!r}: give a number from 0 on")
        return value

    def _time_s(self, element: Element, name: str, default: float | None) -> float:
        text = element.get(name)
        if text is None and default is not None:
            return default
        try:
            return cases.seconds(text or "")
        except ValueError:
            self._refuse(element, f"has {name} {text or ''!r}: give a time in seconds")

    def _name(self, element: Element) -> str:
        return f"{element.tag} {element.get('id', '')!r} of {str(self.path)!r}"

    def _refuse(self, element: Element, what: str) -> NoReturn:
        raise SettingError(f"{self._name(element)} {what}")


def _usual(vclass: str) -> _Kind:
    acceleration_m_s2 = ACCELERATION_M_S2.get(vclass, CAR_ACCELERATION_M_S2)
    return _Kind(vclass, *LENGTH_AND_GAP_M.get(vclass, CAR_M), acceleration_m_s2)


def _of_queues_m_s2(by_acceleration_veh: Mapping[float, float]) -> float:
    """Harmonic mean of the slowest of SLOWEST_OF_VEH vehicles, of which so many accelerate by as much."""
    total_veh, faster_veh, slowest_s2_m = sum(by_acceleration_veh.values()), 0.0, 0.0
    for acceleration_m_s2, veh in sorted(by_acceleration_veh.items(), reverse=True):
        before, faster_veh = faster_veh, faster_veh + veh
        slowest = (faster_veh / total_veh) ** SLOWEST_OF_VEH - (before / total_veh) ** SLOWEST_OF_VEH
        slowest_s2_m += slowest / acceleration_m_s2
    return 1 / slowest_s2_m


def _known(table: Mapping[str, Shares[T]], name: str, who: str) -> Shares[T]:
    if name not in table:
        raise SettingError(f"{who} refers to {name!r}, which nothing before it defines: define it, or name another")
    return table[name]
