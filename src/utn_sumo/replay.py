"""A recorded run as plain SUMO input: the signals that were shown, as static programmes, and a configuration.

The bare `sumo` binary run on it gives the same trips, vehicle for vehicle: nothing of ours is needed to check ours.
A run of a .sumocfg is replayed from the files that it was made from, where they lie; signals that were left alone
keep the net's own programme.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from utn_sumo import case, monitor, recording, sumo_signals
from utn_sumo.case import Case
from utn_sumo.errors import ResultError
from utn_sumo.plant.sumo import records, run_arguments

FOLDER = "replay"
PROGRAM = "replay"
MICROHOUR_S = 0.0036


def write(folder: Path) -> Path:
    """Write `replay/signals.add.xml` and `replay/run.sumocfg` into a result folder; returns the configuration.

    Raises ResultError if the folder holds no finished run, holds a replay already, or if the files of a .sumocfg that
    it was made from have moved or changed.
    """
    settings = recording.read_json(folder, recording.SETTINGS)
    result = recording.read_json(folder, recording.RESULT)
    try:
        seed = int(settings["scenario"]["seed"])
        chosen = Case.recorded(settings["case"]) if "case" in settings else None
        duration_s = _duration_s(result["hours"], 1.0 if chosen is None else chosen.step_s)
        controlled = result["controller"] not in sumo_signals.RUNS
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ResultError(f"{str(folder)!r} lacks a run's seed or length: give one that `utn run` wrote") from error
    if chosen is not None:
        _check_files(folder, settings["case"])
    elif not (folder / recording.ROUTES).is_file():
        raise ResultError(f"{str(folder)!r} holds no routes: give a folder that `utn run` wrote")
    target = folder / FOLDER
    if target.exists():
        raise ResultError(f"{str(target)!r} is there already: remove it to write the replay anew")
    begin_s = 0.0 if chosen is None else chosen.begin_s
    switches = monitor.read_switches(folder / "signals.xml", begin_s)
    if not switches:
        raise ResultError(f"{str(folder)!r} has no recorded signals: the run ended before its first second")
    left_alone = result.get("left_alone", {}) if controlled else switches
    target.mkdir()
    signals = target / "signals.add.xml"
    shown = {junction: each for junction, each in switches.items() if junction not in left_alone}
    _write_programmes(signals, shown, begin_s, duration_s)
    if chosen is None:
        above, programmes = Path(".."), folder / recording.PROGRAMMES
        arguments = run_arguments(
            above / recording.NET,
            above / recording.ROUTES,
            [*([above / programmes.name] if programmes.is_file() else []), Path(signals.name)],
            Path(),
            seed=seed,
            duration_s=duration_s,
        )
    else:
        window = replace(chosen, end_s=begin_s + duration_s)
        arguments = [*window.arguments([Path(signals.name)]), *records(Path(), seed)]
    configuration = target / "run.sumocfg"
    _write_configuration(configuration, arguments)
    return configuration


def _check_files(folder: Path, recorded: Mapping[str, Any]) -> None:
    for name, before in recorded.get("sha256", {}).items():
        now = case.digest(Path(name)) if Path(name).is_file() else None
        if now != before:
            what = "is gone from there" if now is None else "has changed since"
            raise ResultError(f"{str(folder)!r} was made from {name!r}, which {what}: put it back, or run it anew")


def _duration_s(hours: float, step_s: float) -> float:
    """How long a run was that is recorded in `hours`, to a microhour: as many steps as it took to get there."""
    return math.ceil((hours * 3600 - MICROHOUR_S) / step_s) * step_s


def _write_programmes(
    path: Path, switches: dict[str, list[tuple[float, str]]], begin_s: float, duration_s: float
) -> None:
    root = ET.Element("additional")
    for junction, shown in switches.items():
        # A programme runs round as if it had begun at its offset: this one begins with the run.
        logic = ET.SubElement(
            root, "tlLogic", id=junction, type="static", programID=PROGRAM, offset=case.in_digits(begin_s)
        )
        ends = [start for start, _ in shown[1:]] + [duration_s]
        for (start, state), end in zip(shown, ends, strict=True):
            if end > start:
                ET.SubElement(logic, "phase", duration=case.in_digits(end - start), state=state)
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
