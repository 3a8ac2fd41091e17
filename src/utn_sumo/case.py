"""Other people's SUMO scenarios: what a .sumocfg says, as far as it decides what happens on the road.

What SUMO is to write and to show is left out; that is ours to say.
"""

from __future__ import annotations

import hashlib
import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from utn_sumo.errors import SettingError
from utn_sumo.xml_files import opened

SUFFIX = ".sumocfg"
DEFAULT_TELEPORT_S = 300.0
"""SUMO's own."""
ABOUT_OUTPUT = frozenset({"output", "report", "gui_only"})
"""Sections of a configuration that say what SUMO writes and shows."""
SHOWN = frozenset({"log", "error-log", "message-log", "no-step-log", "no-warnings", "verbose", "gui-settings-file"})
SHOWN |= {"duration-log.disable", "duration-log.statistics", "print-options", "aggregate-warnings"}
SHOWN |= {"human-readable-time", "precision"}
"""Options that say so wherever they stand: SUMO does not look at sections."""
WRITTEN = re.compile(
    r".*output|(netstate|ndump|summary|tripinfo|vehroutes?|save-\w+)\b"
    r"|device\.((ssm|toc)\.file|tripinfo\.(explicit|deterministic))$|pedestrian\.jupedsim\.(wkt|py)$"
)
"""Options that have SUMO write files, by older names too, or write of some vehicles alone."""
NOWHERE = "NUL"
"""The file that SUMO writes nothing to."""
LEFT = frozenset({"max-depart-delay", "max-num-teleports", "remote-port", "num-clients"})
LEFT |= {"xml-validation", "xml-validation.net", "xml-validation.routes"}
"""Options that no run has: who waits long to enter goes on waiting, since a controller that keeps more vehicles out
would look better without them, as one would that ends its run early; nobody else's programme steers SUMO; and our own
files name no schema."""
RECORDED = "device.tripinfo.probability"
"""Option by which trips are left off the record: every trip is on it. SUMO still draws a number for each vehicle where
it is said, so that who has other devices stays the same."""
SEEDS = frozenset({"seed", "random"})
OURS = frozenset({"net-file", "route-files", "additional-files", "begin", "end", *SEEDS})
"""Options that other fields of a `Case` stand for."""
TABLES = ("astar.all-distances", "astar.landmark-distances", "device.ssm.filter-edges.input-file")
FILES = ("weight-files", "load-state", "device.fcd-replay.files", *TABLES)
"""Further options that name files to read, of XML but for `TABLES`."""
LONG = {"n": "net-file", "r": "route-files", "a": "additional-files", "b": "begin", "e": "end", "w": "weight-files"}
LONG |= {"net": "net-file", "routes": "route-files", "additional": "additional-files", "weights": "weight-files"}
LONG |= {"W": "no-warnings", "v": "verbose", "l": "log", "p": "print-options", "C": "save-configuration"}
LONG |= {"H": "human-readable-time", "t": "duration-log.statistics", "X": "xml-validation"}
"""SUMO's short and older names of options."""
ON = frozenset({"1", "yes", "true", "on", "x", "t"})
"""What SUMO takes for switched on, in letters of any case."""
UNITS_S = (1.0, 60.0, 3600.0, 86400.0)


