"""What comes from outside, foretold each control step from what the loops gave so far.

Demand at the source links is foretold as a departure from its historical profile, disturbances on the links as one
from none. Where a method can't serve a series, a plainer one does, and the forecast says which one it was:

`starima`   all series together, from each other's past: `STARIMA`
`arima`     each from its own past: the same without space
`profile`   the historical profile; where there is none, what was known last
`last`      what was known last
`mean`      the mean of what was known, where there is no structure and no profile: no method to ask for
`perfect`   what will really come
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np

from utn_sumo.contract import Bools, Floats, Forecast, Network
from utn_sumo.errors import SettingError, did_you_mean
from utn_sumo.prediction import fitting
from utn_sumo.prediction.fitting import Fit, Fitter, Job
from utn_sumo.prediction.weights import network_weights

METHODS = ("starima", "arima", "profile", "last", "perfect")
FITTED = ("starima", "arima")
REFIT_STEPS = 15
"""Control steps between two fits."""
LEAST_ROWS, MOST_ROWS = 30, 480
"""Of the history that a model is fitted to: fewer say too little, and older ones take too long."""
ADOPTED_AFTER = 5
"""Control steps after which a fit comes into use, however fast it was: so a run does not depend on the machine."""
SILENT_VEH = 14.0
"""Vehicles that should have come while a loop counts none: by chance that happens once in a million times."""
LEAST_PROFILE_VEH = 1.0
"""A profile below this in a step is taken for this when departures from it are related to it."""


class Predictor:
    """Foretells a network's demand and disturbances. `close` it, or use it in a `with` statement."""

    def __init__(
        self,
        network: Network,
        method: str,
        *,
        profile_veh: Floats | None = None,
        coming_veh: tuple[Floats, Floats] | None = None,
        disturbed: bool = False,
        refit_steps: int = REFIT_STEPS,
        background: bool = False,
    ):
        """`profile_veh` (K, Z) is the demand known from history, in each control step, `coming_veh` what demand and
        disturbance, (K, Z) each, will really be. Only a `disturbed` network's disturbances are foretold. In the
        `background`, a process of its own fits the models, every `refit_steps`.

        Raises SettingError for a method that is unknown, or `perfect` without what will come.
        """
        if method not in METHODS:
            raise SettingError(f"setting 'forecast' is {method!r}: {did_you_mean(method, METHODS)}")
        if method == "perfect" and coming_veh is None:
            raise SettingError("setting 'forecast' is 'perfect': what will come is known only of a drawn demand")
        self._links = len(network.links)
        self._sources = sources = np.flatnonzero(network.is_source)
        self._fitter: Fitter = fitting.Background() if background and method in FITTED else fitting.Here()
        demand_veh, disturbance_veh = coming_veh or (None, None)
        count = len(sources)
        self._demand = SeriesPredictor(
            method,
            count,
            profile=None if profile_veh is None else profile_veh[:, sources],
            coming=None if demand_veh is None else demand_veh[:, sources],
            # What sways one source's demand sways the others': the time of the day, the weather, the match.
            weights=[(np.ones((count, count)) - np.eye(count)) / max(count - 1, 1)],
            refit_steps=refit_steps,
            fitter=self._fitter,
        )
        self._disturbance: SeriesPredictor | None = None
        if disturbed:
            self._disturbance = SeriesPredictor(
                method,
                self._links,
                profile=np.zeros((1, self._links)),
                coming=disturbance_veh,
                weights=network_weights(network, orders=1),
                refit_steps=refit_steps,
                fitter=self._fitter,
                signed=True,
            )

    def observe(self, entered_veh: Floats, waited: Bools, disturbance_veh: Floats) -> None:
        """Take up a control step: what the loops counted in, and what disturbed the links, (Z,) each.

        `waited` (Z,) is where somebody had to wait outside: there the demand is unknown, elsewhere it is what entered.
        """
        self._demand.observe(np.where(waited, np.nan, entered_veh)[self._sources])
        if self._disturbance is not None:
            self._disturbance.observe(disturbance_veh)

    def forecast(self, horizon: int) -> Forecast:
        """Of the `horizon` control steps to come."""
        demand_veh, served = np.zeros((horizon, self._links)), [""] * self._links
        found = self._demand.forecast(horizon)
        demand_veh[:, self._sources] = found.ahead
        for link, method in zip(self._sources.tolist(), found.methods, strict=True):
            served[link] = method
        disturbance_veh = None if self._disturbance is None else self._disturbance.forecast(horizon).ahead
        return Forecast(demand_veh, disturbance_veh, tuple(served))

    def close(self) -> None:
        """End what runs in the background."""
        self._fitter.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass
class Served:
    """A forecast (horizon, n) and by what method each of the n series was foretold."""

    ahead: Floats
    methods: list[str]


