"""Who calls for green himself, as streams after those of a junction's motor traffic: people, bicycles, trams.

As long as a button is pressed somebody stands there; how many is not known. All go as soon as they have green. Who
waits on side roads (`sides`) comes after these.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.sides import Sides
from utn_controllers.scheduled.streams import Streams
from utn_sumo.callers import served
from utn_sumo.contract import Floats, Network

PRESSED_VEH = 0.5
"""What a pressed button weighs, or a lane with somebody close to the stop line."""
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
        motors, self._called, self._beside = np.split(where, np.cumsum([len(of_motors), len(one)]))
        """Places of the callers' streams, and of those on side roads."""
        self.motors = motors if len(where) > len(motors) else slice(None)
        """(N,) places of the streams of motor traffic."""
        self._junction, self._sides = junctions[one], sides

    def join(
        self,
        calling: Floats,
        waiting: Floats,
        staying: Floats,
        stand: Floats,
        come: Floats,
        worth: Floats,
        ends: Floats,
        most: Floats,
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """`stand`, `come`, `worth`, `ends` and `most` of all streams, by those of motor traffic.

        And by how many buttons of each caller are pressed, `calling` (C,), and how many are `waiting` (E,) on side
        roads; who is left at the end of a schedule stays there for so many bins, `staying` (J,).
        """
        if isinstance(self.motors, slice):
            return stand, come, worth, ends, most
        pressed = np.bincount(self._stream, calling, len(self._called)).astype(np.float64)
        left, sides = staying[self._junction], self._sides
        return (
            self._mixed(stand, pressed, waiting),
            self._mixed(come, 0.0, 0.0),
            self._mixed(worth, PRESSED_VEH, 1.0),
            self._mixed(ends, PRESSED_VEH * left, staying[sides.junction]),
            self._mixed(most, ALL, sides.most),
        )

    def _mixed(self, of_motors: Floats, of_callers: Floats | float, of_sides: Floats | float) -> Floats:
        each = np.empty((len(self.letters), *of_motors.shape[1:]))
        each[self.motors], each[self._called], each[self._beside] = of_motors, of_callers, of_sides
        return each
