"""Who calls for green himself, as streams after those of a junction's motor traffic: people, bicycles, trams.

As long as a button is pressed somebody stands there; how many is not known. All go as soon as they have green.
"""

from __future__ import annotations

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.callers import served
from utn_sumo.contract import Floats, Network

PRESSED_VEH = 0.5
"""What a pressed button weighs, or a lane with somebody close to the stop line."""
ALL = 1e4
"""So many go in a bin of green: all."""


class Calling:
    """The streams of a network and behind them, junction by junction, those of its callers (A in all).

    Callers who have green in the same stages are one stream.
    """

    def __init__(self, network: Network, streams: Streams):
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
        junction = np.concatenate([of_motors, junctions[one]])
        order = np.argsort(junction, kind="stable")
        self.first = np.searchsorted(junction[order], np.arange(len(network.junctions) + 1))
        """(J + 1,) where the junctions' streams begin."""
        self.serves = np.hstack([streams.serves, own[:, one]])[:, order]
        """(S, A) whether a stage gives a stream green."""
        both = [*streams.letters, *((letter,) for letter in letters[one].tolist())]
        self.letters = [both[stream] for stream in order]
        """(A,) letters of its junction that each has green by."""
        where = np.argsort(order)
        self._called = where[len(of_motors) :]
        """Places of the callers' streams."""
        self.motors = where[: len(of_motors)] if len(self._called) else slice(None)
        """(N,) places of the streams of motor traffic."""
        self._junction = junctions[one]

    def join(
        self, calling: Floats, staying: Floats, stand: Floats, come: Floats, worth: Floats, ends: Floats, most: Floats
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """`stand`, `come`, `worth`, `ends` and `most` of all streams, by those of motor traffic.

        And by how many buttons of each caller are pressed, `calling` (C,); who is left at the end of a schedule stays
        there for so many bins, `staying` (J,).
        """
        if not len(self._called):
            return stand, come, worth, ends, most
        pressed = np.bincount(self._stream, calling, len(self._called)).astype(np.float64)
        left = PRESSED_VEH * staying[self._junction]
        return (
            self._mixed(stand, pressed),
            self._mixed(come, 0.0),
            self._mixed(worth, PRESSED_VEH),
            self._mixed(ends, left),
            self._mixed(most, ALL),
        )

    def _mixed(self, of_motors: Floats, of_callers: Floats | float) -> Floats:
        both = np.empty((len(self.letters), *of_motors.shape[1:]))
        both[self.motors], both[self._called] = of_motors, of_callers
        return both
