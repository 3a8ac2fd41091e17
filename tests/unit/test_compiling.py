"""Machine code kept on disk is out of date once anything that went into it has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

FILES = {
    "limits": "LIMIT = 3",
    "rates": """
        from typing import NamedTuple

        class Rates(NamedTuple):
            slow: float
            fast: float
        """,
    "helper": """
        from utn_sumo.compiling import inlined

        @inlined
        def raised(value):
            return value + 1
        """,
    "user": """
        from helper import raised
        from limits import LIMIT
        from rates import Rates
        from utn_sumo.compiling import compiled

        @compiled
        def first(value):
            return second(value)

        @compiled
        def second(rates):
            return raised(rates.slow) + LIMIT

        print(first(Rates(slow=10.0, fast=20.0)), sum(first.stats.cache_hits.values()))
        """,
}


@pytest.fixture
def run(tmp_path: Path):
    def write(name: str, text: str) -> None:
        lines = text.strip("\n").splitlines()
        indent = len(lines[0]) - len(lines[0].lstrip())
        (tmp_path / f"{name}.py").write_text("\n".join(line[indent:] for line in lines) + "\n", encoding="utf-8")

    def printed(**changed: str) -> tuple[float, int]:
        for name, text in changed.items():
            write(name, text)
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
        environment.pop("NUMBA_CACHE_DIR", None)
        result, hits = subprocess.run(
            [sys.executable, "user.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        ).stdout.split()
        return float(result), int(hits)

    assert printed(**FILES) == (14, 0)
    return printed


def test_machine_code_is_kept_while_nothing_changes(run):
    assert run() == (14, 1)


def test_a_called_function_of_another_file_counts(run):
    assert run(helper=FILES["helper"].replace("value + 1", "value + 5")) == (18, 0)


def test_a_constant_of_another_file_counts(run):
    assert run(limits="LIMIT = 7") == (18, 0)


def test_the_order_of_a_named_tuple_s_fields_counts(run):
    turned = FILES["rates"].replace("slow", "none").replace("fast", "slow").replace("none", "fast")
    assert run(rates=turned) == (14, 0)


def test_what_is_not_in_the_machine_code_does_not_count(run):
    assert run(limits="LIMIT = 3\nOTHER = 5") == (14, 1)


def test_who_waits_for_machine_code_is_told_what_for_and_nobody_else(run, tmp_path: Path):
    impatient = "from utn_sumo import compiling\ncompiling.UNSAID_S = 0\n"
    user = tmp_path / "user.py"
    user.write_text(impatient + user.read_text(encoding="utf-8"), encoding="utf-8")
    command = [sys.executable, "user.py"]
    first, again = (subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True) for _ in range(2))
    assert first.stderr == "compiling, the first time on this machine: up to a minute or so\n"
    assert again.stderr == ""
