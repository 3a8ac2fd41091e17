"""Shared by all tests: the two shipped networks, and hypothesis settings that give the same examples every time."""

from __future__ import annotations

import pytest
from hypothesis import settings

from utn_sumo import network
from utn_sumo.contract import Network

settings.register_profile("utn", max_examples=25, deadline=None, derandomize=True)
settings.load_profile("utn")


@pytest.fixture(scope="session")
def utn17() -> Network:
    return network.load("utn17")


@pytest.fixture(scope="session")
def utn17_long() -> Network:
    return network.load("utn17-long")
