"""Peers that SUMO brings itself: its own actuated signals, and fixed programmes that its tools compute.

A net keeps its stages, their order and its clearances. Its signals get programmes of a programID of their own from an
additional file, and nobody but SUMO touches them; everything else is as under `native`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self
from xml.etree import ElementTree as ET  # only to write

from pydantic import BaseModel, ConfigDict, Field, model_validator

from utn_sumo import controllers, native, streets, webster
from utn_sumo.case import Case, in_digits
from utn_sumo.contract import Network
from utn_sumo.plant.untouched import Look
from utn_sumo.scenario import Scenario


class Peer(BaseModel, ABC):
    """One of them, with its settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    min_green_s: int = Field(5, ge=1, le=120)
    """Least green of a stage for which the net names none (`minDur`): netconvert's `tls.min-dur`. SUMO's own
    actuation has it no longer than the programme shows the stage."""

    @abstractmethod
    def programmes(self, network: Network, chosen: Case) -> tuple[Network, list[ET.Element]]:
        """The programmes of its junctions, and the network with the cycles that they have. Raises UtnError."""


class Responsive(Peer):
    """A peer that ends greens itself."""

    max_green_s: int = Field(50, ge=1, le=3600)
    """Netconvert's `tls.max-dur`."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_green_s > self.max_green_s:
            raise ValueError(f"min_green_s is {self.min_green_s}, over max_green_s {self.max_green_s}: make it less")
        return self


class Actuated(Responsive):
    """SUMO's actuated signals: a green ends when nobody has passed its detectors for a while."""

    max_gap_s: float = Field(3.0, ge=0, le=60)
    """Time without a vehicle that ends a green: SUMO's default."""
    detector_gap_s: float = Field(2.0, ge=0, le=60)
    """Way from a detector to the stop line, in time at the speed limit: SUMO's default."""

    def programmes(self, network: Network, chosen: Case) -> tuple[Network, list[ET.Element]]:
        gaps = {"max-gap": self.max_gap_s, "detector-gap": self.detector_gap_s}
        return network, _responsive(network, "actuated", chosen.begin_s, self.max_green_s, gaps)


class DelayBased(Responsive):
    """SUMO's delay_based signals: a green goes on while vehicles that have lost time come nearer."""

    detector_range_m: float = Field(100.0, gt=0, le=10_000)
    """How far upstream vehicles are seen: SUMO's default."""
    min_time_loss_s: float = Field(1.0, ge=0, le=3600)
    """Time that a vehicle must have lost to prolong a green: SUMO's default."""

    def programmes(self, network: Network, chosen: Case) -> tuple[Network, list[ET.Element]]:
        seen = {"detectorRange": self.detector_range_m, "minTimeloss": self.min_time_loss_s}
        return network, _responsive(network, "delay_based", chosen.begin_s, self.max_green_s, seen)


class Webster(Peer):
    """Fixed programmes by SUMO's tlsCycleAdaptation.py: Webster's cycles and splits for the busiest hour's flows."""

    coordinated: ClassVar[bool] = False

    min_cycle_s: int = Field(50, ge=1, le=3600)
    """The tool's own least is 20 s, too short for most nets."""
    max_cycle_s: int = Field(120, ge=1, le=3600)
    """The tool's own most is 120 s too."""
    lost_time_s: int = Field(6, ge=0, le=60)
    """Of a stage, by start-up and clearance. The tool's 4 s make cycles too short: with 6 s there is up to 29 % less
    delay on `utn17`, cologne8 and ingolstadt7."""
    headway_s: float = Field(2.0, gt=0, le=60)
    """Between vehicles that leave a queue on one lane: the tool's default."""

    @model_validator(mode="after")
    def _ordered(self) -> Webster:
        if self.min_cycle_s > self.max_cycle_s:
            raise ValueError(f"min_cycle_s is {self.min_cycle_s}, over max_cycle_s {self.max_cycle_s}: make it less")
        return self

    def programmes(self, network: Network, chosen: Case) -> tuple[Network, list[ET.Element]]:
        wanted = webster.Wanted(**self.model_dump())
        network, green_s = webster.timed(network, chosen, wanted, coordinated=self.coordinated)
        return network, webster.fixed(network, green_s, chosen.begin_s)


class CoordinatedWebster(Webster):
    """Webster's splits in one cycle for all, with offsets by SUMO's tlsCoordinator.py."""

    coordinated: ClassVar[bool] = True


PEERS: Mapping[str, type[Peer]] = {
    "actuated": Actuated,
    "delay_based": DelayBased,
    "webster": Webster,
    "webster+offsets": CoordinatedWebster,
}


def run(
    scenario: Scenario, folder: Path | None = None, on_look: Callable[[float, float, Look], None] | None = None
) -> dict[str, Any]:
    """Run a scenario under one of the `PEERS`; see `native.measured`. Raises UtnError."""
    peer = controllers.made(scenario.controller, PEERS[scenario.controller], scenario.settings)
    chosen = native.of(scenario)
    network, logics = peer.programmes(streets.taken_over(chosen, peer.min_green_s), chosen)
    root = ET.Element("additional")
    root.extend(logics)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode") + "\n"
    return native.measured(scenario, chosen, network, folder, on_look, programmes=text)


RUNS = {native.NAME: native.run, **dict.fromkeys(PEERS, run)}
"""How to run a scenario by SUMO alone, by controller."""


def _responsive(
    network: Network, kind: str, begin_s: float, max_green_s: float, parameters: Mapping[str, float]
) -> list[ET.Element]:
    """Programmes of a type of SUMO's that ends greens itself, from the first stage on when the run begins."""
    logics = []
    for junction in network.junctions:
        logic = ET.Element("tlLogic", id=junction.id, type=kind, programID=webster.PROGRAM, offset=in_digits(begin_s))
        for name, value in parameters.items():
            ET.SubElement(logic, "param", key=name, value=f"{value:g}")
        for stage in (network.stages[index] for index in junction.stages):
            # A plan's least green is no more than the net's own programme shows; `minDur` may be more.
            least_s = max(stage.min_green_s, stage.least_green_s)
            least, most = (in_digits(green_s) for green_s in (least_s, max(least_s, max_green_s)))
            ET.SubElement(logic, "phase", duration=least, minDur=least, maxDur=most, state=stage.state)
            for state, seconds in stage.clearance:
                ET.SubElement(logic, "phase", duration=in_digits(seconds), state=state)
        logics.append(logic)
    return logics
