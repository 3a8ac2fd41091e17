"""What a vehicle of each stream is worth, and how many of them go in a bin of green: by how full links are."""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.pockets import between, rooms_veh
from utn_controllers.scheduled.streams import Shares, Streams
from utn_sumo.compiling import compiled
from utn_sumo.contract import EXIT, Bools, Floats, Ints, Network

FADING = 0.2
"""Over what share about `full` of its storage, or FULL_LANE of a lane's room, a link is fed less and less."""
FULL_LANE = 0.7
"""Share of their room about which the fullest lanes of a link do the same, however empty the others: who wants to get
onto them stands before it, in the way of all behind. Of several lanes that are one set one may be full long before."""
LEAST_WORTH = 0.05
"""Of a vehicle that would go from an empty link into a full one."""
HOLDING_BACK = 0.4, 0.5
"""Shares of a link's storage, now and of late, between which those come to be held back who share lanes with traffic
onto it: with one of two lanes full half of it is taken."""
BLOCKED_VEH = 1e-6
"""What leaves in a bin where nobody goes, or is to go."""
LASTING_S = 100.0
"""Over what time queues are taken that hold up those behind them, and full links: within a cycle all come and go."""
DENSE = 0.3
"""Share of the room in sight from which on, over that time, a queue holds up who is behind it."""
REACHING = 0.2, 0.4
"""Shares of its storage between which the queue on a link that begins amid the net comes to hold up those behind it
whom nobody sees. Who moves takes more room than who stands: it is at its beginning long before the link is full."""
STARVED_S = 120.0
"""Who has not been let go to the last one for so long weighs more by all of `starving`, before that by the square of
his share of it: most queues are gone within half of that time, and those are no matter."""


class Worth:
    """Keeps how dense lane sets have been of late, and when they were last empty."""

    def __init__(
        self, network: Network, streams: Streams, *, crowding: float, blocking: float, starving: float, full: float
    ):
        self._network, self._streams = network, streams
        self._settings = crowding, blocking, starving, full
        self._set_junction = network.link_junction[network.set_link]
        set_veh, before_veh = rooms_veh(network)
        self._room = set_veh, before_veh
        lanes = np.array([len(lane_set.lanes) for lane_set in network.lane_sets], dtype=np.float64)
        unseen_veh = network.storage_veh - np.bincount(network.set_link, set_veh, len(network.links))
        of_link = lanes / np.bincount(network.set_link, lanes, len(network.links))[network.set_link]
        self._lane_room = set_veh + of_link * np.maximum(unseen_veh, 0.0)[network.set_link]
        """(L,) vehicles that the lanes of each set hold, with their part of the link out of sight of their own."""
        self._merged = np.zeros(len(network.links), dtype=np.bool_)
        self._merged[network.set_link[lanes > 1]] = True
        """(Z,) links with lanes of which it is not known which one is how full."""
        self._seen = np.zeros(len(network.lane_sets))
        """(L,) vehicles that were on the lanes of each set in sight when somebody looked last."""
        self._wide = np.array([link.lanes > 1 for link in network.links], dtype=np.bool_)
        """(Z,) links of which one lane may be full and another one empty."""
        ways = [len(np.unique(network.turn_next[network.turn_link == link])) for link in streams.link]
        self._only = np.array(ways) == 1
        """(N,) streams of links all of whose traffic goes on to the same one."""
        self._late = np.zeros(len(network.links))
        """(Z,) share of their storage that has been taken of late."""
        self._time_s = 0.0
        """When that was looked at."""
        self._dense = np.zeros(len(network.lane_sets))
        """(L,) share of their room in sight that vehicles have taken up of late."""
        self._looked_s = np.zeros(len(network.lane_sets))
        """(L,) when that was looked at."""
        self._empty_s = np.zeros(len(network.lane_sets))
        """(L,) when nobody was by the stop line of each last."""

    def look(
        self,
        time_s: float,
        asked: Bools,
        zones: tuple[Floats, Floats],
        x: Floats,
        shares: Shares,
        most: Floats,
        stuck: Bools,
        held: Floats,
    ) -> tuple[Floats, Floats]:
        """(N,) what a vehicle of each stream is worth, (N,) how many leave in a bin of green.

        By the vehicles in `zones` (View.zone_veh) before the junctions `asked` (J,) and on all links `x` (Z,); the
        `shares` that streams and lane sets have of traffic; the `most` (N,) that can leave of each stream, whether it
        is `stuck` (N,) before its green, and how many times as much lane groups (G,) weigh who hold others up.
        """
        network, streams = self._network, self._streams
        _lasting(
            time_s, asked, self._set_junction, network.set_link, *zones, *self._room,
            shares.set_of_link, self._dense, self._looked_s, self._empty_s,
        )  # fmt: skip
        fullest = _fullest(
            asked, self._set_junction, network.set_link, zones[0], x, self._lane_room, shares.set_of_link, self._seen
        )
        worth, moving = _worth(
            x, network.storage_veh, self._merged, fullest, self._dense, network.begins_amid, streams.link,
            streams.lane_set, streams.group, streams.next_link, shares.of_link, shares.of_set, self._wide, self._only,
            self._late, time_s - self._time_s, most, stuck, held, time_s, self._empty_s, *self._settings,
        )  # fmt: skip
        self._time_s = time_s
        return worth, moving


