"""What a net of 1,000 signals costs: to read it, and to step its model."""

from __future__ import annotations

import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from utn_sumo import network, sumo_tools
from utn_sumo.contract import Network
from utn_sumo.model import LinkModel, ModelState, green_windows

STEPS = 20
"""Model steps of which the median is taken."""


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
