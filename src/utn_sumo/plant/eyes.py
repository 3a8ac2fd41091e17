"""What the detectors show at one moment, each read when somebody asks for it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from utn_sumo.contract import ZONES_M, Bools, Floats, Ints, Network
from utn_sumo.detectors import DetectorIds
from utn_sumo.plant.heads import Heads


class Eyes:
    """Reads the lane-area detectors and the loops of a network."""

    def __init__(self, network: Network, ids: DetectorIds, sumo: Any):
        """`sumo` is libsumo."""
        self._groups = len(network.groups)
        self._links = len(network.links)
        self._group_link = network.group_link
        self._share = network.group_shares(network.fraction)
        """(G,) of a link's traffic what takes the lanes of each group."""
        self._areas, self._area_group = _flat(ids.group)
        self._before, self._before_link = _flat(ids.upstream)
        self._all_areas = [*self._areas, *self._before]
        self._zones, self._zone_place = _flat(list(chain.from_iterable(ids.group_zone)))
        """Detectors of zones, and the place of each in (G, zones) that is made flat."""
        self._before_zones, self._before_zone_place = _flat(list(chain.from_iterable(ids.upstream_zone)))
        self._entries, self._entry_link = _flat([(*a, *b) for a, b in zip(ids.entry, ids.joining, strict=True)])
        turn_exits = [
            [name for turn in np.flatnonzero(network.turn_link == link) for name in ids.turn[turn]]
            for link in range(self._links)
        ]
        self._exits, self._exit_link = _flat([(*a, *b) for a, b in zip(turn_exits, ids.parting, strict=True)])
        self._group_areas = ids.group
        self._group_before = [ids.upstream[link] for link in self._group_link]
        self._group_stop_line = ids.group_stop_line
        self._step_s = network.control_step_s
        self._halting = sumo.lanearea.getLastStepHaltingNumber
        self._present = sumo.lanearea.getLastStepVehicleNumber
        self._counted = sumo.inductionloop.getIntervalVehicleNumber
        self._counted_last = sumo.inductionloop.getLastIntervalVehicleNumber
        self._since_s = sumo.inductionloop.getTimeSinceDetection
        self._x_veh = np.zeros(self._links)
        """(Z,) vehicles on each link when the control step began."""
        self._entered_veh = np.zeros(self._links)
        self._left_veh = np.zeros(self._links)
        """(Z,) vehicles that had come onto each link by then, and that had left it."""
        self._seen_s = -np.inf
        self._seen_veh: list[int] = []
        """When the lane-area detectors were last looked at for who is there, and what each of them showed."""

    def begin(self, time_s: float, x_veh: Floats) -> None:
        """A control step begins, with so many vehicles on each link (Z,)."""
        self._x_veh = x_veh
        if time_s > 0:
            self._entered_veh = self._entered_veh + self._by_link(self._counted_last, self._entries, self._entry_link)
            self._left_veh = self._left_veh + self._by_link(self._counted_last, self._exits, self._exit_link)

    def waiting_veh(self, time_s: float) -> Floats:
        """(G,) standing in the lane-area detectors."""
        if time_s != self._seen_s:
            return self._by_group(list(map(self._halting, self._all_areas)))
        # Nobody stands where nobody is.
        seen = zip(self._all_areas, self._seen_veh, strict=True)
        return self._by_group([veh and self._halting(name) for name, veh in seen])

    def near_veh(self, time_s: float) -> Floats:
        """(G,) in the lane-area detectors, moving or not."""
        self._seen_veh = list(map(self._present, self._all_areas))
        self._seen_s = time_s
        return self._by_group(self._seen_veh)

    def zone_veh(self) -> Floats:
        """(G, zones) vehicles by how far they are from the stop line; who is before the lanes part is shared out."""
        own = self._by_zone(self._zones, self._zone_place, self._groups)
        if not self._before_zones:
            return own
        before = self._by_zone(self._before_zones, self._before_zone_place, self._links)
        return np.asarray(own + before[self._group_link] * self._share[:, None])

    def crossed_veh(self, time_s: float) -> tuple[Floats, Floats]:
        """(Z,) that have come onto each link since the control step began, and (Z,) that have left it."""
        if time_s % self._step_s == 0:
            return np.zeros(self._links), np.zeros(self._links)
        entered = self._by_link(self._counted, self._entries, self._entry_link)
        return entered, self._by_link(self._counted, self._exits, self._exit_link)

    def total_veh(self, crossed_veh: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """The same since the run began."""
        return self._entered_veh + crossed_veh[0], self._left_veh + crossed_veh[1]

    def now_veh(self, crossed_veh: tuple[Floats, Floats]) -> Floats:
        """(Z,) vehicles on each link after so many have come and left in this control step."""
        return np.asarray(np.maximum(self._x_veh + crossed_veh[0] - crossed_veh[1], 0.0))

    def near_one_veh(self, group: int) -> float:
        """In the lane-area detectors of one lane group, moving or not."""
        own, before = self._group_areas[group], self._group_before[group]
        veh = float(sum(map(self._present, own)))
        return veh + float(self._share[group]) * sum(map(self._present, before)) if before else veh

    def gap_one_s(self, group: int) -> float:
        """Since a vehicle was last on the stop-line loops of one lane group."""
        return float(min(map(self._since_s, self._group_stop_line[group])))

    def _by_link(self, getter: Any, names: Sequence[str], link: Ints) -> Floats:
        return np.asarray(np.bincount(link, list(map(getter, names)), self._links), dtype=float)

    def _by_zone(self, names: Sequence[str], place: Ints, rows: int) -> Floats:
        """(rows, zones) vehicles that the detectors of zones count."""
        veh = np.bincount(place, list(map(self._present, names)), rows * len(ZONES_M))
        return np.asarray(veh, dtype=float).reshape(rows, len(ZONES_M))

    def _by_group(self, counts: Sequence[int]) -> Floats:
        """(G,) what all areas count, by lane group; who is before the lanes part is shared out as the traffic is."""
        own = np.asarray(np.bincount(self._area_group, counts[: len(self._areas)], self._groups), dtype=float)
        if not self._before:
            return own
        before = np.bincount(self._before_link, counts[len(self._areas) :], self._links)
        return np.asarray(own + before[self._group_link] * self._share)


class Sight:
    """The view at one moment (contract.View)."""

    def __init__(self, eyes: Eyes, heads: Heads, time_s: float, free: Bools):
        self.time_s = time_s
        self.stage = heads.stage.copy()
        self.begin_s = heads.begin_s.copy()
        self.free = free
        self.near_one_veh = eyes.near_one_veh
        self.gap_one_s = eyes.gap_one_s
        self._eyes = eyes

    @cached_property
    def waiting_veh(self) -> Floats:
        """(G,) standing in the lane-area detectors, by lane group."""
        return self._eyes.waiting_veh(self.time_s)

    @cached_property
    def near_veh(self) -> Floats:
        """(G,) in the lane-area detectors, moving or not, by lane group."""
        return self._eyes.near_veh(self.time_s)

    @cached_property
    def zone_veh(self) -> Floats:
        """(G, zones) vehicles by lane group and by how far they are from the stop line."""
        return self._eyes.zone_veh()

    @cached_property
    def x_veh(self) -> Floats:
        """(Z,) vehicles on each link: as estimated when the control step began, and counted since."""
        return self._eyes.now_veh(self._crossed_veh)

    @property
    def entered_veh(self) -> Floats:
        """(Z,) vehicles that have come onto each link since the run began, but for who starts on it."""
        return self._total_veh[0]

    @property
    def left_veh(self) -> Floats:
        """(Z,) vehicles that have left each link since the run began, but for who ends on it."""
        return self._total_veh[1]

    @cached_property
    def _crossed_veh(self) -> tuple[Floats, Floats]:
        return self._eyes.crossed_veh(self.time_s)

    @cached_property
    def _total_veh(self) -> tuple[Floats, Floats]:
        return self._eyes.total_veh(self._crossed_veh)


def _flat(groups: Sequence[Sequence[str]]) -> tuple[list[str], Ints]:
    """All names one after the other, and which group each is of."""
    counts = [len(group) for group in groups]
    return list(chain.from_iterable(groups)), np.repeat(np.arange(len(groups)), counts).astype(np.int64)