@dataclass(frozen=True)
class Case:
    """A net with its demand and its window of time."""

    file: Path
    net_file: Path
    route_files: tuple[Path, ...]
    additional_files: tuple[Path, ...]
    begin_s: float
    end_s: float | None
    """None: until everybody has arrived."""
    teleport_s: float
    """Time that a vehicle stands before SUMO takes it out of the way; none is ever where it is not positive."""
    options: tuple[tuple[str, str], ...]
    """Whatever else it says of SUMO's options, as (name, value); files among them as paths that hold from here."""
    seeds: tuple[tuple[str, str], ...] = ()
    """What it says of chance, likewise: a run of ours has a seed of its own."""
    called: frozenset[str] = frozenset()
    """Vehicles that depart when somebody calls for them, by id; none as long as nobody has read its routes."""

    @property
    def step_s(self) -> float:
        """Length of SUMO's steps."""
        return seconds(dict(self.options).get("step-length", "1"))

    def switches_on(self, name: str) -> bool:
        """Whether it has an option that is on or off switched on."""
        return dict(self.options).get(name, "").strip().lower() in ON

    @property
    def scale(self) -> float:
        """How many of each of its vehicles drive."""
        return float(dict(self.options).get("scale", "1"))

    @property
    def further_files(self) -> dict[str, tuple[Path, ...]]:
        """Files that its options name, by option."""
        said = dict(self.options)
        return {name: tuple(map(Path, said[name].split(","))) for name in FILES if name in said}

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that it reads but the .sumocfg itself."""
        further = (path for paths in self.further_files.values() for path in paths)
        return (self.net_file, *self.route_files, *self.additional_files, *further)

    def record(self) -> dict[str, Any]:
        """It as plain data, for a run's settings: files by their absolute paths, and what was in them by SHA-256."""
        return {
            "file": str(self.file.resolve()),
            "net_file": str(self.net_file.resolve()),
            "route_files": [str(path.resolve()) for path in self.route_files],
            "additional_files": [str(path.resolve()) for path in self.additional_files],
            "begin_s": self.begin_s,
            "end_s": self.end_s,
            "step_s": self.step_s,
            "teleport_s": self.teleport_s,
            "options": {
                **dict(self.options),
                **{name: _joined(path.resolve() for path in paths) for name, paths in self.further_files.items()},
            },
            "sha256": {str(path.resolve()): digest(path) for path in self.files},
        }

    @classmethod
    def recorded(cls, content: Mapping[str, Any]) -> Case:
        """The case of such a record. Raises KeyError or TypeError if it is none."""
        return cls(
            file=Path(content["file"]),
            net_file=Path(content["net_file"]),
            route_files=tuple(map(Path, content["route_files"])),
            additional_files=tuple(map(Path, content["additional_files"])),
            begin_s=float(content["begin_s"]),
            end_s=content["end_s"],
            teleport_s=float(content["teleport_s"]),
            options=tuple(content["options"].items()),
        )

    def arguments(self, additional: list[Path]) -> list[str]:
        """SUMO's arguments for it, with further additional files."""
        files = [*self.additional_files, *additional]
        words = ["--net-file", str(self.net_file), "--begin", in_digits(self.begin_s)]
        if self.route_files:
            words += ["--route-files", _joined(self.route_files)]
        if files:
            words += ["--additional-files", _joined(files)]
        if self.end_s is not None:
            words += ["--end", in_digits(self.end_s)]
        # The device writes a file for each vehicle that has it, even where nobody names one.
        words += ["--device.ssm.file", NOWHERE]
        return [*words, *(word for name, value in self.options for word in (f"--{name}", value))]


def read(path: Path) -> Case:
    """Read a .sumocfg. Raises SettingError with one line if it can't be used."""
    if "," in str(path.resolve()):
        raise SettingError(
            f"scenario {str(path)!r} lies under a name with a comma, which SUMO parts lists at: rename it"
        )
    said = _said(path)
    if "net-file" not in said:
        raise SettingError(f"scenario {str(path)!r} names no net-file: give a whole .sumocfg")
    found = {name: _files(path, name, said.get(name, "")) for name in ("net-file", "route-files", "additional-files")}
    if len(found["net-file"]) != 1:
        raise SettingError(f"scenario {str(path)!r}: net-file is {said['net-file']!r}: name one file")
    for name in FILES:
        if name in said:
            said[name] = _joined(_files(path, name, said[name]))
    if said.get("load-state") and not {"load-state.offset", "begin"} <= said.keys():
        said["begin"] = _saved_s(path, Path(said["load-state"].split(",")[0]))
    begin_s, end_s = _window_s(path, said)
    if not _seconds(path, "step-length", said.get("step-length", "1")) > 0:
        raise SettingError(f"scenario {str(path)!r}: step-length is {said['step-length']!r}: make it more than 0 s")
    if not _is_number(said.get("scale", "1")):
        raise SettingError(f"scenario {str(path)!r}: scale is {said['scale']!r}: give a number from 0 on")
    return Case(
        file=path,
        net_file=found["net-file"][0],
        route_files=found["route-files"],
        additional_files=found["additional-files"],
        begin_s=begin_s,
        end_s=end_s,
        teleport_s=_seconds(path, "time-to-teleport", said.get("time-to-teleport", str(DEFAULT_TELEPORT_S))),
        options=tuple((name, value) for name, value in said.items() if name not in OURS),
        seeds=tuple((name, value) for name, value in said.items() if name in SEEDS),
    )


