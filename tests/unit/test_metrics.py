"""Greens that were really shown, and who waited before their reds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from utn_sumo.contract import Network
from utn_sumo.metrics import Greens, gridlocked


@pytest.fixture
def shown(utn17: Network, tmp_path: Path) -> Path:
    """Every junction shows each of its stages for 30 s in turn, 5 s of red after it, for an hour."""
    lines = []
    for junction in utn17.junctions:
        now_s = 0
        while now_s < 3600:
            for stage in junction.stages:
                state = utn17.stages[stage].state
                for second, letters in ((now_s, state), (now_s + 30, "r" * len(state))):
                    lines.append(f'<tlsState time="{100 + second}.00" id="{junction.id}" state="{letters}"/>')
                now_s += 35
    path = tmp_path / "signals.xml"
    path.write_text(f"<tlsStates>{''.join(lines)}</tlsStates>", encoding="utf-8")
    return path


def greens(network: Network, path: Path) -> Greens:
    return Greens(network, path, 3600.0, 100.0)


def test_green_by_turn_is_what_was_shown(utn17: Network, shown: Path) -> None:
    found = greens(utn17, shown).by_turn_s([105.0 * step for step in range(1, 11)])
    three = utn17.junctions[0].stages
    assert len(three) == 3
    for stage in three:
        for turn in utn17.stages[stage].turns:
            assert found[:, turn] == pytest.approx(30)


def test_who_stands_all_the_time_waits_for_the_longest_red(utn17: Network, shown: Path) -> None:
    looks = [10.0 * look for look in range(1, 361)]
    everybody = np.ones(len(utn17.lane_sets), dtype=bool)
    assert greens(utn17, shown).longest_wait_s([(look, everybody) for look in looks]) == 75
    assert greens(utn17, shown).longest_wait_s([(look, ~everybody) for look in looks]) == 0
    assert greens(utn17, shown).longest_wait_s([]) == 0


def test_a_wait_begins_when_it_is_first_seen_and_ends_when_it_is_last_seen(utn17: Network, shown: Path) -> None:
    group = utn17.turns[utn17.stages[utn17.junctions[0].stages[0]].turns[0]].group
    # Its red is from 30 to 105 s.
    for first_s, last_s, wait_s in ((50, 80, 30), (60, 100, 45), (60, 200, 65), (10, 60, 30), (10, 20, 0)):
        looks = [(10.0 * look, (utn17.set_group == group) & (first_s <= 10 * look <= last_s)) for look in range(1, 30)]
        assert greens(utn17, shown).longest_wait_s(looks) == wait_s


def test_a_full_link_is_gridlocked_unless_it_discharges(utn17: Network) -> None:
    full, nobody = [utn17.storage_veh] * 6, [np.zeros(len(utn17.links))] * 6
    green_s = np.full((6, len(utn17.turns)), 30.0)
    assert gridlocked(utn17, full, nobody, green_s)
    assert not gridlocked(utn17, full, [30.0 * utn17.saturation_flow_veh_s] * 6, green_s)
