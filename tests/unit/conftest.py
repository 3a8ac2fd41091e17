"""Shared by the tests of single modules: every net, every cost, and small nets that netconvert makes once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from utn_sumo import network
from utn_sumo.contract import Network


@pytest.fixture(params=["utn17", pytest.param("utn17-long", marks=pytest.mark.long)], scope="module")
def net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network) -> Network:
    return utn17 if request.param == "utn17" else utn17_long


@pytest.fixture(params=["tts", "paper"], scope="module")
def cost(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="session")
def net_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Callable[[Path], Any]], Path]:
    """The .net.xml that a function makes in a folder, made once."""

    @cache
    def made(make: Callable[[Path], Any]) -> Path:
        folder = tmp_path_factory.mktemp("net")
        make(folder)
        return next(folder.glob("*.net.xml"))

    return made


@pytest.fixture(scope="session")
def street_of(net_of: Callable[[Callable[[Path], Any]], Path]) -> Callable[[Callable[[Path], Any]], Network]:
    """The network of such a net."""
    return cache(lambda make: network.load(str(net_of(make))))
