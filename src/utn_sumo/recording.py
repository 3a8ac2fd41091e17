"""What a run leaves on disk, readable at any moment: settings first, a line per cycle, the result last.

settings.json   scenario, versions
cycles.jsonl    one object per control step: measurement, state, forecast, plan, who it came from, SUMO's truth
trips.xml       SUMO's tripinfo, unfinished and undeparted vehicles included
signals.xml     every signal switch
routes.rou.xml, net.net.xml   what the run was made from, so that the folder is complete in itself, where the traffic is
                ours; of a .sumocfg the settings name the files
programmes.add.xml   the signal programmes of SUMO's own controllers
result.json     the measures of SPEC 7
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import platform
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

import utn_sumo
from utn_sumo.contract import Floats
from utn_sumo.errors import ResultError

SETTINGS, CYCLES, RESULT = "settings.json", "cycles.jsonl", "result.json"
NET, ROUTES, PROGRAMMES = "net.net.xml", "routes.rou.xml", "programmes.add.xml"


@contextmanager
def results_in(path: Path | None, default_name: str) -> Iterator[Path]:
    """A `new_folder`, which is gone again if an error ends what is done with it before anything is in it."""
    is_new = path is None or not path.exists()
    folder = new_folder(path, default_name)
    try:
        yield folder
    except BaseException:
        if is_new and not any(folder.iterdir()):
            folder.rmdir()
        raise


def new_folder(path: Path | None, default_name: str, flag: str = "--out") -> Path:
    """Make and return the folder for a run's results; `results/<default name>[-n]` if `flag` names none.

    Raises ResultError if the named folder holds anything, since nothing is ever overwritten, or can't be written to.
    """
    if path is None:
        return _numbered(Path("results"), default_name.replace(",", "-"))
    for sign, taken in ((":", "a colon, which SUMO takes for host:port"), (",", "a comma, which SUMO parts lists at")):
        if sign in str(path):
            raise ResultError(f"output folder {str(path)!r} has {taken}: name another")
    try:
        if path.exists() and not path.is_dir():
            raise ResultError(f"output folder {str(path)!r} is a file: name another with {flag}")
        if path.is_dir() and any(path.iterdir()):
            raise ResultError(f"output folder {str(path)!r} is not empty: name another with {flag}")
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return path
    except OSError as error:
        raise ResultError(
            f"output folder {str(path)!r} can't be written to ({error.strerror}): name another with {flag}"
        ) from error


def _numbered(base: Path, name: str) -> Path:
    """A new folder `base/name`, or `base/name-2`, ...: made and claimed in one step, for runs side by side."""
    for number in itertools.count(1):
        path = base / (name if number == 1 else f"{name}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ResultError(f"folder {str(path)!r} can't be made ({error.strerror}): name one with --out") from error
        return path
    raise AssertionError


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

    def close(self) -> None:
        """End the record of cycles."""
        self._cycles.close()


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object so that the file is either whole or absent."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(plain(content), indent=1) + "\n", encoding="utf-8")
    part.replace(path)


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """A file of a result folder. Raises ResultError if it isn't there or is no object in JSON."""
    try:
        return dict(json.loads((folder / name).read_text(encoding="utf-8")).items())
    except (OSError, ValueError, AttributeError) as error:
        raise ResultError(f"{str(folder)!r} holds no readable {name}: give a folder that `utn run` wrote") from error


def versions(sumo: str) -> dict[str, str]:
    """What a run was made with, SUMO of this version beside it."""
    packages = ("libsumo", "sumolib", "casadi", "daqp", "numpy")
    return {
        "utn_sumo": utn_sumo.__version__,
        "sumo": sumo,
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }


def plain(value: Any) -> Any:
    """Anything as JSON has it: numbers rounded to six digits after the point, null for one that is not finite,
    text for what JSON does not know.
    """
    # Most that a run writes is arrays of finite numbers: they go in one piece.
    if isinstance(value, np.ndarray) and value.dtype.kind == "f" and np.isfinite(value).all():
        return np.round(value, 6).tolist()
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        value = round(value, 6) if math.isfinite(value) else None
    if isinstance(value, bool | int | float | str | NoneType):
        return value
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    return repr(value)


@dataclasses.dataclass(frozen=True)
class Log:
    """Recorded runs as arrays over their K control steps: what the model is held against.

    The axis after that of the steps is that of the runs.
    """

    x_veh: Floats
    """(K, runs, Z) estimated vehicles at the start of each step."""
    q_veh: Floats
    """(K, runs, M) estimated queues by turn at its start."""
    source_queue_veh: Floats
    """(K, runs, Z) estimated vehicles outside at its start."""
    fraction: Floats
    """(K, runs, M) estimated turning fractions at its start."""
    green_s: Floats
    """(K, runs, S) greens that were applied."""
    forecast_veh: Floats
    """(K, runs, Z) demand that was forecast for the step."""
    forecast_disturbance_veh: Floats
    """(K, runs, Z) who was forecast to come onto each link amid it in the step, less those to end there."""
    entered_by_sample_veh: Floats
    """(K, runs, P, Z) counted into each link, by sample."""
    turned_veh: Floats
    """(K, runs, M) counted out of it by turn."""
    true_x_veh: Floats
    """(K, runs, Z) vehicles at its end, as SUMO knows them."""
    true_queue_veh: Floats
    """(K, runs, Z) halting vehicles at its end."""
    true_waiting_veh: Floats
    """(K, runs, Z) vehicles waiting outside at its end."""

    @property
    def entered_veh(self) -> Floats:
        """(K, runs, Z) counted into each link."""
        return np.asarray(self.entered_by_sample_veh.sum(axis=-2))

    @classmethod
    def stack(cls, logs: Sequence[Log]) -> Log:
        """Several runs as one log, as long as the shortest of them."""
        names, steps = [field.name for field in dataclasses.fields(cls)], min(len(log.x_veh) for log in logs)
        return cls(**{name: np.concatenate([getattr(log, name)[:steps] for log in logs], axis=1) for name in names})


def read_log(folder: Path) -> Log:
    """The cycles of a result folder as the arrays of one run. Raises ResultError."""
    places = {
        "x_veh": ("state", "x_veh"),
        "q_veh": ("state", "q_veh"),
        "source_queue_veh": ("state", "source_queue_veh"),
        "fraction": ("state", "fraction"),
        "green_s": ("decision", "plan", "green_s"),
        "forecast_veh": ("forecast", "demand_veh", 0),
        "entered_by_sample_veh": ("seen", "entered_veh"),
        "turned_veh": ("seen", "turned_veh"),
        "true_x_veh": ("truth", "x_veh"),
        "true_queue_veh": ("truth", "queue_veh"),
        "true_waiting_veh": ("truth", "waiting_veh"),
    }
    try:
        lines = (folder / CYCLES).read_text(encoding="utf-8").splitlines()
        records = [json.loads(line) for line in lines]
        columns = {
            name: np.array([functools.reduce(lambda at, key: at[key], path, record) for record in records], dtype=float)
            for name, path in places.items()
        }
        foreseen = [record["forecast"]["disturbance_veh"] for record in records]
        columns["forecast_disturbance_veh"] = np.array(
            [np.zeros(columns["x_veh"].shape[1]) if ahead is None else ahead[0] for ahead in foreseen], dtype=float
        )
    except (OSError, UnicodeDecodeError, ValueError, KeyError, IndexError, TypeError) as error:
        raise ResultError(f"{str(folder)!r} holds no readable {CYCLES}: give a folder that `utn run` wrote") from error
    return Log(**{name: column[:, None] for name, column in columns.items()})
