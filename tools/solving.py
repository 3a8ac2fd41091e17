"""How well and how fast the plans are found: what `tools/bench.py solve` measures.

Every ratio is taken within one run on one machine. Costs are those of the greens under the best flows that they allow,
by the whole problem with its greens fixed; gaps are over the whole problem's optimum.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import scaling
from central import SOLVERS, Judge, Stopwatch, greens_of
from utn_controllers.mpc.agent import Agent
from utn_controllers.mpc.central import CentralizedMPC
from utn_controllers.mpc.distributed import DistributedMPC
from utn_controllers.mpc.exact import ExactProblem, rolled_out_cost
from utn_controllers.mpc.settings import ProblemSettings
from utn_controllers.mpc.whole import programs
from utn_sumo import bridge, calibration, network, processes, recording
from utn_sumo.contract import Forecast, Network, State
from utn_sumo.errors import ControllerError
from utn_sumo.scenario import scenario
from utn_sumo.testing import HARD, random_forecast, random_state

COSTS = ("tts", "paper")
MODES = ("admm", "sensitivity", "none")
CAPS = (1, 5, 10, 20, 40)
WARM_CAP = 10
FOREVER = {"tolerance_abs": 1e-12, "tolerance_rel": 0.0}
"""Settings with which the cap alone ends the coordination."""
Case = tuple[State, Forecast]


def random_cases(net: Network, count: int) -> list[Case]:
    """States and forecasts, each from a seed of its own."""
    found = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        found.append((random_state(net, rng), random_forecast(net, rng, 7)))
    return found


@cache
def recorded_cases() -> list[Case]:
    """The states and forecasts of two hours of `utn17` at demand 1.3 under the default controller, in SUMO."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run"
        bridge.run(scenario(hours=2.0, demand=1.3), folder)
        lines = (folder / recording.CYCLES).read_text(encoding="utf-8").splitlines()
    found = []
    for record in map(json.loads, lines):
        values: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in record["state"].items()}
        found.append((State(**values), Forecast(np.array(record["forecast"]["demand_veh"]))))
    return found


def agreement(
    net: Network, cases: Sequence[Case], *, warm: bool, cost: str, mode: str, cap: int | None
) -> dict[str, Any]:
    """Gaps of one way to coordinate over some cases; `warm` from one to the next, else from nothing each time.

    `cap` iterations, or the default stop.
    """
    chosen = {"cost": cost, "coordination": mode, **({} if cap is None else {"iterations": cap, **FOREVER})}
    gaps, facts = [], []
    judge: Judge | None = None
    mpc = DistributedMPC(net, **chosen)
    for state, forecast in cases:
        mpc = mpc if warm else DistributedMPC(net, **chosen)
        judge = judge or Judge([agent.problem for agent in mpc.agents])
        stated = programs(judge.problems, state, forecast, mpc.timing())
        plan = mpc.plan(state, forecast)
        facts.append(plan.facts)
        gaps.append(judge.gap(stated, greens_of(plan), judge.least(stated)))
    neighbours = 2 * len({(a, b) for a, b in _neighbours(net)})
    return {
        "states": "closed loop" if warm else "random",
        "cost": cost,
        "coordination": mode,
        "cap": cap,
        "iterations_mean": statistics.mean(fact["iterations"] for fact in facts),
        "iterations_max": max(fact["iterations"] for fact in facts),
        "primal_veh": statistics.median(fact["primal_veh"] for fact in facts),
        "dual": statistics.median(fact["dual"] for fact in facts),
        "bytes_per_neighbour": statistics.mean(fact["bytes_exchanged"] for fact in facts) / neighbours,
        "gap_mean": statistics.mean(gaps),
        "gap_max": max(gaps),
    }


def _neighbours(net: Network) -> Iterable[tuple[int, int]]:
    """Pairs of junctions that a link joins."""
    for turn in net.turns:
        if turn.next_link >= 0:
            yield tuple(sorted((net.links[turn.link].junction, net.links[turn.next_link].junction)))  # type: ignore[misc]


REPEATS = 3


