"""``uvgs run`` on bags: one picture set through every container gives the same poses, byte for byte."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.helpers import spots
from tests.helpers.bag_files import KINDS, camera_info_note, image_note, png_note, write_bag
from uvgs_bench.cli.app import main
from uvgs_bench.interop.stamp_file import PictureStamp, stamps_text
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv
START_NS = 1_700_000_000 * 10**9


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    write_calibration(folder / "camera.yaml", spots.calibration())
    write_beacon(folder / "beacon.toml", spots.beacon())
    rng = np.random.default_rng(11)
    (folder / "pictures").mkdir()
    images, stamps = [], []
    for i in range(2):
        pose = spots.random_pose(rng, cone_deg=20.0)
        image = spots.draw(spots.lens().project(pose.apply(spots.beacon().positions_m)), rng)
        cv2.imwrite(str(folder / "pictures" / f"{i}.png"), image)
        images.append(image)
        stamps.append(START_NS + i * 33_333_333)
    text = stamps_text([PictureStamp(f"{i}.png", t_ns) for i, t_ns in enumerate(stamps)])
    (folder / "pictures" / "stamps.csv").write_text(text)
    return folder, images, stamps


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in words])
    return int(caught.value.code or 0)


def poses(source: object, folder, out) -> list[str]:
    """The pose file without the column that names the source."""
    setup = ("--camera", folder / "camera.yaml", "--beacon", folder / "beacon.toml", "--quiet", "--force")
    assert uvgs("run", source, *setup, "--out", out) == 0
    return [",".join(line.split(",")[:1] + line.split(",")[2:]) for line in out.read_text().splitlines()]


@pytest.fixture(scope="module")
def expected(bench, tmp_path_factory):
    folder, _, stamps = bench
    lines = poses(f"images:{folder / 'pictures'}", folder, tmp_path_factory.mktemp("out") / "poses.csv")
    assert [int(line.split(",")[1]) for line in lines[1:]] == stamps
    assert all(",ok," in line for line in lines[1:])
    return lines


@pytest.mark.parametrize("kind", [*KINDS, "ros1-png", "mcap-png"])
def test_every_container_gives_the_same_poses(bench, expected, tmp_path, kind):
    folder, images, stamps = bench
    note = png_note if kind.endswith("png") else image_note
    path = write_bag(tmp_path, kind.removesuffix("-png"), [note(*pair) for pair in zip(images, stamps, strict=True)])
    assert poses(f"bag:{path}", folder, tmp_path / "poses.csv") == expected


def test_bags_one_after_the_other_are_one_stream(bench, expected, tmp_path):
    folder, images, stamps = bench
    notes = [image_note(*pair) for pair in zip(images, stamps, strict=True)]
    parts = [write_bag(tmp_path / kind, kind, [note]) for kind, note in zip(("db3", "mcap"), notes, strict=True)]
    assert poses(f"bag:{','.join(map(str, parts))}", folder, tmp_path / "poses.csv") == expected


@pytest.mark.parametrize("kind", ["ros1", "mcap-dir"])
def test_the_path_of_a_bag_is_enough_and_its_lens_is_taken(bench, expected, tmp_path, capfd, kind):
    folder, images, stamps = bench
    lens = spots.lens()
    notes = [camera_info_note(lens, stamps[0]), *(image_note(*pair) for pair in zip(images, stamps, strict=True))]
    path, out = write_bag(tmp_path, kind, notes), tmp_path / "poses.csv"
    assert uvgs("run", path, "--beacon", folder / "beacon.toml", "--out", out) == 0
    assert "the lens is that of /cam/camera_info; how sure it is, is not known" in capfd.readouterr().err
    columns = [line.split(",") for line in out.read_text().splitlines()]
    assert [line[3] for line in columns[1:]] == ["ok"] * 2
    # The calibration has the same numbers, and here no more doubt.
    assert spots.calibration().covariance is None
    assert [",".join(line[:1] + line[2:]) for line in columns] == expected
    bare = write_bag(tmp_path, kind, notes[1:], "bare")
    assert uvgs("run", bare, "--beacon", folder / "beacon.toml", "--out", out, "--force") == 2
    assert "--camera: is needed unless" in capfd.readouterr().err


def test_a_cut_bag_is_solved_as_far_as_it_goes(bench, expected, tmp_path, capfd):
    folder, images, stamps = bench
    path = write_bag(tmp_path, "ros1", [image_note(*pair) for pair in zip(images, stamps, strict=True)])
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 4])
    lines = poses(f"bag:{path}", folder, tmp_path / "poses.csv")
    assert len(lines) == 2
    assert lines == expected[: len(lines)]
    said = capfd.readouterr().err
    assert "read record by record" in said
    assert "ends in the middle of a" in said
    path.write_bytes(whole[:5000])
    setup = ("--camera", folder / "camera.yaml", "--beacon", folder / "beacon.toml")
    assert uvgs("run", path, *setup, "--out", tmp_path / "none.csv") == 4
    said = capfd.readouterr().err
    assert "has no message that can be read" in said
    assert "Traceback" not in said
