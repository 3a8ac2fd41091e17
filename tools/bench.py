"""The project's own benchmarks: figures that the README quotes and no command of `utn` prints.

    python tools/bench.py overhead     control and bridge against the bare `sumo` binary on the same signals
    python tools/bench.py solve        centralized and distributed MPC: gaps, times, scale, failures
    python tools/bench.py traffic      controllers against each other over nets, demands and seeds
    python tools/bench.py step         the model's step: what a finer one costs and brings, in prediction and in control
    python tools/bench.py estimate     vehicles estimated from loops that miscount: counting against the filter
    python tools/bench.py forecast     STARIMA: time to fit, and to update and forecast each cycle
    python tools/bench.py foresight    what forecasts are worth in closed loop, against perfect ones
    python tools/bench.py bound        delay on a net that no controller can go below
    python tools/bench.py scale        a net of 1,000 signals: time to read it, and to step its model

Each prints a table, or with --json one object (traffic, step, estimate, foresight and bound: a list of objects).
"""

from __future__ import annotations

from utn_sumo.cli import told

if __name__ == "__main__":
    with told("bench.py", "traffic goes on from its --out"):
        # Heavy: a Ctrl-C may come meanwhile, and processes that do runs need none of it.
        from benchmarks import bench

        bench(prog_name="bench.py", standalone_mode=False)