class SeriesPredictor:
    """Foretells n series together from their history, step by step.

    A series that is far too quiet for its profile has a dead detector, and is taken to be unknown.
    """

    def __init__(
        self,
        method: str,
        count: int,
        *,
        profile: Floats | None = None,
        coming: Floats | None = None,
        weights: Sequence[Floats] = (),
        refit_steps: int = REFIT_STEPS,
        fitter: Fitter | None = None,
        signed: bool = False,
    ):
        """`profile` and `coming` are (K, n): what is usual, and what will really come, by step; beyond their ends the
        last rows. `weights` are those of `STARIMA`. Counts depart from their profile in proportion to it, `signed`
        numbers by as much whatever it is, with a mean of their own.
        """
        self.method = method
        self._count = count
        self._profile, self._coming = profile, coming
        self._weights = list(weights) if count > 1 and method == "starima" else []
        self._groups = [list(range(count))] if method == "starima" else [[each] for each in range(count)]
        self._refit_steps = refit_steps
        self._fitter = fitter or fitting.Here()
        self._signed = signed
        self._centred = profile is not None and not signed
        self._departures: list[Floats] = []
        self._last = np.full(count, np.nan)
        self._missed_veh = np.zeros(count)
        """(n,) what should have come since a detector last counted anything."""
        self._models: list[_Model] = []

    def observe(self, row: Floats) -> None:
        """Take up one step's numbers (n,), NaN where unknown."""
        step = len(self._departures)
        self._listen(row, step)
        row = np.where(self._dead, np.nan, row)
        self._last = np.where(np.isnan(row), self._last, row)
        self._departures.append(self._departure(row, step))
        if self.method not in FITTED:
            return
        for model in self._models:
            model.update(self._departures[-1])
        since = step + 1 - LEAST_ROWS
        if since >= 0 and since % self._refit_steps == 0:
            rows, weights = np.array(self._departures[-MOST_ROWS:]), [matrix.tolist() for matrix in self._weights]
            self._fitter.submit(Job(rows.tolist(), self._groups, weights, self._centred))
        if since >= ADOPTED_AFTER and (since - ADOPTED_AFTER) % self._refit_steps == 0:
            self._adopt(self._fitter.result())

    def forecast(self, horizon: int) -> Served:
        """Of the `horizon` steps to come."""
        step = len(self._departures)
        if self.method == "perfect" and self._coming is not None:
            return Served(_rows_from(self._coming, step, horizon), ["perfect"] * self._count)
        found = self._plain(step, horizon)
        dead = self._dead
        for model in self._models:
            departures = model.forecast(horizon)
            serves = self.method if model.has_structure else "profile" if self._centred else "mean"
            for column, series in enumerate(model.series):
                if np.isfinite(departures[:, column]).all() and not dead[series]:
                    found.ahead[:, series] = self._from_departure(departures[:, column], series, step)
                    found.methods[series] = serves
        return found

    def _plain(self, step: int, horizon: int) -> Served:
        """The profile; for `last`, and without a profile, what was known last, or nothing."""
        known = ~np.isnan(self._last)
        last = np.tile(np.nan_to_num(self._last), (horizon, 1))
        if self._profile is None:
            return Served(last, np.where(known, "last", "none").tolist())
        usual = _rows_from(self._profile, step, horizon)
        if self.method == "last":
            return Served(np.where(known, last, usual), np.where(known, "last", "profile").tolist())
        return Served(usual, ["profile"] * self._count)

    def _listen(self, row: Floats, step: int) -> None:
        """Reckon what a silent detector missed."""
        if self._centred:
            missed_veh = np.where(np.isnan(row), 0.0, _rows_from(self._profile, step, 1)[0])
            self._missed_veh = np.where(row > 0, 0.0, self._missed_veh + missed_veh)

    @property
    def _dead(self) -> Bools:
        """(n,) series whose detectors have been silent for too long."""
        return np.asarray(self._missed_veh > SILENT_VEH)

    def _adopt(self, fits: Sequence[Fit]) -> None:
        """Use these from now on; where there is none the models so far go on."""
        rows = np.array(self._departures[-MOST_ROWS:])
        found = []
        for each in fits:
            try:
                found.append(_Model(each, rows, self._weights, centred=self._centred))
            except fitting.FAILURES:
                continue
        self._models = found or self._models

    def _departure(self, row: Floats, step: int) -> Floats:
        """A step's numbers (n,) less their profile."""
        if self._profile is None:
            return row
        usual = _rows_from(self._profile, step, 1)[0]
        if self._signed:
            return np.asarray(row - usual)
        # In proportion, so that busy and quiet hours are of one kind.
        scale = np.maximum(usual, LEAST_PROFILE_VEH)
        return np.asarray(row / scale - usual / scale)

    def _from_departure(self, departure: Floats, series: int, step: int) -> Floats:
        """The way back for one series, (horizon,) from `step` on."""
        if self._profile is None:
            return departure if self._signed else np.maximum(departure, 0.0)
        usual = _rows_from(self._profile, step, len(departure))[:, series]
        if self._signed:
            return np.asarray(usual + departure)
        scale = np.maximum(usual, LEAST_PROFILE_VEH)
        return np.asarray(scale * np.maximum(usual / scale + departure, 0.0))


class _Model:
    """A fit in use: it knows all rows so far and says what is next."""

    def __init__(self, found: Fit, rows: Floats, weights: Sequence[Floats], *, centred: bool):
        """`rows` (T, n) of all series."""
        self.series = found.series
        self._mean = np.array(found.mean)
        self._results: Any = None
        if found.params is not None:
            own = [matrix[np.ix_(found.series, found.series)] for matrix in weights]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                fitted = fitting.model(rows[:, found.series], found.order, found.spatial, own, centred=centred)
                # Standard errors would take two passes of the filter for each parameter, and nobody asks for them.
                self._results = fitted.filter(np.array(found.params), cov_type="none")

    @property
    def has_structure(self) -> bool:
        """Whether it says more than the mean."""
        return self._results is not None

    def update(self, row: Floats) -> None:
        """Take up one more row (n,) of all series."""
        if self._results is not None:
            self._results = self._results.update(row[self.series])

    def forecast(self, horizon: int) -> Floats:
        """(horizon, its series)"""
        if self._results is None:
            return np.tile(self._mean, (horizon, 1))
        return np.asarray(self._results.forecast(horizon), dtype=float).reshape(horizon, -1)


def _rows_from(table: Floats | None, step: int, count: int) -> Floats:
    """`count` rows from `step` on; beyond the end the last one."""
    assert table is not None
    return np.asarray(table[np.minimum(np.arange(step, step + count), len(table) - 1)], dtype=float)
