"""Build the shipped networks from the topology of SPEC 1: plain XML, netconvert, detectors, manifest.

utn net build            write them
utn net check            build into a temporary folder and compare with what is shipped
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))

import topology  # noqa: E402 - beside this script, not in a package
from utn_sumo import detectors, network  # noqa: E402
from utn_sumo.errors import UtnError  # noqa: E402
from utn_sumo.sumo_tools import sumo_binary  # noqa: E402

NETCONVERT_OPTIONS = [
    "--no-turnarounds",
    "--tls.layout", "incoming",
    "--tls.yellow.time", "3",
    "--tls.allred.time", "2",
    "--tls.cycle.time", "120",
]  # fmt: skip


def build(target: Path) -> list[Path]:
    """Write every file under `target` (`plain/` and `utn_network/`) and return their paths."""
    written = []
    for name in topology.LENGTH_M:
        plain = target / "plain" / name
        topology.write_plain(name, plain)
        written += sorted(plain.iterdir())
        written += _netconvert(name, plain, target / "utn_network")
    manifest = target / "utn_network" / "manifest.json"
    manifest.write_text(
        json.dumps({path.name: digest(path) for path in written if path.parent == manifest.parent}, indent=1) + "\n",
        encoding="utf-8",
    )
    return [*written, manifest]


def _netconvert(name: str, plain: Path, folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    net_file = folder / f"{name}.net.xml"
    inputs = [("-n", "nod"), ("-e", "edg"), ("-t", "typ"), ("-x", "con")]
    command = [str(sumo_binary("netconvert"))]
    for flag, suffix in inputs:
        command += [flag, f"{name}.{suffix}.xml"]
    # Run in the plain folder, with relative names, so that no path of the machine gets into the header.
    command += [*NETCONVERT_OPTIONS, "-o", os.path.relpath(net_file, plain)]
    done = subprocess.run(command, cwd=plain, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise UtnError(f"netconvert failed on {name}: {done.stderr.strip().splitlines()[-1]}")
    turns = folder / f"{name}.turns.xml"
    turns.write_bytes((plain / f"{name}.turns.xml").read_bytes())
    net = network.read(net_file, name)
    detector_file = folder / f"{name}.detectors.add.xml"
    detectors.write(net, detector_file, period_s=net.control_step_s)
    return [net_file, turns, detector_file]


def content(path: Path) -> bytes:
    """A file's bytes without netconvert's header, which holds the date and the file names."""
    return re.sub(rb"<!-- generated on .*?-->\s*", b"", path.read_bytes(), count=1, flags=re.DOTALL)


def digest(path: Path) -> str:
    return hashlib.sha256(content(path)).hexdigest()


def check() -> list[str]:
    """Names of the shipped files that differ from a fresh build; empty if none does."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder)
        fresh = {path.relative_to(target): content(path) for path in build(target)}
    differing = [
        str(name) for name, data in sorted(fresh.items()) if not (ROOT / name).is_file() or content(ROOT / name) != data
    ]
    stray = {
        path.relative_to(ROOT) for pattern in ("plain/*/*.xml", "utn_network/*.xml") for path in ROOT.glob(pattern)
    } - set(fresh)
    return differing + sorted(f"{name} (not built any more)" for name in stray)
