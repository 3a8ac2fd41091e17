"""What the detectors show at one moment, each read when somebody asks for it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cached_property, partial
from itertools import chain, compress, pairwise
from typing import Any

import numpy as np

from utn_sumo.compiling import compiled
from utn_sumo.contract import CLOSE_ZONES, EXIT, ZONES_M, Bools, Floats, Ints, Network
from utn_sumo.detectors import DetectorIds
from utn_sumo.plant.buttons import Buttons
from utn_sumo.plant.functions import bare
from utn_sumo.plant.heads import Heads
from utn_sumo.plant.hidden import Hidden

COMPARED_S = 10.0
"""Time between two looks at whether as many can be on a link as are counted."""


class Eyes:
    """Reads the lane-area detectors and the loops of a network."""

    def __init__(self, network: Network, ids: DetectorIds, sumo: Any):
        """`sumo` is libsumo."""
        self._groups = len(network.groups)
        self._sets = len(network.lane_sets)
        self._links = len(network.links)
        self._group_link = network.group_link
        self._share = network.group_shares(network.fraction)
        """(G,) of a link's traffic what takes the lanes of each group."""
        self._set_link = network.set_link
        self._set_group = network.set_group
        # Detectors of a lane set, then of a link before its lanes part.
        by_set = np.concatenate([network.link_junction[network.set_link], network.link_junction])
        self._is_shared = any(ids.upstream)
        detectors = partial(_Detectors, junctions=len(network.junctions))
        self._areas = detectors([*ids.set_area, *ids.upstream], by_set)
        self._zones = detectors(
            list(chain.from_iterable([*ids.set_zone, *ids.upstream_zone])), np.repeat(by_set, len(ZONES_M))
        )
        self._far = detectors(_farthest(network, ids), network.link_junction)
        self._entries = detectors(
            [(*a, *b) for a, b in zip(ids.entry, ids.joining, strict=True)], network.link_junction
        )
        # Counted at the stop line: who changes lanes just there is missed now and then, but loops are half as many.
        self._exits = detectors([*ids.set_stop_line, *ids.parting], by_set)
        sides = len(network.side_roads)
        self._side_areas, self._side_lines = (
            _Detectors(names, np.arange(sides), sides) for names in (ids.side_area, ids.side_line)
        )
        self._group_areas = ids.group
        self._group_before = [ids.upstream[link] for link in self._group_link]
        self._group_stop_line = ids.group_stop_line
        self._amid = ids.amid
        self._ahead = [() if turn.next_link == EXIT else ids.entry[turn.next_link] for turn in network.turns]
        """(M,) entry loops of the link that each turn goes on to."""
        self._group_close: list[list[str]] = [[] for _ in network.groups]
        for group, zones in zip(network.set_group, ids.set_zone, strict=True):
            self._group_close[group] += chain.from_iterable(zones[:CLOSE_ZONES])
        self._set_close = [
            list(chain.from_iterable([*zones[:CLOSE_ZONES], *ids.upstream_zone[link][:CLOSE_ZONES]]))
            for link, zones in zip(self._set_link.tolist(), ids.set_zone, strict=True)
        ]
        self._buttons = Buttons(network, ids.calling, sumo)
        self._step_s = network.control_step_s
        self._halting = bare(sumo, "lanearea", "getLastStepHaltingNumber")
        self._present = bare(sumo, "lanearea", "getLastStepVehicleNumber")
        self._counted = bare(sumo, "inductionloop", "getIntervalVehicleNumber")
        self._counted_last = bare(sumo, "inductionloop", "getLastIntervalVehicleNumber")
        self._since_s = bare(sumo, "inductionloop", "getTimeSinceDetection")
        self._x_veh = np.zeros(self._links)
        """(Z,) vehicles on each link when the control step began."""
        self._hidden = Hidden(network, np.array([*map(any, zip(ids.joining, ids.parting, strict=True))]))
        self.uncounted_veh = np.zeros(self._links)
        """(Z,) of contract.Measurement, in the control step under way."""
        self._compared_s = -np.inf
        """When what is counted was last held against what is seen."""
        self._entered_veh = np.zeros(self._links)
        self._left_veh = np.zeros(self._sets)
        self._parted_veh = np.zeros(self._links)
        """(Z,) vehicles that had come onto each link by then, (L,) that had crossed each lane set's stop line, (Z,)
        that had left each link amid it."""
        self._side_left_veh = np.zeros(sides)
        """(R,) that had left each side road by then."""
        self._warm_up()

    def begin(self, time_s: float, x_veh: Floats) -> None:
        """A control step begins, with so many vehicles on each link (Z,)."""
        self._x_veh = np.array(x_veh, dtype=np.float64)
        self.uncounted_veh = np.zeros(self._links)
        if time_s > 0:
            self._entered_veh = self._entered_veh + self._entries.read(self._counted_last)
            left = self._exits.read(self._counted_last)
            self._left_veh = self._left_veh + left[: self._sets]
            self._parted_veh = self._parted_veh + left[self._sets :]
            self._side_left_veh = self._side_left_veh + self._side_lines.read(self._counted_last)

    @property
    def sumo_time_s(self) -> float:
        """Wall time so far inside SUMO's functions, in readings of many detectors at once."""
        readers = (
            self._areas, self._zones, self._far, self._entries, self._exits, self._buttons, self._side_areas,
            self._side_lines,
        )  # fmt: skip
        return sum(reader.sumo_time_s for reader in readers)

    def calling(self) -> Floats:
        """(C,) of contract.View."""
        return self._buttons.read()

    def pressed(self, junction: int, letters: str) -> bool:
        """Whether somebody waits at a junction to walk where there is green among these letters of its signal."""
        return self._buttons.pressed(junction, letters)

    def side_standing_veh(self, roads: Bools) -> Floats:
        """(R,) of contract.View."""
        return self._side_areas.read(self._halting, roads)

    def side_left_veh(self, time_s: float, roads: Bools) -> Floats:
        """(R,) of contract.View."""
        # Where a control step begins its counts have just been taken up, and SUMO's begin anew with the next second.
        since = self._side_lines.read(self._counted, roads) if time_s % self._step_s else 0.0
        return np.asarray(self._side_left_veh + since)

    def standing_veh(self) -> Floats:
        """(L + Z,) standing in the lane-area detectors of lane sets, and of links before their lanes part."""
        return self._areas.read(self._halting)

    def near_veh(self) -> Floats:
        """(G,) in the lane-area detectors, moving or not."""
        return self.by_group(self._areas.read(self._present))

    def by_group(self, veh: Floats) -> Floats:
        """(G,) counts by lane group, of (L + Z,) with those before the lanes part, shared out as traffic is."""
        own: Floats = np.bincount(self._set_group, veh[: self._sets], self._groups).astype(np.float64)
        if not self._is_shared:
            return own
        return np.asarray(own + veh[self._sets :][self._group_link] * self._share)

    def by_set(self, veh: Floats) -> Floats:
        """(L,) the same by lane set; of those before the lanes part each has what its lane group has."""
        own = veh[: self._sets]
        if not self._is_shared:
            return own
        return np.asarray(own + veh[self._sets :][self._set_link] * self._share[self._set_group])

    def zone_veh(self, junctions: Bools) -> tuple[Floats, Floats]:
        """(L, zones) and (Z, zones) of contract.View."""
        veh = self._zones.read(self._present, junctions).reshape(-1, len(ZONES_M))
        return veh[: self._sets], veh[self._sets :]

    def counted_veh(self, time_s: float) -> tuple[Floats, Floats, Floats, Floats]:
        """What has been counted by now.

        (Z,) vehicles on each link, and since the run began (Z,) that have come onto it, (L,) left over stop lines, (Z,)
        left amid it.
        """
        if time_s % self._step_s == 0:
            # What is counted on from is never handed out: a foreign execution may write into it.
            there, gone = np.maximum(self._x_veh, 0.0), (self._left_veh.copy(), self._parted_veh.copy())
            return there, self._entered_veh.copy(), *gone
        came, left = self._entries.read(self._counted), self._exits.read(self._counted)
        counted: tuple[Floats, Floats, Floats, Floats] = _counted(
            came, left, self._x_veh, self._entered_veh, self._left_veh, self._parted_veh, self._set_link
        )
        x_veh, entered_veh = counted[:2]
        self._hidden.note(time_s, entered_veh)
        if time_s >= self._compared_s + COMPARED_S:
            self._compared_s = time_s
            veh = self._areas.read(self._present)
            seen_veh = np.bincount(self._set_link, veh[: self._sets], self._links) + veh[self._sets :]
            can_be = self._hidden.correct(time_s, entered_veh, x_veh, seen_veh, self._far.read(self._present))
            self._x_veh += can_be - x_veh
            self.uncounted_veh += can_be - x_veh
            x_veh[:] = can_be
        return counted

    def close_one_veh(self, lane_set: int) -> float:
        """In the zones up to CLOSE_ZONES of one lane set, and before its lanes part, moving or not."""
        return float(sum(map(self._present, self._set_close[lane_set])))

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

    def standing_amid_veh(self, turn: int) -> float:
        """Of a turn that may wait amid the junction, standing or creeping on its lanes there."""
        return float(sum(map(self._halting, self._amid[turn])))

    def is_taken(self, turn: int) -> bool:
        """Whether somebody is on the entry loops of the road ahead: it is full, or has just let one more in."""
        return any(since_s <= 0 for since_s in map(self._since_s, self._ahead[turn]))

    def close_veh(self, group: int) -> float:
        """In the zones of one lane group up to CLOSE_ZONES, moving or not."""
        return float(sum(map(self._present, self._group_close[group])))

    def _warm_up(self) -> None:
        """Have the machine code made now, not at the first decision."""
        self._entries.read(lambda _: 0)
        left = np.zeros(self._sets + self._links)
        _counted(
            self._x_veh, left, self._x_veh, self._entered_veh, self._left_veh, self._parted_veh, self._set_link
        )  # fmt: skip
        self._hidden.correct(0.0, *[np.zeros(self._links)] * 4)


