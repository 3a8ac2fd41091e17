"""What a run shows to people: the progress bar on standard error, the closing table on standard output."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from utn_sumo import recording
from utn_sumo.bridge import LONGEST_RUN_S
from utn_sumo.bridge import Progress as RunProgress
from utn_sumo.manual import Entry
from utn_sumo.scenario import Scenario

FLOOR_LIMIT = 1.5
"""Links whose error is beyond this many times the floor are named."""
ROWS = [
    ("total_time_spent_veh_h", "total time spent", "veh h", "{:.1f}"),
    ("total_delay_veh_h", "total delay", "veh h", "{:.1f}"),
    ("mean_travel_time_s", "mean travel time", "s", "{:.1f}"),
    ("mean_delay_s", "mean delay", "s", "{:.1f}"),
    ("arrived", "arrived", "veh", "{:d}"),
    ("unfinished", "unfinished", "veh", "{:d}"),
    ("max_queue_veh", "longest queue", "veh", "{:.0f}"),
    ("max_vehicles_veh", "most vehicles on a link", "veh", "{:.0f}"),
    ("over_storage_veh", "over storage", "veh", "{:.1f}"),
    ("stops", "stops", "", "{:d}"),
    ("teleports", "teleports", "", "{:d}"),
    ("gridlock", "gridlock", "", "{}"),
    ("longest_red_s", "longest wait before a red", "s", "{:.0f}"),
    ("unsafe_signal_s", "unsafe signals", "s", "{:d}"),
    ("fallbacks", "fallbacks", "cycles", "{:d}"),
    ("sumo_time_s", "time in SUMO", "s", "{:.2f}"),
    ("control_time_s", "time in the controller", "s", "{:.2f}"),
    ("bridge_time_s", "time in the bridge", "s", "{:.2f}"),
]

PAPER_ROWS = [
    ("max_queue_veh", "longest queue (veh)", "{:.0f}"),
    ("max_vehicles_veh", "most vehicles on a link (veh)", "{:.0f}"),
    ("max_vehicles_and_waiting_veh", "with those waiting to enter (veh)", "{:.0f}"),
    ("total_time_spent_veh_h", "total time spent (veh h)", "{:.1f}"),
    ("control_time_s", "time in the controller (s)", "{:.1f}"),
]
PAPER_VIOLATIONS = [
    ("over_capacity_link_cycles", "over capacity (link cycles)"),
    ("over_capacity_links", "over capacity (links)"),
    ("unfit_cycles", "greens that can't be shown (cycles)"),
]


NEVER_GREEN = "has no green in its programme: nobody goes there"


@contextmanager
def progress(scenario: Scenario) -> Iterator[Callable[[RunProgress], None]]:
    """A progress bar with time to go, time spent so far and the present queue; it shows up with the first cycle,
    so that an error before it stays the only line.
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[state]}"),
    )
    bar = Progress(*columns, console=Console(markup=False, stderr=True))
    task = bar.add_task(f"{scenario.controller} on {scenario.net}", total=None, state="")

    def show(now: RunProgress) -> None:
        bar.start()
        total = now.duration_s if 0 < now.duration_s < LONGEST_RUN_S else None
        state = f"TTS {now.time_spent_veh_h:.0f} veh h, queue {now.queue_veh:.0f} veh"
        bar.update(task, completed=now.time_s, total=total, state=state)

    try:
        yield show
    finally:
        if bar.live.is_started:
            bar.stop()


def table(result: dict[str, Any]) -> None:
    """The closing table, what went wrong if anything did, and where the results are."""
    console = Console(markup=False)
    title = "{controller} on {net}, demand {demand:g}, seed {seed}, {hours:.2f} h".format(**result)
    view = Table(title=title, title_justify="left")
    view.add_column("measure")
    view.add_column("value", justify="right")
    view.add_column("unit")
    for key, label, unit, pattern in ROWS:
        view.add_row(label, "not known" if result[key] is None else pattern.format(result[key]), unit)
    console.print(view)
    brought = recording.read_json(Path(result["out"]), recording.SETTINGS).get("case")
    if brought is not None:
        console.print(_window(brought), highlight=False)
    for reason in [*result.get("unsafe_reasons", []), *result.get("fallback_reasons", [])]:
        console.print(f"  ! {reason}")
    for junction, letters in result.get("never_green", {}).items():
        console.print(f"  ! {junction}: signal {', '.join(map(str, letters))} {NEVER_GREEN}")
    if not result["arrived"] + result["unfinished"]:
        console.print("  ! nobody departed: no vehicle of the routes departs in this window, give another one")
    if result["left_out_veh"]:
        number = result["left_out_veh"]
        console.print(f"  ! SUMO left out {number} vehicles: sort their routes by departure")
    if result["interrupted"]:
        console.print("stopped before its end: the measures cover the time that was run")
    console.print(f"results: {result['out']}")


