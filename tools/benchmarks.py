"""The commands of `python tools/bench.py`."""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.table import Table

import bounding
import comparing
import forecasting
import foreign
import nets
import scaling
import showing
import solving
from utn_sumo import (
    bridge,
    calibration,
    campaign,
    mismatch,
    network,
    processes,
    recording,
    replay,
    report,
    streets,
    study,
    sumo_tools,
)
from utn_sumo.case import SUFFIX
from utn_sumo.cli import numbers
from utn_sumo.contract import Measurement, Network
from utn_sumo.demand import mean_profile_veh_h
from utn_sumo.detectors import Miscount
from utn_sumo.errors import ResultError, SettingError, did_you_mean
from utn_sumo.estimation import Estimator
from utn_sumo.recording import Log
from utn_sumo.scenario import Scenario, scenario

COUNT = click.IntRange(1)
AHEAD = 7
"""Control steps ahead for which the model's errors are measured."""


@click.group()
def bench() -> None:
    """Benchmarks of utn-sumo."""


@bench.command()
@click.option("--controller", default="dmpc", show_default=True)
@click.option("--net", default="utn17", show_default=True)
@click.option("--hours", default=4.0, show_default=True)
@click.option("--demand", default=1.0, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--repeats", type=COUNT, default=3, show_default=True)
@click.option("--json", "as_json", is_flag=True)
def overhead(controller: str, net: str, hours: float, demand: float, seed: int, repeats: int, as_json: bool) -> None:
    """What control and bridge cost, as a share of the bare `sumo` binary's wall time on the same signals.

    `access_over_sumo`, of `control_over_sumo`, is what SUMO's own functions take that read detectors and show signals.
    """
    chosen = scenario(controller=controller, net=net, hours=hours, demand=demand, seed=seed)
    rows = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "run"
            started = time.perf_counter()
            result = bridge.run(chosen, folder)
            run_s = time.perf_counter() - started
            configuration = replay.write(folder)
            started = time.perf_counter()
            sumo = sumo_tools.sumo_binary("sumo")
            subprocess.run([sumo, "-c", configuration.name], cwd=configuration.parent, check=True)
            bare_s = time.perf_counter() - started
        rows.append(
            {
                "bare_sumo_s": bare_s,
                "sumo_time_s": result["sumo_time_s"],
                "control_time_s": result["control_time_s"],
                "bridge_time_s": result["bridge_time_s"],
                "control_over_sumo": result["control_time_s"] / result["sumo_time_s"],
                "access_over_sumo": result["access_time_s"] / result["sumo_time_s"],
                "run_over_bare": run_s / bare_s,
                "overhead": (result["control_time_s"] + result["bridge_time_s"]) / bare_s,
            }
        )
    summary = {key: statistics.median(row[key] for row in rows) for key in rows[0]}
    if as_json:
        click.echo(json.dumps({**summary, "repeats": rows}))
        return
    _show(
        f"{controller}, {net}, {hours:g} h, demand {demand:g}, seed {seed}: median of {repeats}",
        ["figure", "median", "min", "max"],
        [
            [key, *(f"{value:.3f}" for value in (summary[key], min(r[key] for r in rows), max(r[key] for r in rows)))]
            for key in summary
        ],
    )


@bench.command()
@click.option("--only", default=",".join(solving.PARTS), show_default=True, help="Parts, separated by commas.")
@click.option("--states", type=click.IntRange(2), default=50, show_default=True, help="Random states for the gaps.")
@click.option("--hard", type=COUNT, default=1000, show_default=True, help="Hard states for the failures.")
@click.option("--sizes", default="100,400,1000", show_default=True, help="Junctions of the large networks.")
@click.option("--grids", default="one-way", show_default=True, help="Kinds: one-way, imported (half an hour).")
@click.option("--steps", type=COUNT, default=14, show_default=True, help="Control steps on them.")
@click.option("--hours", default=4.0, show_default=True, help="Of the run for the overhead.")
@click.option(
    "--plot", type=click.Path(path_type=Path), help="New folder for solve.png: gaps and time spent against iterations."
)
@click.option("--json", "as_json", is_flag=True)
def solve(only: str, sizes: str, grids: str, plot: Path | None, as_json: bool, **given: Any) -> None:
    """Centralized and distributed MPC: how near to the optimum, how fast, how large, how often without a plan."""
    large = [int(size) for size in _among("sizes", sizes, map(str, nets.SIZES))]
    folder = None if plot is None else recording.new_folder(plot, "", "--plot")
    wanted = solving.Wanted(sizes=large, grids=_among("grids", grids, scaling.JUDGED), **given)
    found: dict[str, Any] = {}
    for part in _among("only", only, solving.PARTS):
        found |= solving.PARTS[part](wanted)
    if as_json:
        click.echo(json.dumps(found))
    else:
        for name, rows in found.items():
            if isinstance(rows, list):
                _show(name, list(rows[0]), [[_text(value) for value in row.values()] for row in rows])
        _show("figures", ["figure", "value"], [[k, _text(v)] for k, v in found.items() if not isinstance(v, list)])
    if folder is not None:
        solving.draw(found, folder / "solve.png")


def _text(value: Any) -> str:
    """A number in four digits, anything else as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@bench.command()
@click.option("--nets", default=("utn17",), multiple=True, help="Shipped nets, nets, .sumocfg files.  [utn17]")
@click.option("--hours", type=float, help="Simulated hours of each run.  [2; of a .sumocfg its window]")
@click.option("--controllers", default="dmpc,fixed", show_default=True, help="CONTROLLER/EXECUTION too, and best.toml.")
@click.option("--demands", help="Demands.  [1.3; of a .sumocfg 1.0]")
@click.option("--seeds", default="1-5", show_default=True, help="Numbers and ranges.")
@click.option("--workers", type=click.IntRange(1), help="Runs at the same time.  [one a processor]")
@click.option("--plot", type=click.Path(path_type=Path), help="New folder for a picture a net: delay against demand.")
@click.option("--out", type=click.Path(path_type=Path), help="File of all results, from which a stopped one goes on.")
@click.option("--json", "as_json", is_flag=True)
def traffic(nets: tuple[str, ...], controllers: str, plot: Path | None, as_json: bool, **given: Any) -> None:
    """Controllers over nets, demands and seeds: delay, time spent, alarms; the first one against the best other one.

    What takes several has them separated by commas.
    """
    jobs = comparing.jobs(
        _words(",".join(nets)),
        None if given["demands"] is None else _words(given["demands"]),
        _words(controllers),
        campaign.seeds(given["seeds"]),
        given["hours"],
    )
    folder = None if plot is None else recording.new_folder(plot, "", "--plot")
    with report.counter("runs", len(jobs)) as tick:
        results = comparing.results(jobs, given["workers"], given["out"], tick)
    rows = comparing.figures(jobs, results)
    pictures = [] if folder is None else showing.draw(rows, folder)
    if as_json:
        click.echo(json.dumps(rows))
        return
    for table in showing.tables(rows):
        _show(*table)
    for line in [*showing.remarks(rows), *map(str, pictures)]:
        click.echo(line)


@bench.command()
@click.option("--net", default="utn17", show_default=True)
@click.option("--hours", default=2.0, show_default=True)
@click.option("--demand", default=1.3, show_default=True)
@click.option("--seeds", default="1,2,3", show_default=True)
@click.option("--steps", default="120,60,30", show_default=True, help="Model steps in seconds; 10 takes minutes a run.")
@click.option("--json", "as_json", is_flag=True)
def step(net: str, hours: float, demand: float, seeds: str, steps: str, as_json: bool) -> None:
    """Control by `dmpc` with each model step: time spent, time a plan, and the same step's error in open loop."""
    _check_drawn(net)
    whole = network.load(net)
    known = calibration.for_model(whole, None)
    rows, seed_list = [], campaign.seeds(seeds)
    for step_s in numbers("steps", steps):
        runs = [
            scenario(net=net, hours=hours, demand=demand, seed=seed, settings={"step_s": step_s}) for seed in seed_list
        ]
        for each in runs:
            study.check(each, AHEAD + 2)
        with tempfile.TemporaryDirectory() as temporary:
            results = [bridge.run(each, Path(temporary) / str(each.seed)) for each in runs]
            log = Log.stack([recording.read_log(Path(temporary) / str(seed)) for seed in seed_list])
        found = mismatch.errors(known, log, step_s, AHEAD)
        ratio = mismatch.summary(known, found, None)["rmse_over_persistence"]
        spent = [result["total_time_spent_veh_h"] for result in results]
        plans = hours * 3600 / whole.control_step_s
        rows.append(
            {
                "step_s": step_s,
                "total_time_spent_veh_h": spent,
                "plan_s": statistics.median(result["control_time_s"] / plans for result in results),
                "fallbacks": sum(result["fallbacks"] for result in results),
                "rmse_over_persistence": ratio.tolist(),
            }
        )
    if as_json:
        click.echo(json.dumps(rows))
        return
    _show(
        f"{net}, dmpc, demand {demand:g}, {hours:g} h, seeds {seeds}: the model's step",
        ["step s", "time spent veh h", "median", "ms a plan", "fallbacks", "RMSE/persistence 1 ahead", "7 ahead"],
        [
            [
                f"{row['step_s']:g}",
                " ".join(f"{value:.0f}" for value in row["total_time_spent_veh_h"]),
                f"{statistics.median(row['total_time_spent_veh_h']):.0f}",
                f"{1000 * row['plan_s']:.1f}",
                str(row["fallbacks"]),
                f"{row['rmse_over_persistence'][0]:.3f}",
                f"{row['rmse_over_persistence'][-1]:.3f}",
            ]
            for row in rows
        ],
    )


@bench.command()
@click.option("--net", default="utn17", show_default=True)
@click.option("--hours", default=2.0, show_default=True)
@click.option("--demands", default="0.6,1.0,1.3", show_default=True)
@click.option("--errors", default="0,0.01,0.03", show_default=True, help="Loop errors, as in utn run --loop-error.")
@click.option("--seed", default=1, show_default=True)
@click.option("--json", "as_json", is_flag=True)
def estimate(net: str, hours: float, demands: str, errors: str, seed: int, as_json: bool) -> None:
    """RMSE of x over links and cycles, from the same miscounting loops: by counting, and by the filter."""
    _check_drawn(net)
    whole = network.load(net)
    known = calibration.for_model(whole, None)
    rows, error_list = [], numbers("errors", errors)
    runs = [scenario(net=net, hours=hours, demand=each, seed=seed) for each in numbers("demands", demands)]
    for error in error_list:
        scenario(loop_error=error)
    for chosen in runs:
        with tempfile.TemporaryDirectory() as temporary:
            bridge.run(chosen, Path(temporary) / "run")
            lines = (Path(temporary) / "run" / recording.CYCLES).read_text(encoding="utf-8").splitlines()
        records = [json.loads(line) for line in lines]
        for error in error_list:
            estimators = {"counting": Estimator(whole, known), "filter": Estimator(whole, known, error)}
            miscount = Miscount(whole, error, seed)
            squares: dict[str, list[float]] = {name: [] for name in estimators}
            for record in records:
                values: dict[str, Any] = {key: np.array(value) for key, value in record["seen"].items()}
                seen = miscount.distort(Measurement(**values))
                expected = np.array(record["forecast"]["demand_veh"][0])
                for name, estimator in estimators.items():
                    off = estimator.update(seen, expected).x_veh - np.array(record["truth"]["x_veh"])
                    squares[name].append(float(np.mean(off**2)))
            rmse = {name: math.sqrt(statistics.mean(each)) for name, each in squares.items()}
            rows.append({"demand": chosen.demand, "loop_error": error, **{f"{k}_rmse_veh": v for k, v in rmse.items()}})
    if as_json:
        click.echo(json.dumps(rows))
        return
    _show(
        f"{net}, {hours:g} h, seed {seed}: RMSE of the estimated vehicles on a link",
        ["demand", "loop error", "counting veh", "filter veh"],
        [
            [f"{r['demand']:g}", f"{r['loop_error']:g}", f"{r['counting_rmse_veh']:.2f}", f"{r['filter_rmse_veh']:.2f}"]
            for r in rows
        ],
    )


@bench.command()
@click.option("--net", default="utn17", show_default=True)
@click.option("--rows", default=480, show_default=True, help="Steps of the series that are fitted.")
@click.option("--repeats", type=COUNT, default=5, show_default=True)
@click.option("--json", "as_json", is_flag=True)
def forecast(net: str, rows: int, repeats: int, as_json: bool) -> None:
    """STARIMA (2,0,1), spatial order 1, a series per link: time to fit; to update and forecast 7 steps."""
    found = forecasting.measure(net, rows, repeats)
    if as_json:
        click.echo(json.dumps(found))
        return
    _show(
        f"{net}, STARIMA of {found['series']} series: median of {repeats}",
        ["figure", "value"],
        [[key, _text(value)] for key, value in found.items()],
    )


@bench.command()
@click.option("--net", default="utn17", show_default=True)
@click.option("--hours", default=2.0, show_default=True)
@click.option("--forecasts", default="starima,profile,last", show_default=True, help="Methods beside perfect.")
@click.option("--demands", default="1.0,1.3", show_default=True)
@click.option("--noises", default="0,0.3", show_default=True)
@click.option("--seeds", default="1,2,3,4,5", show_default=True)
@click.option("--json", "as_json", is_flag=True)
def foresight(forecasts: str, demands: str, noises: str, seeds: str, *, as_json: bool, **given: Any) -> None:
    """What forecasts are worth in closed loop: total delay over that with perfect ones, in parallel processes."""
    methods = _words(f"perfect,{forecasts}")
    cases = [(demand, noise) for demand in numbers("demands", demands) for noise in numbers("noises", noises)]
    jobs = [
        {**given, "forecast": method, "demand": demand, "noise": noise, "seed": seed}
        for demand, noise in cases
        for method in methods
        for seed in campaign.seeds(seeds)
    ]
    for job in jobs:
        scenario(**job)
    with processes.pool(afresh=True) as pool:
        results = list(pool.map(campaign.measures, jobs))
    delays: dict[tuple[float, float, str], list[float]] = {}
    for job, result in zip(jobs, results, strict=True):
        delays.setdefault((job["demand"], job["noise"], job["forecast"]), []).append(result["total_delay_veh_h"])
    found: list[dict[str, Any]] = [
        {
            "demand": demand,
            "noise": noise,
            "forecast": method,
            "total_delay_veh_h": delays[demand, noise, method],
            "over_perfect": comparing.ratio(delays[demand, noise, method], delays[demand, noise, "perfect"])[0],
        }
        for demand, noise in cases
        for method in methods
    ]
    if as_json:
        click.echo(json.dumps(found))
        return
    _show(
        "{net}, {hours:g} h: total delay (veh h) by seed, and its sum over perfect forecasts'".format(**given),
        ["demand", "noise", "forecast", "by seed", "over perfect"],
        [
            [
                f"{each['demand']:g}",
                f"{each['noise']:g}",
                each["forecast"],
                " ".join(f"{delay:.0f}" for delay in each["total_delay_veh_h"]),
                "not known" if each["over_perfect"] is None else f"{each['over_perfect']:.3f}",
            ]
            for each in found
        ],
    )


@bench.command()
@click.option("--side", type=COUNT, default=32, show_default=True, help="Signals along each side of the grid.")
@click.option("--json", "as_json", is_flag=True)
def scale(side: int, as_json: bool) -> None:
    """Time to read a netgenerate grid of side x side signals, and to step its model."""
    found = foreign.scale(side)
    if as_json:
        click.echo(json.dumps(found))
        return
    rows = [[name, f"{value:.3g}" if isinstance(value, float) else str(value)] for name, value in found.items()]
    _show(f"netgenerate grid of {side} x {side} signals", ["", ""], rows)


@bench.command()
@click.option("--net", default="utn17", show_default=True)
@click.option("--hours", default=2.0, show_default=True)
@click.option("--demands", default="1.0,1.2,1.3,1.5", show_default=True)
@click.option("--lost", default="0.05,0.08,0.11", show_default=True, help="Shares of the time with no green.")
@click.option("--measured", metavar="CONTROLLER", help="With the flows that its queues have, seed 1: no bound.")
@click.option("--unhindered", metavar="SEEDS", help="Delay in SUMO with all green and nobody giving way instead.")
@click.option("--json", "as_json", is_flag=True)
def bound(
    net: str, hours: float, demands: str, lost: str, measured: str | None, unhindered: str | None, as_json: bool
) -> None:
    """Delay that no controller can go below: the linear programme of tools/bounding.py."""
    _check_drawn(net)
    found, rows = streets.named(net), []
    # Of a run in SUMO or not: demand and hours are what a run's may be.
    runs = [scenario(net=net, hours=hours, demand=each) for each in numbers("demands", demands)]
    if unhindered is not None:
        _unhindered(found, runs, unhindered, as_json)
        return
    steps, shares = round(hours * 30), numbers("lost", lost)
    if not steps:
        raise SettingError(f"setting 'hours' is {hours:g}: a bound goes by steps of 120 s, make it longer")
    if not all(0 <= share <= 1 for share in shares):
        raise SettingError(f"setting 'lost' is {lost!r}: it must be shares of the time, from 0 to 1")
    for chosen in runs:
        flowing = found
        if measured is not None:
            with tempfile.TemporaryDirectory() as temporary:
                bridge.run(chosen.model_copy(update={"controller": measured}), Path(temporary) / "run")
                try:
                    flowing = bounding.with_flows_of(found, Path(temporary) / "run")
                except ResultError as error:
                    raise SettingError(
                        f"--measured is {measured!r}, whose runs keep no counts by cycle: name another, as recommended"
                    ) from error
        demand_veh_h = mean_profile_veh_h(found, "peak", steps, chosen.demand)
        for share in shares:
            least_veh_h = bounding.least_delay_veh_h(flowing, demand_veh_h, hours, step_s=20.0, lost=share)
            rows.append({"demand": chosen.demand, "lost": share, "least_delay_veh_h": least_veh_h})
    if as_json:
        click.echo(json.dumps(rows))
        return
    cells = [[f"{row['demand']:g}", f"{row['lost']:.0%}", f"{row['least_delay_veh_h']:.0f}"] for row in rows]
    title = f"no less delay on {net}, {hours:g} h" + (f", with the flows of {measured}" if measured else "")
    _show(title, ["demand", "time lost", "veh h"], cells)


def _check_drawn(net: str) -> None:
    """Raises SettingError for a net whose demand is somebody else's, where it has to be ours."""
    if net.endswith(SUFFIX):
        raise SettingError(f"setting 'net' is {net!r}: this goes by our own demand, name a shipped net or a .net.xml")


def _unhindered(found: Network, runs: list[Scenario], unhindered: str, as_json: bool) -> None:
    """Shows the delay that is left with all signals green and nobody giving way."""
    rows: list[dict[str, Any]] = []
    seeds = campaign.seeds(unhindered)
    for chosen in runs:
        seeded = [chosen.model_copy(update={"seed": seed}) for seed in seeds]
        delays_veh_h = [bounding.unhindered_delay_veh_h(found, each) for each in seeded]
        rows.append({"demand": chosen.demand, "unhindered_delay_veh_h": delays_veh_h})
    if as_json:
        click.echo(json.dumps(rows))
        return
    cells = [[f"{row['demand']:g}", f"{statistics.mean(row['unhindered_delay_veh_h']):.1f}"] for row in rows]
    _show(
        f"delay on {runs[0].net}, {runs[0].hours:g} h, seeds {unhindered}",
        ["demand", "all signals green, nobody gives way: veh h"],
        cells,
    )


def _words(text: str) -> list[str]:
    """What is separated by commas, each once."""
    return list(dict.fromkeys(word.strip() for word in text.split(",")))


def _among(name: str, text: str, known: Iterable[str]) -> list[str]:
    """The words separated by commas, all of which are known. Raises SettingError."""
    words, known = _words(text), list(known)
    for word in words:
        if word not in known:
            raise SettingError(f"setting {name!r} has {word!r}: {did_you_mean(word, known)}")
    return words


def _show(title: str, heads: list[str], rows: list[list[str]]) -> None:
    table = Table(title=title, title_justify="left")
    for position, head in enumerate(heads):
        table.add_column(head, justify="left" if position == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(markup=False, width=None if sys.stdout.isatty() else 140).print(table)
