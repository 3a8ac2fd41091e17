"""Forecasts in the loop: what serves, when, and what it is worth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from threading import Thread
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st
from statsmodels.tsa.statespace.kalman_filter import KalmanFilter
from threadpoolctl import threadpool_limits

from utn_sumo import demand
from utn_sumo.contract import Floats, Network
from utn_sumo.errors import SettingError
from utn_sumo.prediction import Predictor, fitting
from utn_sumo.prediction.fitting import Background, Here, Job
from utn_sumo.prediction.predictor import ADOPTED_AFTER, LEAST_ROWS, METHODS, SeriesPredictor

HORIZON = 7
SERVING = LEAST_ROWS + ADOPTED_AFTER
"""Rows after which a fitted model serves for the first time."""


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Small matrices: more threads than one only wait for each other."""
    with threadpool_limits(1):
        yield


def correlated(steps: int, count: int, seed: int, *, noise: float = 0.4) -> tuple[Floats, Floats]:
    """Counts (steps, n) and their profile; a level of its own for each series and one for all sway them."""
    rng = np.random.default_rng(seed)
    profile = 20.0 + 10.0 * np.sin(np.arange(steps) / 20)[:, None] * np.ones(count)
    level = np.zeros(count)
    counts = np.zeros((steps, count))
    for step in range(steps):
        level = 0.8 * level + 0.6 * (np.sqrt(0.8) * rng.standard_normal() + np.sqrt(0.2) * rng.standard_normal(count))
        counts[step] = rng.poisson(profile[step] * np.maximum(1 + noise * level, 0))
    return counts, profile


def mean_of_others(count: int) -> list[Floats]:
    return [(np.ones((count, count)) - np.eye(count)) / (count - 1)]


def rmse(method: str, counts: Floats, profile: Floats, **chosen: Any) -> float:
    predictor = SeriesPredictor(
        method, counts.shape[1], profile=profile, weights=mean_of_others(counts.shape[1]), **chosen
    )
    errors = []
    for step, row in enumerate(counts[:-HORIZON]):
        if step >= SERVING:
            errors.append(predictor.forecast(HORIZON).ahead - counts[step : step + HORIZON])
        predictor.observe(row)
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.long
def test_what_neighbours_tell_is_worth_something_and_so_is_the_own_past() -> None:
    errors = {
        method: np.mean([rmse(method, *correlated(130, 6, seed)) for seed in range(2)])
        for method in ("starima", "arima", "profile", "last")
    }
    assert errors["starima"] < errors["arima"] < errors["profile"] < errors["last"]


def test_without_structure_the_profile_is_not_beaten_by_guesswork() -> None:
    rng = np.random.default_rng(3)
    profile = np.full((160, 5), 18.0)
    counts = rng.poisson(profile).astype(float)
    usual = rmse("profile", counts, profile)
    assert rmse("starima", counts, profile) <= 1.02 * usual
    assert rmse("arima", counts, profile) <= 1.02 * usual


@pytest.mark.parametrize("usual_veh", [0.2, 0.5, 1.0, 5.0])
@pytest.mark.parametrize("method", ["starima", "arima"])
def test_without_structure_the_forecast_is_the_profile_however_low_it_is(method: str, usual_veh: float) -> None:
    counts = np.random.default_rng(1).poisson(usual_veh, (SERVING, 8)).astype(float)
    predictor = SeriesPredictor(method, 8, profile=np.full((1, 8), usual_veh), weights=mean_of_others(8))
    for row in counts:
        predictor.observe(row)
    assert predictor.forecast(HORIZON).ahead.tolist() == [[usual_veh] * 8] * HORIZON


@pytest.mark.parametrize(("seed", "steps"), [(1, 90), (49, 50)])
def test_a_search_that_ends_at_a_unit_root_has_found_nothing(seed: int, steps: int) -> None:
    chance = np.random.default_rng(seed).poisson(5.0, (steps, 8)) / 5.0 - 1.0
    job = Job(chance.tolist(), [list(range(8))], [matrix.tolist() for matrix in mean_of_others(8)], centred=True)
    assert [found.params for found in fitting.fit(job)] == [None]