def manual_tables(entries: Sequence[Entry], *, whole: bool) -> None:
    """Controllers and executions with their settings: by name alone, or as a `whole` with what these mean."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 120)
    noun = ""
    for each in entries:
        if each.noun != noun:
            noun = each.noun
            console.print(f"{noun}s", highlight=False)
        console.print(f"  {each.name}: {each.does}", highlight=False)
        if whole and each.settings:
            view = Table("setting", "default", "may be", "what it is")
            for setting in each.settings:
                view.add_row(*dataclasses.astuple(setting))
            console.print(view)
        else:
            told = ", ".join(f"{setting.name}={setting.default}" for setting in each.settings) or "none"
            console.print(f"      settings: {told}", highlight=False, soft_wrap=True)
    if not whole:
        console.print("utn controllers NAME tells what its settings mean", highlight=False)


def _window(brought: dict[str, Any]) -> str:
    """What a .sumocfg says of times, in a line."""
    end_s, teleport_s = brought["end_s"], brought["teleport_s"]
    return (
        f"from {brought['begin_s']:.12g} s {'until the roads are empty' if end_s is None else f'to {end_s:.12g} s'}, "
        f"step {brought['step_s']:g} s, teleport {f'after {teleport_s:g} s' if teleport_s > 0 else 'never'}"
    )


def import_table(result: dict[str, Any]) -> None:
    """What has been imported, and how to run it."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 120)
    without_veh, nowhere_veh = result["without_route_veh"], result["without_ends_veh"]
    without = {
        "taken to go the fastest way on empty roads": without_veh - nowhere_veh,
        "left out of the turning fractions, as their ends are no edges": nowhere_veh,
    }
    rows = {
        "window": _window(result),
        "at its begin": "the roads are empty: they have to fill first" if result["empty_at_begin"] else "a saved state",
        "signals controlled": f"{len(result['controlled'])}: {', '.join(result['controlled'])}",
        **{f"left alone: {signal}": reason for signal, reason in result["left_alone"].items()},
        "links, stages": f"{result['links']}, {result['stages']}; a plan every {result['control_step_s']:g} s",
        "vehicles": ", ".join(f"{veh:.0f} {vclass}" for vclass, veh in result["by_class_veh"].items()) or "none",
        "room of a vehicle": f"{result['space_m']:.2f} m with its gap",
        "without a route": "; ".join(f"{veh:.0f}: {how}" for how, veh in without.items() if veh) or "none",
        "turning fractions": f"in {Path(result['turns']).name}",
        "calibration": Path(result["calibration"]).name if result["calibration"] else "none: utn import --calibrate",
    }
    view = Table(title=result["scenario"], title_justify="left", show_header=False)
    view.add_column()
    view.add_column(overflow="fold")
    for label, value in rows.items():
        view.add_row(label, value)
    console.print(view)
    console.print(f"run it with  utn run {shlex.quote(result['scenario'])}", highlight=False, soft_wrap=True)


@contextmanager
def counter(label: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar over `total` like pieces of work; it shows up with the first of them."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=Console(markup=False, stderr=True),
    )
    task = bar.add_task(label, total=total)

    def tick() -> None:
        bar.start()
        bar.advance(task)

    try:
        yield tick
    finally:
        if bar.live.is_started:
            bar.stop()


