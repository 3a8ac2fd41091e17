"""`tools/bench.py`: what goes wrong is one line that says what to do, and names in its tables are whole."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import benchmarks
from utn_sumo.cli import told

BENCH = Path(benchmarks.__file__).with_name("bench.py")

# name: (arguments, what the line names, the remedy that it gives)
MISTAKES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "unknown command": (("rum",), "'rum'", "see bench.py --help"),
    "demand that is no number": (("bound", "--demands", "nan"), "'demands' is 'nan'", "must be numbers"),
    "demand beyond a run's": (("bound", "--demands", "11"), "'demand' is 11.0", "less than or equal to 10"),
    "hours that are no number": (("bound", "--hours", "nan"), "'hours' is nan", "it must be"),
    "hours under a step": (("bound", "--hours", "0.01"), "'hours' is 0.01", "make it longer"),
    "more time lost than there is": (("bound", "--lost", "0.1,5"), "'lost' is '0.1,5'", "shares of the time"),
    "seeds in letters": (("step", "--seeds", "x"), "'seeds' is 'x'", "as in 1-3,7"),
    "steps in letters": (("step", "--steps", "60,x"), "'steps' is '60,x'", "must be numbers"),
    "errors that are no numbers": (("estimate", "--errors", "nan"), "'errors' is 'nan'", "must be numbers"),
    "errors beyond a loop's": (("estimate", "--errors", "0.5"), "'loop_error' is 0.5", "less than or equal to 0.2"),
    "pictures where there is a file": (("traffic", "--plot", "own.net.xml"), "'own.net.xml'", "another with --plot"),
    "a grid without signals": (("scale", "--side", "0"), "'--side'", "x>=1"),
    "nothing repeated": (("forecast", "--repeats", "0"), "'--repeats'", "x>=1"),
    "unknown forecast": (("foresight", "--forecasts", "starma"), "'forecast' is 'starma'", "must be 'starima'"),
    "noises in letters": (("foresight", "--noises", "x"), "'noises' is 'x'", "must be numbers"),
    "a bound for others' traffic": (("bound", "--net", "a.sumocfg"), "'net' is 'a.sumocfg'", "name a shipped net"),
    "steps of others' traffic": (("step", "--net", "a.sumocfg"), "'net' is 'a.sumocfg'", "name a shipped net"),
    "runs too short for seven steps": (("step", "--hours", "0.1"), "'hours' gives runs of 0.1 h", "9 control steps"),
    "parts drawn where there is a file": (("solve", "--plot", "own.net.xml"), "'own.net.xml'", "another with --plot"),
    "unknown part": (("solve", "--only", "gaps"), "'gaps'", "did you mean 'gap'"),
    "unknown size": (("solve", "--sizes", "x"), "'x'", "known: 100, 1000, 400"),
    "unknown grid": (("solve", "--grids", "oneway"), "'oneway'", "did you mean 'one-way'"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_with_its_remedy(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], mistake: str
) -> None:
    arguments, thing, remedy = MISTAKES[mistake]
    monkeypatch.chdir(folder)
    (folder / "own.net.xml").touch()
    with pytest.raises(SystemExit) as caught, told("bench.py", ""):
        benchmarks.bench(arguments, prog_name="bench.py", standalone_mode=False)
    printed, complaint = capsys.readouterr()
    assert caught.value.code == 2
    assert printed == ""
    assert complaint.startswith("bench.py: ")
    assert complaint.count("\n") == 1
    assert thing in complaint
    assert remedy in complaint
    assert [path.name for path in folder.iterdir()] == ["own.net.xml"]


def test_a_ctrl_c_while_it_still_imports_is_one_line(folder: Path) -> None:
    shutil.copyfile(BENCH, folder / "bench.py")
    imports = "import os, signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    (folder / "benchmarks.py").write_text(imports + "os.kill(os.getpid(), signal.SIGINT)\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "bench.py", "traffic"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "bench.py: stopped; traffic goes on from its --out\n"


def test_names_in_tables_are_whole_and_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    names = ["cyclic_max_pressure (per=storage)", "cyclic_max_pressure (per=none)", "mine[/x].py:Mine"]
    heads = ["demand", "controller", "delay", "median", "time spent", "gridlocked", "alarms", "ratio", "longest red"]
    rows = [["1.3", name, *["1,234 (1,234-1,234)"] * (len(heads) - 2)] for name in names]
    benchmarks._show("a net", heads, rows)
    printed = capsys.readouterr().out
    parts = [line.split("│")[2].strip() for line in printed.splitlines() if line.startswith("│")]
    assert "".join(parts).replace(" ", "") == "".join(names).replace(" ", "")
