"""Runs side by side: each in a fresh process of its own, so that none can spoil another, or end it."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from utn_sumo import bridge, processes
from utn_sumo.errors import SettingError, UtnError
from utn_sumo.scenario import LAST_SEED, scenario

FAILED = "failed"
"""In the place of measures: the one line that says why a run has none."""

STOP = (signal.SIGINT,)

MOST_SEEDS = 10_000
"""More runs than that of one kind nobody waits for."""

Job = Mapping[str, Any]
"""Settings of a run, as `scenario` takes them."""


@contextmanager
def started(workers: int | None = None) -> Iterator[Callable[[Job], Future[dict[str, Any]]]]:
    """A function that starts a run, `workers` at a time (by default one a processor), in the order of its calls.

    Its future holds the measures, or why there are none under `FAILED`. Runs that have not begun when the context is
    left never do.
    """
    # A thread watches over each process: one that dies, as SUMO can, takes no other run with it.
    threads = ThreadPoolExecutor(workers or os.cpu_count())
    try:
        yield lambda job: threads.submit(_alone, job)
    finally:
        threads.shutdown(cancel_futures=True)


def measures(job: Job) -> dict[str, Any]:
    """The measures of a run whose folder nobody needs. Raises UtnError, and KeyboardInterrupt if it was stopped."""
    with tempfile.TemporaryDirectory() as temporary:
        result = bridge.run(scenario(**job), Path(temporary) / "run")
    if result["interrupted"]:
        raise KeyboardInterrupt
    return {name: value for name, value in result.items() if name != "out"}


def seeds(text: str) -> list[int]:
    """The seeds that a list of numbers and ranges names, as in 1-3,7; each once. Raises SettingError."""
    found: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = (word.strip() for word in part.partition("-"))
        ends = (first, last if dash else first)
        if not all(map(_is_seed, ends)) or int(ends[0]) > int(ends[1]):
            raise SettingError(
                f"setting 'seeds' is {text!r}: write numbers up to {LAST_SEED} and ranges with commas, as in 1-3,7"
            )
        found |= dict.fromkeys(range(int(ends[0]), int(ends[1]) + 1)[: MOST_SEEDS + 1])
        if len(found) > MOST_SEEDS:
            raise SettingError(f"setting 'seeds' is {text!r}: name no more than {MOST_SEEDS}")
    return list(found)


def _is_seed(word: str) -> bool:
    """Whether it is a number that a scenario takes as its seed."""
    return word.isdecimal() and len(word) <= len(str(LAST_SEED)) and int(word) <= LAST_SEED


def _alone(job: Job) -> dict[str, Any]:
    # The process inherits the mask: a Ctrl-C ends its run, and is silent before and after it. Where Python's resource
    # tracker has yet to be started, which the first process needs, that takes the mask away: so it comes before.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP)
    with processes.pool(1) as process:
        try:
            return process.submit(_outcome, dict(job)).result()
        except BrokenProcessPool:
            return {FAILED: "its process died"}


def _outcome(job: Job) -> dict[str, Any]:
    """What a run gave, told in the process that ran it: an exception of somebody's own may not travel."""
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP)
        return measures(job)
    except UtnError as error:
        return {FAILED: str(error)}
    except Exception as error:  # noqa: BLE001 - whatever a controller raises
        return {FAILED: " ".join(f"{type(error).__name__}: {error}".split())}
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP)
