"""The `utn` command as a user starts it: a process of its own, in a folder of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from utn_sumo.cli import main


@pytest.fixture(scope="session", autouse=True)
def route_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UTN_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def command() -> str:
    return str(Path(sys.executable).with_name("utn"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the command is started."""
    path = tmp_path / "here"
    path.mkdir()
    return path


@pytest.fixture
def utn(command: str, folder: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [command, *arguments], cwd=folder, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
        )

    return run


@pytest.fixture
def refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., subprocess.CompletedProcess[str]]:
    """The command in this process, for what ends before anything is run: it spares a second of imports each."""
    monkeypatch.chdir(folder)

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        printed, complaint = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, ended.value.code, printed, complaint)

    return run
