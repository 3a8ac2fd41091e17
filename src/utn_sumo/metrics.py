"""The measures of SPEC 7, from SUMO's own record of the trips: nothing that a controller estimated is in them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET  # only for the files that our own SUMO has just written

import numpy as np

from utn_sumo.contract import Floats, Network
from utn_sumo.errors import ResultError


def trip_measures(trips: Path) -> dict[str, Any]:
    """Sums over every vehicle that wanted to travel, whether it arrived, was under way or still waited to enter.

    `total_time_spent_veh_h` is time on the road and time waiting to enter; `total_delay_veh_h` is SUMO's time
    loss plus that wait, `mean_delay_s` the same a vehicle; `mean_travel_time_s` is entry to arrival
    with the wait before it, over the vehicles that arrived; `stops` counts halts.
    """
    spent = delay = travel = 0.0
    vehicles = arrived = stops = 0
    try:
        for _, trip in ET.iterparse(trips):
            if trip.tag != "tripinfo":
                continue
            vehicles += 1
            wait_s, road_s = float(trip.attrib["departDelay"]), float(trip.attrib["duration"])
            spent += wait_s + road_s
            delay += wait_s + float(trip.attrib["timeLoss"])
            stops += int(trip.attrib["waitingCount"])
            if float(trip.attrib["arrival"]) >= 0:
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


GRIDLOCK_STEPS = 3
GRIDLOCK_OCCUPANCY = 0.5
GRIDLOCK_DISCHARGE = 0.1


def gridlocked(network: Network, x_veh: Sequence[Floats], left_veh: Sequence[Floats], greens: Sequence[Floats]) -> bool:
    """Whether some link stood still: for three control steps on end it was at least half full at both ends of the
    step and discharged under a tenth of what its green allows.

    `x_veh` (steps, Z) at the end of each step, `left_veh` (steps, Z), `greens` (steps, S).
    """
    if len(x_veh) <= GRIDLOCK_STEPS:
        return False
    x, left, green = (np.asarray(series, dtype=float) for series in (x_veh, left_veh, greens))
    first_turn = np.searchsorted(network.turn_link, np.arange(x.shape[1]))
    link_green = np.maximum.reduceat(green @ network.serves, first_turn, axis=1)
    full = x >= GRIDLOCK_OCCUPANCY * network.storage_veh
    stuck = left <= GRIDLOCK_DISCHARGE * link_green * network.saturation_flow_veh_s
    still = full[:-1] & full[1:] & stuck[1:]
    windows = np.lib.stride_tricks.sliding_window_view(still, GRIDLOCK_STEPS, axis=0)
    return bool(windows.all(axis=-1).any())