def test_a_search_that_takes_long_is_waited_for() -> None:
    counts, profile = correlated(125, 6, 0, noise=0.2)
    departure = (counts / profile - 1.0)[:90, :1]
    found = fitting.fit(Job(departure.tolist(), [[0]], [], centred=True))
    assert found[0].order == (1, 0, 1)


@pytest.mark.parametrize("method", ["starima", "arima"])
def test_the_profile_serves_until_a_model_does(method: str) -> None:
    counts, profile = correlated(SERVING + 1, 4, 1, noise=0.8)
    predictor = SeriesPredictor(method, 4, profile=profile, weights=mean_of_others(4))
    for step, row in enumerate(counts):
        found = predictor.forecast(3)
        assert found.methods == [method if step >= SERVING else "profile"] * 4
        predictor.observe(row)


def test_without_a_profile_what_was_known_last_serves_and_before_that_nothing() -> None:
    predictor = SeriesPredictor("starima", 2)
    assert predictor.forecast(2).methods == ["none", "none"]
    predictor.observe(np.array([4.0, np.nan]))
    found = predictor.forecast(2)
    assert found.methods == ["last", "none"]
    assert found.ahead.tolist() == [[4.0, 0.0], [4.0, 0.0]]


@pytest.mark.parametrize("has_profile", [True, False])
def test_a_series_that_never_varies_costs_the_others_nothing(has_profile: bool) -> None:
    counts, profile = correlated(SERVING + 5, 4, 1, noise=0.8)
    empty = np.zeros((len(counts), 1))
    without = SeriesPredictor("starima", 4, profile=profile if has_profile else None, weights=mean_of_others(4))
    beside = SeriesPredictor(
        "starima", 5, profile=np.hstack([profile, empty]) if has_profile else None, weights=mean_of_others(5)
    )
    for row in counts:
        without.observe(row)
        beside.observe(np.append(row, 0.0))
    found = beside.forecast(3)
    assert found.methods == ["starima"] * 4 + ["profile" if has_profile else "last"]
    assert found.ahead[:, :4] == pytest.approx(without.forecast(3).ahead)
    assert not found.ahead[:, 4].any()


@pytest.mark.parametrize(("has_profile", "serves"), [(True, "profile"), (False, "mean")])
@pytest.mark.parametrize("method", ["starima", "arima"])
def test_where_no_structure_was_found_no_model_is_said_to_serve(method: str, has_profile: bool, serves: str) -> None:
    counts = np.random.default_rng(2).poisson(18.0, (SERVING, 3)).astype(float)
    profile = np.full((1, 3), 18.0) if has_profile else None
    predictor = SeriesPredictor(method, 3, profile=profile, weights=mean_of_others(3))
    for row in counts:
        predictor.observe(row)
    found = predictor.forecast(2)
    assert found.methods == [serves] * 3
    expected = [18.0] * 3 if has_profile else counts[:LEAST_ROWS].mean(axis=0)
    assert found.ahead == pytest.approx(np.tile(expected, (2, 1)))


def test_a_detector_that_dies_is_served_by_the_profile_and_misleads_nobody() -> None:
    counts, profile = correlated(160, 4, 5)
    broken = counts.copy()
    broken[60:, 2] = 0.0
    predictors = [SeriesPredictor("starima", 4, profile=profile, weights=mean_of_others(4)) for _ in (counts, broken)]
    for rows in zip(counts[:120], broken[:120], strict=True):
        for predictor, row in zip(predictors, rows, strict=True):
            predictor.observe(row)
    sound, found = (predictor.forecast(HORIZON) for predictor in predictors)
    assert sound.methods == ["starima"] * 4
    assert found.methods == ["starima", "starima", "profile", "starima"]
    assert found.ahead[:, 2] == pytest.approx(profile[120:127, 2])
    others = [0, 1, 3]
    assert found.ahead[:, others] == pytest.approx(sound.ahead[:, others], rel=0.35)
    predictors[1].observe(counts[120])
    assert predictors[1].forecast(1).methods == ["starima"] * 4


