"""The measures of SPEC 7, from SUMO's own record of the trips: nothing that a controller estimated is in them."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET  # only for the files that our own SUMO has just written

import numpy as np

from utn_sumo import monitor
from utn_sumo.contract import Bools, Floats, Network
from utn_sumo.errors import ResultError


def trip_measures(trips: Path, called: Collection[str] = (), end_s: float = math.inf) -> dict[str, Any]:
    """Sums over every vehicle that wanted to travel, whether it arrived, was under way or still waited to enter.

    `total_time_spent_veh_h` is time on the road and time waiting to enter; `total_delay_veh_h` is SUMO's time
    loss plus that wait, `mean_delay_s` the same a vehicle; `mean_travel_time_s` is entry to arrival
    with the wait before it, over the vehicles that arrived; `stops` counts halts.

    Of the vehicles that somebody has to call for (`called`, by id), those are left out whom nobody had called when the
    run ended, at SUMO's time `end_s`: they did not want to travel, and by SUMO's record wait since its time 0.
    """
    spent = delay = travel = 0.0
    vehicles = arrived = stops = 0
    try:
        for _, trip in ET.iterparse(trips):
            if trip.tag != "tripinfo":
                continue
            wait_s, road_s = float(trip.attrib["departDelay"]), float(trip.attrib["duration"])
            never_called = float(trip.attrib["depart"]) < 0 and wait_s >= end_s - monitor.HUNDREDTH_S
            # Where traffic is scaled up, copies of a vehicle have its id and a number.
            if never_called and (trip.attrib["id"] in called or trip.attrib["id"].rpartition(".")[0] in called):
                continue
            vehicles += 1
            spent += wait_s + road_s
            delay += wait_s + float(trip.attrib["timeLoss"])
            stops += int(trip.attrib["waitingCount"])
            # Whom SUMO takes off the road for good has an arrival too, but never got to where he wanted.
            if float(trip.attrib["arrival"]) >= 0 and not trip.get("vaporized"):
                arrived += 1
                travel += wait_s + road_s
            trip.clear()
    except (OSError, ET.ParseError) as error:
        raise ResultError(f"trips {str(trips)!r} can't be read ({error})") from error
    return {
        "total_time_spent_veh_h": spent / 3600,
        "total_delay_veh_h": delay / 3600,
        "mean_travel_time_s": travel / arrived if arrived else 0.0,
        "mean_delay_s": delay / vehicles if vehicles else 0.0,
        "arrived": arrived,
        "unfinished": vehicles - arrived,
        "stops": stops,
    }


def teleports(statistics: Path) -> int:
    """Vehicles that SUMO teleported, from its statistics output."""
    try:
        element = ET.parse(statistics).find("teleports")
    except (OSError, ET.ParseError) as error:
        raise ResultError(f"statistics {str(statistics)!r} can't be read ({error})") from error
    return int(element.attrib["total"]) if element is not None else 0


def left_out_veh(log: Path) -> int:
    """Vehicles that SUMO left out since their routes are not in the order of their departures, by its error log."""
    text = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""
    return text.count("sorted by departure time, ignoring")


GRIDLOCK_STEPS = 3
GRIDLOCK_OCCUPANCY = 0.5
GRIDLOCK_DISCHARGE = 0.1


def gridlocked(network: Network, x_veh: Sequence[Floats], left_veh: Sequence[Floats], green_s: Floats) -> bool:
    """Whether some link stood still: for three control steps on end it was at least half full at both ends of the
    step and discharged under a tenth of what its green allows.

    `x_veh` (steps, Z) at the end of each step, `left_veh` (steps, Z), `green_s` (steps, M) of each turn.
    """
    if len(x_veh) <= GRIDLOCK_STEPS:
        return False
    x, left = (np.asarray(series, dtype=float) for series in (x_veh, left_veh))
    first_turn = np.searchsorted(network.turn_link, np.arange(x.shape[1]))
    link_green = np.maximum.reduceat(green_s, first_turn, axis=1)
    full = x >= GRIDLOCK_OCCUPANCY * network.storage_veh
    stuck = left <= GRIDLOCK_DISCHARGE * link_green * network.saturation_flow_veh_s
    still = full[:-1] & full[1:] & stuck[1:]
    windows = np.lib.stride_tricks.sliding_window_view(still, GRIDLOCK_STEPS, axis=0)
    return bool(windows.all(axis=-1).any())


class Greens:
    """When turns and lane sets had green, by SUMO's own record of the signals."""

    def __init__(self, network: Network, switches: Path, duration_s: float, begin_s: float = 0.0):
        """Of a run of `duration_s` that began at SUMO's time `begin_s`. Raises ResultError."""
        shown = monitor.read_switches(switches, begin_s)
        self._turns = len(network.turns)
        self._spans: dict[int, tuple[Floats, Floats]] = {}
        """Of each turn with signals when its greens began and ended."""
        self._reds: dict[int, tuple[Floats, Floats]] = {}
        """Of each lane set with signals alone the same of its reds."""
        junction_of_set = network.link_junction[network.set_link]
        for index, junction in enumerate(network.junctions):
            switched = shown.get(junction.id, [])
            times = np.array([time_s for time_s, _ in switched] + [duration_s], dtype=float)
            letters = np.array([[letter in monitor.GREEN for letter in state] for _, state in switched], dtype=bool)
            if not len(letters):
                continue
            by_turn: dict[int, list[int]] = {}
            for signal, turns in enumerate(junction.signal_turns):
                for turn in turns:
                    by_turn.setdefault(turn, []).append(signal)
            for turn, signals in by_turn.items():
                self._spans[turn] = _spans(np.any(letters[:, signals], axis=1), times)
            for lane_set in np.flatnonzero(junction_of_set == index).tolist():
                ways = network.lane_sets[lane_set].letters
                if all(ways):
                    signals = sorted({letter for way in ways for letter in way})
                    self._reds[lane_set] = _spans(~np.any(letters[:, signals], axis=1), times)

    def by_turn_s(self, ends_s: Sequence[float]) -> Floats:
        """(steps, M) green of each turn in each control step, of which `ends_s` are the ends; without signals all."""
        edges_s = np.array([0.0, *ends_s])
        green_s = np.repeat(np.diff(edges_s)[:, None], self._turns, axis=1)
        for turn, (begin_s, end_s) in self._spans.items():
            lit_s = np.clip(edges_s[:, None], begin_s, end_s) - begin_s
            green_s[:, turn] = np.diff(lit_s.sum(axis=1))
        return green_s

    def longest_wait_s(self, waiting: Sequence[tuple[float, Bools]]) -> float:
        """Longest that somebody stood before a lane set's red, on end, without green meanwhile.

        `waiting` has (time, whether anybody stands (L,)) at each look: who stood between two looks is not known.
        """
        if not waiting:
            return 0.0
        times = np.array([time_s for time_s, _ in waiting])
        stands = np.array([each for _, each in waiting])
        longest_s = 0.0
        for lane_set, (begin_s, end_s) in self._reds.items():
            nobody = np.where(stands[:, lane_set], -1, np.arange(len(times)))
            since_s = times[np.minimum(np.maximum.accumulate(nobody) + 1, len(times) - 1)]
            # A wait is over at the last look that saw it, or at the red's end if that comes before another look.
            seen = np.flatnonzero(stands[:, lane_set])
            red = np.searchsorted(begin_s, times[seen], side="right") - 1
            seen, red = seen[red >= 0], red[red >= 0]
            if not len(seen):
                continue
            until_s = np.append(times, np.inf)[seen + 1]
            ended_s = np.where(end_s[red] < until_s, end_s[red], times[seen])
            wait_s = ended_s - np.maximum(begin_s[red], since_s[seen])
            longest_s = max(longest_s, float(wait_s.max()))
        return longest_s


def _spans(lit: Bools, times: Floats) -> tuple[Floats, Floats]:
    """Begins and ends of the stretches in which `lit` (n,) holds, which changes at `times` (n + 1,)."""
    edges = np.diff(np.concatenate([[False], lit, [False]]).astype(int))
    return times[np.flatnonzero(edges == 1)], times[np.flatnonzero(edges == -1)]
