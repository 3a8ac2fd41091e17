"""Towns as OpenStreetMap has them: imported as one would, their signals are controlled, safely."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import drawn_nets
import drawn_towns
from utn_sumo import bridge, network
from utn_sumo.scenario import scenario


@pytest.mark.long
@pytest.mark.parametrize("number", range(4))
def test_a_town_is_what_openstreetmap_has_and_its_signals_are_controlled_safely(number: int, tmp_path: Path) -> None:
    config = drawn_towns.write("town", tmp_path / "town", np.random.default_rng([21, number]))
    tags = {tag.attrib["k"] for tag in ET.parse(tmp_path / "town" / "town.osm.xml").iter("tag")}
    assert {"highway", "lanes"} <= tags
    found = network.load(str(tmp_path / "town" / "town.net.xml"))
    assert drawn_nets.busy(found, config.with_suffix(".rou.xml")) == pytest.approx(1.0, rel=0.25)
    chosen = scenario(net=str(config), controller="recommended", demand=0.4, hours=0.3)
    result = bridge.run(chosen, tmp_path / "run")
    assert (result["unsafe_signal_s"], result["fallbacks"]) == (0, 0)
    assert result["arrived"] > 0
    # Nobody leaves a crossing alone for what netconvert made of left turns.
    assert not any("both green" in reason for reason in result["left_alone"].values())


def test_a_crossing_of_carriageways_apart_is_one_junction_with_all_four_approaches(tmp_path: Path) -> None:
    dual_x = drawn_towns.Street("primary", 2, ((-7.0, 1), (7.0, -1)))
    assert list(drawn_towns._in_order(dual_x)) == [0, 1]
    town = drawn_towns.Map()
    signals = [town.node(x, y, highway="traffic_signals") for x in (-7, 7) for y in (-7, 7)]
    assert all(map(town.is_signal, signals))
    for x, (low, high) in ((7, (2, 3)), (-7, (1, 0))):
        far = 200 if x > 0 else -200
        ways = [town.node(x, -far), signals[low], signals[high], town.node(x, far)]
        town.ways.append((ways, drawn_towns._lanes(dual_x, both=False, towards=0)))
    for y, (low, high) in ((-7, (0, 2)), (7, (3, 1))):
        far = 200 if y < 0 else -200
        ways = [town.node(-far, y), signals[low], signals[high], town.node(far, y)]
        town.ways.append((ways, drawn_towns._lanes(dual_x, both=False, towards=0)))
    town.write(tmp_path / "cross.osm.xml")
    drawn_towns.imported(tmp_path / "cross.osm.xml", tmp_path / "cross.net.xml", seed=1, people=False)
    found = network.load(str(tmp_path / "cross.net.xml"))
    assert len(found.junctions) == 1
    assert len(found.links) == 4
