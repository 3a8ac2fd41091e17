"""The distributed MPC on large networks: time, memory and loss against the central solvers."""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import nets
from central import SOLVERS, Judge, greens_of
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.place import places
from utn_controllers.mpc.problem import JunctionProblem
from utn_controllers.mpc.whole import programs
from utn_sumo.contract import Floats, Forecast, Network
from utn_sumo.plant.macroscopic import MacroscopicPlant

HORIZON = 7
JUDGED = {"one-way": 1000, "imported": 400}
"""Largest grids, by kind, whose optimum is found too. PIQP needs two minutes for 400 imported junctions, and its time
grows faster than they do: for 1,000 OSQP alone is the central solver.
"""
TIMED, WARM = 3, 2
"""Control steps, the last ones, whose plans are timed; that are solved centrally too, all but the last to warm up."""


def scale(kind: str, junctions: int, *, workers: int, steps: int) -> dict[str, Any]:
    """The distributed MPC on a large network against the central solvers, in closed loop with the model as plant.

    It runs for `steps` control steps, alone in one process and in `workers` of them.
    """
    net = grid(kind, junctions)
    started = time.perf_counter()
    alone = DistributedMPC(net)
    built_s = time.perf_counter() - started
    pool = DistributedMPC(net, agents="processes", workers=workers)
    demand = _demand(net, steps + HORIZON)
    plant = MacroscopicPlant(net, demand)
    spent: dict[str, list[float]] = {"one": [], "pool": []}
    iterations, cases = [], []
    for step in range(steps):
        state, forecast = plant.state, Forecast(demand[step : step + HORIZON])
        cases.append((state, forecast, alone.timing()))
        plans = {}
        for name, mpc in (("one", alone), ("pool", pool)):
            begun = time.perf_counter()
            plans[name] = mpc.plan(state, forecast)
            spent[name].append(time.perf_counter() - begun)
        iterations.append(plans["one"].facts["iterations"])
        plant.run(plans["one"])
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    times = {name: statistics.median(each[-TIMED:]) for name, each in spent.items()}
    own = min(times, key=lambda name: times[name])

    problems = [JunctionProblem(place, alone.settings) for place in places(net)]
    judged = junctions <= JUDGED[kind]
    central, solutions = {name: build(problems) for name, build in SOLVERS.items() if judged or name == "osqp"}, {}
    for case in cases[-WARM:]:
        stated = programs(problems, *case)
        for name, solver in central.items():
            solutions[name] = solver.solve(stated)
            times[name] = solver.watch.spent_s[-1]
    best = min(central, key=lambda name: times[name])
    plan_loss = central_loss = None
    if judged:
        judge = Judge(problems, tolerance=1e-6)
        least = judge.least(stated)
        plan_loss = judge.gap(stated, greens_of(plans[own]), least)
        central_loss = judge.gap(stated, _greens(net, problems, solutions[best]), least)
    return {
        "kind": kind,
        "junctions": len(net.junctions),
        "links": len(net.links),
        "iterations": statistics.mean(iterations[-TIMED:]),
        **{f"{name}_s": value for name, value in times.items()},
        "dmpc_over_central": times[own] / times[best],
        "cycle_share": times[own] / net.control_step_s,
        "agent_ms": 1000 * times["one"] / len(net.junctions),
        "plan_loss": plan_loss,
        "central_loss": central_loss,
        "built_s": built_s,
        "memory_mb": memory_mb,
    }


def _greens(net: Network, problems: Sequence[JunctionProblem], parts: Sequence[Floats]) -> Floats:
    greens = np.zeros((problems[0].settings.control_horizon, len(net.stages)))
    for problem, part in zip(problems, parts, strict=True):
        greens[:, problem.place.stages] = problem.greens(part)
    return greens


def _demand(net: Network, steps: int) -> Floats:
    """(steps, Z) demand that fills the network in the course of the steps: 400 to 700 veh/h for every two lanes."""
    rng = np.random.default_rng(7)
    lanes = np.array([link.lanes for link in net.links])
    rising = 400 + 300 * np.minimum(1, np.arange(steps) / 20)
    noise = rng.uniform(0.7, 1.3, (steps, len(net.links)))
    return np.asarray(rising[:, None] * noise * lanes / 2 * net.is_source * net.control_step_s / 3600)


def grid(kind: str, junctions: int) -> Network:
    """A large network: `one-way`, of the contract alone, or `imported` through netgenerate."""
    rows, columns = nets.SIZES[junctions]
    return nets.one_way_grid(rows, columns) if kind == "one-way" else nets.imported_grid(rows, columns)
