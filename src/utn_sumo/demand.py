"""Demand of SPEC 7: profiles to individual trips, drawn once per seed and cached as a SUMO route file.

Arrivals at each source are a Poisson process whose rate is constant within a control step; each vehicle's
route is drawn from the turning fractions. Every source has a random stream of its own, so that
adding a source does not change the others.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from defusedxml import ElementTree

from utn_sumo.contract import EXIT, Floats, Network
from utn_sumo.errors import NetworkError, SettingError

LOW_VEH_H, HIGH_VEH_H = 300.0, 800.0
PAPER_MEAN_VEH_H, PAPER_SD_VEH_H = 550.0, 125.0
PROFILES = ("peak", "paper", "constant")
NOISE_PERSISTENCE = 0.7
"""Lag-one correlation of the optional noise, over control steps."""
NOISE_SHARED = 0.5
"""Share of its variance that all sources have in common."""
AMID = (0.2, 0.8)
"""Where on a link's first edge vehicles that start amid it do so, as shares of its length."""
FORMAT = 3
"""Counted up when the same settings give other trips, so that stale caches are left aside."""


def mean_profile_veh_h(network: Network, profile: str, steps: int, scale: float) -> Floats:
    """(steps, Z) mean demand by link: what is known in advance, without noise and without the draw."""
    middle = (np.arange(steps) + 0.5) / steps
    shape = {
        # A bell from 300 to 800 and back: three standard deviations to either side of the middle.
        "peak": LOW_VEH_H + (HIGH_VEH_H - LOW_VEH_H) * np.exp(-18 * (middle - 0.5) ** 2),
        "paper": np.full(steps, PAPER_MEAN_VEH_H),
        "constant": np.full(steps, HIGH_VEH_H),
    }[profile]
    return scale * shape[:, None] * network.is_source[None, :]


def drawn_rates_veh_h(network: Network, profile: str, steps: int, *, scale: float, noise: float, seed: int) -> Floats:
    """(steps, Z) the demand rates of one seed: the mean profile, the paper's draw each step, the noise.

    `noise` is the standard deviation of a multiplicative disturbance correlated in time and among sources.
    """
    rng = np.random.default_rng([seed, 0xDE])
    rates = mean_profile_veh_h(network, profile, steps, scale)
    sources = np.flatnonzero(network.is_source)
    if profile == "paper":
        for step in range(steps):
            for link in sources:
                rates[step, link] = scale * _truncated_normal(rng)
    if noise > 0:
        level = np.zeros(len(sources))
        for step in range(steps):
            shock = np.sqrt(NOISE_SHARED) * rng.standard_normal()
            shock = shock + np.sqrt(1 - NOISE_SHARED) * rng.standard_normal(len(sources))
            fresh = shock if step == 0 else np.sqrt(1 - NOISE_PERSISTENCE**2) * shock
            level = NOISE_PERSISTENCE * level + fresh if step else fresh
            rates[step, sources] *= np.maximum(0.0, 1 + noise * level)
    return rates


def route_file(
    network: Network,
    *,
    profile: str,
    duration_s: float,
    step_s: float,
    scale: float,
    noise: float,
    seed: int,
    disturbance_veh_h: float = 0.0,
    cache: Path | None = None,
) -> Path:
    """The route file of these settings, drawn if the cache does not hold it.

    `disturbance_veh_h` start amid each link, for each hour and unit of `scale`.

    The cache is `$UTN_CACHE`, else `~/.cache/utn-sumo`. A file is written aside and moved into place, so that
    runs side by side never see half of one. Raises NetworkError if a trip might never come to an end.
    """
    key = repr(
        (FORMAT, profile, duration_s, step_s, scale, noise, seed, disturbance_veh_h, network.turns, network.links)
    )
    digest = hashlib.sha256(key.encode()).hexdigest()[:16]
    folder = cache or Path(os.environ.get("UTN_CACHE", Path.home() / ".cache" / "utn-sumo"))
    path = folder / f"{network.name}-{profile}-{scale:g}-seed{seed}-{digest}.rou.xml"
    if path.is_file():
        return path
    _check_ways_out(network, everywhere=disturbance_veh_h > 0)
    steps = int(np.ceil(duration_s / step_s))
    rates = drawn_rates_veh_h(network, profile, steps, scale=scale, noise=noise, seed=seed)
    trips = _trips(network, rates, step_s, duration_s, seed)
    trips += _trips_amid(network, scale * disturbance_veh_h, duration_s, seed)
    trips.sort(key=lambda trip: trip.depart_s)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".part", delete=False, encoding="utf-8") as part:
            part.write("<routes>\n")
            for number, trip in enumerate(trips):
                where = "" if trip.start_m is None else f' departPos="{trip.start_m:.2f}"'
                part.write(
                    f'  <vehicle id="v{number}" depart="{trip.depart_s:.2f}" departLane="best"'
                    f' departSpeed="max"{where}>'
                    f"<route edges={quoteattr(' '.join(trip.edges))}/></vehicle>\n"
                )
            part.write("</routes>\n")
        Path(part.name).replace(path)
    except OSError as error:
        raise SettingError(f"cache folder {str(folder)!r} can't be used ({error.strerror}): set UTN_CACHE") from error
    return path


