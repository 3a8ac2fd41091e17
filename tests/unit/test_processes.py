"""Processes beside this one end when it does, killed or not."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from utn_sumo import processes

WORKS = """
import os, time
from utn_sumo import processes

def work(_):
    print(os.getpid(), flush=True)
    time.sleep(600)

if __name__ == "__main__":
    with processes.pool(2) as pool:
        list(pool.map(work, range(2)))
"""


def is_running(process: int) -> bool:
    """Whether it is there and has not ended: nobody may have asked yet how it did."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="tells by Linux's /proc who is running")
def test_processes_end_with_the_one_that_started_them_even_if_it_is_killed(tmp_path: Path) -> None:
    (tmp_path / "works.py").write_text(WORKS)
    with subprocess.Popen([sys.executable, "works.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True) as parent:
        try:
            assert parent.stdout is not None
            workers = [int(parent.stdout.readline()) for _ in range(2)]
            assert all(map(is_running, workers))
        finally:
            parent.kill()
    until = time.monotonic() + 30
    while any(map(is_running, workers)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(is_running, workers))


def test_a_process_made_afresh_does_one_job() -> None:
    with processes.pool(1, afresh=True) as pool:
        first, second = (pool.submit(os.getpid).result() for _ in range(2))
    assert first != second
    with processes.pool(1) as pool:
        assert len({pool.submit(os.getpid).result() for _ in range(2)}) == 1