def mismatch_table(results: list[dict[str, Any]], folder: Path) -> None:
    """Error by demand and step ahead, the links that are worst against the floor, and where the rest is."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 120)
    for result in results:
        title = (
            "{controller} on {net}, demand {demand:g}, {n} seeds, model step {step_s:g} s, demand {inputs}, "
            "turning {turning}"
        ).format(n=len(result["seeds"]), **result)
        view = Table(title=title, title_justify="left")
        heads = {
            "rmse_veh": "RMSE x (veh)",
            "bias_veh": "bias x (veh)",
            "rmse_over_persistence": "over persistence",
            "rmse_over_history": "over historical mean",
            "rmse_over_floor": "over floor",
            "queue_rmse_veh": "RMSE q (veh)",
            "flow_rmse_veh": "RMSE inflow (veh)",
        }
        shown = [key for key in heads if key in result]
        view.add_column("cycles ahead")
        for key in shown:
            view.add_column(heads[key], justify="right")
        for ahead in range(len(result["rmse_veh"])):
            view.add_row(str(ahead + 1), *(f"{result[key][ahead]:.3f}" for key in shown))
        console.print(view)
        if "rmse_over_floor" in result:
            over = {link: values["rmse_over_floor"][0] for link, values in result["links"].items()}
            worse = sorted((link for link in over if over[link] > FLOOR_LIMIT), key=lambda link: -over[link])
            listed = ", ".join(f"{link} ({over[link]:.2f})" for link in worse) or "none"
            console.print(f"links over {FLOOR_LIMIT} of the floor one cycle ahead: {listed}")
    console.print(f"plots and mismatch.json: {folder}")


def _controlled(junction: dict[str, Any]) -> str:
    if junction["refused"]:
        return f"no: {junction['refused']}"
    notes = {
        "made_to_yield": "gives way to who has green with it",
        "given_yellow": "is given the yellow that it lacks",
        "kept_waiting": "waits until others are cleared",
        "never_green": NEVER_GREEN,
    }
    said = [f"signal {', '.join(map(str, junction[key]))} {how}" for key, how in notes.items() if junction[key]]
    return ", ".join(["yes", *said])


def inspection_table(found: dict[str, Any], folder: Path) -> None:
    """Junctions, links, and what is left alone."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 140)
    view = Table(title=f"{found['net']}: control step {found['control_step_s']:g} s", title_justify="left")
    for head in ("junction", "cycle (s)", "offset (s)", "stages", "green to share (s)", "links", "controlled"):
        view.add_column(head)
    for each in found["junctions"]:
        numbers = [f"{each[key]:g}" for key in ("cycle_s", "offset_s")]
        numbers += [str(len(each["stages"])), f"{each['green_budget_s']:g}"]
        view.add_row(each["id"], *numbers, ", ".join(each["links"]), _controlled(each))
    for signal, reason in found["left_alone"].items():
        view.add_row(signal, "", "", "", "", "", f"no: {reason}")
    console.print(view)
    view = Table()
    for head in (
        "link",
        "to",
        "lanes",
        "length (m)",
        "storage (veh)",
        "saturation (veh/h)",
        "source",
        "turns: share, by lane group",
    ):
        view.add_column(head)
    for each in found["links"]:
        shares = {
            edge: f"{turn['next_link'] or 'exit ' + edge}: {turn['fraction']:.2f}"
            for edge, turn in each["turns"].items()
        }
        turns = " | ".join(", ".join(shares[edge] for edge in group["turns"]) for group in each["lane_groups"])
        numbers = [f"{each[key]:.0f}" for key in ("lanes", "length_m", "storage_veh", "saturation_flow_veh_h")]
        view.add_row(each["id"], each["junction"], *numbers, "yes" if each["is_source"] else "", turns)
    console.print(view)
    console.print(f"map.png and inspection.json: {folder}", highlight=False)


def forecast_table(result: dict[str, Any], folder: Path) -> None:
    """Error by method and step ahead, with intervals."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 120)
    title = "RMSE of a source's demand (veh/h), {net}, demand {demand:g}, noise {noise:g}, {runs} runs of {hours:g} h"
    view = Table(title=title.format(**result), title_justify="left")
    view.add_column("method")
    for ahead in range(1, result["horizon"] + 1):
        view.add_column(f"{ahead} ahead", justify="right")
    view.add_column("all steps (95 %)", justify="right")
    view.add_column("over profile's (95 %)", justify="right")
    for method, found in result["methods"].items():
        low, high = found["all_steps_low_veh_h"], found["all_steps_high_veh_h"]
        view.add_row(
            method,
            *(f"{value:.1f}" for value in found["rmse_veh_h"]),
            f"{found['all_steps_rmse_veh_h']:.1f} ({low:.1f} to {high:.1f})",
            f"{found['ratio_to_profile']:.4f} +- {found['ratio_half_width']:.4f}",
        )
    console.print(view)
    console.print("intervals within runs: what one run has more error than another is taken away", highlight=False)
    console.print(f"plot and forecasts.json: {folder}", highlight=False)


def calibration_table(content: dict[str, Any]) -> None:
    """Parameters by link with their standard errors."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 120)
    view = Table(title="start-up lag {:.2f} s (standard error {:.2f})".format(*content["startup_lag_s"]))
    keys = ("saturation_flow_veh_s", "storage_veh", "free_speed_m_s")
    for head in ("link", *keys, "turns"):
        view.add_column(head)
    for link, values in content["links"].items():
        turns = "  ".join("{} {:.3f} ({:.3f})".format(edge, *pair) for edge, pair in values["turns"].items())
        view.add_row(link, *("{:.3f} ({:.3f})".format(*values[key]) for key in keys), turns)
    console.print(view)


