"""What a user gets from pip: a wheel that is complete in itself."""

from __future__ import annotations

import configparser
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
PACKAGES = ("utn_sumo", "utn_controllers", "utn_network")
pytestmark = pytest.mark.long


def pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(PROJECT))
    (path,) = folder.glob("utn_sumo-*.whl")
    return path


def test_the_wheel_holds_the_three_packages_with_types_and_networks(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for package in PACKAGES:
        assert {f"{package}/__init__.py", f"{package}/py.typed"} <= names
    for net in ("utn17", "utn17-long"):
        assert {f"utn_network/{net}.{part}.xml" for part in ("net", "turns", "detectors.add")} <= names
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == set(PACKAGES)
    assert not [name for name in names if "__pycache__" in name or name.endswith((".part", ".pyc"))]


def test_the_wheel_registers_the_command_and_the_controllers(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/entry_points.txt"))
        points = configparser.ConfigParser()
        points.optionxform = str  # type: ignore[assignment,method-assign]
        points.read_string(archive.read(name).decode())
    assert points["console_scripts"]["utn"] == "utn_sumo.cli:main"
    assert {"fixed", "dmpc"} <= set(points["utn_sumo.controllers"])


def test_the_installed_wheel_runs_on_its_own_networks(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    pip("install", "--no-deps", "--target", str(site), str(wheel))
    environment = os.environ | {"PYTHONPATH": str(site), "UTN_CACHE": str(tmp_path / "cache")}
    code = (
        "import sys, utn_network; print(utn_network.__file__, file=sys.stderr); from utn_sumo.cli import main; main()"
    )

    def utn(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    done = utn("run", "--hours", "0.1", "--json", "--out", "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith(str(site))
    assert json.loads(done.stdout)["fallbacks"] == 0

    refused = utn("net", "check")
    assert refused.returncode == 2
    assert "from a checkout" in refused.stderr
