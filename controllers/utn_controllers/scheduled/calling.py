"""Who calls for green himself, as streams after those of a junction's motor traffic: people, bicycles, trams.

As long as a button is pressed somebody stands there; how many is not known. Bicycles and trams on lanes of theirs are
counted. All go as soon as they have green. Who waits on side roads (`sides`) comes after these.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from utn_controllers.scheduled.sides import Sides
from utn_controllers.scheduled.streams import Streams
from utn_sumo.callers import served
from utn_sumo.compiling import compiled
from utn_sumo.contract import Floats, Ints, Network

PRESSED_VEH = 0.5
"""What a pressed button weighs."""
ALL = 1e4
"""So many go in a bin of green: all."""


class Calling:
    """The streams of a network and behind them, junction by junction, those of its callers and side roads (A in all).

    Callers who have green in the same stages are one stream.
    """

    def __init__(self, network: Network, streams: Streams, sides: Sides):
        self.stage, self.first_stage = streams.stage, streams.first_stage
        """As in `Streams`."""
        own = served(network)[self.stage]
        place: dict[tuple[int, bytes], int] = {}
        found = [
            (place.setdefault((junction, own[:, caller].tobytes()), len(place)), junction, each.letter)
            for caller, (junction, each) in enumerate(network.callers)
        ]
        self._stream, junctions, letters = np.array(found, dtype=np.int64).reshape(-1, 3).T
        """(C,) stream of each caller, counted from the first that is a caller's."""
        # A lane is that of several letters, one for each way from it.
        shared = Counter(lane for _, each in network.callers for lane in each.lanes)
        ways = [max((shared[lane] for lane in each.lanes), default=0) for _, each in network.callers]
        self.weight_veh = np.array([1 / count if count else PRESSED_VEH for count in ways])
        """(C,) what a pressed button of his weighs, or who is close on his lanes."""
        one = np.unique(self._stream, return_index=True)[1]
        of_motors = np.repeat(np.arange(len(network.junctions)), np.diff(streams.first))
        junction = np.concatenate([of_motors, junctions[one], sides.junction])
        order = np.argsort(junction, kind="stable")
        self.first = np.searchsorted(junction[order], np.arange(len(network.junctions) + 1))
        """(J + 1,) where the junctions' streams begin."""
        self.serves = np.hstack([streams.serves, own[:, one], sides.serves])[:, order]
        """(S, A) whether a stage gives a stream green."""
        each = [*streams.letters, *((letter,) for letter in letters[one].tolist()), *[()] * len(sides)]
        self.letters = [each[stream] for stream in order]
        """(A,) letters of its junction that each has green by; none of those that no signal stops."""
        where = np.argsort(order)
        self._places = np.split(where, np.cumsum([len(of_motors), len(one)]))
        """Places of the streams of motor traffic, of the callers', and of those on side roads."""
        self._is_joined = len(where) > len(of_motors)
        self.motors = self._places[0] if self._is_joined else slice(None)
        """(N,) places of the streams of motor traffic."""
        self._junctions, self._most = (junctions[one], sides.junction), sides.most
        """At which junction callers' streams are, and those on side roads; (E,) who go of these in a bin."""

    def join(
        self,
        calling: Floats,
        waiting: Floats,
        staying: Floats,
        stand: Floats,
        come: Floats,
        worth: Floats,
        ends: Floats,
        kept: Floats,
        most: Floats,
    ) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
        """`stand`, `come`, `worth`, `ends`, `kept` and `most` of all streams, by those of motor traffic.

        And by how many call, `calling` (C,), as contract.View has them, and how many are `waiting` (E,) on side roads;
        who is left at the end of a schedule stays there for so many bins, `staying` (J,).
        """
        if not self._is_joined:
            return stand, come, worth, ends, kept, most
        joined: tuple[Floats, Floats, Floats, Floats, Floats, Floats] = _joined(
            *self._places, *self._junctions, self._stream, self._most, calling * self.weight_veh, waiting, staying,
            stand, come, worth, ends, kept, most,
        )  # fmt: skip
        return joined


@compiled
def _joined(
    motors: Ints, called: Ints, beside: Ints, called_at: Ints, beside_at: Ints, stream: Ints, beside_most: Floats,
    calling: Floats, waiting: Floats, staying: Floats,
    stand: Floats, come: Floats, worth: Floats, ends: Floats, kept: Floats, most: Floats,
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:  # fmt: skip
    every = len(motors) + len(called) + len(beside)
    all_stand, all_worth, all_ends, all_kept, all_most = np.zeros((5, every))
    all_come = np.zeros((every, come.shape[1]))
    for own, place in enumerate(motors):
        all_stand[place], all_come[place] = stand[own], come[own]
        all_worth[place], all_most[place] = worth[own], most[own]
        all_ends[place], all_kept[place] = ends[own], kept[own]
    for caller, calling_veh in enumerate(calling):
        all_stand[called[stream[caller]]] += calling_veh
    for own, place in enumerate(called):
        all_worth[place], all_most[place] = 1.0, ALL
        all_ends[place] = all_kept[place] = staying[called_at[own]]
    # A side road's weigh as before an empty road: how full theirs is, nothing says.
    for own, place in enumerate(beside):
        all_stand[place], all_worth[place], all_most[place] = waiting[own], 1.0, beside_most[own]
        all_ends[place] = all_kept[place] = staying[beside_at[own]]
    return all_stand, all_come, all_worth, all_ends, all_kept, all_most
