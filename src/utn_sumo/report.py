"""What a run shows to people: the progress bar on standard error, the closing table on standard output."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from utn_sumo.bridge import Progress as RunProgress
from utn_sumo.scenario import Scenario

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
    ("unsafe_signal_s", "unsafe signals", "s", "{:d}"),
    ("fallbacks", "fallbacks", "cycles", "{:d}"),
    ("sumo_time_s", "time in SUMO", "s", "{:.2f}"),
    ("control_time_s", "time in the controller", "s", "{:.2f}"),
    ("bridge_time_s", "time in the bridge", "s", "{:.2f}"),
]


@contextmanager
def progress(scenario: Scenario) -> Iterator[Callable[[RunProgress], None]]:
    """A progress bar with time to go, time spent so far and the present queue; it shows up with the first cycle,
    so that an error before it stays the only line.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[state]}"),
    )
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task(f"{scenario.controller} on {scenario.net}", total=scenario.duration_s, state="")

    def show(now: RunProgress) -> None:
        bar.start()
        state = f"TTS {now.time_spent_veh_h:.0f} veh h, queue {now.queue_veh:.0f} veh"
        bar.update(task, completed=now.time_s, state=state)

    try:
        yield show
    finally:
        if bar.live.is_started:
            bar.stop()


def table(result: dict[str, Any]) -> None:
    """The closing table, what went wrong if anything did, and where the results are."""
    console = Console()
    title = "{controller} on {net}, demand {demand:g}, seed {seed}, {hours:.2f} h".format(**result)
    view = Table(title=title, title_justify="left")
    view.add_column("measure")
    view.add_column("value", justify="right")
    view.add_column("unit")
    for key, label, unit, pattern in ROWS:
        view.add_row(label, pattern.format(result[key]), unit)
    console.print(view)
    for reason in [*result["unsafe_reasons"], *result["fallback_reasons"]]:
        console.print(f"  ! {reason}", markup=False)
    if result["interrupted"]:
        console.print("stopped before its end: the measures cover the time that was run")
    console.print(f"results: {result['out']}", markup=False)
