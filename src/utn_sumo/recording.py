"""What a run leaves on disk, readable at any moment: settings first, a line per cycle, the result last.

settings.json   scenario, versions
cycles.jsonl    one object per control step: measurement, state, forecast, plan, who it came from, SUMO's truth
trips.xml       SUMO's tripinfo, unfinished and undeparted vehicles included
signals.xml     every signal switch
routes.rou.xml, net.net.xml   what the run was made from, so that the folder is complete in itself
result.json     the measures of SPEC 7
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from utn_sumo.errors import ResultError

SETTINGS, CYCLES, RESULT = "settings.json", "cycles.jsonl", "result.json"


def new_folder(path: Path | None, default_name: str) -> Path:
    """Make and return the folder for a run's results; `results/<default name>[-n]` if none is named.

    Raises ResultError if the named folder holds anything: results are never overwritten.
    """
    if path is None:
        base = Path("results")
        names = [default_name, *(f"{default_name}-{n}" for n in range(2, 10_000))]
        path = next(base / name for name in names if not (base / name).exists())
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ResultError(
            f"output folder {str(path)!r} exists and holds results: name another with --out, or remove it"
        )
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"output folder {str(path)!r} can't be made ({error.strerror}): name another") from error
    return path


class Recorder:
    """Writes cycle records as they come, each line whole on disk before the next cycle starts."""

    def __init__(self, folder: Path, settings: Mapping[str, Any]):
        self.folder = folder
        write_json(folder / SETTINGS, settings)
        self._cycles = (folder / CYCLES).open("w", encoding="utf-8")

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one cycle."""
        self._cycles.write(json.dumps(plain(record)) + "\n")
        self._cycles.flush()

    def close(self, result: Mapping[str, Any]) -> None:
        """Write the result and end the record."""
        self._cycles.close()
        write_json(self.folder / RESULT, result)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object so that the file is either whole or absent."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(plain(content), indent=1) + "\n", encoding="utf-8")
    part.replace(path)


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """A file of a result folder. Raises ResultError if it isn't there or isn't JSON."""
    try:
        content = json.loads((folder / name).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ResultError(f"{str(folder)!r} holds no readable {name}: give a folder that `utn run` wrote") from error
    return dict(content)


def plain(value: Any) -> Any:
    """Dataclasses and arrays as JSON has them; numbers rounded to six digits after the point."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return np.round(value, 6).tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return round(value, 6) if isinstance(value, float) else value
