"""Who calls for green himself: people by buttons at crossings, bicycles and trams by detectors on lanes of theirs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from utn_sumo.clearances import GREEN
from utn_sumo.contract import Floats, Network
from utn_sumo.plant.functions import bare


class Buttons:
    """Reads them. A button is pressed as long as somebody stands or walks before it who wants to cross there."""

    def __init__(self, network: Network, detectors: Sequence[Sequence[str]], sumo: Any):
        """`detectors` (C,) on each caller's lanes; `sumo` is libsumo."""
        self._buttons = [
            (number, area, crossing)
            for number, (_, caller) in enumerate(network.callers)
            for area, crossing in caller.buttons
        ]
        self._of_junction: dict[int, list[tuple[int, str, str]]] = {}
        for index, caller in network.callers:
            self._of_junction.setdefault(index, []).extend((caller.letter, *button) for button in caller.buttons)
        self._areas = sorted({area for _, area, _ in self._buttons})
        self._detectors = [(number, name) for number, names in enumerate(detectors) for name in names]
        self._callers = len(network.callers)
        self._people = bare(sumo, "edge", "getLastStepPersonIDs")
        self._next_edge = bare(sumo, "person", "getNextEdge")
        self._present = bare(sumo, "lanearea", "getLastStepVehicleNumber")
        self.sumo_time_s = 0.0
        """Wall time so far in reading them."""

    def read(self) -> Floats:
        """(C,) of each caller how many buttons are pressed, and how many are close on its lanes."""
        called = np.zeros(self._callers)
        if not self._callers:
            return called
        started = time.perf_counter()
        wanted = {area: {self._next_edge(person) for person in self._people(area)} for area in self._areas}
        for number, area, crossing in self._buttons:
            called[number] += crossing in wanted[area]
        for number, name in self._detectors:
            called[number] += self._present(name)
        self.sumo_time_s += time.perf_counter() - started
        return called

    def pressed(self, junction: int, letters: str) -> bool:
        """Whether any button of a junction is pressed whose crossing has green among these letters of its signal."""
        started = time.perf_counter()
        pressed = any(
            self._next_edge(person) == crossing
            for letter, area, crossing in self._of_junction.get(junction, ())
            if letters[letter] in GREEN
            for person in self._people(area)
        )
        self.sumo_time_s += time.perf_counter() - started
        return pressed
