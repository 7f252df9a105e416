"""What scatters a visit: the quick way to weigh many guesses gives what the plain way gives."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.accuracy.variance_components import Scatter, Visits, _Whitening, visits_of, whitened


def _visits(of_place: list[int], shots: int, rng: np.random.Generator) -> Visits:
    station = np.repeat(np.arange(len(of_place)), shots)
    sides = rng.normal(size=(len(station), 6, 6)) * np.array([1e-3, 1e-3, 3e-4, 1e-4, 1e-4, 5e-4])[:, None]
    covariance = sides @ sides.transpose(0, 2, 1)
    residual = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(len(station), 6)))
    # One capture of some visits is missing.
    kept = np.arange(len(station)) % 7 != 3
    place = np.array(of_place, dtype=np.int64)[station]
    return visits_of(residual[kept], covariance[kept], station[kept], place[kept])[0]


@pytest.mark.parametrize(
    "of_place", [[0, 1, 2, 3, 4, 5], [0, 1, 0, 2, 3, 0, 2, 4], [0, 0, 1, 1]], ids=["once", "mixed", "twice"]
)
@pytest.mark.parametrize("scatter", [Scatter(1.0, 0.1, 1e-10), Scatter(2.5, 1e-3, 4e-8), Scatter(0.6, 7.0, 1e-14)])
def test_many_scatters_whiten_alike(of_place: list[int], scatter: Scatter) -> None:
    rng = np.random.default_rng(3)
    visits = _visits(of_place, 3, rng)
    table = rng.normal(size=(len(of_place), 6, 4)) * 1e-3
    plain, determinant = whitened(visits, scatter, table)
    quick, same = _Whitening(visits, table).by(scatter)
    # Relative, of the largest: covariances with condition numbers of 1e6 lose as many digits on both ways.
    assert np.allclose(quick.T @ quick, plain.T @ plain, rtol=0.0, atol=1e-9 * np.abs(plain.T @ plain).max())
    assert same == pytest.approx(determinant, abs=1e-8)