def test_what_is_unknown_is_no_zero() -> None:
    counts, profile = correlated(120, 4, 6)
    gappy = counts.copy()
    gappy[40:50, 1] = np.nan
    predictor = SeriesPredictor("starima", 4, profile=profile, weights=mean_of_others(4))
    for row in gappy:
        predictor.observe(row)
    found = predictor.forecast(3)
    assert found.methods == ["starima"] * 4
    assert (found.ahead > 0.3 * profile[-1]).all()


@given(seed=st.integers(0, 2**32 - 1), method=st.sampled_from(METHODS))
@limits(max_examples=25)
def test_any_history_gives_a_forecast_that_is_finite_and_never_negative(seed: int, method: str) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 5))
    rows = rng.poisson(rng.uniform(0, 30, count), (60, count)).astype(float)
    rows[rng.random(rows.shape) < rng.choice([0.0, 0.3, 1.0])] = np.nan
    profile = rng.uniform(0, 30, (60, count)) if rng.random() < 0.7 else None
    predictor = SeriesPredictor(
        method, count, profile=profile, coming=np.nan_to_num(rows), weights=mean_of_others(count) if count > 1 else []
    )
    for row in rows:
        predictor.observe(row)
    found = predictor.forecast(4)
    assert found.ahead.shape == (4, count)
    assert np.isfinite(found.ahead).all()
    assert (found.ahead >= 0).all()


@pytest.mark.parametrize("fitter", [Here, Background])
def test_a_run_is_the_same_wherever_the_fits_are_done(fitter: Callable[[], fitting.Fitter]) -> None:
    counts, profile = correlated(60, 3, 2)
    doer = fitter()
    predictors = [
        SeriesPredictor("starima", 3, profile=profile, weights=mean_of_others(3), fitter=each)
        for each in (Here(), doer)
    ]
    for row in counts:
        for predictor in predictors:
            predictor.observe(row)
    here, there = (predictor.forecast(HORIZON) for predictor in predictors)
    doer.close()
    assert there.methods == here.methods == ["starima"] * 3
    assert there.ahead == pytest.approx(here.ahead, rel=1e-6)


def test_a_fitter_that_dies_costs_its_fits_and_nothing_else() -> None:
    doer = Background()
    doer._process.kill()
    doer._process.wait()
    counts, profile = correlated(SERVING + 5, 3, 2)
    predictor = SeriesPredictor("starima", 3, profile=profile, weights=mean_of_others(3), fitter=doer)
    for row in counts:
        predictor.observe(row)
    assert predictor.forecast(2).methods == ["profile"] * 3
    doer.close()


def test_nobody_waits_where_jobs_and_answers_are_longer_than_a_pipe_holds() -> None:
    rows = np.random.default_rng(0).normal(5.0, 2.0, (15, 4000))
    job = Job(rows.tolist(), [list(range(4000))], [], centred=False)
    with closing(Background()) as doer:
        submitting = Thread(target=lambda: [doer.submit(job) for _ in range(3)])
        submitting.start()
        submitting.join(1.0)
        assert not submitting.is_alive()
        for _ in range(3):
            assert doer.result()[0].mean == pytest.approx(rows.mean(axis=0))


def test_a_fit_that_fails_leaves_the_last_models_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, profile = correlated(80, 3, 2)
    predictor = SeriesPredictor("starima", 3, profile=profile, weights=mean_of_others(3), refit_steps=15)
    for row in counts[: SERVING + 2]:
        predictor.observe(row)

    def refuse(job: Job) -> list[fitting.Fit]:
        return []

    monkeypatch.setattr(fitting, "fit", refuse)
    for row in counts[SERVING + 2 :]:
        predictor.observe(row)
    assert predictor.forecast(2).methods == ["starima"] * 3


