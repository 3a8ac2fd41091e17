"""A change of stages that nobody is seen to need waits until it would be regretted not to have made it.

A schedule weighs who may come by how likely that is: with nobody before a signal that is red it goes to and fro for
tenths of vehicles. Whoever then comes elsewhere than thought waits until the change is over, a least green and a change
back: the longer changes take the more of these seconds there are, and the longer each is waited. To stay costs a little
with each decision, and shows meanwhile who comes. So the junction stays until what that has cost, added up, is what a
change may cost for nothing: as who rents until that has cost as much as to buy (ski rental: Karlin, Manasse, Rudolph
and Sleator 1988, Competitive snoopy caching).
"""

from __future__ import annotations

from utn_sumo.compiling import compiled
from utn_sumo.contract import Floats

SEEN_VEH = 1.0
"""With as many who do not go freely and stand, or will have come before the change is over, by what they are worth,
somebody is seen to need it."""
NEEDLESS = 0.03
"""What a change for nobody costs, over the square of the bins that its clearance takes."""


@compiled
def forborne(
    stand: Floats, came: Floats, worth: Floats, moves: Floats, gives_way: Floats, clearance: int
) -> float:  # fmt: skip
    """How much it may cost to stay, in vehicles and bins, before a change with such a `clearance` in bins.

    By those that `stand` (n,) and have come by each bin (n, K + 1), `came`, what each is `worth`, how each `moves` in
    the present stage, and how much of each `gives_way` there.
    """
    waiting, over = 0.0, min(clearance, came.shape[1] - 1)
    for stream in range(len(stand)):
        if moves[stream] < 1 or gives_way[stream] > 0:
            waiting += worth[stream] * (stand[stream] + came[stream, over])
    return float(NEEDLESS * clearance**2 if waiting < SEEN_VEH else 0.0)
