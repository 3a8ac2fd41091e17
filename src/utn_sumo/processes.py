"""Processes beside this one, which end when it does."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from threading import Thread


def pool(workers: int | None = None, *, afresh: bool = False) -> ProcessPoolExecutor:
    """So many processes, by default one a processor; each job has one of its own if they are to be made `afresh`."""
    return ProcessPoolExecutor(
        workers or os.cpu_count(),
        mp_context=get_context("spawn"),
        initializer=end_with_parent,
        max_tasks_per_child=1 if afresh else None,
    )


def end_with_parent() -> None:
    """Have this process end as soon as that which started it has, killed or not: it would wait for jobs for good."""
    Thread(target=_outlive_none, daemon=True).start()


def _outlive_none() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
