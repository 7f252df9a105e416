"""Doubts of time and temperature go from the bench file into the budget, and links of boards are read strictly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.synthetic_run import synthetic_run, write_run
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.board_links import read_board_link
from uvgs_bench.store.judging import judge_run
from uvgs_bench.store.run import read_run
from uvgs_bench.store.run_writer import SETUP, SETUP_BENCH

ROOT = Path(__file__).parents[3]
LINK = """
schema = 1
board = "a_board"
beacon = "a_beacon"
position_mm = [10.0, 20.0, 30.0]
euler_zyx_deg = [90.0, 0.0, 0.0]
sigma_position_mm = [0.1, 0.1, 0.1]
sigma_rotation_deg = [0.0, 0.0, 0.05]
source = "measuring machine"
"""


def bench_with(folder: Path, line: str) -> Path:
    text = (ROOT / "calib" / "bench.toml").read_text().replace("position_sigma_mm", f"{line}\nposition_sigma_mm", 1)
    path = folder / "bench.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("key", ["time_sigma_ms", "temperature_span_k"])
def test_a_negative_doubt_is_refused(tmp_path: Path, key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key} must not be negative"):
        read_bench(bench_with(tmp_path, f"{key} = -1.0"))


def test_the_run_s_copy_of_the_bench_file_feeds_the_budget(tmp_path: Path) -> None:
    run = read_run(write_run(synthetic_run(), tmp_path / "20260102T030405Z_synthetic"))
    before = judge_run(run).budget
    assert before is not None
    assert not next(line for line in before.lines if line.name == "temperature of the gantry").is_known
    (run.path / SETUP).mkdir(exist_ok=True)
    bench_with(run.path / SETUP, "temperature_span_k = 4.0").rename(run.path / SETUP / SETUP_BENCH)
    after = judge_run(replace(run)).budget
    assert after is not None
    warm = next(line for line in after.lines if line.name == "temperature of the gantry")
    assert warm.is_known
    # 2 K to either side of half a metre of aluminium: some micrometres, less what the registration takes up.
    assert 1e-6 < warm.position_m < 3e-5


def test_a_link_is_read(tmp_path: Path) -> None:
    path = tmp_path / "link.toml"
    path.write_text(LINK)
    link = read_board_link(path, "a_board", "a_beacon")
    np.testing.assert_allclose(link.board_from_beacon.t_m, [0.01, 0.02, 0.03], atol=1e-15)
    np.testing.assert_allclose(link.board_from_beacon.R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    # Stated is the doubt of the beacon's place: the left tangent's, moved there, must be that again.
    x, y, z = link.board_from_beacon.t_m
    J = np.eye(6)
    J[3:, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    at_beacon = J @ link.covariance @ J.T
    expected = np.diag(np.concatenate([[0.0, 0.0, np.radians(0.05) ** 2], np.full(3, 1e-8)]))
    np.testing.assert_allclose(at_beacon, expected, atol=1e-18)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("a_beacon", "another"), "beacon: is 'another', expected 'a_beacon'"),
        (("0.05]", "-0.05]"), "must not be negative"),
        (("measuring machine", " "), "who measured"),
        (("source", "sauce"), "source"),
    ],
)
def test_a_link_that_cannot_be_meant_is_refused(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    path = tmp_path / "link.toml"
    path.write_text(LINK.replace(*change, 1))
    with pytest.raises(ConfigError, match=message):
        read_board_link(path, "a_board", "a_beacon")
