"""`scheduled`: every junction shows the beginning of the schedule that it makes anew every two seconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from utn_controllers.scheduled.calling import Calling
from utn_controllers.scheduled.ending import (
    Ending,
    ahead_bins,
    are_alone,
    are_apart,
    are_far,
    have_way,
    lost,
    lost_at_least,
)
from utn_controllers.scheduled.gaps import Giving
from utn_controllers.scheduled.moves import Moves, Rules
from utn_controllers.scheduled.outlook import Outlook
from utn_controllers.scheduled.parked import Parked
from utn_controllers.scheduled.programme import schedules
from utn_controllers.scheduled.rounds import Rounds
from utn_controllers.scheduled.sides import Sides
from utn_controllers.scheduled.standstill import Standstill
from utn_controllers.scheduled.streams import Streams
from utn_controllers.scheduled.within import Within
from utn_controllers.scheduled.worth import Worth
from utn_controllers.scheduled.yielding import Yielding
from utn_sumo.contract import ZONES_M, Bools, Floats, Ints, Network, Plan, State, View

BIN_S = 2
"""Length of a bin, and time between two decisions."""
SOONER_S = 1
"""After a decision by which a green ends with the bin it is looked so soon whether it has let go all that it will."""


class ScheduledSettings(BaseModel):
    """Settings of `scheduled`, found on the nets of tools/tuning_nets.py and `utn17` with seeds 1 to 3."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    order: Literal["any", "cycle"] = "any"
    """Any stage may come next, or only the one that the net's own cycle has next."""
    bounds: Literal["none", "plan"] = "none"
    """Whether a green lasts no longer than the plan has it where others wait."""
    horizon_s: float = Field(50.0, ge=10, le=200)
    """How far ahead a schedule goes [s], where clearances take little."""
    discharge: float = Field(1.2, gt=0, le=3)
    """Over the saturation flow, which is that of long queues with their start: what a queue leaves with."""
    crowding: float = Field(0.4, ge=0, le=20)
    """By how much waiting on a full link costs more than on an empty one, in vehicles."""
    blocking: float = Field(4.0, ge=0, le=20)
    """By how much more it costs in a queue that others have to wait behind, one link back, in vehicles."""
    starving: float = Field(1.5, ge=0, le=20)
    """By how much more it costs where nobody has been let go to the last one for two minutes, in shares."""
    full: float = Field(0.4, gt=0, le=2)
    """Share of its storage about which a link is fed less and less where lanes are seen together: beyond it some lane
    is full and stops all."""
    standstill_s: float = Field(8.0, ge=2, le=200)
    """How long a queue may have green and nobody go before others are served [s]."""