def test_a_fit_comes_into_use_with_one_pass_of_the_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    passes = []
    one_pass = KalmanFilter._filter

    def counted(self: Any, *args: Any, **kwargs: Any) -> Any:
        passes.append(self.nobs)
        return one_pass(self, *args, **kwargs)

    counts, profile = correlated(SERVING, 4, 1, noise=0.8)
    predictor = SeriesPredictor("starima", 4, profile=profile, weights=mean_of_others(4))
    for row in counts[:-1]:
        predictor.observe(row)
    found = predictor._fitter.result()
    monkeypatch.setattr(KalmanFilter, "_filter", counted)
    predictor._adopt(found)
    assert passes == [SERVING - 1]
    assert predictor.forecast(1).methods == ["starima"] * 4


def test_a_network_s_forecast_says_who_served_each_source(utn17: Network) -> None:
    profile = np.full((50, 17), 20.0) * utn17.is_source
    predictor = Predictor(utn17, "starima", profile_veh=profile)
    nobody, nowhere = np.zeros(17), np.zeros(17, dtype=np.bool_)
    predictor.observe(profile[0], nowhere, nobody)
    ahead = predictor.forecast(3)
    assert ahead.demand_veh == pytest.approx(profile[:3])
    assert ahead.served == tuple("profile" if source else "" for source in utn17.is_source)
    assert ahead.disturbance_veh is None


def test_where_somebody_waits_outside_the_demand_is_unknown(utn17: Network) -> None:
    profile = np.full((50, 17), 20.0) * utn17.is_source
    predictor = Predictor(utn17, "last", profile_veh=profile)
    waited = np.zeros(17, dtype=np.bool_)
    predictor.observe(profile[0] + 3, waited, np.zeros(17))
    waited[utn17.is_source] = True
    predictor.observe(profile[0] - 9, waited, np.zeros(17))
    assert predictor.forecast(1).demand_veh[0, utn17.is_source] == pytest.approx(23)


def test_disturbances_are_foretold_about_their_own_mean(utn17: Network) -> None:
    rng = np.random.default_rng(0)
    usual = np.linspace(0, 4, 17)
    with Predictor(utn17, "starima", profile_veh=np.zeros((60, 17)), disturbed=True) as predictor:
        for _ in range(60):
            predictor.observe(np.zeros(17), np.ones(17, dtype=np.bool_), usual + rng.normal(0, 0.5, 17))
        ahead = predictor.forecast(2).disturbance_veh
    assert ahead is not None
    assert ahead == pytest.approx(np.tile(usual, (2, 1)), abs=0.5)


def test_perfect_is_what_the_routes_bring(utn17: Network, tmp_path: Any) -> None:
    path = demand.route_file(
        utn17,
        profile="peak",
        duration_s=1200,
        step_s=120,
        scale=1.0,
        noise=0.0,
        seed=3,
        disturbance_veh_h=60,
        cache=tmp_path,
    )
    coming = demand.coming_veh(utn17, path, 10)
    assert coming[0].sum() + coming[1].sum() == path.read_text(encoding="utf-8").count("<vehicle")
    assert not coming[0][:, ~utn17.is_source].any()
    assert coming[1].sum(axis=0).min() > 5
    ahead = Predictor(utn17, "perfect", coming_veh=coming, disturbed=True).forecast(4)
    assert ahead.demand_veh.tolist() == coming[0][:4].tolist()
    assert ahead.disturbance_veh is not None
    assert ahead.disturbance_veh.tolist() == coming[1][:4].tolist()


@pytest.mark.parametrize(("method", "hint"), [("starma", "starima"), ("perfect", "drawn demand")])
def test_a_method_that_can_not_be_had_is_refused(utn17: Network, method: str, hint: str) -> None:
    with pytest.raises(SettingError, match=hint):
        Predictor(utn17, method)
