"""The `utn` command: what goes wrong is one line that says what to do, and what goes right is clean."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from utn_sumo import sumo_tools
from utn_sumo.contract import Network

Utn = Callable[..., subprocess.CompletedProcess[str]]
SHORT = ("run", "--controller", "fixed", "--hours", "0.1")
HEAVY = {"libsumo", "casadi", "numpy", "pydantic", "sumolib", "daqp"}

FILES = {
    "unreadable.net.xml": "no net at all",
    "empty.net.xml": "<net/>",
    "text.py": "class Own:\n    def __init__(self, network:\n",
    "fails.py": "class Own:\n    def __init__(self, network):\n        raise ValueError('needs a licence')\n",
    "lacks.py": "class Own:\n    def __init__(self, network):\n        pass\n",
    "broken.toml": "hours = = 1",
    "typo.toml": "hourz = 1",
    "shape.toml": "settings = 3",
    "file.txt": "mine",
}
# name: (arguments, what the line names, the remedy that it gives)
MISTAKES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "unknown controller": (("run", "--controller", "dpmc"), "'dpmc'", "did you mean 'dmpc'? known: "),
    "controller in no file": (("run", "--controller", "none.py:Own"), "'none.py:Own'", "there is no file"),
    "controller of another name": (("run", "--controller", "lacks.py:Other"), "'Other'", "has no class"),
    "controller with a syntax error": (("run", "--controller", "text.py:Own"), "text.py:Own", "line 2"),
    "controller that can't be built": (("run", "--controller", "fails.py:Own"), "fails.py:Own", "needs a licence"),
    "controller without a plan": (("run", "--controller", "lacks.py:Own"), "lacks.py:Own", "contract.Controller"),
    "unknown net": (("run", "--net", "utn71"), "'utn71'", "did you mean 'utn17"),
    "unreadable net": (("run", "--net", "unreadable.net.xml"), "unreadable.net.xml", "give a .net.xml"),
    "empty net": (("run", "--net", "empty.net.xml"), "empty.net.xml", "give a .net.xml"),
    "negative demand": (("run", "--demand", "-1"), "'demand' is '-1'", "must be greater than or equal to 0"),
    "no hours": (("run", "--hours", "0"), "'hours' is '0'", "must be greater than 0"),
    "hours under a second": (("run", "--hours", "0.0001"), "'hours' is '0.0001'", "must be"),
    "seed in letters": (("run", "--seed", "abc"), "'seed' is 'abc'", "must be a valid integer"),
    "horizon of zero": (("run", "--horizon", "0"), "'horizon' is 0", "must be greater than or equal to 1"),
    "unknown cost": (("run", "--cost", "money"), "'cost' is 'money'", "must be 'tts' or 'paper'"),
    "setting without value": (("run", "--set", "rho"), "--set 'rho'", "NAME=VALUE"),
    "unknown setting": (("run", "--set", "iteration=3"), "'iteration'", "did you mean 'iterations'"),
    "setting without a bound": (("run", "--hours", "0.1", "--set", "rho=Infinity"), "'rho' is inf", "must be"),
    "setting of a controller that has none": (("run", "--controller", "fixed", "--horizon", "3"), "'horizon'", "none"),
    "unknown execution": (("run", "--execution", "actuatd"), "'actuatd'", "did you mean 'actuated'? known: "),
    "setting of no execution": (("run", "--set", "execution.gap_s=2"), "'execution.gap_s'", "name the execution"),
    "setting that an execution lacks": (
        ("run", "--execution", "actuated", "--set", "execution.gap=2"),
        "'gap'",
        "did you mean 'gap_s'",
    ),
    "setting of an execution out of range": (
        ("run", "--execution", "actuated", "--set", "execution.gap_s=0"),
        "'gap_s' is 0",
        "must be greater than 0",
    ),
    "execution beside SUMO's own signals": (
        ("run", "--controller", "delay_based", "--execution", "exact"),
        "'execution' is 'exact'",
        "leave it out",
    ),
    "unknown flag": (("run", "--horizn", "3"), "'--horizn'", "--horizon"),
    "unknown command": (("rum",), "'rum'", "Did you mean 'run'"),
    "missing scenario file": (("run", "--scenario", "none.toml"), "'none.toml'", "name"),
    "broken scenario file": (("run", "--scenario", "broken.toml"), "'broken.toml'", "line 1"),
    "unknown setting in a scenario file": (("run", "--scenario", "typo.toml"), "'hourz'", "did you mean 'hours'"),
    "settings of the wrong shape": (("run", "--scenario", "shape.toml"), "'settings' is 3", "must be"),
    "output into a file": (("run", "--out", "file.txt"), "'file.txt'", "name another"),
    "unknown forecast": (("run", "--forecast", "starma"), "'forecast' is 'starma'", "must be 'starima', 'arima'"),
    "refits without an interval": (("run", "--refit-steps", "0"), "'refit_steps' is '0'", "must be greater than"),
    "forecasts judged on one run": (("forecast-report", "--seeds", "1"), "runs", "--seeds 2"),
    "forecasts judged on no runs": (
        ("forecast-report", "none", "void"),
        "'none'",
        "give a folder that `utn run` wrote",
    ),
    "tuning of nobody": (("tune", "max_wav"), "'max_wav'", "did you mean 'max_wave'"),
    "tuning over an unknown setting": (("tune", "max_wave", "--over", "evry_s=2:9"), "'evry_s'", "did you mean"),
    "tuning over a range beyond the bounds": (
        ("tune", "max_wave", "--over", "every_s=0:9"),
        "'every_s=0:9'",
        "must be",
    ),
    "tuning with an unknown execution": (("tune", "dmpc", "--execution", "actuatd"), "'actuatd'", "'actuated'"),
    "tuning with an execution beside SUMO's own signals": (
        ("tune", "actuated", "--execution", "actuated"),
        "'execution' is 'actuated'",
        "leave it out",
    ),
    "tuning what does not run": (
        ("tune", "recommended", "--execution", "exact"),
        "'recommended'",
        "leave one of the two",
    ),
    "tuning on an unknown net": (("tune", "max_wave", "--nets", "utn71"), "'utn71'", "did you mean 'utn17"),
    "tuning with seeds in letters": (("tune", "max_wave", "--seeds", "a-b"), "'seeds' is 'a-b'", "as in 1-3,7"),
    "seeds that are no numbers": (("calibrate", "--seeds", "nan", "--out", "new"), "'seeds' is 'nan'", "as in 1-3,7"),
    "endless seeds": (("import", "x.sumocfg", "--seeds", "inf", "--out", "new"), "'seeds' is 'inf'", "as in 1-3,7"),
    "parts of seeds": (("calibrate", "--seeds", "7.9", "--out", "new"), "'seeds' is '7.9'", "as in 1-3,7"),
    "demand twice": (("mismatch", "--demand", "1.0,1", "--out", "new"), "'demand' is '1.0,1'", "each number once"),
    "demand that is no number": (("calibrate", "--demand", "nan", "--out", "new"), "'demand' is 'nan'", "numbers"),
    "step that is no number": (("mismatch", "--step", "nan", "--out", "new"), "'step' is 'nan'", "must be numbers"),
    "two steps": (("mismatch", "--step", "10,20", "--out", "new"), "'step' is '10,20'", "one number"),
    "replay of nothing": (("replay", "none"), "'none'", "give a folder that `utn run` wrote"),
}


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """The line that a mistake ends in; it is all that is printed."""
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    lines = done.stderr.splitlines()
    assert lines[-1].startswith("utn: ")
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize(("arguments", "thing", "remedy"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_one_line_with_its_remedy_and_leaves_nothing_behind(
    refused: Utn, folder: Path, arguments: tuple[str, ...], thing: str, remedy: str
) -> None:
    for name, content in FILES.items():
        (folder / name).write_text(content, encoding="utf-8")
    done = refused(*arguments)
    left_behind = {path.name for path in folder.iterdir()} - set(FILES) - {"__pycache__"}
    assert not left_behind
    assert thing in done.stderr
    assert remedy in done.stderr
    one_line(done)


def test_an_output_folder_that_holds_files_is_refused_and_they_stay(utn: Utn, folder: Path) -> None:
    (folder / "out").mkdir()
    (folder / "out" / "result.json").write_text("precious", encoding="utf-8")
    done = utn(*SHORT, "--out", "out")
    assert "'out'" in done.stderr
    assert "name another" in done.stderr
    assert [path.name for path in (folder / "out").iterdir()] == ["result.json"]
    assert (folder / "out" / "result.json").read_text(encoding="utf-8") == "precious"
    one_line(done)


def test_a_cache_that_can_not_be_written_is_one_line(utn: Utn, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("UTN_CACHE", str(folder / "file" / "cache"))
    done = utn(*SHORT)
    assert "cache" in done.stderr
    one_line(done)


def test_json_is_one_object_and_nothing_else_on_standard_output(utn: Utn, folder: Path) -> None:
    done = utn(*SHORT, "--json", "--out", "out")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert done.stdout.count("\n") == 1
    assert printed["controller"] == "fixed"
    on_disk = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    assert printed.keys() == on_disk.keys()
    assert printed["arrived"] == on_disk["arrived"]


def test_a_run_prints_its_measures_and_where_the_results_are(utn: Utn, folder: Path) -> None:
    done = utn(*SHORT)
    assert done.returncode == 0, done.stderr
    assert "total time spent" in done.stdout
    (out,) = (folder / "results").iterdir()
    assert f"results: results/{out.name}" in done.stdout
    again = utn(*SHORT)
    assert again.returncode == 0, again.stderr
    assert len(list((folder / "results").iterdir())) == 2


def test_names_in_brackets_are_printed_as_they_are(utn: Utn, folder: Path, utn17: Network) -> None:
    (folder / "a[").mkdir()
    net = Path(shutil.copyfile(utn17.net_file, folder / "a[" / "x].net.xml"))
    for command in (("run", "--controller", "fixed", "--hours", "0.1", "--net"), ("inspect",)):
        done = utn(*command, f"a[/{net.name}")
        assert done.returncode == 0, done.stderr
        assert "x]" in done.stdout
        assert done.stderr == "" or "Traceback" not in done.stderr


def test_a_scenario_file_says_what_flags_say_and_flags_win(utn: Utn, folder: Path) -> None:
    (folder / "scenario.toml").write_text('controller = "fixed"\nhours = 0.2\nseed = 3\n', encoding="utf-8")
    done = utn("run", "--scenario", "scenario.toml", "--hours", "0.1", "--json", "--out", "out")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["controller"], result["hours"], result["seed"]) == ("fixed", 0.1, 3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--help",), ["run", "replay", "controllers", "net"]),
        (("run", "--help"), ["--controller", "--demand", "--horizon", "--json", "--out"]),
        (("replay", "--help"), ["FOLDER"]),
        (("net", "--help"), ["build", "check"]),
        (("--version",), ["utn"]),
        (("controllers", "scheduled"), ["blocking", "4.0", "number, from 0 on, up to 20", "behind"]),
        (("controllers", "fixed"), ["fixed", "settings: none"]),
        (("controllers",), ["fixed", "dmpc", "horizon", "settings: none", "executions", "exact", "gap_s"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_help_names_what_there_is(utn: Utn, arguments: tuple[str, ...], words: list[str]) -> None:
    done = utn(*arguments)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert [word for word in words if word not in done.stdout] == []


def test_help_imports_no_engine(folder: Path) -> None:
    code = "import sys; from utn_sumo.cli import main; main(['--help']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    assert "Usage: utn" in done.stdout
    assert HEAVY & set(done.stdout.splitlines()[-1].split()) == set()


def test_replay_writes_a_configuration_that_sumo_runs_and_refuses_to_write_it_twice(utn: Utn, folder: Path) -> None:
    assert utn(*SHORT, "--out", "out").returncode == 0
    done = utn("replay", "out")
    assert done.returncode == 0, done.stderr
    configuration = folder / "out" / "replay" / "run.sumocfg"
    assert configuration.is_file()
    assert f"sumo -c {configuration.relative_to(folder)}" in done.stdout
    before = configuration.read_bytes()
    assert "remove it" in one_line(utn("replay", "out"))
    assert configuration.read_bytes() == before


@pytest.mark.parametrize("controller", ["native", "actuated"])
def test_runs_of_sumo_alone_are_kept_whole_too(utn: Utn, folder: Path, controller: str) -> None:
    assert utn("run", "--controller", controller, "--hours", "0.1", "--demand", "0.5").returncode == 0
    out = folder / "results" / f"utn17-{controller}-demand0.5-seed1"
    settings = json.loads((out / "settings.json").read_text(encoding="utf-8"))
    assert settings["versions"].keys() >= {"utn_sumo", "sumo"}
    # The folder is enough, wherever it is and whatever becomes of the rest.
    moved = folder / "elsewhere"
    out.rename(moved)
    assert utn("replay", "elsewhere").returncode == 0
    subprocess.run([sumo_tools.sumo_binary("sumo"), "-c", "run.sumocfg"], cwd=moved / "replay", check=True)
    assert trips(moved / "replay" / "trips.xml") == trips(moved / "trips.xml")


def trips(file: Path) -> list[dict[str, str]]:
    return [trip.attrib for trip in ET.parse(file).getroot().iter("tripinfo")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", "--out", "file"), ["'file'", "is a file", "--out"]),
        (("run", "--out", "."), ["'.'", "is not empty", "--out"]),
        (
            ("mismatch", "--hours", "0.2", "--no-floor", "--out", "new"),
            ["'hours'", "0.2 h", "9 control steps", "0.3 h"],
        ),
        (("calibrate", "--controller", "native", "--out", "new"), ["'controller'", "'native'", "one that plans"]),
        (("run", "--calibration", "nowhere.json"), ["'nowhere.json'", "can't be read", "utn calibrate"]),
        (("run", "--net", "routes.xml"), ["'routes.xml'", "holds no roads", "netconvert"]),
        (("forecast-report", "nowhere"), ["'nowhere'", "settings.json"]),
        (("forecast-report", "--demand", "0", "--out", "new"), ["'demand' is 0", "nothing to forecast"]),
        (("tune", "priced", "--nets", "utn17,utn17", "--out", "new"), ["'utn17,utn17'", "each word once"]),
        (("mismatch", "--demand", "1,1.0000001", "--out", "new"), ["'1,1.0000001'", "each number once"]),
        (("mismatch", "--horizon", "9" * 5000, "--out", "new"), ["'horizon'", "a whole number"]),
        (("run", "--net", "", "--out", "new"), ["net ''"]),
        (("run", "--net", "a,b.net.xml", "--out", "new"), ["'a,b.net.xml'", "a comma", "rename it"]),
        (("run", "--scenario", "deep.toml", "--out", "new"), ["'deep.toml'", "name a TOML file"]),
        (("run", "--scenario", "long.toml", "--out", "new"), ["'long.toml'", "name a TOML file"]),
        (("run", "--set", "horizon=" + "9" * 5000, "--out", "new"), ["'horizon'"]),
        (("forecast-report", "empty", "empty"), ["'empty'", "a run's scenario", "`utn run` wrote"]),
        (("forecast-report", "list", "list"), ["'list'", "settings.json", "`utn run` wrote"]),
        (("forecast-report", "typo", "typo"), ["'typo'", "'hourz' is unknown", "`utn run` wrote"]),
    ],
    ids=lambda value: " ".join(value[:3]) if isinstance(value, tuple) else "",
)
def test_what_cannot_be_is_said_before_anything_is_run(
    refused: Utn, folder: Path, arguments: tuple[str, ...], words: list[str]
) -> None:
    (folder / "file").touch()
    for name, content in {"empty": "{}", "list": "[]", "typo": '{"scenario": {"hourz": 1}}'}.items():
        (folder / name).mkdir()
        (folder / name / "settings.json").write_text(content, encoding="utf-8")
    (folder / "routes.xml").write_text("<routes/>", encoding="utf-8")
    (folder / "a,b.net.xml").write_text("<net/>", encoding="utf-8")
    (folder / "deep.toml").write_text("net = " + 5000 * "[", encoding="utf-8")
    (folder / "long.toml").write_text("seed = " + 5000 * "9", encoding="utf-8")
    line = one_line(refused(*arguments))
    assert [word for word in words if word not in line] == []
    # Another try may have the same folder.
    assert not (folder / "new").exists() or not any((folder / "new").iterdir())


@pytest.fixture
def interruptible() -> Iterator[None]:
    """A test run in the background ignores Ctrl-C, and its children would with it."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_a_run_with_a_readable_result(command: str, folder: Path) -> None:
    cycles = folder / "out" / "cycles.jsonl"
    arguments = [command, "run", "--controller", "fixed", "--hours", "12", "--json", "--out", "out"]
    with subprocess.Popen(
        arguments, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL
    ) as running:
        try:
            while not cycles.is_file() or cycles.read_bytes().count(b"\n") < 3:
                assert running.poll() is None, "the run ended too early"
                time.sleep(0.05)
            running.send_signal(signal.SIGINT)
            printed, complaint = running.communicate(timeout=120)
        finally:
            running.kill()
    assert running.returncode == 130
    assert "Traceback" not in complaint
    result = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["interrupted"] is True
    assert json.loads(printed)["interrupted"] is True
    lines = cycles.read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["cycle"] for line in lines] == list(range(len(lines)))
    assert 3 * 120 <= result["hours"] * 3600 < 12 * 3600
