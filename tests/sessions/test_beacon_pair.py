"""``uvgs beacon pair``: planted wander between two beacons comes out, and half a pair is refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import uvgs_bench.cli.app as cli
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.interop.trajectories import open_pose_writer
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate

COUNT, SIGMA_M, SIGMA_RAD = 400, 2e-4, 1e-3
BETWEEN = Pose(so3_exp(np.array([0.0, 0.0, 0.3])), np.array([0.1, -0.02, 0.0]), "beacon", "beacon")


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pair that swings before the camera; in every tenth capture one beacon is hidden."""
    rng = np.random.default_rng(2)
    path = tmp_path_factory.mktemp("pair") / "poses.csv"
    image = np.zeros((4, 4), dtype=np.uint8)
    with open_pose_writer(path, beacons=("left", "right")) as writer:
        for k in range(COUNT):
            t_ns = 1_000_000_000 + 20_000_000 * k
            swing = np.array([0.1 * np.sin(0.05 * k), 0.1, 0.2 * np.cos(0.03 * k)])
            first = Pose(so3_exp(swing), np.array([0.0, 0.1, 1.0]) + 0.1 * swing, "camera", "beacon")
            truth = first @ BETWEEN
            second = Pose(
                so3_exp(rng.normal(scale=SIGMA_RAD, size=3)) @ truth.R,
                truth.t_m + rng.normal(scale=SIGMA_M, size=3), "camera", "beacon",
            )  # fmt: skip
            for name, pose in (("left", first), ("right", second)):
                px = np.zeros((4, 2))
                outcome: Outcome = PoseEstimate(pose, 1e-8 * np.eye(6), t_ns, name, px, px, 0.1, 9.0, 4)
                if name == "right" and k % 10 == 0:
                    outcome = Miss("selection", "too_few_blobs", "3 of 4", t_ns, name)
                writer.write(Capture(image, t_ns, f"{k}", k), outcome)
    return path


def asked(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main(["beacon", "pair", *map(str, words)])
    said = capsys.readouterr()
    return int(end.value.code or 0), said.out, said.err


def test_the_planted_wander_comes_out(poses: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = asked(capsys, poses, "--json")
    assert code == 0
    said = json.loads(out)
    assert (said["first"], said["second"]) == ("left", "right")
    assert (said["captures_with_both"], said["captures"]) == (COUNT - COUNT // 10, COUNT)
    np.testing.assert_allclose(said["position_mm"], [100.0, -20.0, 0.0], atol=0.1)
    for key, planted in (("position_rms_mm", 0.2), ("attitude_rms_deg", np.degrees(SIGMA_RAD))):
        found = said[f"two_cluster_{key}"]
        assert found["low"] < found["value"] < found["high"]
        # Three components each, known to 2 % by 360 captures.
        np.testing.assert_allclose(found["value"], planted * 3.0**0.5, rtol=0.08)


def test_words_say_the_source(poses: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = asked(capsys, poses, "--first", "right")
    assert code == 0
    assert out.startswith("left in the frame of right: ")
    assert "E3064" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [(["--first", "up"], "no beacon 'up'"), (["--first", "left", "--second", "left"], "two different beacons")],
)
def test_half_a_pair_is_refused(poses: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    code, _, err = asked(capsys, poses, *words)
    assert code == 2
    assert said in err