@compiled
def _lasting(
    time_s: float, asked: Bools, set_junction: Ints, set_link: Ints, zone: Floats, upstream: Floats, room: Floats,
    before: Floats, share: Floats, dense: Floats, looked_s: Floats, empty_s: Floats,
) -> None:  # fmt: skip
    """Brings `dense` (L,) and `empty_s` (L,) up to date where somebody has looked."""
    for lane_set, link in enumerate(set_link):
        if asked[set_junction[lane_set]]:
            veh = zone[lane_set].sum() + share[lane_set] * upstream[link].sum()
            now = min(veh / max(room[lane_set] + share[lane_set] * before[link], 1.0), 1.0)
            dense[lane_set] += (1 - np.exp((looked_s[lane_set] - time_s) / LASTING_S)) * (now - dense[lane_set])
            looked_s[lane_set] = time_s
            if zone[lane_set, 0] < 1:
                empty_s[lane_set] = time_s


@compiled
def _fullest(
    asked: Bools, set_junction: Ints, set_link: Ints, zone: Floats, x: Floats, room: Floats, share: Floats, seen: Floats
) -> Floats:
    """(Z,) share that is taken of the lane set of each link that is fullest; `seen` (L,) is brought up to date.

    Whoever of a link's `x` (Z,) is not seen on some set's lanes is shared out as traffic is, by `share` (L,).
    """
    fullest, elsewhere = np.zeros(len(x)), x.copy()
    for lane_set, link in enumerate(set_link):
        if asked[set_junction[lane_set]]:
            seen[lane_set] = zone[lane_set].sum()
        elsewhere[link] -= seen[lane_set]
    for lane_set, link in enumerate(set_link):
        veh = seen[lane_set] + share[lane_set] * max(elsewhere[link], 0.0)
        fullest[link] = max(fullest[link], veh / room[lane_set])
    return fullest


@compiled
def _lasts(dense: Floats) -> Floats:
    """By how much queues as dense as this hold up who is behind them, 0 to 1."""
    return np.maximum(dense - DENSE, 0.0) / (1 - DENSE)


@compiled
def _worth(
    x: Floats, storage: Floats, merged: Bools, fullest: Floats, dense: Floats, amid: Bools, links: Ints, sets: Ints,
    groups: Ints, next_links: Ints, of_link: Floats, of_set: Floats, wide: Bools, only: Bools, late: Floats,
    ago_s: float, most: Floats, stuck: Bools, held: Floats, time_s: float, empty_s: Floats, crowding: float,
    blocking: float, starving: float, full: float,
) -> tuple[Floats, Floats]:  # fmt: skip
    queue, taken = _lasts(dense), x / storage
    feeding, behind = amid.astype(np.float64), np.zeros(len(x))
    for link in range(len(x)):
        # Where nobody sees who waits behind a link, its own vehicles say it.
        if amid[link]:
            behind[link] = between(taken[link], REACHING)
    for stream, ahead in enumerate(next_links):
        if ahead != EXIT:
            feeding[ahead] += of_link[stream]
            behind[ahead] += of_link[stream] * queue[sets[stream]]
    late += (1 - np.exp(-ago_s / LASTING_S)) * (taken - late)
    back = _held_back(np.minimum(taken, late), feeding, wide, only, links, sets, next_links, of_set, len(dense))
    worth, moving = np.empty(len(links)), most.copy()
    for stream, ahead in enumerate(next_links):
        link = links[stream]
        there = taken[ahead] if ahead != EXIT else 0.0
        # A queue takes the room of those who would come onto its link, the more of them wait behind.
        blocks = queue[sets[stream]] * behind[link] / feeding[link] if feeding[link] > 0 else 0.0
        value = (1 + crowding * (taken[link] - there) + blocking * blocks) * (1 - back[sets[stream]])
        # With queues enough for the best stages there are others that would never be worth their clearance.
        starved = min((time_s - empty_s[sets[stream]]) / STARVED_S, 1.0) ** 2
        worth[stream] = held[groups[stream]] * (1 + starving * starved) * max(value, LEAST_WORTH)
        if ahead != EXIT:
            room = FULL_LANE - fullest[ahead]
            if merged[ahead]:
                room = min(room, full - there)
            fed = (room + FADING / 2) / FADING
            if fed < 1:
                moving[stream] = max(fed * most[stream], BLOCKED_VEH)
        if stuck[stream]:
            moving[stream] = BLOCKED_VEH
    return worth, moving


@compiled
def _held_back(
    taken: Floats, feeding: Floats, wide: Bools, only: Bools, links: Ints, sets: Ints, next_links: Ints,
    of_set: Floats, count: int,
) -> Floats:  # fmt: skip
    """(L,) of each lane set's traffic the share that should not go on yet, so that the others have to wait with it.

    Green for who turns elsewhere lets in whoever shares his lanes. Where all links of a circuit have a lane full to its
    beginning, each lets go only when the next one does: who comes from outside waits there, where he is in nobody's
    way, and whoever would go onto a road of several lanes, of which one is full while others are empty. A single lane
    is far from full by then, and who has to wait before it would soon fill a short block. Nor is anybody held back on a
    full road amid the net that leads nowhere else (`only`, N): on a ring with signals all have to go on, so that some
    can leave it, and who is not yet on it waits for them. `taken` (Z,) are shares of the links' storage.
    """
    back = np.zeros(count)
    for stream, ahead in enumerate(next_links):
        link = links[stream]
        if ahead != EXIT and (wide[ahead] or feeding[link] == 0):
            on_it = between(taken[link], HOLDING_BACK) if only[stream] and feeding[link] > 0 else 0.0
            back[sets[stream]] += of_set[stream] * between(taken[ahead], HOLDING_BACK) * (1 - on_it)
    return back