def tuning_table(found: dict[str, Any]) -> None:
    """The best settings beside the defaults, what they are worth, and how to run them."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 120)
    states = [trial["state"] for trial in found["trials"]]
    failed = len(states) - states.count("whole") - states.count("cut")
    console.print("{controller}: scenarios {scenarios}, seeds {seeds}".format(**found), highlight=False)
    console.print(f"trials {len(states) - 1}, cut short {states.count('cut')}, failed {failed}", highlight=False)
    view = Table()
    for head in ("setting", "default", "best"):
        view.add_column(head, justify="left" if head == "setting" else "right")
    best = found["best"]
    for name, default in found["defaults"].items():
        view.add_row(name, str(default), str(best["settings"].get(name, default)))
    console.print(view)
    between = "" if best["low"] is None else f" (95 % over the seeds: {best['low']:.3f} to {best['high']:.3f})"
    console.print(f"delay over that under the defaults: {best['ratio']:.3f}{between}", highlight=False)
    console.print("found on these seeds: judge it on others", highlight=False)
    if best["alarms"]:
        console.print(f"  ! {best['alarms']} unsafe seconds, fallbacks and teleports with them", highlight=False)
    for trial in found["trials"]:
        if trial["state"] not in {"whole", "cut"}:
            console.print(f"  ! trial {trial['trial']}: {trial['state']}", highlight=False)
    if found["left"]:
        console.print(f"not searched: {', '.join(found['left'])}", highlight=False)
    folder = Path(found["out"])
    console.print(f"trials: {folder}", highlight=False)
    file = shlex.quote(str(folder / "best.toml"))
    console.print(f"run it with  utn run --scenario {file}", highlight=False, soft_wrap=True)


def paper_table(results: list[dict[str, Any]], folder: Path) -> None:
    """The paper's table beside ours, one for each plant and demand."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 140)
    published = [each for each in results if each["plant"] == "paper"]
    ours: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for each in results:
        if each not in published:
            ours.setdefault((each["plant"], each["demand"]), []).append(each)
    for (plant, demand), columns in ours.items():
        head = "{net}, seed {seed}, {hours:.2f} h".format(**columns[0])
        console.print(_beside(f"{plant} plant, demand {demand:g}, {head}", [*published, *columns]))
    console.print(
        "constraints: greens fill their cycle and keep their least, links take what they hold", highlight=False
    )
    console.print("in brackets: by how much DMPC beside it differs from that", highlight=False)
    console.print(f"figures and paper.json: {folder}", highlight=False)


def _beside(title: str, columns: list[dict[str, Any]]) -> Table:
    view = Table(title=title, title_justify="left")
    view.add_column("measure", no_wrap=True)
    for each in columns:
        view.add_column(f"paper's {each['title']}" if each["plant"] == "paper" else each["title"], justify="right")
    rivals = {each["plant"] == "paper": each for each in columns if each["controller"] == "dmpc"}

    def cell(each: dict[str, Any], key: str, pattern: str) -> str:
        if key not in each:
            return ""
        rival = rivals.get(each["plant"] == "paper", each)
        if rival is each or not each[key]:
            return pattern.format(each[key])
        # Zero is added for the sign: a change of -0.0 % is none.
        return f"{pattern.format(each[key])} ({round(rival[key] / each[key] - 1, 3) + 0.0:+.1%})"

    for key, label, pattern in PAPER_ROWS:
        view.add_row(label, *(cell(each, key, pattern) for each in columns))
    for key, label in PAPER_VIOLATIONS:
        found = [each.get(key, "") for each in columns]
        view.add_row(label, *(", ".join(item) or "none" if isinstance(item, list) else str(item) for item in found))
    return view
