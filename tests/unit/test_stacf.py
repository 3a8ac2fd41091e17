"""Space-time correlations, the portmanteau test, and spatial weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from utn_sumo import plots
from utn_sumo.contract import EXIT, Floats, Network
from utn_sumo.errors import SettingError
from utn_sumo.prediction import network_weights, portmanteau, stacf, stpacf

W1 = np.array([[0, 1, 0], [0.5, 0, 0.5], [0, 1, 0]])
Z = np.array([(1, 2, 0), (2, 1, 3), (0, 4, 2), (3, 2, 5), (4, 1, 1), (2, 5, 3), (5, 3, 4), (6, 2, 5)], dtype=float)


def ring(sites: int, *steps: int) -> Floats:
    """Each site's neighbours are those so many places away on a ring, both ways."""
    weights = np.zeros((sites, sites))
    place = np.arange(sites)
    for step in steps:
        weights[place, (place + step) % sites] = weights[place, (place - step) % sites] = 1
    return weights


def test_the_reference_figures_of_the_spec() -> None:
    assert stacf(Z, [W1], 2) == pytest.approx(np.array([[-0.0032223, 0.4170646], [-0.0275689, 0.1772006]]), abs=1e-6)
    assert stpacf(Z, [W1], 2) == pytest.approx(np.array([[-0.0032223, 0.4930633], [-0.1337953, 0.2689935]]), abs=1e-6)


@pytest.mark.parametrize("found", [stacf, stpacf])
def test_the_common_mean_changes_nothing(found: type[object]) -> None:
    assert found(Z - Z.mean(), [W1], 3) == pytest.approx(found(Z + 100, [W1], 3))


def test_identity_in_front_and_weights_of_zeros_and_ones_are_the_same_weights() -> None:
    assert stacf(Z, [np.eye(3), W1], 2) == pytest.approx(stacf(Z, [W1 > 0], 2))


def test_the_first_partial_autocorrelation_of_one_site_is_its_autocorrelation() -> None:
    assert stpacf(Z[:, :1], [], 1) == pytest.approx(stacf(Z[:, :1], [], 1))


def test_the_partial_autocorrelations_of_a_star_end_with_its_order() -> None:
    rng = np.random.default_rng(1)
    z = np.zeros((3000, 9))
    weights = ring(9, 1)
    for t in range(1, len(z)):
        z[t] = 0.4 * z[t - 1] + 0.3 * weights @ z[t - 1] / 2 + rng.normal(size=9)
    found = stpacf(z, [weights], 3)
    assert found[0, 1] == pytest.approx(0.3, abs=0.03)
    assert np.abs(found[1:]).max() < 0.04


def test_a_spatial_order_without_neighbours_has_no_correlation() -> None:
    for found in (stacf, stpacf):
        assert (found(Z, [W1, np.zeros((3, 3))], 2)[:, 2] == 0).all()


def test_missing_values_count_as_the_mean() -> None:
    gaps = Z.copy()
    gaps[3, 1] = np.nan
    filled = np.where(np.isnan(gaps), np.nanmean(gaps), gaps)
    assert stacf(gaps, [W1], 2) == pytest.approx(stacf(filled, [W1], 2))


@pytest.mark.parametrize("weights", [[ring(12, 1), ring(12, 2)], [ring(12, 1), ring(12, 1, 2)]])
def test_the_portmanteau_refuses_white_noise_at_its_rate(weights: list[Floats]) -> None:
    # Also where the neighbours of one order are those of another.
    rng = np.random.default_rng(2)
    values = np.array([portmanteau(rng.normal(size=(150, 12)), weights, 4).pvalue for _ in range(300)])
    assert (values < 0.1).mean() == pytest.approx(0.1, abs=0.05)
    assert values.mean() == pytest.approx(0.5, abs=0.05)


def test_the_portmanteau_sees_what_only_neighbours_tell() -> None:
    rng = np.random.default_rng(3)
    e = rng.normal(size=(151, 12))
    found = portmanteau(e[1:] + 0.2 * e[:-1] @ ring(12, 1).T / 2, [ring(12, 1)], 3)
    assert found.df == 6
    assert found.pvalue < 1e-3


