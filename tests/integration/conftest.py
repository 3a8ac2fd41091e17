"""Runs that several tests look at are made once a session; drawn routes are cached outside the user's home."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from utn_sumo import bridge, demand
from utn_sumo.contract import Network
from utn_sumo.scenario import scenario

from .odd_nets import Make


@pytest.fixture(scope="session", autouse=True)
def route_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UTN_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def run_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[dict[str, Any], Path]]:
    """Measures and folder of the run with these settings; tests leave the folder as it is."""
    made: dict[str, tuple[dict[str, Any], Path]] = {}

    def run(**settings: Any) -> tuple[dict[str, Any], Path]:
        key = repr(sorted(settings.items()))
        if key not in made:
            folder = tmp_path_factory.mktemp("run")
            made[key] = bridge.run(scenario(**settings), folder), folder
        return made[key]

    return run


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Make], Path]:
    """The .sumocfg of one of `odd_nets`; tests leave its folder as it is."""
    files: dict[Make, Path] = {}

    def write(make: Make) -> Path:
        if make not in files:
            files[make] = make(tmp_path_factory.mktemp(make.__name__))
        return files[make]

    return write


@pytest.fixture
def town(utn17: Network, tmp_path: Path) -> Path:
    """A .sumocfg of a quarter of an hour that begins at six, asks for outputs of its own and has an unusual option."""
    drawn = demand.route_file(
        utn17, profile="constant", duration_s=900, step_s=120, scale=0.8, noise=0.0, seed=4, cache=tmp_path / "cache"
    )
    tree = ET.parse(drawn)
    for vehicle in tree.getroot():
        vehicle.set("depart", f"{21600 + float(vehicle.attrib['depart']):.2f}")
    tree.write(tmp_path / "town.rou.xml")
    file = tmp_path / "town.sumocfg"
    file.write_text(
        f"""<configuration>
        <input><net-file value="{utn17.net_file}"/><route-files value="town.rou.xml"/></input>
        <time><begin value="6:00:00"/><end value="22500"/><step-length value="0.5"/></time>
        <processing><time-to-teleport value="120"/></processing>
        <output><tripinfo-output value="theirs.xml"/></output>
        </configuration>""",
        encoding="utf-8",
    )
    return file
