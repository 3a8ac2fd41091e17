"""The shipped networks are what their topology gives."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """build.py of a copy of the networks that a test may change."""
    root = tmp_path / "sumo_net"
    shutil.copytree(PROJECT / "sumo_net", root, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(sys, "path", list(sys.path))
    spec = importlib.util.spec_from_file_location("copied_net_build", root / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert root == module.ROOT
    yield module
    sys.modules.pop("topology", None)


def change(name: str, old: str, new: str) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        text = (root / name).read_text(encoding="utf-8")
        assert old in text
        (root / name).write_text(text.replace(old, new, 1), encoding="utf-8")

    return apply


def test_utn_net_check_finds_the_shipped_networks_in_order() -> None:
    utn = Path(sys.executable).with_name("utn")
    done = subprocess.run([str(utn), "net", "check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "what their topology gives" in done.stdout


def test_a_fresh_copy_passes_and_netconverts_date_does_not_matter(copied: Any) -> None:
    change("utn_network/utn17.net.xml", "generated on 20", "generated on 19")(copied.ROOT)
    assert copied.check() == []


@pytest.mark.parametrize(
    ("alter", "named"),
    [
        (change("utn_network/utn17.net.xml", 'speed="11.11"', 'speed="13.89"'), "utn_network/utn17.net.xml"),
        (change("utn_network/utn17-long.turns.xml", "0.70", "0.60"), "utn_network/utn17-long.turns.xml"),
        (change("utn_network/utn17.detectors.add.xml", 'period="120"', 'period="60"'), "utn17.detectors.add.xml"),
        (change("plain/utn17/utn17.edg.xml", "street", "road"), "plain/utn17/utn17.edg.xml"),
        (lambda root: (root / "utn_network/manifest.json").unlink(), "utn_network/manifest.json"),
        (lambda root: (root / "utn_network/utn18.net.xml").write_text("<net/>"), "utn_network/utn18.net.xml"),
    ],
    ids=["net", "turns", "detectors", "plain", "manifest missing", "stray"],
)
def test_a_file_that_the_topology_does_not_give_is_named(
    copied: Any, alter: Callable[[Path], None], named: str
) -> None:
    alter(copied.ROOT)
    differing = copied.check()
    assert len(differing) == 1
    assert named in differing[0]


def test_building_anew_mends_a_changed_file(copied: Any) -> None:
    change("utn_network/utn17.net.xml", 'speed="11.11"', 'speed="13.89"')(copied.ROOT)
    copied.build(copied.ROOT)
    assert copied.check() == []
