"""libsumo's functions as they are called often."""

from __future__ import annotations

from typing import Any


def bare(sumo: Any, domain: str, getter: str) -> Any:
    """A function of libsumo, without the one in Python about it where there is one: half of a reading's time."""
    module = getattr(getattr(sumo, "libsumo", None), "_libsumo", None)
    return getattr(module, f"{domain}_{getter}", None) or getattr(getattr(sumo, domain), getter)
