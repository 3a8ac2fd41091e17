"""Runs side by side: the seeds they are for, and a Ctrl-C that ends them all without a word from the processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from utn_sumo import campaign
from utn_sumo.errors import UtnError

INTERRUPTED = """
import os, signal, sys
from utn_sumo import campaign

signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == "__mp_main__":  # the process of the first run, which still imports
    os.killpg(0, signal.SIGINT)
if __name__ == "__main__":
    try:
        with campaign.started(1) as start:
            start({"controller": "fixed", "hours": 0.1}).result()
    except KeyboardInterrupt:
        sys.exit("stopped")
"""


def test_a_ctrl_c_while_the_first_process_still_imports_is_silent_there(tmp_path: Path) -> None:
    (tmp_path / "compares.py").write_text(INTERRUPTED, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "compares.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,
    )
    assert done.stderr == "stopped\n"


@pytest.mark.parametrize("text", ["2147483648", "1-99999999999", "9" * 5000])
def test_seeds_that_sumo_does_not_take_are_refused_by_name(text: str) -> None:
    with pytest.raises(UtnError, match=r"'seeds' is .*up to 2147483647"):
        campaign.seeds(text)


@pytest.mark.parametrize("text", ["1-2147483647", "1-6000,7000-12000"])
def test_more_seeds_than_anybody_waits_for_are_refused_before_there_is_a_list_of_them(text: str) -> None:
    with pytest.raises(UtnError, match=f"'seeds' is '{text}'"):
        campaign.seeds(text)
