"""Shared by all tests: the two shipped networks, and hypothesis settings that give the same examples every time."""

from __future__ import annotations

import os

# One thread a worker: with one a processor in each, those of numpy wait for each other ten times as long as they work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

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
