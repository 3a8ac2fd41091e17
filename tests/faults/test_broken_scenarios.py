"""Broken scenarios of other people: one line that names the file, the fault and the remedy, and nothing left behind."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from utn_sumo.cli import main
from utn_sumo.contract import Network

LAUGHS = "<!DOCTYPE x [<!ENTITY a 'ha'>" + "".join(
    f"<!ENTITY {chr(98 + n)} '{f'&{chr(97 + n)};' * 10}'>" for n in range(9)
)
ROUTES = '<routes><vehicle id="v" depart="1"><route edges="1 10"/></vehicle></routes>'


@pytest.fixture
def broken(utn17: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scenario in the working folder, for a test to break."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    (folder / "town.net.xml").write_bytes(utn17.net_file.read_bytes())
    (folder / "town.rou.xml").write_text(ROUTES, encoding="utf-8")
    (folder / "town.add.xml").write_text("<additional/>", encoding="utf-8")
    (folder / "town.sumocfg").write_text(
        '<configuration><net-file value="town.net.xml"/><route-files value="town.rou.xml"/>'
        '<additional-files value="town.add.xml"/><begin value="0"/><end value="60"/></configuration>',
        encoding="utf-8",
    )
    return folder


def edit(name: str, pattern: str, by: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        changed = re.sub(pattern, lambda _: by, text, flags=re.DOTALL)
        assert changed != text
        (folder / name).write_text(changed, encoding="utf-8")

    return change


def cut_off(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return change


def laughs(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_text(f"{LAUGHS}]><x>&j;</x>", encoding="utf-8")

    return change


def empty(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(b"")


def compressed(name: str, content: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / f"{name}.gz").write_bytes(content((folder / name).read_bytes()))
        edit("town.sumocfg", f'"{name}"', f'"{name}.gz"')(folder)

    return change


def a_folder(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).mkdir()

    return change


FILES = ("town.sumocfg", "town.net.xml", "town.rou.xml", "town.add.xml")
# name: (what is done to it, what the line says)
FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    **{f"cut-off {name}": (cut_off(name), f"'{name}' can't be read .*: give") for name in FILES[:3]},
    **{f"entities in {name}": (laughs(name), f"'{name}' can't be read .*: give") for name in FILES},
    **{f"empty {name}": (empty(name), f"'{name}' can't be read .*: give") for name in FILES},
    "net that is a folder": (a_folder("town.net.xml"), "'town.net.xml' as net-file: that is a folder"),
    "routes that are a folder": (a_folder("town.rou.xml"), "'town.rou.xml' as route-files: that is a folder"),
    "scenario that is a folder": (a_folder("town.sumocfg"), "'town.sumocfg' can't be read .*directory.*: give"),
    **{
        f"{name}.gz that is no gzip": (compressed(name, bytes), f"'{name}.gz' can't be read .*gzip.*: give")
        for name in FILES[1:]
    },
    "gzip that is cut off": (
        compressed("town.net.xml", lambda content: gzip.compress(content)[:1000]),
        "'town.net.xml.gz' can't be read .*: give",
    ),
    "gzip that is damaged": (
        compressed("town.net.xml", lambda content: gzip.compress(content)[:1000] + bytes(1000)),
        "'town.net.xml.gz' can't be read .*: give",
    ),
    "net without signals": (
        edit("town.net.xml", r"<tlLogic.*</tlLogic>| tl=\"[^\"]*\" linkIndex=\"[^\"]*\"", ""),
        "'town.net.xml' has no traffic lights: there is nothing to control",
    ),
    "routes of another net": (
        edit("town.rou.xml", "1 10", "1 elsewhere"),
        "vehicle 'v' of 'town.rou.xml' drives on edge 'elsewhere', which net 'town.net.xml' has not: give",
    ),
    "trips of another net": (
        edit("town.rou.xml", "<vehicle.*</vehicle>", '<trip id="t" depart="1" from="nowhere" to="10"/>'),
        "trip 't' of 'town.rou.xml' drives on edge 'nowhere'",
    ),
    "departure in words": (edit("town.rou.xml", 'depart="1"', 'depart="soon"'), "has depart 'soon': give a time"),
    "type that nobody defines": (edit("town.rou.xml", 'id="v"', 'id="v" type="lorry"'), "'lorry', .*: define it"),
    "files that include each other": (
        edit("town.add.xml", "<additional/>", '<additional><include href="town.add.xml"/></additional>'),
        "'town.add.xml' includes itself",
    ),
    "two nets": (edit("town.sumocfg", "town.net.xml", "town.net.xml,town.net.xml"), "net-file is .*: name one file"),
    "steps of no length": (edit("town.sumocfg", "<end", '<step-length value="0"/><end'), "step-length is '0': make it"),
    **{
        f"end {where} its begin": (
            edit("town.sumocfg", 'begin value="0"', f'begin value="{begin_s}"'),
            "end is '60', not after its begin: make it later",
        )
        for where, begin_s in (("before", 90), ("at", 60))
    },
    "scale in words": (edit("town.sumocfg", "<end", '<scale value="twice"/><end'), "scale is 'twice'"),
}


def line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err


@pytest.mark.parametrize("command", ["run", "import"])
@pytest.mark.parametrize(("fault", "says"), FAULTS.values(), ids=FAULTS.keys())
def test_a_broken_scenario_is_one_line_and_leaves_nothing_behind(
    broken: Path, fault: Callable[[Path], None], says: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    fault(broken)
    before = sorted(broken.iterdir())
    more = ["--demand", "2"] if command == "run" else []
    assert re.search(says, line([command, "town.sumocfg", "--out", "out", *more], capsys))
    assert sorted(broken.iterdir()) == before


@pytest.mark.usefixtures("broken")
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["none.sumocfg", "--out", "out"], "'none.sumocfg' can't be read .*: give a .sumocfg"),
        (["town.net.xml", "--out", "out"], "'town.net.xml' names no net-file: give a whole .sumocfg"),
        (["town.sumocfg"], "--out"),
        (["town.sumocfg", "--out", "out", "--seeds", "many"], "'seeds' is 'many'"),
    ],
)
def test_a_mistake_in_importing_is_one_line(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert re.search(says, line(["import", *arguments], capsys))
    assert not Path("out").exists()


def test_nothing_is_imported_over_what_is_there(broken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.read_bytes() for path in broken.iterdir()}
    assert "name another with --out" in line(["import", "town.sumocfg", "--out", "."], capsys)
    assert {path.name: path.read_bytes() for path in broken.iterdir()} == before


def test_commas_in_paths_are_refused(broken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "'a,b' has a comma" in line(["run", "town.sumocfg", "--controller", "native", "--out", "a,b"], capsys)
    assert not Path("a,b").exists()
    broken.rename(broken.with_name("he,re"))
    elsewhere = f"{broken.with_name('he,re')}/town.sumocfg"
    assert "a name with a comma" in line(["run", elsewhere, "--controller", "native", "--out", "out"], capsys)


@pytest.mark.usefixtures("broken")
@pytest.mark.parametrize(
    ("controller", "more", "says"),
    [
        ("native", ["--set", "foo=1"], "'native' has no setting 'foo': it takes none"),
        ("native", ["--calibration", "nowhere.json"], "'calibration' is 'nowhere.json': .*leave it out"),
        ("actuated", ["--calibration", "nowhere.json"], "'calibration' is 'nowhere.json': .*leave it out"),
        ("actuated", ["--loop-error", "0.02"], "'loop_error' is 0.02: .*leave it out"),
        ("webster", ["--forecast", "profile"], "'forecast' is 'profile': .*leave it out"),
        ("native", ["--refit-steps", "3"], "'refit_steps' is 3: .*leave it out"),
    ],
)
def test_what_sumo_s_own_signals_do_not_take_is_refused(
    controller: str, more: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert re.search(says, line(["run", "town.sumocfg", "--controller", controller, "--out", "out", *more], capsys))
    assert not Path("out").exists()


@pytest.mark.parametrize("controller", ["fixed", "native", "actuated"])
def test_where_sumo_breaks_off_its_own_clock_says_when(
    broken: Path, capsys: pytest.CaptureFixture[str], controller: str
) -> None:
    # Of routes SUMO reads two hundred seconds ahead: so it has begun.
    late = '<route edges="1 10"/></vehicle><vehicle id="w" depart="707" departLane="7"><route edges="1 10"/></vehicle>'
    edit("town.rou.xml", '<route edges="1 10"/></vehicle>', late)(broken)
    edit("town.rou.xml", 'depart="1"', 'depart="301"')(broken)
    edit("town.sumocfg", '<begin value="0"/><end value="60"/>', '<begin value="300"/><end value="900"/>')(broken)
    arguments = ["run", "town.sumocfg", "--controller", controller, "--out", "out"]
    with pytest.raises(SystemExit):
        main(arguments)
    assert "SUMO broke off at 707 s of its time (" in capsys.readouterr().err
