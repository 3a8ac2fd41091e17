"""A bound below every controller's delay: traffic as a fluid, the future known, green shared out without a cycle.

A linear programme over the whole run. Nobody waits at a red that the junction has time to spare for, nobody loses time
by starting or braking, storage is kept, and links discharge at the network's saturation flows all the time. All that
is charged is a share of the time that goes to clearances. What is left is delay that no control can take away: more
vehicles than the junctions can serve. It is below the mean over runs whose demand is drawn about the one given, since
the least delay is convex in the demand; a single run may have drawn less.

With the flows that queues had in a run it is no bound, but what could be had if nobody ever waited at such a red.

Of what the programme leaves out a run tells in which all signals are green at once and nobody gives way: how much delay
is left where vehicles drive as they do, slow down to turn and hold each other up on the road, and nobody controls them.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from utn_sumo import metrics, recording, sumo_tools, traffic
from utn_sumo.clearances import HAS_WAY
from utn_sumo.contract import EXIT, Floats, Network
from utn_sumo.errors import UtnError
from utn_sumo.plant.sumo import run_arguments
from utn_sumo.scenario import Scenario

QUEUE_VEH = 10.0
"""A link with so many standing at both ends of a control step had a queue all through it."""
LEAST_GREEN_S = 10.0
"""Less green in a step says little about the flow in it."""
FREELY = 0.75
"""Of the steps in which a link had a queue so many had less flow than it is said to have: some were blocked."""


def with_flows_of(network: Network, folder: Path) -> Network:
    """The network with the flow of green that each link's queues had in a run, in the better control steps.

    `folder` is what the run has left; a link that never had a queue keeps its saturation flow. Who goes on yellow is
    counted to the green before. Raises ResultError.
    """
    log = recording.read_log(folder)
    ends_s = network.control_step_s * np.arange(1, len(log.x_veh) + 1)
    greens = metrics.Greens(network, folder / "signals.xml", float(ends_s[-1]))
    standing = log.true_queue_veh[:, 0] >= QUEUE_VEH
    queued = standing & np.vstack([np.zeros(len(network.links), dtype=bool), standing[:-1]])
    green_s, links = greens.by_turn_s(ends_s.tolist()), []
    for index, link in enumerate(network.links):
        own = network.turn_link == index
        lit_s = green_s[:, own].max(axis=1)
        counts = queued[:, index] & (lit_s >= LEAST_GREEN_S)
        flow_veh_s = log.turned_veh[counts, 0][:, own].sum(axis=1) / lit_s[counts]
        saturated = float(np.quantile(flow_veh_s, FREELY)) if counts.any() else link.saturation_flow_veh_s
        links.append(replace(link, saturation_flow_veh_s=saturated))
    return replace(network, links=tuple(links))


def least_delay_veh_h(network: Network, demand_veh_h: Floats, hours: float, *, step_s: float, lost: float) -> float:
    """Delay [veh h] that is not to be gone below in a run of so many hours.

    `demand_veh_h` (steps, Z) at the sources, the steps of equal length, which the programme's own steps of `step_s`
    divide; `lost` share of each junction's time in which nobody has green. Its turning fractions are the network's.
    """
    count, links, stages = round(hours * 3600 / step_s), len(network.links), len(network.stages)
    sources = np.flatnonzero(network.is_source)
    arriving = np.repeat(demand_veh_h[:, sources], -(-count // len(demand_veh_h)), axis=0)[:count] * step_s / 3600
    onward = np.zeros((links, links))
    inside = network.turn_next != EXIT
    np.add.at(onward, (network.turn_next[inside], network.turn_link[inside]), network.fraction[inside])
    entry = np.eye(links)[:, sources]
    steps, one = sparse.eye_array(count), sparse.eye_array(links)
    change = steps - sparse.eye_array(count, k=-1)
    # Rounded down: nobody is later at a queue than they could be.
    lag = (network.free_time_s / step_s).astype(int)
    late = [sparse.eye_array(count, k=-int(steps_late)) for steps_late in lag]
    row = [sparse.csr_array(np.eye(links)[:, [link]] @ np.eye(links)[[link]]) for link in range(links)]
    at_queue = [sum(sparse.kron(late[z], row[z] @ came) for z in range(links)) for came in (onward, entry)]
    flow = network.saturation_flow_veh_s * step_s
    served = np.array([[network.serves[s][network.turn_link == z].any() for s in range(stages)] for z in range(links)])
    junction = np.eye(len(network.junctions))[:, network.stage_junction]
    # Variables in steps: left (Z), entered (sources), green share (S), on links (Z), queued (Z), outside (sources).
    outside, nothing = sparse.eye_array(len(sources)), sparse.csr_array((count * links, count * stages))
    equal = sparse.block_array(
        [
            [
                sparse.kron(steps, one - onward),
                -sparse.kron(steps, entry),
                nothing,
                sparse.kron(change, one),
                None,
                None,
            ],
            [sparse.kron(steps, one) - at_queue[0], -at_queue[1], None, None, sparse.kron(change, one), None],
            [None, sparse.kron(steps, outside), None, None, None, sparse.kron(change, outside)],
        ]
    )
    width = [links, len(sources), stages, links, links, len(sources)]
    begin = count * np.cumsum([0, *width])
    most = sparse.block_array(
        [
            [sparse.kron(steps, one), sparse.csr_array((count * links, begin[2] - begin[1])),
             -sparse.kron(steps, flow[:, None] * served), sparse.csr_array((count * links, begin[6] - begin[3]))],
            [None, None, sparse.kron(steps, junction), None],
        ]
    )  # fmt: skip
    cost = np.zeros(begin[6])
    cost[begin[4] :] = step_s / 3600
    upper = np.full(begin[6], np.inf)
    upper[begin[3] : begin[4]] = np.tile(network.storage_veh, count)
    found = linprog(
        cost,
        A_ub=most,
        b_ub=np.concatenate([np.zeros(count * links), np.full(count * len(network.junctions), 1 - lost)]),
        A_eq=equal,
        b_eq=np.concatenate([np.zeros(2 * count * links), arriving.ravel()]),
        bounds=np.column_stack([np.zeros(begin[6]), upper]),
        method="highs",
    )
    if found.status != 0:
        raise UtnError(f"there is no bound: {found.message}")
    return float(found.fun)


def unhindered_delay_veh_h(network: Network, chosen: Scenario) -> float:
    """Delay [veh h] of a scenario's own demand in SUMO with all signals green at once and nobody giving way to anybody.

    Raises PlantError if SUMO breaks off.
    """
    signals = "".join(
        f'<tlLogic id={quoteattr(junction.id)} programID="open" type="static" offset="0">'
        f'<phase duration="3600" state="{HAS_WAY * len(network.stages[junction.stages[0]].state)}"/></tlLogic>'
        for junction in network.junctions
    )
    drivers = '<vType id="DEFAULT_VEHTYPE" jmIgnoreJunctionFoeProb="1"/>'
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        additional = folder / "open.add.xml"
        additional.write_text(f"<additional>{drivers}{signals}</additional>\n", encoding="utf-8")
        arguments = run_arguments(
            network.net_file, traffic.drawn(chosen, network), [additional], folder,
            seed=chosen.seed, duration_s=chosen.duration_s,
        )  # fmt: skip
        sumo_tools.run_program("sumo", [str(sumo_tools.sumo_binary("sumo")), *arguments])
        return float(metrics.trip_measures(folder / "trips.xml")["total_delay_veh_h"])