def critical_path(net: Network, cases: Sequence[Case], cost: str) -> dict[str, Any]:
    """The slowest agent's solver time, summed over the iterations, against the central solver's; both warm.

    Processor times, since cores are shared here and agents have their own: medians over the cases, of medians over
    repeats. Solver times hold the update of its numbers; `_whole` ones the evaluation of the problem too.
    """
    mpcs = [DistributedMPC(net, cost=cost) for _ in range(REPEATS)]
    alone = [[agent for agent in mpc.agents if isinstance(agent, Agent)] for mpc in mpcs]
    watches = [
        [(Stopwatch(a.receding.programs), Stopwatch(a.load), Stopwatch(a.solve)) for a in agents] for agents in alone
    ]
    for agents, watched in zip(alone, watches, strict=True):
        for agent, (program, load, solve) in zip(agents, watched, strict=True):
            agent.receding.programs, agent.load, agent.solve = program, load, solve  # type: ignore[method-assign]
    problems = [agent.problem for agent in alone[0]]
    central = {name: build(problems) for name, build in SOLVERS.items()}
    evaluate = Stopwatch(programs)
    rows = []
    for state, forecast in cases:
        stated = evaluate(problems, state, forecast, mpcs[0].timing())
        repeats = []
        for mpc, watched in zip(mpcs, watches, strict=True):
            for watch in (watch for each in watched for watch in each):
                watch.cpu_s = []
            mpc.plan(state, forecast)
            spent = [np.concatenate([program.cpu_s, load.cpu_s, solve.cpu_s]) for program, load, solve in watched]
            repeats.append(np.array(spent))
        # (agents, 2 + iterations): evaluation, update, and each answer.
        spent = np.median(repeats, axis=0)
        rows.append([spent[:, 1:].max(axis=0).sum(), spent[:, 1:].sum(), spent.max(axis=0).sum(), spent.sum()])
        for solver in central.values():
            solver.solve(stated)
    # The first of each is cold.
    path_s, work_s, path_whole_s, work_whole_s = np.median(rows[1:], axis=0).tolist()
    times = {name: statistics.median(solver.watch.cpu_s[1:]) for name, solver in central.items()}
    best = min(times, key=lambda name: times[name])
    whole_s = times[best] + statistics.median(evaluate.cpu_s[1:])
    return {
        "cost": cost,
        "path_ms": 1000 * path_s,
        "work_ms": 1000 * work_s,
        **{f"{name}_ms": 1000 * value for name, value in times.items()},
        "best_central": best,
        "critical_path_over_cmpc": path_s / times[best],
        "work_over_cmpc": work_s / times[best],
        "critical_path_whole_over_cmpc": path_whole_s / whole_s,
        "work_whole_over_cmpc": work_whole_s / whole_s,
    }


def robustness(net: Network, count: int, cost: str) -> dict[str, Any]:
    """Solves that end without a plan, over hard states one after the other, by controller."""
    mpcs = {mode: DistributedMPC(net, cost=cost, coordination=mode) for mode in MODES}
    everybody: dict[str, Any] = {**mpcs, "cmpc": CentralizedMPC(net, cost=cost)}
    failures = dict.fromkeys(everybody, 0)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        state, forecast = list(HARD.values())[seed % len(HARD)](net, rng, 7)
        for name, mpc in everybody.items():
            try:
                mpc.plan(state, forecast)
            except ControllerError:
                failures[name] += 1
    return {"cost": cost, "states": count, **failures}


def transcriptions(net: Network, cases: Sequence[Case], cost: str) -> dict[str, Any]:
    """Both transcriptions, solved from nothing and warm: what each predicts, and what the exact model makes of it."""
    settings = ProblemSettings.model_validate({"cost": cost})
    exact = ExactProblem(net, settings)
    rows = []
    for state, forecast in cases:
        central = CentralizedMPC(net, cost=cost)
        begun = time.perf_counter()
        plan = central.plan(state, forecast)
        convex_s = time.perf_counter() - begun
        greens = greens_of(plan)
        begun = time.perf_counter()
        found = exact.solve(state, forecast, greens)
        exact_s = time.perf_counter() - begun
        equal = np.tile(net.equal_split().green_s, (len(greens), 1))
        real = [rolled_out_cost(net, settings, state, forecast, each) for each in (greens, found.greens_s, equal)]
        rows.append((plan.facts["cost"], found.cost, *real, convex_s, exact_s))
    convex, nlp, convex_real, nlp_real, equal_real, convex_times_s, exact_times_s = np.array(rows).T
    return {
        "cost": cost,
        "convex_predicted": float(convex.mean()),
        "convex_rolled_out": float(convex_real.mean()),
        "nlp_predicted": float(nlp.mean()),
        "nlp_rolled_out": float(nlp_real.mean()),
        "equal_split_rolled_out": float(equal_real.mean()),
        "convex_over_nlp": float(np.mean(convex_real / nlp_real)),
        "convex_s": float(np.median(convex_times_s)),
        "nlp_s": float(np.median(exact_times_s)),
    }


