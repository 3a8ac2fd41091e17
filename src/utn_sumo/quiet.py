"""Input files of a scenario that have SUMO write others, which go nowhere, or leave trips off the record."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from utn_sumo.case import NOWHERE, Case
from utn_sumo.xml_files import opened

WRITES = {"timedEvent": "dest", "calibrator": "output"} | dict.fromkeys(
    (
        *("inductionLoop", "e1Detector", "instantInductionLoop", "laneAreaDetector", "e2Detector", "entryExitDetector"),
        *("e3Detector", "edgeData", "laneData", "meandata", "routeProbe", "vTypeProbe"),
    ),
    "file",
)
"""Elements of additional files that have SUMO write a file, and the attribute that names it."""
PARAMETERS = dict.fromkeys(("file", "device.ssm.file", "device.toc.file"), NOWHERE)
"""Keys of parameters that have signals and devices write a file, and what they are to say."""
PARAMETERS |= {"has.tripinfo.device": "true", "device.tripinfo.probability": "1"}
"""Those by which a vehicle's trip may be on no record."""
SIGNS = re.compile(
    rb"<include|(?<![\w.-])(file|dest|output)\s*(=|$)|[\"'](%b)[\"']" % "|".join(map(re.escape, PARAMETERS)).encode()
)
"""What a file holds that names other files, or one of these."""


def parsed(path: Path) -> Any | None:
    """The tree of an XML file that may name other files; None for one that does not, which is not read as a whole."""
    from defusedxml import ElementTree  # noqa: PLC0415

    with opened(path) as file:
        if not any(map(SIGNS.search, file)):
            return None
    with opened(path) as file:
        return ElementTree.parse(file, forbid_dtd=True)


def mend(tree: Any, original: Path, *, included: Callable[[Path], str], read: Callable[[Path], str]) -> bool:
    """Turn what a tree writes to nowhere, put every trip on record, and name what it includes and reads anew; whether
    it had to be changed.

    `included` and `read` give the new name of a file that lies where the `original` has it.
    """
    changed = False
    for element in tree.iter():
        written = WRITES.get(element.tag, "")
        names = "href" if element.tag == "include" else "file"
        if written in element.attrib:
            element.set(written, NOWHERE)
            changed = True
        elif element.tag == "param" and element.get("key") in PARAMETERS:
            element.set("value", PARAMETERS[element.get("key")])
            changed = True
        elif (original.parent / element.get(names, "")).is_file():
            inside = original.parent / element.get(names)
            element.set(names, included(inside) if element.tag == "include" else read(inside))
            changed = changed or element.tag == "include"
    return changed


def write(tree: Any, target: Path) -> None:
    """Write a tree, packed where the name says so."""
    with gzip.open(target, "wb") if target.suffix == ".gz" else target.open("wb") as file:
        tree.write(file, encoding="utf-8", xml_declaration=True)


def silenced(chosen: Case, folder: Path) -> Case:
    """The case with copies in `folder` of those of its files that say what SUMO is to write."""
    copies: dict[Path, Path] = {}

    def copied(path: Path) -> Path:
        """The file itself where it writes nothing."""
        if path not in copies:
            tree = parsed(path)
            copies[path] = path
            if tree is not None and mend(tree, path, included=included, read=lambda inside: str(inside.resolve())):
                copies[path] = folder / f"quiet-{len(copies)}-{path.name}"
                write(tree, copies[path])
        return copies[path]

    def included(path: Path) -> str:
        return str(copied(path).resolve())

    return replace(
        chosen,
        net_file=copied(chosen.net_file),
        route_files=tuple(map(copied, chosen.route_files)),
        additional_files=tuple(map(copied, chosen.additional_files)),
    )
