"""Shared by the tests of the model predictive controllers: every net, every cost."""

from __future__ import annotations

import pytest

from utn_sumo.contract import Network


@pytest.fixture(params=["utn17", "utn17-long"], scope="module")
def net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network) -> Network:
    return utn17 if request.param == "utn17" else utn17_long


@pytest.fixture(params=["tts", "paper"], scope="module")
def cost(request: pytest.FixtureRequest) -> str:
    return str(request.param)
