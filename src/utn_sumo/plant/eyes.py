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

CLOSE_ZONES = 2
"""Who is in these, up to 50 m, is at the stop line within a few seconds."""


class Eyes:
    """Reads the lane-area detectors and the loops of a network."""

    def __init__(self, network: Network, ids: DetectorIds, sumo: Any):
        """`sumo` is libsumo."""
        self._groups = len(network.groups)
        self._links = len(network.links)
        self._group_link = network.group_link
        self._share = network.group_shares(network.fraction)
        """(G,) of a link's traffic what takes the lanes of each group."""
        # Detectors of a lane group, then of a link before its lanes part.
        junction = np.concatenate([network.link_junction[network.group_link], network.link_junction])
        self._is_shared = any(ids.upstream)
        self._areas = _Detectors([*ids.group, *ids.upstream], junction)
        self._zones = _Detectors(
            list(chain.from_iterable([*ids.group_zone, *ids.upstream_zone])), np.repeat(junction, len(ZONES_M))
        )
        self._entries = _Detectors(
            [(*a, *b) for a, b in zip(ids.entry, ids.joining, strict=True)], network.link_junction
        )
        # Counted at the stop line: who changes lanes just there is missed now and then, but loops are half as many.
        self._exits = _Detectors([*ids.group_stop_line, *ids.parting], junction)
        self._group_areas = ids.group
        self._group_before = [ids.upstream[link] for link in self._group_link]
        self._group_stop_line = ids.group_stop_line
        self._amid = ids.amid
        self._group_close = [list(chain.from_iterable(zones[:CLOSE_ZONES])) for zones in ids.group_zone]
        self._step_s = network.control_step_s
        self._halting = _bare(sumo, "lanearea", "getLastStepHaltingNumber")
        self._present = _bare(sumo, "lanearea", "getLastStepVehicleNumber")
        self._counted = _bare(sumo, "inductionloop", "getIntervalVehicleNumber")
        self._counted_last = _bare(sumo, "inductionloop", "getLastIntervalVehicleNumber")
        self._since_s = _bare(sumo, "inductionloop", "getTimeSinceDetection")
        self._x_veh = np.zeros(self._links)
        """(Z,) vehicles on each link when the control step began."""
        self._entered_veh = np.zeros(self._links)
        self._left_veh = np.zeros(self._groups)
        """(Z,) vehicles that had come onto each link by then, (G,) that had crossed each lane group's stop line."""

    def begin(self, time_s: float, x_veh: Floats) -> None:
        """A control step begins, with so many vehicles on each link (Z,)."""
        self._x_veh = x_veh
        if time_s > 0:
            self._entered_veh = self._entered_veh + self._entries.read(self._counted_last)
            self._left_veh = self._left_veh + self._exits.read(self._counted_last)[: self._groups]

    def waiting_veh(self) -> Floats:
        """(G,) standing in the lane-area detectors."""
        return self._by_group(self._areas.read(self._halting))

    def near_veh(self) -> Floats:
        """(G,) in the lane-area detectors, moving or not."""
        return self._by_group(self._areas.read(self._present))

    def zone_veh(self, junctions: Bools) -> tuple[Floats, Floats]:
        """(G, zones) and (Z, zones) of contract.View."""
        veh = self._zones.read(self._present, junctions).reshape(-1, len(ZONES_M))
        return veh[: self._groups], veh[self._groups :]

    def crossed_veh(self, time_s: float) -> tuple[Floats, Floats, Floats]:
        """What has been counted since the control step began.

        (Z,) who has come onto each link, (G,) left over each lane group's stop line, (Z,) left each link amid it.
        """
        if time_s % self._step_s == 0:
            return np.zeros(self._links), np.zeros(self._groups), np.zeros(self._links)
        left = self._exits.read(self._counted)
        return self._entries.read(self._counted), left[: self._groups], left[self._groups :]

    def total_veh(self, crossed_veh: tuple[Floats, Floats, Floats]) -> tuple[Floats, Floats]:
        """(Z,) that have come onto each link, (G,) that have left over stop lines since the run began."""
        return self._entered_veh + crossed_veh[0], self._left_veh + crossed_veh[1]

    def now_veh(self, crossed_veh: tuple[Floats, Floats, Floats]) -> Floats:
        """(Z,) vehicles on each link after so many have come and left in this control step."""
        came, over, parted = crossed_veh
        left = np.bincount(self._group_link, over, self._links) + parted
        return np.asarray(np.maximum(self._x_veh + came - left, 0.0))

    def near_one_veh(self, group: int) -> float:
        """In the lane-area detectors of one lane group, moving or not."""
        own, before = self._group_areas[group], self._group_before[group]
        veh = float(sum(map(self._present, own)))
        return veh + float(self._share[group]) * sum(map(self._present, before)) if before else veh

    def gap_one_s(self, group: int) -> float:
        """Since a vehicle was last on the stop-line loops of one lane group."""
        return float(min(map(self._since_s, self._group_stop_line[group])))

    def amid_veh(self, turn: int) -> float:
        """Of a turn that may wait amid the junction, on its lanes there."""
        return float(sum(map(self._present, self._amid[turn])))

    def close_veh(self, group: int) -> float:
        """In the zones of one lane group up to CLOSE_ZONES, moving or not."""
        return float(sum(map(self._present, self._group_close[group])))

    def _by_group(self, veh: Floats) -> Floats:
        """(G,) counts by lane group, of (G + Z,) with those before the lanes part, shared out as traffic is."""
        own = veh[: self._groups]
        if not self._is_shared:
            return own
        return np.asarray(own + veh[self._groups :][self._group_link] * self._share)


