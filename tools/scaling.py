"""The distributed MPC on large networks: time, memory and loss against the central solvers."""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import nets
from central import Judge, central_solvers, greens_of
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.problem import JunctionProblem
from utn_controllers.mpc.whole import programs
from utn_sumo.contract import Floats, Forecast, Network
from utn_sumo.plant.macroscopic import MacroscopicPlant

CHECKED = 3
"""Control steps that are judged: the last ones."""


def scale(kind: str, junctions: int, *, workers: int, steps: int) -> dict[str, Any]:
    """The distributed MPC on a large network against the central solvers, in closed loop with the model as plant.

    It runs for `steps` control steps, alone in one process and in `workers` of them.
    """
    net = grid(kind, junctions)
    started = time.perf_counter()
    alone = DistributedMPC(net)
    built_s = time.perf_counter() - started
    pool = DistributedMPC(net, agents="processes", workers=workers)
    problems = [agent.problem for agent in alone.agents]
    judge = Judge(problems, tolerance=1e-6)
    central = central_solvers(problems)
    demand = _demand(net, steps + 7)
    plant = MacroscopicPlant(net, demand)
    rows = []
    for step in range(steps):
        state, forecast = plant.state, Forecast(demand[step : step + 7])
        timings = alone.timings()
        plans, spent = {}, {}
        for name, mpc in (("one", alone), ("pool", pool)):
            begun = time.perf_counter()
            plans[name] = mpc.plan(state, forecast)
            spent[name] = time.perf_counter() - begun
        if step >= steps - CHECKED - 1:
            stated = programs(problems, state, forecast, timings)
            solutions = {name: solver.solve(stated) for name, solver in central.items()}
            if step >= steps - CHECKED:
                least = judge.least(stated)
                losses = {name: judge.gap(stated, greens_of(plan), least) for name, plan in plans.items()}
                for name, parts in solutions.items():
                    losses[name] = judge.gap(stated, _greens(net, problems, parts), least)
                facts = plans["one"].facts
                rows.append({"spent": spent, "losses": losses, "iterations": facts["iterations"]})
        plant.run(plans["one"])
    times = {name: statistics.median(row["spent"][name] for row in rows) for name in ("one", "pool")}
    times |= {name: statistics.median(solver.watch.spent_s[1:]) for name, solver in central.items()}
    losses = {name: max(row["losses"][name] for row in rows) for name in rows[0]["losses"]}
    best = min(central, key=lambda name: times[name])
    own = min(("one", "pool"), key=lambda name: times[name])
    return {
        "kind": kind,
        "junctions": len(net.junctions),
        "links": len(net.links),
        "iterations": statistics.mean(row["iterations"] for row in rows),
        **{f"{name}_s": value for name, value in times.items()},
        "best_central": best,
        "best_dmpc": own,
        "dmpc_over_central": times[own] / times[best],
        "cycle_share": times[own] / net.control_step_s,
        "agent_s": times["one"] / len(net.junctions),
        "plan_loss": max(losses["one"], losses["pool"]),
        "central_loss": losses[best],
        "built_s": built_s,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000,
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