def elements(
    path: Path, name: str = "file", remedy: str = "give whole XML without entities", within: tuple[Path, ...] = ()
) -> Iterator[Element]:
    """The elements at the top of an XML file (.gz too), one by one; each is gone when the next is read.

    A file that it includes stands in its place, as in SUMO; `within` are the files that include this one. Raises
    SettingError under the given name if a file can't be opened, is cut off, includes itself, or declares entities,
    which could blow up.
    """
    from defusedxml import ElementTree  # noqa: PLC0415
    from defusedxml.common import DefusedXmlException  # noqa: PLC0415

    if path.resolve() in within:
        raise SettingError(f"{name} {str(path)!r} includes itself: {remedy}")
    try:
        with opened(path) as file:
            above: list[Element] = []
            for event, element in ElementTree.iterparse(file, events=("start", "end"), forbid_dtd=True):
                if event == "start":
                    above.append(element)
                    continue
                above.pop()
                if element.tag == "include":
                    included = path.parent / element.get("href", "")
                    yield from elements(included, name, remedy, (*within, path.resolve()))
                elif len(above) == 1:
                    yield element
                    above[0].clear()
    except (OSError, EOFError, zlib.error, ElementTree.ParseError, DefusedXmlException, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SettingError(f"{name} {str(path)!r} can't be read ({reason}): {remedy}") from error


def digest(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def in_digits(time_s: float) -> str:
    """A time for SUMO, to the millisecond that it knows."""
    return f"{round(time_s, 3):.15g}"


def seconds(text: str) -> float:
    """A time as SUMO writes it: seconds, or hours, minutes and seconds (and days before them) with colons.

    Raises ValueError if it is none.
    """
    parts = [float(part) for part in text.split(":")]
    if len(parts) > len(UNITS_S) or not all(map(math.isfinite, parts)):
        raise ValueError(text)
    return sum(part * unit for part, unit in zip(reversed(parts), UNITS_S, strict=False))


def _said(path: Path) -> dict[str, str]:
    """The options that count, by their long names."""
    said: dict[str, str] = {}
    for section in elements(path, "scenario", "give a .sumocfg"):
        for option in [section, *section]:
            name, value = LONG.get(option.tag, option.tag), option.get("value", option.get("v"))
            if value is None or section.tag in ABOUT_OUTPUT or name in SHOWN | LEFT or WRITTEN.match(name):
                continue
            said[name] = "1" if name == RECORDED else value
    return said


def _saved_s(path: Path, state: Path) -> str:
    """When a state was saved: SUMO goes on from there, whatever `begin` says."""
    from defusedxml import ElementTree  # noqa: PLC0415

    with opened(state) as file:
        _, snapshot = next(ElementTree.iterparse(file, events=("start",), forbid_dtd=True))
    if snapshot.get("time") is None:
        raise SettingError(
            f"scenario {str(path)!r} names {str(state)!r} as load-state, which is none: give one of SUMO's"
        )
    return str(snapshot.get("time"))


def _window_s(path: Path, said: Mapping[str, str]) -> tuple[float, float | None]:
    begin_s, end_s = (_seconds(path, name, said.get(name, usual)) for name, usual in (("begin", "0"), ("end", "-1")))
    if 0 <= end_s <= begin_s:
        raise SettingError(f"scenario {str(path)!r}: end is {said['end']!r}, not after its begin: make it later")
    return begin_s, end_s if end_s >= 0 else None


def _seconds(path: Path, name: str, text: str) -> float:
    try:
        return seconds(text)
    except ValueError as error:
        raise SettingError(f"scenario {str(path)!r}: {name} is {text!r}, which is no time in seconds") from error


def _is_number(text: str) -> bool:
    try:
        return 0 <= float(text) < math.inf
    except ValueError:
        return False


def _files(path: Path, name: str, text: str) -> tuple[Path, ...]:
    """The files that an option names, from the folder of its .sumocfg; SUMO would read whatever is in them."""
    found = tuple(path.parent / word.strip() for word in text.split(",") if word.strip())
    for each in found:
        if not each.is_file():
            what = "that is a folder" if each.is_dir() else "there is no such file"
            raise SettingError(f"scenario {str(path)!r} names {str(each)!r} as {name}: {what}, mend its path")
        for _ in () if name in TABLES else elements(each, name):
            pass
    return found


def _joined(paths: Iterable[Path]) -> str:
    return ",".join(map(str, paths))