class _Detectors:
    """Detectors whose counts add up by place: by link, by lane group, or by zone of it."""

    def __init__(self, names: Sequence[Sequence[str]], junction: Ints):
        """`names` of those at each place, before which `junction` it is."""
        self._places = len(names)
        order = np.argsort(junction, kind="stable")
        counts = np.array([len(names[place]) for place in order], dtype=np.int64)
        self._place = np.repeat(order, counts)
        self._names = list(chain.from_iterable(names[place] for place in order))
        ends = np.cumsum(np.bincount(junction[order], counts)).astype(np.int64).tolist()
        self._parts = [
            (self._names[begin:end], [0] * (end - begin)) for begin, end in zip([0, *ends[:-1]], ends, strict=True)
        ]
        """Of each junction the names of its detectors, and as many that see nobody."""

    def read(self, getter: Any, junctions: Bools | None = None) -> Floats:
        """(places,) what a getter has; of `junctions` (J,) alone if they are said, 0 elsewhere."""
        if junctions is None:
            seen = list(map(getter, self._names))
        else:
            seen = []
            for asked, (names, nobody) in zip(junctions.tolist(), self._parts, strict=True):
                seen += map(getter, names) if asked else nobody
        return np.asarray(np.bincount(self._place, seen, self._places), dtype=float)


class Sight:
    """The view at one moment (contract.View)."""

    def __init__(self, eyes: Eyes, heads: Heads, time_s: float, free: Bools):
        self.time_s = time_s
        self.stage = heads.stage.copy()
        self.begin_s = heads.begin_s.copy()
        self.free = free
        self.near_one_veh = eyes.near_one_veh
        self.gap_one_s = eyes.gap_one_s
        self.zone_veh = eyes.zone_veh
        self._eyes = eyes

    @cached_property
    def waiting_veh(self) -> Floats:
        """(G,) standing in the lane-area detectors, by lane group."""
        return self._eyes.waiting_veh()

    @cached_property
    def near_veh(self) -> Floats:
        """(G,) in the lane-area detectors, moving or not, by lane group."""
        return self._eyes.near_veh()

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
        """(G,) vehicles that have left over the stop line of each lane group since the run began."""
        return self._total_veh[1]

    @cached_property
    def _crossed_veh(self) -> tuple[Floats, Floats, Floats]:
        return self._eyes.crossed_veh(self.time_s)

    @cached_property
    def _total_veh(self) -> tuple[Floats, Floats]:
        return self._eyes.total_veh(self._crossed_veh)


def _bare(sumo: Any, domain: str, getter: str) -> Any:
    """A getter of libsumo, without the function in Python about it where there is one: half of a reading's time."""
    module = getattr(getattr(sumo, "libsumo", None), "_libsumo", None)
    return getattr(module, f"{domain}_{getter}", None) or getattr(getattr(sumo, domain), getter)
