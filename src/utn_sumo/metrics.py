"""The measures of SPEC 7, from SUMO's own record of the trips: nothing that a controller estimated is in them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree  # only for the files that our own SUMO has just written

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
        for _, trip in ElementTree.iterparse(trips):
            if trip.tag != "tripinfo":
                continue
            vehicles += 1
            wait_s, road_s = float(trip.get("departDelay")), float(trip.get("duration"))
            spent += wait_s + road_s
            delay += wait_s + float(trip.get("timeLoss"))
            stops += int(trip.get("waitingCount"))
            if float(trip.get("arrival")) >= 0:
                arrived += 1
                travel += wait_s + road_s
            trip.clear()
    except (OSError, ElementTree.ParseError) as error:
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
        element = ElementTree.parse(statistics).find("teleports")
    except (OSError, ElementTree.ParseError) as error:
        raise ResultError(f"statistics {str(statistics)!r} can't be read ({error})") from error
    return int(element.get("total")) if element is not None else 0


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
    turn_green = green @ network.serves
    link_green = np.zeros_like(x)
    np.maximum.at(link_green, (slice(None), network.turn_link), turn_green)
    full = x >= GRIDLOCK_OCCUPANCY * network.storage_veh
    stuck = left <= GRIDLOCK_DISCHARGE * link_green * network.saturation_flow_veh_s
    still = full[:-1] & full[1:] & stuck[1:]
    windows = np.lib.stride_tricks.sliding_window_view(still, GRIDLOCK_STEPS, axis=0)
    return bool(windows.all(axis=-1).any())
