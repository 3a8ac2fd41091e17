"""What the detectors show at one moment, read all at once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np

from utn_sumo.contract import Bools, Floats, Ints, Network, View
from utn_sumo.detectors import DetectorIds
from utn_sumo.plant.heads import Heads


class Eyes:
    """Reads the lane-area detectors and the counting loops of a network."""

    def __init__(self, network: Network, ids: DetectorIds):
        self._groups = len(network.groups)
        self._links = len(network.links)
        self._group_link = network.group_link
        share = np.bincount(network.turn_group, network.fraction, self._groups)
        self._share = share / np.maximum(np.bincount(self._group_link, share, self._links), 1e-9)[self._group_link]
        """(G,) of a link's traffic what takes the lanes of each group."""
        self._areas, self._area_group = _flat(ids.group)
        self._before, self._before_link = _flat(ids.upstream)
        self._entries, self._entry_link = _flat([(*a, *b) for a, b in zip(ids.entry, ids.joining, strict=True)])
        turn_exits = [
            [name for turn in np.flatnonzero(network.turn_link == link) for name in ids.turn[turn]]
            for link in range(self._links)
        ]
        self._exits, self._exit_link = _flat([(*a, *b) for a, b in zip(turn_exits, ids.parting, strict=True)])
        self._step_s = network.control_step_s
        self.x_veh = np.zeros(self._links)
        """(Z,) vehicles on each link when the control step began."""

    def look(self, sumo: Any, time_s: float, heads: Heads, free: Bools) -> View:
        """The view at this moment. `sumo` is libsumo."""
        area, loop = sumo.lanearea, sumo.inductionloop
        return View(
            time_s=time_s,
            stage=heads.stage.copy(),
            free=free,
            waiting_veh=self._by_group(area.getLastStepHaltingNumber),
            near_veh=self._by_group(area.getLastStepVehicleNumber),
            x_veh=self._now_veh(time_s, loop.getIntervalVehicleNumber),
        )

    def _now_veh(self, time_s: float, counted: Any) -> Floats:
        if time_s % self._step_s == 0:
            return self.x_veh
        entered = np.bincount(self._entry_link, [counted(name) for name in self._entries], self._links)
        left = np.bincount(self._exit_link, [counted(name) for name in self._exits], self._links)
        return np.asarray(np.maximum(self.x_veh + entered - left, 0.0))

    def _by_group(self, getter: Any) -> Floats:
        """(G,) a count by lane group; who is before the lanes part is shared out as the traffic is."""
        own = np.bincount(self._area_group, [getter(name) for name in self._areas], self._groups)
        before = np.bincount(self._before_link, [getter(name) for name in self._before], self._links)
        return np.asarray(own + before[self._group_link] * self._share)


def _flat(groups: Sequence[Sequence[str]]) -> tuple[list[str], Ints]:
    """All names one after the other, and which group each is of."""
    counts = [len(group) for group in groups]
    return list(chain.from_iterable(groups)), np.repeat(np.arange(len(groups)), counts).astype(np.int64)
