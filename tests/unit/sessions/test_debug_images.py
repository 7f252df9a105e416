"""Debug images show the outcome and do not break on any picture; ``uvgs run --debug-images`` writes one per capture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.cli.app import main
from uvgs_bench.sensor import Capture, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.blobs import NoBlobs, find_blobs
from uvgs_bench.sensor.overlay import arrow_gain, blob_notes
from uvgs_bench.sessions import debug_images as di
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv


def scene(detection: str = "fast", colour: bool = False) -> tuple[Uvgs, Capture]:
    rng = np.random.default_rng(7)
    uvgs = Uvgs(spots.calibration(), spots.beacon(), UvgsConfig(detection=detection))
    pose = spots.random_pose(rng, 20.0, 0.6, 0.8)
    px = spots.lens().project(pose.apply(spots.beacon().positions_m))
    lights = np.array([[200.0, 200.0], [900.0, 700.0]])
    image = spots.draw(np.vstack([px, lights]), rng, 170.0, np.array([1.8] * 4 + [40.0, 1.6]))
    return uvgs, Capture(np.repeat(image[:, :, None], 3, axis=2) if colour else image, 0, "p²°.png", 3)


def count(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - colour).max(axis=2) < 12).sum())


@pytest.mark.parametrize("detection", ["fast", "paper"])
@pytest.mark.parametrize("colour", [False, True])
def test_a_pose_shows_axes_arrows_and_a_dropped_light(detection, colour):
    uvgs, capture = scene(detection, colour)
    outcome = uvgs.solve(capture)
    assert isinstance(outcome, PoseEstimate)
    picture = di.draw_debug_image(capture, outcome, uvgs)
    assert picture.dtype == np.uint8
    assert picture.shape == (960 + 84 + 30, 1280 + 216, 3)
    body = picture[84:-30, :1280]
    # Nothing in a grey picture has these colours but what is drawn.
    assert count(body, di.RED) > 10
    assert count(body, di.GREEN) > 60
    # The mask of the paper shows the wide light; it is too large to be measured as a blob there.
    assert count(body, di.ORANGE if detection == "fast" else di.BLUE) > 20
    origin = uvgs.calibration.lens.project(outcome.camera_from_beacon.t_m[None])[0]
    x, y = np.round(origin).astype(int)
    assert body[y - 3 : y + 4, x - 3 : x + 4].max() > 200


def test_a_dropped_light_says_why():
    uvgs, capture = scene()
    blobs = find_blobs(capture, uvgs.config)
    assert not isinstance(blobs, NoBlobs)
    notes = blob_notes(blobs, uvgs)
    dropped = {note.dropped for note in notes if note.dropped}
    assert len(dropped) == 1
    assert dropped.pop().startswith(("shape", "area"))
    assert sum(not note.dropped for note in notes) == 5


@pytest.mark.parametrize(
    "image",
    [
        np.full((960, 1280), 9, dtype=np.uint8),
        np.random.default_rng(1).integers(0, 4096, (960, 1280)).astype(np.uint16),
        spots.draw(np.array([[0.0, 0.0], [1279.0, 959.0], [640.0, 480.0]]), np.random.default_rng(2)),
    ],
)
def test_every_miss_can_be_drawn(image):
    uvgs, _ = scene()
    capture = Capture(image, 0)
    outcome = uvgs.solve(capture)
    assert not isinstance(outcome, PoseEstimate)
    picture = di.draw_debug_image(capture, outcome, uvgs)
    # Thin smoothed strokes are mostly blends of orange and ground, so it is the tint that counts.
    header = picture[:84].astype(int)
    assert ((header[:, :, 2] - header[:, :, 0]) > 60).sum() > 50


def test_arrows_are_as_long_as_can_be_seen_and_no_longer():
    assert arrow_gain(np.array([[0.1, 0.0], [np.nan, np.nan]])) == 200
    assert arrow_gain(np.array([[90.0, 0.0]])) == 1
    assert arrow_gain(np.array([[1e-9, 0.0]])) == 500


def test_run_writes_one_image_per_capture(tmp_path):
    uvgs, capture = scene()
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "a.png"), capture.image)
    cv2.imwrite(str(tmp_path / "pictures" / "b.png"), np.full((960, 1280), 9, dtype=np.uint8))
    write_calibration(tmp_path / "camera.yaml", uvgs.calibration)
    write_beacon(tmp_path / "beacon.toml", uvgs.beacon)
    words = [
        "run", f"images:{tmp_path / 'pictures'}", "--camera", str(tmp_path / "camera.yaml"), "--quiet",
        "--beacon", str(tmp_path / "beacon.toml"), "--out", str(tmp_path / "p.csv"),
        "--debug-images", str(tmp_path / "seen"),
    ]  # fmt: skip
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 0
    names = sorted(path.name for path in (tmp_path / "seen").iterdir())
    assert names == ["000000_pose.png", "000001_miss_preprocess_no_contrast.png"]
    assert cv2.imread(str(tmp_path / "seen" / names[0])).shape == (1074, 1496, 3)
    # Neither poses nor pictures are replaced unasked.
    (tmp_path / "p.csv").unlink()
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
