"""The floor: what no model can know, the spread of SUMO itself.

A recorded run is replayed to a cut: the same seed, routes and signals give the same history, bit for bit. From there on
the future is drawn anew: every vehicle that departs later gets a new way and a new moment within its control step,
every vehicle on the road a new way from its next junction on (from the one after it if it is within the reach of the
lane-area detectors: the lane that it is in has settled the turn there), and a speed factor moved by one per cent, which
sets SUMO's own random streams apart within seconds. The standard deviation of x over such replicas is the error of the
best predictor that knows all of the history, every vehicle's place and speed, the greens to come and how many will
arrive in each control step, but nobody's mind.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from utn_sumo import demand, processes, recording
from utn_sumo.contract import Floats, Network, Plan
from utn_sumo.plant.sumo import SumoPlant

SPEED_SHARE = 0.01


def spread(network: Network, folder: Path, cuts: Sequence[int], replicas: int, horizon: int) -> Floats:
    """(H, Z) root mean square over the cuts of the standard deviation of x over the replicas, by step ahead.

    `folder` holds a recorded run, `cuts` are control steps of it. The replicas run in as many processes as there are
    processors.
    """
    jobs = [(network, folder, cut, replica, horizon) for cut in cuts for replica in range(replicas)]
    with processes.pool(afresh=True) as pool:
        futures = np.array(list(pool.map(_replica, jobs)))
    by_cut = futures.reshape(len(cuts), replicas, horizon, -1)
    return np.asarray(np.sqrt(np.mean(np.var(by_cut, axis=1, ddof=1), axis=0)))


def _replica(job: tuple[Network, Path, int, int, int]) -> Floats:
    """(H, Z) x after each step ahead of the cut in one drawn future."""
    network, folder, cut, replica, horizon = job
    log = recording.read_log(folder)
    seed = int(recording.read_json(folder, recording.SETTINGS)["scenario"]["seed"])
    rng = np.random.default_rng([seed, cut, replica])
    step_s = network.control_step_s
    with tempfile.TemporaryDirectory() as temporary:
        routes = Path(temporary) / "routes.rou.xml"
        _redraw_departures(network, folder / recording.ROUTES, routes, cut * step_s, rng)
        ahead = []
        end_s = (cut + horizon) * step_s
        with SumoPlant(network, routes, Path(temporary), seed=seed, duration_s=end_s) as plant:
            for step in range(cut + horizon):
                if step == cut:
                    plant.redraw(lambda link: demand.onward(network, link, rng), rng, SPEED_SHARE)
                plant.run(Plan(log.green_s[step, 0]))
                if step >= cut and plant.truth is not None:
                    ahead.append(plant.truth.x_veh)
    return np.array(ahead)


def _redraw_departures(network: Network, source: Path, target: Path, cut_s: float, rng: np.random.Generator) -> None:
    """Copy a route file; who departs after the cut gets a new way and a new moment in the same control step."""
    root = ET.parse(source).getroot()
    first_edge = {link.edges[0]: index for index, link in enumerate(network.links)}
    step_s = network.control_step_s
    for vehicle in root.iter("vehicle"):
        depart_s = float(vehicle.attrib["depart"])
        route = vehicle.find("route")
        if depart_s >= cut_s and route is not None:
            link = first_edge[route.attrib["edges"].split()[0]]
            route.set("edges", " ".join(demand.onward(network, link, rng)))
            vehicle.set("depart", f"{(depart_s // step_s + rng.uniform()) * step_s:.2f}")
    root[:] = sorted(root, key=lambda vehicle: float(vehicle.attrib["depart"]))
    ET.ElementTree(root).write(target)
