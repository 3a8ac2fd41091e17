"""Somebody else's scenario as a folder of its own: complete, with all that the bench knows of it, for anybody to run.

scenario.sumocfg        window, step, teleport and every other option, by names that hold wherever the folder lies
the input files         unchanged, but for the files that they name, and what they want written, or left off the record
NET.turns.xml           turning fractions, as the routes have them, or the ways that SUMO finds
NET.calibration.json    the model's parameters, where they have been fitted
detectors.add.xml       our detectors: no part of the scenario, since every run brings its own
model.json, map.png     the bench's view of the net
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from utn_sumo import calibration, case, detectors, inspection, network, plots, quiet, recording, routes, streets, study
from utn_sumo.case import Case
from utn_sumo.contract import Network
from utn_sumo.network import Traffic
from utn_sumo.xml_files import stem

SCENARIO, DETECTORS, MODEL, MAP = "scenario.sumocfg", "detectors.add.xml", "model.json", "map.png"
TURNS, FITTED = ".turns.xml", ".calibration.json"
"""Endings of what goes with a net under its name."""
CALIBRATED_AT = (1.0,)
"""Demands of the runs that a calibration is made from: the scenario's own."""


@dataclass(frozen=True)
class Import:
    """A case that can be used, and what drives in it."""

    case: Case
    traffic: Traffic


def read(path: Path) -> Import:
    """Read a .sumocfg with its net and its routes. Raises UtnError with one line if any of them can't be used."""
    chosen = case.read(path)
    traffic = routes.read(chosen)
    routes.check(chosen, traffic)
    streets.controllable(chosen)
    return Import(chosen, traffic)


def write(found: Import, folder: Path) -> dict[str, Any]:
    """Write it into an empty folder, and tell what is in it, in plain data under names with units."""
    chosen, traffic = found.case, found.traffic
    copies = _Copies(folder, chosen.net_file)
    _write_scenario(folder / SCENARIO, chosen, copies)
    turns, fitted = (_beside(folder / copies.net, ending) for ending in (TURNS, FITTED))
    for copy, ending in ((turns, TURNS), (fitted, FITTED)):
        if (original := _beside(chosen.net_file, ending)).is_file():
            shutil.copyfile(original, copy)
    net = _network(folder)
    if not turns.is_file():
        _write_turns(turns, net, chosen)
    detectors.write(net, folder / DETECTORS, net.control_step_s)
    recording.write_json(folder / MODEL, inspection.inspect(net))
    plots.network_map(net, network.shapes(net.net_file), (), folder / MAP)
    return {
        "scenario": str(folder / SCENARIO),
        "begin_s": chosen.begin_s,
        "end_s": chosen.end_s,
        "step_s": chosen.step_s,
        "teleport_s": chosen.teleport_s,
        "empty_at_begin": "load-state" not in dict(chosen.options),
        "controlled": [junction.id for junction in net.junctions],
        "left_alone": dict(net.left_alone),
        "links": len(net.links),
        "stages": len(net.stages),
        "control_step_s": net.control_step_s,
        "by_class_veh": dict(traffic.by_class_veh),
        "space_m": traffic.space_m,
        "without_route_veh": traffic.without_route_veh,
        "without_ends_veh": traffic.without_ends_veh,
        "turns": str(turns),
        "calibration": str(fitted) if fitted.is_file() else None,
        "files": {str(original): name for original, name in copies.names.items()},
        "out": str(folder),
    }


def calibrate(folder: Path, seeds: Sequence[int], tick: Callable[[], None]) -> Path:
    """Fit the model to runs of the scenario in a folder, `tick` after each, and put its parameters beside the net."""
    base = {"net": str(folder / SCENARIO), "calibration": "none"}
    with tempfile.TemporaryDirectory() as runs:
        content = study.study_calibration(base, CALIBRATED_AT, seeds, Path(runs), step_s=None, tick=tick)
    path = calibration.beside_net(_network(folder))
    recording.write_json(path, content)
    return path


def _network(folder: Path) -> Network:
    return streets.controllable(case.read(folder / SCENARIO))


def _beside(net_file: Path, ending: str) -> Path:
    """The file that goes with a net under its name."""
    return net_file.with_name(stem(net_file) + ending)


class _Copies:
    """The copies of input files in a folder, each under a name of its own."""

    def __init__(self, folder: Path, net_file: Path):
        self.folder = folder
        self.names: dict[Path, str] = {}
        """Of each original its copy."""
        self._taken = {SCENARIO, DETECTORS, MODEL, MAP}
        self.net = self.mended(net_file)
        self._taken |= {_beside(Path(self.net), ending).name for ending in (TURNS, FITTED)}

    def of(self, path: Path) -> str:
        """Copy a file, once, and return its name in the folder."""
        return self._copied(path, shutil.copyfile)

    def mended(self, path: Path) -> str:
        """Copy a file of elements: what they have SUMO write goes nowhere, what they read is copied too."""
        return self._copied(path, self._mend)

    def _copied(self, path: Path, copy: Callable[[Path, Path], Any]) -> str:
        original = path.resolve()
        if original not in self.names:
            first, _, rest = path.name.partition(".")
            name = next(
                each for n in count(1) if (each := path.name if n == 1 else f"{first}-{n}.{rest}") not in self._taken
            )
            self._taken.add(name)
            self.names[original] = name
            copy(original, self.folder / name)
        return self.names[original]

    def _mend(self, original: Path, target: Path) -> None:
        tree = quiet.parsed(original)
        # Route files may be large: only what may need it is read as a whole.
        if tree is None:
            shutil.copyfile(original, target)
            return
        quiet.mend(tree, original, included=self.mended, read=self.of)
        quiet.write(tree, target)


def _write_scenario(path: Path, chosen: Case, copies: _Copies) -> None:
    read = {"net-file": copies.net}
    if chosen.route_files:
        read["route-files"] = ",".join(copies.mended(each) for each in chosen.route_files)
    if chosen.additional_files:
        read["additional-files"] = ",".join(copies.mended(each) for each in chosen.additional_files)
    read |= {name: ",".join(map(copies.of, files)) for name, files in chosen.further_files.items()}
    ends = {} if chosen.end_s is None else {"end": case.in_digits(chosen.end_s)}
    sections = {
        "input": read,
        "time": {"begin": case.in_digits(chosen.begin_s), **ends},
        "processing": {name: value for name, value in chosen.options if name not in read},
        "random_number": dict(chosen.seeds),
    }
    root = ET.Element("configuration")
    # A section without options SUMO takes for an option without a value.
    for name, options in ((name, options) for name, options in sections.items() if options):
        section = ET.SubElement(root, name)
        for option, value in options.items():
            ET.SubElement(section, option, value=value)
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


def _write_turns(path: Path, net: Network, chosen: Case) -> None:
    root = ET.Element("data")
    end_s = chosen.begin_s + routes.DAY_S if chosen.end_s is None else chosen.end_s
    times = {"begin": case.in_digits(chosen.begin_s), "end": case.in_digits(end_s)}
    interval = ET.SubElement(root, "interval", {"id": "turning", **times})
    for turn in net.turns:
        share = {"from": net.links[turn.link].edges[-1], "to": turn.to_edge, "probability": repr(turn.fraction)}
        ET.SubElement(interval, "edgeRelation", share)
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
