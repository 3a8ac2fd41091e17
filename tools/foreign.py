"""Other people's nets and scenarios: how controllers do on them, and what a net of 1,000 signals costs."""

from __future__ import annotations

import statistics
import subprocess
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from utn_sumo import bridge, network, sumo_tools
from utn_sumo.contract import Network
from utn_sumo.model import LinkModel, ModelState, green_windows
from utn_sumo.scenario import scenario

KEPT = ("mean_delay_s", "unsafe_signal_s", "fallbacks", "teleports", "arrived", "unfinished", "sumo_time_s")
STEPS = 20
"""Model steps of which the median is taken."""


def delays(
    files: Sequence[str], controllers: Sequence[str], seeds: Sequence[int], workers: int
) -> list[dict[str, Any]]:
    """Runs of scenarios in parallel processes: one object for each file and controller."""
    jobs = [(file, controller, seed) for file in files for controller in controllers for seed in seeds]
    with ProcessPoolExecutor(workers, max_tasks_per_child=1) as pool:
        runs = list(pool.map(_run, jobs))
    found = []
    for file in files:
        for controller in controllers:
            own = [run for job, run in zip(jobs, runs, strict=True) if job[:2] == (file, controller)]
            found.append(
                {
                    "net": file,
                    "controller": controller,
                    "seeds": list(seeds),
                    **{name: [run[name] for run in own] for name in KEPT},
                    "control_time_s": [run["control_time_s"] for run in own],
                    "left_alone": own[0].get("left_alone", {}),
                    "fallback_reasons": [reason for run in own for reason in run.get("fallback_reasons", [])],
                }
            )
    return found


def _run(job: tuple[str, str, int]) -> dict[str, Any]:
    file, controller, seed = job
    with tempfile.TemporaryDirectory() as temporary:
        return bridge.run(scenario(net=file, controller=controller, seed=seed), Path(temporary) / "run")


def scale(side: int) -> dict[str, Any]:
    """Time to read a netgenerate grid of `side` by `side` signals, and to step its model by 10 s and by a cycle."""
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / "grid.net.xml"
        sizes = ("--grid.number", str(side), "--grid.length", "200", "--grid.attach-length", "200")
        lanes = ("--default.lanenumber", "2", "--default-junction-type", "traffic_light", "--seed", "1")
        netgenerate = str(sumo_tools.sumo_binary("netgenerate"))
        subprocess.run(
            [netgenerate, "--grid", *sizes, *lanes, "--output-file", str(file)], check=True, capture_output=True
        )
        started = time.perf_counter()
        net = network.load(str(file))
        import_s = time.perf_counter() - started
    return {
        "signals": len(net.junctions),
        "links": len(net.links),
        "turns": len(net.turns),
        "import_s": import_s,
        "sample_s": net.sample_s,
        "sample_step_ms": 1000 * _step_s(net, net.sample_s),
        "cycle_s": net.control_step_s,
        "cycle_step_ms": 1000 * _step_s(net, net.control_step_s),
    }


def _step_s(net: Network, step_s: float) -> float:
    """Median time of a model step on roads that are a third full."""
    model, rng = LinkModel(net, step_s), np.random.default_rng(1)
    x = rng.uniform(0, 0.6, len(net.links)) * net.storage_veh
    nobody = np.zeros(len(net.links))
    past = tuple(rng.uniform(0, 1, len(net.links)) for _ in range(model.lags))
    state = ModelState(x, net.fraction * x[net.turn_link] / 2, nobody, past)
    windows = green_windows(net, net.equal_split().green_s, step_s)
    times = []
    for _ in range(STEPS):
        started = time.perf_counter()
        model.step(state, windows.shown_s[0], nobody, net.fraction, windows.end_s[0], held_s=windows.held_s[0])
        times.append(time.perf_counter() - started)
    return statistics.median(times)
