"""Nets and towns drawn by chance: another seed, another one; the same one the same, at capacity at demand 1.0."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from click.testing import CliRunner

import drawn_nets
import drawn_towns
from utn_sumo import network


def routes(config: str) -> bytes:
    text = Path(config).with_suffix(".rou.xml").read_bytes()
    return text[text.index(b"<vehicle") :]


@pytest.mark.long
@pytest.mark.parametrize("tool", [drawn_nets, drawn_towns], ids=["nets", "towns"])
def test_a_seed_draws_the_same_and_another_one_others(tool: ModuleType, tmp_path: Path) -> None:
    def drawn(seed: int, name: str) -> list[bytes]:
        words = [str(tmp_path / name), "--seed", str(seed), "--count", "2"]
        said = CliRunner().invoke(tool.main, words, catch_exceptions=False)
        return [routes(line) for line in said.output.split()]

    first, again, other = drawn(3, "a"), drawn(3, "b"), drawn(4, "c")
    assert first == again
    assert len({*first, *other}) == 4


@pytest.mark.parametrize("number", range(6))
def test_the_busiest_junction_has_about_what_it_can_serve_at_demand_1(number: int, tmp_path: Path) -> None:
    config = drawn_nets.write("net", tmp_path / "net", np.random.default_rng([11, number]))
    found = network.load(str(tmp_path / "net" / "net.net.xml"))
    # The routes are drawn anew at the traffic that was found.
    assert drawn_nets.busy(found, config.with_suffix(".rou.xml")) == pytest.approx(1.0, rel=0.25)
