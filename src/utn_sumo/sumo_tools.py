"""SUMO's own binaries and Python tools: found in the eclipse-sumo package, else on PATH and under SUMO_HOME."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from utn_sumo.errors import PlantError


def sumo_binary(name: str) -> Path:
    """Path of `sumo`, `netconvert`, ...: the binary itself, not the slow Python wrapper that pip puts on PATH."""
    for home in _homes():
        if (home / "bin" / name).is_file():
            return home / "bin" / name
    found = shutil.which(name)
    if found is None:
        raise PlantError(f"{name!r} isn't installed: run pip install 'utn-sumo[sumo]', which brings SUMO's binaries")
    return Path(found)


def run_tool(name: str, arguments: Sequence[str]) -> None:
    """Run one of SUMO's Python tools, as `tlsCoordinator.py`. Raises PlantError if it isn't there or breaks off."""
    home = _home_with(f"tools/{name}")
    run_program(name, [sys.executable, str(home / "tools" / name), *arguments], home)


def data_file(name: str) -> Path:
    """A file of SUMO's data, as `typemap/osmNetconvert.typ.xml`. Raises PlantError if it isn't there."""
    return _home_with(f"data/{name}") / "data" / name


def _home_with(name: str) -> Path:
    """A folder of SUMO in which there is this file."""
    homes = [*_homes(), *(Path(home) for home in [os.environ.get("SUMO_HOME")] if home)]
    home = next((each for each in homes if (each / name).is_file()), None)
    if home is None:
        raise PlantError(
            f"{Path(name).name!r} isn't installed: run pip install 'utn-sumo[sumo]', which brings SUMO's tools"
        )
    return home


def run_program(name: str, words: Sequence[str], home: Path | None = None) -> None:
    """Run a program of SUMO's and wait. Raises PlantError with the last line that it says if it breaks off."""
    environment = os.environ if home is None else {**os.environ, "SUMO_HOME": str(home)}
    done = subprocess.run(words, check=False, capture_output=True, text=True, env=environment)  # noqa: S603
    if done.returncode != 0:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["it does not say why"]
        raise PlantError(
            f"SUMO's {name} broke off ({said[-1]}): it can't cope with this scenario, use another controller"
        )


def _homes() -> Iterator[Path]:
    """Folders of SUMO that pip has installed."""
    spec = importlib.util.find_spec("sumo")
    if spec is not None:
        yield from map(Path, spec.submodule_search_locations or ())
