"""A calibration finds the parameters that made the data, and its file goes round the loop."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.test_rollout import simulated
from utn_sumo import calibration, network, recording
from utn_sumo.contract import Network
from utn_sumo.errors import NetworkError
from utn_sumo.recording import Log


@pytest.fixture(scope="module")
def fitted(utn17: Network) -> tuple[Network, dict[str, object]]:
    """A network whose link 8 discharges a fifth less and whose link 15 is slower, and what the fit makes of it."""
    links = list(utn17.links)
    links[7] = replace(links[7], saturation_flow_veh_s=0.8 * links[7].saturation_flow_veh_s)
    links[14] = replace(links[14], free_speed_m_s=0.75 * links[14].free_speed_m_s)
    truth = replace(utn17, links=tuple(links))
    log = Log.stack([simulated(truth, seed) for seed in range(4)])
    return truth, calibration.calibrate(utn17, log)


def test_a_slower_link_is_found(utn17: Network, fitted: tuple[Network, dict[str, object]]) -> None:
    _, content = fitted
    links = content["links"]
    assert isinstance(links, dict)
    speeds = {name: values["free_speed_m_s"][0] for name, values in links.items()}
    true_m_s = 0.75 * utn17.links[14].free_speed_m_s
    assert speeds["15"] == pytest.approx(true_m_s, rel=0.1)
    assert abs(speeds["9"] - utn17.links[8].free_speed_m_s) < 0.1 * utn17.links[8].free_speed_m_s


def test_every_value_has_a_positive_standard_error(fitted: tuple[Network, dict[str, object]]) -> None:
    _, content = fitted
    links = content["links"]
    assert isinstance(links, dict)
    for values in links.values():
        for name in calibration.FITTED:
            value, error = values[name]
            assert value > 0
            assert 0 < error < np.inf
        assert sum(share for share, _ in values["turns"].values()) == pytest.approx(1)


def test_where_nobody_drove_standard_errors_are_as_wide_as_what_was_known_before(utn17: Network) -> None:
    driven = simulated(utn17, 1)
    names = (field.name for field in fields(driven) if field.name not in ("fraction", "green_s"))
    empty = replace(driven, **{name: 0 * getattr(driven, name) for name in names})
    content = calibration.calibrate(utn17, empty)
    for values in content["links"].values():
        for name, spread in calibration.FITTED.items():
            value, error = values[name]
            assert error / value > 0.9 * spread
    assert content["startup_lag_s"][1] == pytest.approx(calibration.LAG_PRIOR_S, rel=0.1)


def test_the_file_gives_the_network_its_values(
    utn17: Network, fitted: tuple[Network, dict[str, object]], tmp_path: Path
) -> None:
    path = tmp_path / "calibration.json"
    recording.write_json(path, fitted[1])
    network_ = calibration.applied(utn17, path)
    links = fitted[1]["links"]
    assert isinstance(links, dict)
    assert network_.links[4].storage_veh == pytest.approx(links["5"]["storage_veh"][0], abs=1e-5)
    assert calibration.for_model(utn17, str(path)) == network_


@pytest.mark.parametrize("name", ["utn17", "utn17-long"])
def test_the_shipped_calibrations_fit_their_nets_and_can_be_declined(name: str) -> None:
    plain = network.load(name)
    assert calibration.for_model(plain, None) != plain
    assert calibration.for_model(plain, "none") is plain


@pytest.mark.parametrize(
    "spoil",
    [
        lambda content: content["links"].pop("3"),
        lambda content: content["links"]["3"].update(storage_veh=[-1, 0]),
        lambda content: content["links"]["3"].update(free_speed_m_s="fast"),
        lambda content: content["links"]["3"]["turns"].pop("10"),
        lambda content: content.pop("startup_lag_s"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_in_one_line(utn17: Network, tmp_path: Path, spoil: object) -> None:
    content = json.loads(calibration.beside_net(utn17).read_text(encoding="utf-8"))
    assert callable(spoil)
    spoil(content)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(NetworkError, match="does not fit net 'utn17'") as caught:
        calibration.applied(utn17, path)
    assert "\n" not in str(caught.value)


def test_runs_of_unlike_length_are_put_together_as_far_as_the_shortest_goes(utn17: Network) -> None:
    whole = simulated(utn17, 1)
    part = replace(whole, **{field.name: getattr(whole, field.name)[:5] for field in fields(whole)})
    both = Log.stack([whole, part])
    assert both.x_veh.shape[:2] == (5, 2)
    assert (both.green_s[:, 0] == both.green_s[:, 1]).all()


@pytest.mark.parametrize(
    ("share", "lag_s", "says"),
    [
        (-0.2, 2.0, "the fraction of 1 to .* is -0.2"),
        (1.4, 2.0, "the fraction of 1 to .* is 1.4"),
        (float("nan"), 2.0, "the fraction of 1 to .* is nan"),
        (0.99, 2.0, "the fractions of 1 sum to"),
        (None, -1.0, "startup_lag_s is -1"),
        (None, float("inf"), "startup_lag_s is inf"),
    ],
)
def test_shares_that_are_none_and_lags_that_can_not_be_are_refused(
    utn17: Network, tmp_path: Path, share: float | None, lag_s: float, says: str
) -> None:
    content = json.loads(calibration.beside_net(utn17).read_text(encoding="utf-8"))
    content["startup_lag_s"][0] = lag_s
    if share is not None:
        turns = content["links"]["1"]["turns"]
        turns[next(iter(turns))][0] = share
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(NetworkError, match=says) as caught:
        calibration.applied(utn17, path)
    assert "\n" not in str(caught.value)
