"""The shipped SUMO networks, as a data package found from a checkout and from a wheel alike."""

from __future__ import annotations

from pathlib import Path

_HERE = Path(__file__).resolve().parent


def names() -> list[str]:
    """Names of the shipped networks, sorted."""
    return sorted(path.name.removesuffix(".net.xml") for path in _HERE.glob("*.net.xml"))


def net_file(name: str) -> Path:
    """The SUMO network file of the shipped network `name`."""
    return _HERE / f"{name}.net.xml"


def turns_file(name: str) -> Path:
    """Its turning fractions, in SUMO's own edgeRelations format."""
    return _HERE / f"{name}.turns.xml"


def detectors_file(name: str) -> Path:
    """Its loops and lane-area detectors for a 120 s control step."""
    return _HERE / f"{name}.detectors.add.xml"
