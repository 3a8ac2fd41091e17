"""SUMO's own binaries: found in the eclipse-sumo package, else on PATH."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

from utn_sumo.errors import PlantError


def sumo_binary(name: str) -> Path:
    """Path of `sumo`, `netconvert`, ...: the binary itself, not the slow Python wrapper that pip puts on PATH."""
    spec = importlib.util.find_spec("sumo")
    if spec is not None and spec.submodule_search_locations:
        for folder in spec.submodule_search_locations:
            candidate = Path(folder) / "bin" / name
            if candidate.is_file():
                return candidate
    found = shutil.which(name)
    if found is None:
        raise PlantError(f"{name!r} isn't installed: run pip install 'utn-sumo[sumo]', which brings SUMO's binaries")
    return Path(found)