class Scheduled:
    """Carries a plan out, or does without, by schedules for the next minute."""

    Settings = ScheduledSettings
    lets_out = True

    def __init__(self, network: Network, **settings: float | str):
        self.network = network
        self.settings = ScheduledSettings(**settings)  # type: ignore[arg-type]
        self.every_s = BIN_S
        self._streams = Streams(network)
        self._sides = Sides(network, self._streams, BIN_S)
        self._calling = Calling(network, self._streams, self._sides)
        alone = are_alone(network, self._streams)
        moves = Moves(network, self._calling, BIN_S, alone)
        lost_bins, cleared_bins = (
            lost(self._streams.first_stage, bins, np.asarray(self._streams.serves.any(axis=1)))
            for bins in (moves.bins, moves.cleared_bins)
        )
        apart = are_apart(network, self._streams, alone)
        ahead = ahead_bins(
            are_far(network, self._streams),
            round(self.settings.horizon_s / BIN_S),
            lost_at_least(self._streams.first_stage, moves.bins, have_way(network, self._streams)),
        )
        bins = int(ahead.max())
        self._outlook = Outlook(network, self._streams, bins, BIN_S)
        self._worth = Worth(
            network,
            self._streams,
            crowding=self.settings.crowding,
            blocking=self.settings.blocking,
            starving=self.settings.starving,
            full=self.settings.full,
        )
        self._within = Within(network, self._streams)
        self._parked = Parked(network, self._streams)
        self._standstill = Standstill(network, self._streams, self.settings.standstill_s)
        stages = self._streams.stage
        self._yielding = Yielding(network, self._streams, moves)
        self._giving = Giving(network, self._streams, self._yielding.learnt, BIN_S, moves.held, cleared_bins)
        self._rules = Rules(
            stages,
            self._streams.first_stage,
            self._calling.first,
            self._orders(),
            moves.share,
            moves.going,
            moves.row,
            moves.bins,
            np.maximum(network.least_green_s[stages] // BIN_S, 1).astype(np.int64),
            ahead,
            self._giving.gaps,
        )
        self._ending = Ending(self._streams, lost_bins, ahead, apart)
        self._rounds = Rounds(self._streams, self._rules.follows, ahead)
        self._plan = np.full((len(network.junctions), bins), -1)
        """(J, K) the last schedules, of each junction as far as they go."""
        self._sent_veh = np.zeros((len(self._calling.letters), bins))
        """(A, K) what each stream sends off by them."""
        self._regret = np.zeros(len(network.junctions))
        """(J,) what it has cost so far not to have changed for nobody, in vehicles and bins."""
        self._row = np.argsort(stages)
        """(S,) row of the rules in which each of the network's stages is."""
        self._due: list[tuple[int, int]] = []
        """Junctions whose green is to end at the next decision, and the stage then: who could be led there sooner."""
        self._stopped: dict[tuple[int, int], tuple[int, ...]] = {}
        """Lane sets that have green in one stage and none in another, of those that it was asked for."""
        self._endless = np.full(len(network.junctions), bins)
        self._green_s: Floats | None = None
        self._take_up()
        self._warm_up()

    def begin(self, plan: Plan, state: State) -> None:
        """Take up the turning fractions as they are at present, and the plan's greens as bounds if they are to be."""
        self._outlook.take_up(state.fraction)
        self._take_up()
        of_group_veh_s = self.network.group_saturation_flow_veh_s[self._streams.group]
        of_lanes_veh_s = self.network.set_saturation_flow_veh_s[self._streams.lane_set]
        discharge = self.settings.discharge * BIN_S
        self._ending.take_up(self._outlook.come_veh, discharge * of_group_veh_s, discharge * of_lanes_veh_s)
        if self.settings.bounds == "plan":
            self._green_s = plan.green_s

    def wish(self, view: View | _Nobody) -> Ints:
        """(J,) stage that each junction's schedule begins with."""
        if self._due:
            return self._sooner(view)
        zones, present = view.zone_veh(view.free), self._row[view.stage]
        parked_veh = self._parked.leave_out(view.time_s, view.free, present, zones[0])
        outlook = self._outlook
        stand, come, held = outlook.look(view, zones, parked_veh)
        self._within.look(view, zones[0][:, 0], outlook.shares.of_link, stand, held)
        stuck = self._standstill.look(view, present, stand)
        self._yielding.look(view, view.free, present, zones[0])
        self._giving.look(view, view.free, present, zones[0], self._within.before)
        worth, most = self._worth.look(
            view.time_s, view.free, zones, view.x_veh, outlook.shares, self._most, stuck, held
        )
        if self._green_s is None:
            rest = self._endless
        else:
            rest_s = self._green_s[view.stage] - (view.time_s - view.begin_s)
            rest = np.clip(rest_s / BIN_S, 0, self._plan.shape[1]).astype(np.int64)
        beyond_bins = self._ending.beyond_bins(view.free, stand, come)
        ends, kept = self._ending.weights(worth, beyond_bins)
        by_turns = self._rounds.look(view.time_s, present, beyond_bins)
        waiting = self._sides.look(view, present)
        wish, then = schedules(
            view.stage,
            view.free,
            rest,
            self._rules,
            *self._calling.join(view.calling, waiting, self._ending.staying_bins, stand, come, worth, ends, kept, most),
            self._plan,
            self._sent_veh,
            by_turns,
            self._rounds.shown_s,
            self._regret,
        )
        outlook.sent_veh = self._sent_veh[self._calling.motors]
        self._due = [(index, int(then[index])) for index in (then != wish).nonzero()[0].tolist()]
        self.every_s = SOONER_S if self._due else BIN_S
        return np.asarray(wish)

    def _sooner(self, view: View | _Nobody) -> Ints:
        """(J,) the present stages, but the next one where nobody is close any more whom it stops."""
        wish = view.stage
        for junction, then in self._due:
            stopped = self._stops(int(view.stage[junction]), then)
            if view.free[junction] and not any(map(view.close_one_veh, stopped)):
                wish = view.stage.copy() if wish is view.stage else wish
                wish[junction] = then
        self._due, self.every_s = [], BIN_S - SOONER_S
        return wish

    def _stops(self, present: int, then: int) -> tuple[int, ...]:
        """Lane sets with streams that have green in the present stage and not in the next one."""
        if (present, then) not in self._stopped:
            serves = self._streams.serves
            stopped = self._streams.lane_set[serves[self._row[present]] & ~serves[self._row[then]]]
            self._stopped[present, then] = tuple(np.unique(stopped).tolist())
        return self._stopped[present, then]

    def _warm_up(self) -> None:
        """Have the machine code made now, not at the first decision."""
        none, nobody = np.zeros(len(self.network.links)), np.zeros(len(self.network.lane_sets))
        stage = np.array([junction.stages[0] for junction in self.network.junctions], dtype=np.int64)
        free, begin_s = np.zeros(len(stage), dtype=np.bool_), np.zeros(len(stage))
        zones = np.zeros((len(self.network.lane_sets), len(ZONES_M))), np.zeros((len(none), len(ZONES_M)))
        calling = np.zeros(len(self.network.callers))
        self.wish(_Nobody(0.0, stage, begin_s, free, zones, none, none, nobody, none, calling))

    def _take_up(self) -> None:
        self._giving.take_up(self._outlook.shares)
        flow_veh_s = self.network.set_saturation_flow_veh_s[self._streams.lane_set]
        self._most = self.settings.discharge * flow_veh_s * BIN_S * self._outlook.shares.of_set

    def _orders(self) -> Bools:
        """(S, most stages) whether its junction's nth stage may come after each."""
        counts = [len(junction.stages) for junction in self.network.junctions]
        follows = np.ones((sum(counts), max(counts)), dtype=np.bool_)
        if self.settings.order == "cycle":
            after = np.concatenate([(np.arange(count) + 1) % count for count in counts])
            follows = np.arange(max(counts)) == after[:, None]
        return follows


@dataclass(frozen=True)
class _Nobody:
    """What is seen of empty roads: of a view what `wish` looks at."""

    time_s: float
    stage: Ints
    begin_s: Floats
    free: Bools
    zones: tuple[Floats, Floats]
    x_veh: Floats
    entered_veh: Floats
    left_veh: Floats
    parted_veh: Floats
    calling: Floats

    def zone_veh(self, junctions: Bools) -> tuple[Floats, Floats]:  # noqa: ARG002 - nobody is anywhere
        return self.zones

    def standing_amid_veh(self, turn: int) -> float:  # noqa: ARG002
        return 0.0

    def side_standing_veh(self, roads: Bools) -> Floats:
        return np.zeros(len(roads))

    def side_left_veh(self, roads: Bools) -> Floats:
        return np.zeros(len(roads))

    def close_one_veh(self, lane_set: int) -> float:  # noqa: ARG002
        return 0.0
