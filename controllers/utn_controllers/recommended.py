"""The project's best configuration, one for all nets and demands: every junction by its own schedule."""

from __future__ import annotations

from utn_controllers.fixed_time import FixedTime
from utn_controllers.scheduled.execution import Scheduled
from utn_sumo.contract import Network


class Recommended(FixedTime):
    """`scheduled` with no plan above it: the greens of `dmpc` as its bounds bring more delay on `utn17` at 1.3."""

    Settings = Scheduled.Settings

    def __init__(self, network: Network, **settings: float | str):
        super().__init__(network)
        self.execution = Scheduled(network, **settings)