def _farthest(network: Network, ids: DetectorIds) -> list[list[str]]:
    """Detectors of the farthest zone of each link in sight, within which its lanes may part."""
    far = [list(zones[-1]) for zones in ids.upstream_zone]
    for link, zones in zip(network.set_link.tolist(), ids.set_zone, strict=True):
        far[link] += zones[-1]
    return far


class _Detectors:
    """Detectors whose counts add up by place: by link, by lane group, or by zone of it."""

    def __init__(self, names: Sequence[Sequence[str]], junction: Ints, junctions: int):
        """`names` of those at each place, before which `junction` of so many it is, or on which side road."""
        self._places = len(names)
        order = np.argsort(junction, kind="stable")
        counts = np.array([len(names[place]) for place in order], dtype=np.int64)
        self._place = np.repeat(order, counts)
        self._names = list(chain.from_iterable(names[place] for place in order))
        self._junction = np.repeat(junction[order], counts)
        ends = np.cumsum(np.bincount(self._junction, minlength=junctions)).tolist()
        self._of_junction = [self._names[begin:end] for begin, end in pairwise([0, *ends])]
        self._everywhere = np.ones(junctions, dtype=np.bool_)
        self.sumo_time_s = 0.0

    def read(self, getter: Any, junctions: Bools | None = None) -> Floats:
        """(places,) what a getter has; of `junctions` (J,) alone if they are said, 0 elsewhere."""
        names = self._names
        if junctions is not None:
            names = list(chain.from_iterable(compress(self._of_junction, junctions.tolist())))
        started = time.perf_counter()
        seen = np.fromiter(map(getter, names), np.float64, len(names))
        self.sumo_time_s += time.perf_counter() - started
        veh: Floats = _added(
            seen, self._junction, self._everywhere if junctions is None else junctions, self._place, self._places
        )
        return veh


