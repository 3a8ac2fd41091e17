"""People, bicycles and trams with green of their own, who call for it themselves (contract.Caller)."""

from __future__ import annotations

import numpy as np

from utn_sumo.clearances import GREEN
from utn_sumo.contract import Bools, Network


def served(network: Network) -> Bools:
    """(S, C) whether a stage gives green to each caller."""
    green = [
        [stage.junction == index and stage.state[caller.letter] in GREEN for index, caller in network.callers]
        for stage in network.stages
    ]
    return np.reshape(np.array(green, dtype=np.bool_), (len(network.stages), len(network.callers)))