@pytest.mark.parametrize("hole", [False, True])
def test_the_correlations_are_drawn(tmp_path: Path, hole: bool) -> None:
    z = np.where(hole & (Z == 5), np.nan, Z)
    plots.space_time_correlations(z, [W1], 4, tmp_path / "z.png", "8 x 3")
    assert (tmp_path / "z.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("z", "weights", "nlags", "message"),
    [
        (Z, [W1], 8, "nlags: 8 is out of range; 8 rows allow 1 to 7"),
        (Z, [W1[:2]], 2, r"weights: W_1 has shape \(2, 3\); 3 series want"),
        (Z, W1, 2, r"weights: W_1 has shape \(3,\)"),
        (Z, [-W1], 2, r"weights: W_1\[0, 1\] is -1"),
        (Z, [W1 * np.nan], 2, r"weights: W_1\[0, 0\] is nan"),
        (Z[:, 0], [W1], 2, r"z: shape \(8,\)"),
        (Z * 0, [W1], 2, "z: all 24 values are the same"),
        (Z * np.nan, [W1], 2, "0 finite values"),
    ],
)
def test_what_cannot_be_correlated_is_refused_in_one_line(z: Floats, weights: object, nlags: int, message: str) -> None:
    with pytest.raises(SettingError, match=message) as caught:
        stacf(z, weights, nlags)
    assert "\n" not in str(caught.value)


def test_a_portmanteau_needs_more_lags_than_fitted_coefficients() -> None:
    with pytest.raises(SettingError, match="nlags: 2 with 2 spatial orders leaves no degree of freedom beside 4"):
        portmanteau(Z, [W1], 2, fitted=4)


class TestNetworkWeights:
    def test_first_order_is_the_turning_fractions_into_a_link(self, utn17: Network) -> None:
        (found,) = network_weights(utn17, 1)
        share = np.zeros_like(found)
        for turn in utn17.turns:
            if turn.next_link != EXIT:
                share[turn.next_link, turn.link] += turn.fraction
        fed = share.sum(axis=1) > 0
        assert found[fed] == pytest.approx(share[fed] / share[fed].sum(axis=1, keepdims=True))
        assert (found[~fed] == 0).all()

    def test_higher_orders_are_farther_upstream_and_never_nearer(self, utn17: Network) -> None:
        found = network_weights(utn17, 3)
        assert (sum(matrix > 0 for matrix in found) <= 1).all()
        assert all((np.diag(matrix) == 0).all() for matrix in found)
        for matrix in found:
            assert set(np.round(matrix.sum(axis=1), 12)) <= {0.0, 1.0}
        second, first = found[1] > 0, found[0] > 0
        assert (second <= (first.astype(int) @ first > 0)).all()

    def test_links_left_out_are_passed_through(self, utn17: Network) -> None:
        whole = network_weights(utn17, 2)[1]
        row = int(np.argmax((whole > 0).sum(axis=1)))
        far = np.flatnonzero(whole[row])
        part = network_weights(utn17, 2, links=[row, *far])
        assert (part[0][0] == 0).all()
        assert part[1][0, 1:] == pytest.approx(whole[row, far])

    def test_sources_have_nearest_neighbours_of_each_order(self, utn17: Network) -> None:
        sources = np.flatnonzero(utn17.is_source)
        assert not network_weights(utn17, 1, sources)[0].any()
        first, second = network_weights(utn17, 2, sources, "nearest")
        assert first.sum(axis=1) == pytest.approx(1)
        assert not ((first > 0) & (second > 0)).any()
        assert (np.diag(first) == 0).all()

    @pytest.mark.parametrize(
        ("asked", "message"),
        [
            ({"orders": 0}, "orders: 0 is no spatial order"),
            ({"orders": 1, "links": [99]}, "links: .* are not links of 'utn17'; give indices from 0 to 16"),
            ({"orders": 1, "neighbours": "nearby"}, "neighbours: 'nearby' is unknown; did you mean 'nearest'"),
        ],
    )
    def test_unhappy_askings_are_one_line(self, utn17: Network, asked: dict[str, object], message: str) -> None:
        with pytest.raises(SettingError, match=message):
            network_weights(utn17, **asked)
