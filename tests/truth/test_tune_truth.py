"""``uvgs tune`` on scenes planted to fail: it solves them, to the true poses, and never makes things worse."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.cli.app import main
from uvgs_bench.errors import CaptureError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor import Capture, PoseEstimate, UvgsConfig
from uvgs_bench.sessions import tune as tuning
from uvgs_bench.sessions.events import ignore_events
from uvgs_bench.sessions.tune_file import sensor_text
from uvgs_bench.sessions.tune_measure import hue_range_deg
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration
from uvgs_bench.store.documents import parse_document, read_document

pytestmark = pytest.mark.opencv


def scene(count: int, seed: int, peak_dn: float, glare: bool, hot: int) -> tuple[list[Capture], list[Pose]]:
    """Captures of a beacon with LEDs of this height, beside a clipped glare or steady small bright points."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([20, 20], [1260, 940], (hot, 2))
    captures, poses = [], []
    for i in range(count):
        pose = spots.random_pose(rng, 25.0, 0.8, 1.2)
        px = [spots.lens().project(pose.apply(spots.beacon().positions_m)), points]
        peaks, sigmas = [np.full(4, peak_dn), np.full(hot, 140.0)], [np.full(4, 1.4), np.full(hot, 0.35)]
        if glare:
            px.append(np.array([[1150.0, 120.0]]))
            peaks.append(np.array([2000.0]))
            sigmas.append(np.array([25.0]))
        image = spots.draw(np.vstack(px), rng, np.concatenate(peaks), np.concatenate(sigmas))
        captures.append(Capture(image, i, f"c{i}.png", i, 0.004))
        poses.append(pose)
    return captures, poses


def run(captures: list[Capture], **more) -> tuning.TuneResult:
    return tuning.tune(captures, spots.calibration(), spots.beacon(), ignore_events, **more)


@pytest.mark.parametrize(
    ("peak_dn", "glare", "hot", "key"), [(14.0, True, 0, "threshold_floor"), (170.0, False, 20, "min_area_px2")]
)
def test_a_planted_bad_scene_is_mended(peak_dn, glare, hot, key):
    captures, poses = scene(12, 3, peak_dn, glare, hot)
    result = run(captures)
    assert result.score_before.poses <= 2
    assert result.score_proposed.poses >= 10
    assert result.check_proposed is not None
    assert result.check_proposed.poses >= 5
    for outcome, pose in zip(result.outcomes_proposed, poses, strict=True):
        if isinstance(outcome, PoseEstimate):
            # LEDs of 13 DN in 1.2 DN of noise: 0.2 px, some mm at 1 m; a wrong pose is off by centimetres.
            assert outcome.camera_from_beacon.is_close(pose, 0.05, 0.02)
    changes = {change.key: change for change in result.changes}
    assert key in changes
    assert changes[key].worth >= 8
    assert any(ch.isdigit() for ch in changes[key].why)
    # What decides whether a pose is believed is as it was.
    for name in ("min_margin", "max_chance_fits", "max_chi2_per_dof", "max_rms_px", "model_error_px"):
        assert getattr(result.proposed, name) == getattr(UvgsConfig(), name)


def test_a_good_scene_is_left_alone_and_a_hopeless_one_is_called_so():
    good = run(scene(6, 4, 170.0, False, 0)[0])
    assert good.proposed == UvgsConfig()
    assert good.changes == ()
    assert "nothing to change" in good.remarks[0]
    assert any("exposure is right" in line for line in good.remarks)
    dark = run(scene(6, 5, 2.0, True, 0)[0])
    assert dark.proposed == UvgsConfig()
    assert dark.score_proposed.poses == 0
    assert "must change" in dark.remarks[0]


def test_what_is_measured_is_what_was_planted():
    result = run(scene(6, 6, 170.0, True, 0)[0])
    # Planted: background 12 DN, sqrt(1 + 12 / 40 + 1 / 12) = 1.18 DN of noise, one glare that clips.
    assert result.noise.background_dn == 12.0
    assert result.noise.temporal_dn == pytest.approx(1.18, abs=0.05)
    assert result.noise.spatial_dn == pytest.approx(1.18, abs=0.25)
    assert result.lights.others == 1.0
    assert result.lights.brightest_other_dn == 255.0
    # A pixel's mean at the centre of a spot of 1.4 px is 0.96 of its height, less when it falls between pixels.
    assert 135.0 < result.lights.least_height_dn < 170.0
    assert 0.7 < result.lights.range_m < 1.3


def test_proposals_are_dropped_when_a_pose_is_lost_or_disagrees():
    captures, poses = scene(6, 7, 170.0, False, 0)
    blind = UvgsConfig(threshold_floor=0.9, min_contrast=0.9)
    bench = tuning._Bench(spots.calibration(), spots.beacon(), tuple(captures), ignore_events)
    kept, remarks = tuning._verified(bench, UvgsConfig(), blind)
    assert kept == UvgsConfig()
    assert "lost" in remarks[0]
    kept, _ = tuning._verified(bench, blind, UvgsConfig())
    assert kept == UvgsConfig()
    assert len(poses) == 6


def test_no_captures_is_an_error():
    with pytest.raises(CaptureError, match="no captures"):
        run([])


def test_the_file_is_read_back_to_the_proposal(tmp_path):
    result = run(scene(6, 8, 14.0, True, 0)[0])
    text = sensor_text(result, "images:x\ny")
    (tmp_path / "sensor.toml").write_text(text, encoding="utf-8")
    assert read_document(tmp_path / "sensor.toml", UvgsConfig) == result.proposed
    assert text.count("\n#") == len(result.changes)
    assert parse_document({}, UvgsConfig, "x") == UvgsConfig()


def test_hues_wrap_through_red():
    assert hue_range_deg([350.0, 10.0, 355.0], 5.0) == (345.0, 15.0)
    assert hue_range_deg([100.0, 140.0], 0.0) == (100.0, 140.0)


def test_the_command_writes_a_file_that_run_accepts(tmp_path, capfd):
    captures, _ = scene(6, 9, 14.0, True, 0)
    (tmp_path / "pictures").mkdir()
    for capture in captures:
        cv2.imwrite(str(tmp_path / "pictures" / capture.source), capture.image)
    write_calibration(tmp_path / "camera.yaml", spots.calibration())
    write_beacon(tmp_path / "beacon.toml", spots.beacon())
    common = [
        f"images:{tmp_path / 'pictures'}", "--camera", str(tmp_path / "camera.yaml"), "--quiet",
        "--beacon", str(tmp_path / "beacon.toml"),
    ]  # fmt: skip
    sensor = tmp_path / "sensor.toml"

    def uvgs(*words: str) -> int:
        with pytest.raises(SystemExit) as caught:
            main(list(words))
        return int(caught.value.code or 0)

    tuned = ["tune", *common, "--out", str(sensor), "--pictures", str(tmp_path / "seen")]
    assert uvgs(*tuned, "--json") == 0
    said = json.loads(capfd.readouterr().out)
    assert said["proposed"]["poses"] > said["before"]["poses"] == 0
    assert {path.name.split("_")[1] for path in (tmp_path / "seen").iterdir()} == {"before.png", "proposed.png"}
    assert uvgs("run", *common, "--config", str(sensor), "--out", str(tmp_path / "p.csv"), "--json") == 0
    assert json.loads(capfd.readouterr().out)["poses"] == said["proposed"]["poses"]
    assert uvgs(*tuned) == 2
    assert "--force" in capfd.readouterr().err
    assert uvgs("tune", *common) == 0
    shown = capfd.readouterr().out
    assert "threshold_floor" in shown
    assert "dimmest LED" in shown
