"""What the controllers are worth on a crowded network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.mark.long
def test_dmpc_halves_the_time_spent_where_fixed_time_locks_up(
    run_of: Callable[..., tuple[dict[str, Any], Path]],
) -> None:
    dmpc, _ = run_of(hours=2, demand=1.3)
    fixed, _ = run_of(hours=2, demand=1.3, controller="fixed")
    assert not dmpc["gridlock"]
    assert dmpc["fallbacks"] == dmpc["unsafe_signal_s"] == dmpc["teleports"] == 0
    assert dmpc["total_time_spent_veh_h"] <= 0.5 * fixed["total_time_spent_veh_h"]
