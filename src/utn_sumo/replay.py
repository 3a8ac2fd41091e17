"""A recorded run as plain SUMO input: the signals that were shown, as static programmes, and a configuration.

The bare `sumo` binary run on it gives the same trips, vehicle for vehicle: nothing of ours is needed to check ours.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

from utn_sumo import monitor, recording
from utn_sumo.errors import ResultError
from utn_sumo.plant.sumo import run_arguments

FOLDER = "replay"
PROGRAM = "replay"


def write(folder: Path) -> Path:
    """Write `replay/signals.add.xml` and `replay/run.sumocfg` into a result folder; returns the configuration.

    Raises ResultError if the folder holds no finished run, or holds a replay already.
    """
    settings = recording.read_json(folder, recording.SETTINGS)
    result = recording.read_json(folder, recording.RESULT)
    try:
        seed, duration_s = int(settings["scenario"]["seed"]), round(result["hours"] * 3600)
    except (KeyError, TypeError, ValueError) as error:
        raise ResultError(f"{str(folder)!r} lacks a run's seed or length: give one that `utn run` wrote") from error
    if not (folder / "routes.rou.xml").is_file():
        raise ResultError(f"{str(folder)!r} holds no routes: runs of a .sumocfg can't be replayed yet")
    target = folder / FOLDER
    if target.exists():
        raise ResultError(f"{str(target)!r} is there already: remove it to write the replay anew")
    switches = monitor.read_switches(folder / "signals.xml")
    if not switches:
        raise ResultError(f"{str(folder)!r} has no recorded signals: the run ended before its first second")
    target.mkdir()
    signals = target / "signals.add.xml"
    _write_programmes(signals, switches, duration_s)
    arguments = run_arguments(
        Path("../net.net.xml"),
        Path("../routes.rou.xml"),
        [Path(signals.name)],
        Path(),
        seed=seed,
        duration_s=duration_s,
    )
    configuration = target / "run.sumocfg"
    _write_configuration(configuration, arguments)
    return configuration


def _write_programmes(path: Path, switches: dict[str, list[tuple[int, str]]], duration_s: int) -> None:
    root = ET.Element("additional")
    for junction, shown in switches.items():
        logic = ET.SubElement(root, "tlLogic", id=junction, type="static", programID=PROGRAM, offset="0")
        ends = [start for start, _ in shown[1:]] + [duration_s]
        for (start, state), end in zip(shown, ends, strict=True):
            if end > start:
                ET.SubElement(logic, "phase", duration=str(end - start), state=state)
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


def _write_configuration(path: Path, arguments: list[str]) -> None:
    """The run's own options as a .sumocfg: the value of each, `true` for a flag without one."""
    root = ET.Element("configuration")
    for position, word in enumerate(arguments):
        if word.startswith("--"):
            after = arguments[position + 1] if position + 1 < len(arguments) else "--"
            ET.SubElement(root, word.removeprefix("--"), value="true" if after.startswith("--") else after)
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
