"""Who has gone from each lane set since its junction was looked at last."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from utn_controllers.scheduled.standstill import Shown
from utn_sumo.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints, Network


class Gone(NamedTuple):
    """Of lane sets (L) before junctions that are looked at; of others it says nothing."""

    share: Floats
    """(L,) flow since the last look, of the saturation flow."""
    queued: Bools
    """(L,) whether somebody was by the stop line then."""
    since_s: Floats
    """(L,) how long ago that was."""
    idle_s: Floats
    """(L,) since when nobody has left though somebody is by the stop line."""


class Flows:
    """Keeps what it takes to know who has gone between two looks at a junction."""

    def __init__(self, network: Network):
        self._junction = network.link_junction[network.set_link]
        self._flow_veh_s = network.set_saturation_flow_veh_s
        sets = len(network.lane_sets)
        self._before_veh = np.zeros(sets)
        """(L,) who had left by the last look."""
        self._queued = np.zeros(sets, dtype=np.bool_)
        """(L,) where somebody was by the stop line then."""
        self._looked_s = np.zeros(sets)
        """(L,) when that was."""
        self._went_s = np.zeros(sets)
        """(L,) when somebody left, or nobody was by the stop line, last."""

    def look(self, view: Shown, asked: Bools, zone: Floats) -> Gone:
        """Who has gone before the junctions `asked` (J,), with those now in each `zone` (L, zones) of View.zone_veh."""
        return Gone(
            *_look(
                view.time_s, asked, view.left_veh, zone[:, 0], self._junction, self._flow_veh_s, self._before_veh,
                self._queued, self._looked_s, self._went_s,
            )
        )  # fmt: skip


@compiled
def _look(
    time_s: float, asked: Bools, left: Floats, near: Floats, junction: Ints, flow: Floats, before: Floats,
    by_line: Bools, looked_s: Floats, went_s: Floats,
) -> tuple[Floats, Bools, Floats, Floats]:  # fmt: skip
    share, since_s, idle_s = np.zeros((3, len(left)))
    queued = by_line.copy()
    for lane_set, own in enumerate(junction):
        if asked[own]:
            since_s[lane_set] = time_s - looked_s[lane_set]
            gone_veh = left[lane_set] - before[lane_set]
            if since_s[lane_set] > 0:
                share[lane_set] = gone_veh / (flow[lane_set] * since_s[lane_set])
            by_line[lane_set] = near[lane_set] >= 1
            if gone_veh > 0 or not by_line[lane_set]:
                went_s[lane_set] = time_s
            idle_s[lane_set] = time_s - went_s[lane_set]
            before[lane_set], looked_s[lane_set] = left[lane_set], time_s
    return share, queued, since_s, idle_s
