"""Other people's SUMO scenarios: what a .sumocfg says, as far as it decides what happens on the road.

What SUMO is to write and to show is left out; that is ours to say.
"""

from __future__ import annotations

import gzip
import math
from dataclasses import dataclass
from pathlib import Path

from utn_sumo.errors import SettingError

SUFFIX = ".sumocfg"
DEFAULT_TELEPORT_S = 300.0
"""SUMO's own."""
ABOUT_OUTPUT = frozenset({"output", "report", "gui_only"})
"""Sections of a configuration that say what SUMO writes and shows."""
OURS = frozenset({"net-file", "route-files", "additional-files", "begin", "end", "seed", "random"})
"""Options that the fields of a `Case` stand for, and the seed."""


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
    """Whatever else it says of SUMO's options, as (name, value)."""

    def arguments(self, additional: list[Path]) -> list[str]:
        """SUMO's arguments for it, with further additional files."""
        files = [*self.additional_files, *additional]
        words = ["--net-file", str(self.net_file), "--begin", f"{self.begin_s:g}"]
        if self.route_files:
            words += ["--route-files", ",".join(map(str, self.route_files))]
        if files:
            words += ["--additional-files", ",".join(map(str, files))]
        if self.end_s is not None:
            words += ["--end", f"{self.end_s:g}"]
        return [*words, *(word for name, value in self.options for word in (f"--{name}", value))]


def read(path: Path) -> Case:
    """Read a .sumocfg. Raises SettingError with one line if it can't be used."""
    from defusedxml import ElementTree  # noqa: PLC0415
    from defusedxml.common import DefusedXmlException  # noqa: PLC0415

    try:
        root = ElementTree.parse(path, forbid_dtd=True).getroot()
    except (OSError, ElementTree.ParseError, DefusedXmlException) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SettingError(f"scenario {str(path)!r} can't be read ({reason}): give a .sumocfg") from error
    said: dict[str, str] = {}
    for section in root:
        if section.tag in ABOUT_OUTPUT:
            continue
        for option in [section, *section]:
            value = option.get("value", option.get("v"))
            if value is not None:
                said[LONG.get(option.tag, option.tag)] = value
    if "net-file" not in said:
        raise SettingError(f"scenario {str(path)!r} names no net-file: give a whole .sumocfg")

    def files(name: str) -> tuple[Path, ...]:
        found = tuple(path.parent / word.strip() for word in said.get(name, "").split(",") if word.strip())
        for each in found:
            if not each.is_file():
                raise SettingError(f"scenario {str(path)!r} names {str(each)!r} as {name}: there is no such file")
            _check(each, name)
        return found

    end_s = _seconds(path, "end", said["end"]) if "end" in said else -1.0
    (net_file,) = files("net-file")
    return Case(
        file=path,
        net_file=net_file,
        route_files=files("route-files"),
        additional_files=files("additional-files"),
        begin_s=_seconds(path, "begin", said.get("begin", "0")),
        end_s=end_s if end_s >= 0 else None,
        teleport_s=_seconds(path, "time-to-teleport", said.get("time-to-teleport", str(DEFAULT_TELEPORT_S))),
        options=tuple((name, value) for name, value in said.items() if name not in OURS),
    )


def _check(path: Path, name: str) -> None:
    """Raise SettingError unless a file is whole XML that declares no entities: SUMO would read whatever it says."""
    from defusedxml import ElementTree  # noqa: PLC0415
    from defusedxml.common import DefusedXmlException  # noqa: PLC0415

    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            for _, element in ElementTree.iterparse(file, forbid_dtd=True):
                element.clear()
    except (OSError, EOFError, ElementTree.ParseError, DefusedXmlException) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SettingError(f"{name} {str(path)!r} can't be read ({reason}): give whole XML without entities") from error


LONG = {"n": "net-file", "r": "route-files", "a": "additional-files", "b": "begin", "e": "end"}
"""SUMO's short names of options, and the older `net`."""


def _seconds(path: Path, name: str, text: str) -> float:
    """A time as SUMO writes it: seconds, or hours, minutes and seconds (and days before them) with colons."""
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = [math.nan]
    if len(parts) > len(UNITS_S) or not all(map(math.isfinite, parts)):
        raise SettingError(f"scenario {str(path)!r}: {name} is {text!r}, which is no time in seconds")
    return sum(part * unit for part, unit in zip(reversed(parts), UNITS_S, strict=False))


UNITS_S = (1.0, 60.0, 3600.0, 86400.0)