@compiled
def _added(seen: Floats, junction: Ints, asked: Bools, place: Ints, places: int) -> Floats:
    """(places,) sums of what was `seen`, one after the other by the detectors before the junctions `asked` (J,).

    Of all detectors `junction` says before which each is, `place` where it counts.
    """
    veh, nth = np.zeros(places), 0
    for detector in range(len(place)):
        if asked[junction[detector]]:
            veh[place[detector]] += seen[nth]
            nth += 1
    return veh


@compiled
def _counted(
    came: Floats, left: Floats, x: Floats, entered: Floats, over: Floats, parted: Floats, set_link: Ints
) -> tuple[Floats, Floats, Floats, Floats]:
    """As Eyes.counted_veh, by who has `left` (L + Z,) over stop lines and amid links since the control step began."""
    sets = len(over)
    now, total = x + came - left[sets:], over + left[:sets]
    for lane_set, link in enumerate(set_link):
        now[link] -= left[lane_set]
    return np.maximum(now, 0.0), entered + came, total, parted + left[sets:]


class Sight:
    """The view at one moment (contract.View)."""

    def __init__(self, eyes: Eyes, heads: Heads, time_s: float, free: Bools):
        self.time_s = time_s
        self.stage = heads.stage.copy()
        self.begin_s = heads.begin_s.copy()
        self.free = free.copy()
        self.near_one_veh = eyes.near_one_veh
        self.close_one_veh = eyes.close_one_veh
        self.gap_one_s = eyes.gap_one_s
        self.zone_veh = eyes.zone_veh
        self.standing_amid_veh = eyes.standing_amid_veh
        self.side_standing_veh = eyes.side_standing_veh
        self.side_left_veh = partial(eyes.side_left_veh, time_s)
        self._eyes = eyes

    @property
    def waiting_veh(self) -> Floats:
        """(G,) standing in the lane-area detectors, by lane group."""
        return self._eyes.by_group(self._standing_veh)

    @property
    def set_waiting_veh(self) -> Floats:
        """(L,) the same by lane set."""
        return self._eyes.by_set(self._standing_veh)

    @cached_property
    def _standing_veh(self) -> Floats:
        return self._eyes.standing_veh()

    @cached_property
    def near_veh(self) -> Floats:
        """(G,) in the lane-area detectors, moving or not, by lane group."""
        return self._eyes.near_veh()

    @cached_property
    def calling(self) -> Floats:
        """(C,) of each caller how many of its buttons are pressed, and how many are close on its lanes."""
        return self._eyes.calling()

    @property
    def x_veh(self) -> Floats:
        """(Z,) vehicles on each link: as estimated when the control step began, and counted since."""
        return self._counted_veh[0]

    @property
    def entered_veh(self) -> Floats:
        """(Z,) vehicles that have come onto each link since the run began, but for who starts on it."""
        return self._counted_veh[1]

    @property
    def left_veh(self) -> Floats:
        """(L,) vehicles that have left over the stop line of each lane set since the run began."""
        return self._counted_veh[2]

    @property
    def parted_veh(self) -> Floats:
        """(Z,) vehicles that have left each link amid it since the run began."""
        return self._counted_veh[3]

    @cached_property
    def _counted_veh(self) -> tuple[Floats, Floats, Floats, Floats]:
        return self._eyes.counted_veh(self.time_s)
