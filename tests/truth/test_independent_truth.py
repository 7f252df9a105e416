"""A board that rides the carriage shows what a registration by the sensor's own poses hides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uvgs_bench.accuracy import Registration, error_table, fit_registration, judge
from uvgs_bench.accuracy.bench_model import predicted
from uvgs_bench.accuracy.blind_bench import BlindBench, PlannedStations, observe, random_bench, standard_stations
from uvgs_bench.accuracy.independent import BoardLink, Independent
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_exp

# Where the middle of the beacon truly is from the board, and what a measuring machine knows of it.
LINK = Pose(so3_exp(np.array([0.02, -0.01, 0.5])), np.array([0.06, 0.02, -0.03]), "board", "beacon")
LINK_SIGMA = np.array([2e-4, 2e-4, 2e-4, 3e-5, 3e-5, 3e-5])
# A turn of a board is seen to a tenth of a milliradian, its place to some micrometres, depth worst.
BOARD_SIGMA = np.array([1e-4, 1e-4, 5e-5, 5e-6, 5e-6, 5e-5])


def board_observations(bench: BlindBench, stations: PlannedStations, rng: np.random.Generator) -> Observations:
    """What a camera sees of a board at every station, as observations of it in the beacon's stead."""
    seen = observe(bench, stations, rng)
    right = bench.right @ replace(LINK.inverse(), target="beacon", source="board")
    R, t = predicted(bench.left, right, seen.R_gs, seen.t_gs_m + rng.normal(scale=1e-5, size=seen.t_gs_m.shape))
    noise: FloatArray = rng.normal(size=(seen.count, 6)) * BOARD_SIGMA
    R = np.array([so3_exp(w) @ each for w, each in zip(noise[:, :3], R, strict=True)])
    # The noise turns about the board, so the left tangent's shift goes with its place.
    J = np.broadcast_to(np.eye(6), (seen.count, 6, 6)).copy()
    hat = np.cross(t[:, None, :], np.eye(3)[None])
    J[:, 3:, :3] = np.swapaxes(hat, 1, 2)
    C = J @ np.diag(BOARD_SIGMA**2) @ J.transpose(0, 2, 1)
    return replace(
        seen, R_cb=R, t_cb_m=t + noise[:, 3:], covariance=C, is_solved=np.ones(seen.count, dtype=np.bool_),
        reason=("",) * seen.count,
    )  # fmt: skip


def independent(bench: BlindBench, rng: np.random.Generator, link: Pose = LINK) -> Independent:
    stations = standard_stations(rng, places=30, revisits=0, moving=0, shots=1)
    board = fit_registration(board_observations(bench, stations, rng), gantry_sigma_m=1e-5)
    return Independent(board, BoardLink(link, np.diag(LINK_SIGMA**2), "measuring machine"))


def error_at_zero(bench: BlindBench, found: Registration, obs: Observations) -> tuple[FloatArray, FloatArray]:
    """Error of the first predicted place, and the factor of its doubt, m."""
    table = error_table(obs, found)
    _, true_t = predicted(bench.left, bench.right, obs.R_gs, obs.t_gs_m)
    return (table.predicted_t_m - true_t)[0], table.registration_factor[0, 3:]


def test_predictions_are_as_good_as_the_chain_says() -> None:
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        bench = replace(random_bench(rng), gantry_repeatability_m=0.0)
        # The link that is told is as wrong as it says it may be.
        off = rng.normal(size=6) * LINK_SIGMA
        told = Pose(so3_exp(off[:3]) @ LINK.R, so3_exp(off[:3]) @ LINK.t_m + off[3:], "board", "beacon")
        found = independent(bench, rng, told).registration()
        stations = standard_stations(rng, places=4, revisits=0, moving=0, shots=1)
        error, factor = error_at_zero(bench, found, observe(bench, stations, rng))
        squares.append(float(error @ np.linalg.solve(factor @ factor.T, error)) / 3.0)
    # Mean of 120 unit squares: 1 to an eighth, more than twice that allowed.
    assert 0.7 < np.mean(squares) < 1.35


def test_a_constant_error_shows_only_against_the_board() -> None:
    rng = np.random.default_rng(11)
    bench = random_bench(rng)
    # All LEDs told 1 mm off: the sensor's poses are shifted by that, along the beacon's x.
    wrong = replace(bench, led_offset_m=np.tile([1e-3, 0.0, 0.0], (4, 1)))
    obs = observe(wrong, standard_stations(rng), rng)
    hidden = judge(obs, (), np.random.default_rng(1), gantry_sigma_m=1e-5)
    shown = judge(obs, (), np.random.default_rng(1), gantry_sigma_m=1e-5, independent=independent(bench, rng))
    assert hidden.summary is not None
    assert shown.summary is not None
    # Nothing to be seen against itself; the millimetre against the board, to the doubt of the chain.
    assert hidden.summary.components["position"].bias.low == 0.0
    bias = shown.summary.components["position"].bias
    np.testing.assert_allclose(bias.value, 1e-3, atol=2.5e-4)
    assert bias.low > 5e-4
    assert shown.is_independent
    assert not hidden.is_independent
    assert shown.table is not None
    assert shown.table.count == obs.count


def test_the_chain_says_how_well_each_link_is_known() -> None:
    rng = np.random.default_rng(12)
    bench = random_bench(rng)
    obs = observe(bench, standard_stations(rng), rng)
    judged = judge(obs, (), rng, independent=independent(bench, rng))
    links = {link.name: link for link in judged.links}
    assert list(links) == ["camera_from_gantry and carriage_from_board", "gantry_from_carriage", "board_from_beacon"]
    by_machine = links["board_from_beacon"]
    # The pose of the link is that of the beacon's middle, so its own doubt is carried over as it is.
    np.testing.assert_allclose(by_machine.attitude_sigma_rad, np.linalg.norm(LINK_SIGMA[:3]), rtol=1e-6)
    lever = np.linalg.norm(np.cross(LINK.t_m, np.eye(3)), axis=1) * LINK_SIGMA[:3]
    expected = np.sqrt((LINK_SIGMA[3:] ** 2).sum() + (lever**2).sum())
    np.testing.assert_allclose(by_machine.position_sigma_m, expected, rtol=1e-6)
    own = judge(obs, (), rng).links
    assert [link.is_independent for link in own] == [False, True]