def closed_loop(
    ways: Sequence[dict[str, Any]], demand: float, seeds: Sequence[int], hours: float
) -> list[dict[str, Any]]:
    """Time spent in SUMO on `utn17` under the default controller with each of these settings; two runs at a time."""
    jobs = [{"hours": hours, "demand": demand, "seed": seed, "settings": way} for way in ways for seed in seeds]
    with processes.pool(2, afresh=True) as workers:
        spent = [result["total_time_spent_veh_h"] for result in workers.map(_run, jobs)]
    by_way = np.array(spent).reshape(len(ways), len(seeds))
    return [
        {
            "coordination": way.get("coordination", "admm"),
            "cap": way.get("iterations"),
            "demand": demand,
            "total_time_spent_veh_h": float(own.mean()),
            "by_seed_veh_h": own.round(1).tolist(),
        }
        for way, own in zip(ways, by_way, strict=True)
    ]


def overhead(hours: float) -> float:
    """Time of all control decisions over SUMO's own in the same run of `utn17`."""
    result = _run({"hours": hours})
    return float(result["control_time_s"] / result["sumo_time_s"])


def _run(given: dict[str, Any]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as temporary:
        return bridge.run(scenario(**given), Path(temporary) / "run")


START_UP = """
import sys, time; started = time.perf_counter()
sys.path.insert(0, {tools!r})
import numpy as np
from utn_controllers.mpc.distributed import DistributedMPC
from utn_sumo import network
from utn_sumo.testing import random_forecast, random_state
import nets
net = network.load("utn17") if {junctions} == 8 else nets.one_way_grid(*nets.SIZES[{junctions}])
rng = np.random.default_rng(1)
mpc = DistributedMPC(net)
mpc.plan(random_state(net, rng), random_forecast(net, rng, 7))
print(time.perf_counter() - started)
"""


def start_up_s(junctions: int) -> float:
    """From the first import to the first plan, in a process of its own."""
    script = START_UP.format(tools=str(Path(__file__).parent), junctions=junctions)
    found = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    return float(found.stdout)


def known(net: str) -> Network:
    """The network as the controllers of a run know it."""
    return calibration.for_model(network.load(net), None)


@dataclass(frozen=True)
class Wanted:
    """How much to measure."""

    states: int
    hard: int
    sizes: Sequence[int]
    grids: Sequence[str]
    steps: int
    hours: float


def gap_part(wanted: Wanted) -> dict[str, Any]:
    """Gaps from nothing over random states, by cost, coordination and iterations."""
    net, cases = known("utn17"), random_cases(known("utn17"), wanted.states)
    ways = [("admm", (*CAPS, None)), ("sensitivity", (*CAPS, None)), ("none", (None,))]
    rows = [
        agreement(net, cases, warm=False, cost=cost, mode=mode, cap=cap)
        for cost in COSTS
        for mode, caps in ways
        for cap in caps
    ]
    at_stop = [row["gap_max"] for row in rows if row["coordination"] == "admm" and row["cap"] is None]
    return {"gap": rows, "gap_admm_max": max(at_stop)}


def warm_part(_: Wanted) -> dict[str, Any]:
    """Gaps in closed loop, warm from one step to the next."""
    rows = [
        agreement(known("utn17"), recorded_cases(), warm=True, cost=cost, mode="admm", cap=cap)
        for cost in COSTS
        for cap in (*CAPS, None)
    ]
    return {"warm": rows, f"gap_warm_{WARM_CAP}_max": max(r["gap_max"] for r in rows if r["cap"] == WARM_CAP)}


def loop_part(_: Wanted) -> dict[str, Any]:
    """Time spent in SUMO against the iterations, and by the other ways to coordinate."""
    ways = [{"iterations": cap} for cap in (1, 2, 5, 10, 20, 60)]
    others = [{"coordination": mode} for mode in ("sensitivity", "none")]
    return {"loop": closed_loop([*ways, *others], 1.3, (1, 2, 3), 2.0)}


def path_part(_: Wanted) -> dict[str, Any]:
    """Critical path and total work against the central solve."""
    rows = [critical_path(known("utn17"), recorded_cases(), cost) for cost in COSTS]
    return {"path": rows, **{k: max(row[k] for row in rows) for k in ("critical_path_over_cmpc", "work_over_cmpc")}}


def transcriptions_part(wanted: Wanted) -> dict[str, Any]:
    """The convex and the exact transcription side by side."""
    net = known("utn17")
    cases = random_cases(net, min(20, wanted.states))
    return {"transcriptions": [transcriptions(net, cases, cost) for cost in COSTS]}


def scale_part(wanted: Wanted) -> dict[str, Any]:
    """Large networks, each in a process of its own, so that memory is counted by network."""
    rows = []
    for kind in wanted.grids:
        for junctions in sorted(wanted.sizes):
            with processes.pool(1) as pool:
                rows.append(pool.submit(scaling.scale, kind, junctions, workers=2, steps=wanted.steps).result())
    first = {row["junctions"]: row for row in rows if row["kind"] == wanted.grids[0]}
    small, large = min(first), max(first)
    return {
        "scale": rows,
        f"dmpc_over_central_{large}": first[large]["dmpc_over_central"],
        f"cycle_share_{large}": first[large]["cycle_share"],
        f"agent_cost_growth_{small}_{large}": first[large]["agent_ms"] / first[small]["agent_ms"],
        f"plan_loss_{large}": first[large]["plan_loss"],
        f"memory_mb_{large}": first[large]["memory_mb"],
    }


def failures_part(wanted: Wanted) -> dict[str, Any]:
    """Solves without a plan."""
    rows = [robustness(known("utn17"), wanted.hard, cost) for cost in COSTS]
    return {"robustness": rows, "failures": sum(row[name] for row in rows for name in (*MODES, "cmpc"))}


def start_part(wanted: Wanted) -> dict[str, Any]:
    """From import to first plan."""
    return {f"start_up_s_{junctions}": start_up_s(junctions) for junctions in (8, max(wanted.sizes))}


def overhead_part(wanted: Wanted) -> dict[str, Any]:
    """All control decisions of a run over SUMO's own time in it."""
    return {"control_over_sumo": overhead(wanted.hours)}


def draw(found: dict[str, Any], path: Path) -> None:
    """Gap by coordination, and time spent in closed loop, against the iterations, from what the parts found."""
    import matplotlib as mpl  # noqa: PLC0415 - heavy

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415 - heavy

    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for axis, cost in zip(axes, COSTS, strict=False):
        for mode, rows in (
            ("admm, warm", found.get("warm", [])),
            ("admm", found.get("gap", [])),
            ("sensitivity", found.get("gap", [])),
        ):
            mine = [r for r in rows if r["cost"] == cost and r["coordination"] == mode.split(",")[0] and r["cap"]]
            if mine:
                line = axis.plot([r["cap"] for r in mine], [100 * r["gap_mean"] for r in mine], "o-", label=mode)
                worst = [100 * r["gap_max"] for r in mine]
                axis.plot([r["cap"] for r in mine], worst, ":", color=line[0].get_color(), label="_worst")
        for row in found.get("gap", []):
            if row["cost"] == cost and row["coordination"] == "none":
                axis.axhline(100 * row["gap_mean"], color="0.5", linestyle="--", label="none")
        axis.set(xscale="log", yscale="log", xlabel="iterations", ylabel="gap to the optimum, %", title=f"cost {cost}")
        axis.set_ylim(bottom=1e-4)
        if axis.lines:
            axis.legend(title="mean; dotted: worst")
    rows = [row for row in found.get("loop", []) if row["cap"]]
    spent = [row["total_time_spent_veh_h"] for row in rows]
    axes[2].plot([row["cap"] for row in rows], spent, "o-", label="admm, warm")
    for row, colour in zip(found.get("loop", [])[len(rows) :], ("C2", "0.5"), strict=False):
        axes[2].axhline(row["total_time_spent_veh_h"], color=colour, linestyle="--", label=row["coordination"])
    axes[2].set(xscale="log", ylim=(0, None), xlabel="most iterations in a step", ylabel="time spent in SUMO, veh h")
    axes[2].set_title("closed loop, demand 1.3, seeds 1-3")
    if axes[2].lines:
        axes[2].legend()
    for axis in axes:
        axis.set_xticks((1, 2, 5, 10, 20, 40), ("1", "2", "5", "10", "20", "40"))
    figure.savefig(path, dpi=110)
    plt.close(figure)


PARTS = {
    "gap": gap_part,
    "warm": warm_part,
    "loop": loop_part,
    "path": path_part,
    "transcriptions": transcriptions_part,
    "scale": scale_part,
    "failures": failures_part,
    "start": start_part,
    "overhead": overhead_part,
}
"""What can be measured: each part returns tables, lists of objects, and figures."""
