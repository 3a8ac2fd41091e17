"""Runs that several tests look at are made once a session; drawn routes are cached outside the user's home."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from utn_sumo import bridge
from utn_sumo.scenario import scenario


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