def coming_veh(network: Network, routes: Path, steps: int) -> tuple[Floats, Floats]:
    """What a route file of ours really brings: demand at the sources and disturbances amid links, (steps, Z) each."""
    link_of = {link.edges[0]: index for index, link in enumerate(network.links)}
    demand_veh, disturbance_veh = (np.zeros((steps, len(network.links))) for _ in range(2))
    for vehicle in ElementTree.parse(routes).getroot().iter("vehicle"):
        step = int(float(vehicle.get("depart", "0")) // network.control_step_s)
        into = demand_veh if vehicle.get("departPos") is None else disturbance_veh
        into[min(step, steps - 1), link_of[vehicle[0].get("edges", "").split()[0]]] += 1
    return demand_veh, disturbance_veh


class Trip(NamedTuple):
    """One vehicle's."""

    depart_s: float
    edges: list[str]
    start_m: float | None
    """Where on the first edge; None for its beginning."""


def _trips(network: Network, rates_veh_h: Floats, step_s: float, duration_s: float, seed: int) -> list[Trip]:
    """Trips from outside, in order of departure and, at the same moment, of links."""
    trips: list[Trip] = []
    for source in np.flatnonzero(network.is_source):
        rng = np.random.default_rng([seed, 0xA7, int(source)])
        counts = rng.poisson(rates_veh_h[:, source] * step_s / 3600)
        departures = np.concatenate(
            [step * step_s + np.sort(rng.uniform(0, step_s, n)) for step, n in enumerate(counts)]
        )
        trips += [
            Trip(float(depart_s), onward(network, int(source), rng), None)
            for depart_s in departures[departures < duration_s]
        ]
    return sorted(trips, key=lambda trip: trip.depart_s)


def _trips_amid(network: Network, rate_veh_h: float, duration_s: float, seed: int) -> list[Trip]:
    """Trips that begin amid a link, for every link."""
    trips: list[Trip] = []
    for link, item in enumerate(network.links):
        rng = np.random.default_rng([seed, 0xE2, link])
        length_m = network.edge_length_m[item.edges[0]]
        departures = rng.uniform(0, duration_s, rng.poisson(rate_veh_h * duration_s / 3600))
        trips += [
            Trip(float(depart_s), onward(network, link, rng), float(rng.uniform(*AMID) * length_m))
            for depart_s in departures
        ]
    return trips


def _check_ways_out(network: Network, *, everywhere: bool) -> None:
    """Raise NetworkError if trips from the sources, or from `everywhere`, come to a link that no way leads out from."""
    onto: dict[int, list[int]] = {}
    into: dict[int, list[int]] = {}
    for turn in network.turns:
        if turn.fraction > 0:
            onto.setdefault(turn.link, []).append(turn.next_link)
            into.setdefault(turn.next_link, []).append(turn.link)
    first = range(len(network.links)) if everywhere else np.flatnonzero(network.is_source).tolist()
    leads_out = _reached(into, [EXIT])
    for link in sorted(_reached(onto, first) - leads_out):
        raise NetworkError(
            f"link {network.links[link].id!r} leads nowhere out of net {network.name!r}, by its turning fractions and "
            "those after it: give a turn that leaves the net a fraction above 0"
        )


def _reached(ways: Mapping[int, list[int]], first: Iterable[int]) -> set[int]:
    """Where the ways lead from the first places, these among them."""
    found, todo = set(first), list(first)
    while todo:
        further = set(ways.get(todo.pop(), ())) - found
        found |= further
        todo += further
    return found


def onward(network: Network, link: int, rng: np.random.Generator) -> list[str]:
    """Edges of one vehicle from the start of a link, turn by turn, until it leaves the network."""
    edges = list(network.links[link].edges)
    while True:
        turns = np.flatnonzero(network.turn_link == link)
        position = int(np.searchsorted(np.cumsum(network.fraction[turns]), rng.uniform(), side="right"))
        turn = network.turns[turns[min(position, len(turns) - 1)]]
        if turn.next_link == EXIT:
            return [*edges, turn.to_edge]
        link = turn.next_link
        edges += network.links[link].edges


def _truncated_normal(rng: np.random.Generator) -> float:
    """A draw of the paper's demand [veh/h]: normal, redrawn until it falls between 300 and 800."""
    while True:
        value = rng.normal(PAPER_MEAN_VEH_H, PAPER_SD_VEH_H)
        if LOW_VEH_H <= value <= HIGH_VEH_H:
            return float(value)
