"""The historical profile as a forecast: what demand is expected where nothing is learnt from the day itself."""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import Floats, Forecast


class ProfileForecast:
    """The historical profile: the mean demand by step, known in advance; the draw of the day is not."""

    def __init__(self, profile_veh: Floats):
        """`profile_veh` (steps, Z): vehicles expected at each source link in each control step."""
        self.profile_veh = profile_veh

    def expected_veh(self, step: int) -> Floats:
        """(Z,) expected in one step; beyond the profile's end its last row."""
        return np.asarray(self.profile_veh[min(step, len(self.profile_veh) - 1)])

    def forecast(self, step: int, horizon: int) -> Forecast:
        """Of the `horizon` steps from `step` on."""
        return Forecast(demand_veh=np.stack([self.expected_veh(step + ahead) for ahead in range(horizon)]))
