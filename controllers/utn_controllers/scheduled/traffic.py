"""Who stands before a junction and who comes, with the sums that what is waited before red is made of."""

from __future__ import annotations

from typing import NamedTuple

from utn_sumo.contract import Floats


class Traffic(NamedTuple):
    """Of one junction's streams (n) and stages (s); a sum up to a bin has all before it, the last one has all (K)."""

    stand: Floats
    """(n,) vehicles."""
    come: Floats
    """(n, K) vehicles."""
    came: Floats
    """(n, K + 1) sum of these."""
    red: Floats
    """(n, s + 1) 1 where a stream has red in a stage, else 0; 1 in the last column."""
    grown: Floats
    """(s + 1, K + 1) sum of what those weigh who have come and have red in a stage; in the last row, of all."""
    paid: Floats
    """(s + 1, K + 1) sum of what they have waited, if nobody had stood before."""
    due: Floats
    """(s + 1, K + 1) sum of what those weigh who have come and have red in a stage, and are left at the end."""
    worth: Floats
    """(n,) weight of a vehicle in a bin."""
    ends: Floats
    """(n,) weight of a vehicle that is left at the end."""
    kept: Floats
    """(n,) weight of one that has green then and waits for no gaps."""
    most: Floats
    """(n,) vehicles that leave in a bin of green."""
