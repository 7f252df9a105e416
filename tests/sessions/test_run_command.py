"""``uvgs run`` end to end on drawn pictures: files, counts, exit codes, and one clear line for each mistake."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.cli.app import main
from uvgs_bench.interop.trajectories import read_poses
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    write_calibration(folder / "camera.yaml", spots.calibration())
    write_beacon(folder / "beacon.toml", spots.beacon())
    rng = np.random.default_rng(7)
    (folder / "pictures").mkdir()
    poses = []
    for i in range(4):
        pose = spots.random_pose(rng, cone_deg=20.0)
        px = spots.lens().project(pose.apply(spots.beacon().positions_m))
        if i == 2:
            px = px[:3]
        cv2.imwrite(str(folder / "pictures" / f"p{i}.png"), spots.draw(px, rng))
        poses.append(pose)
    return folder, poses


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *(str(word) for word in words)])
    return int(caught.value.code or 0)


def setup(folder) -> tuple[object, ...]:
    return ("--camera", folder / "camera.yaml", "--beacon", folder / "beacon.toml", "--quiet")


def test_one_line_per_picture_misses_included(bench, tmp_path, capfd):
    folder, poses = bench
    out = tmp_path / "poses.csv"
    assert uvgs(f"images:{folder / 'pictures'}", *setup(folder), "--out", out, "--json") == 0
    summary = json.loads(capfd.readouterr().out)
    assert (summary["captures"], summary["poses"]) == (4, 3)
    assert summary["misses"] == {"selection/too_few_blobs": 1}
    records = read_poses(out)
    assert [record.source for record in records] == ["p0.png", "p1.png", "p2.png", "p3.png"]
    assert [record.pose is not None for record in records] == [True, True, False, True]
    for record, pose in zip(records, poses, strict=True):
        if record.pose is not None:
            assert record.pose.is_close(pose, 5e-3, 3e-3)  # 0.01 px at 1 m


def test_tum_and_limit_and_a_table_for_people(bench, tmp_path, capfd):
    folder, _ = bench
    out = tmp_path / "poses.tum"
    assert uvgs(f"images:{folder / 'pictures'}", *setup(folder), "--out", out, "--limit", 2) == 0
    assert len(read_poses(out)) == 2
    assert "median" in capfd.readouterr().out


def test_the_output_is_not_overwritten_unasked(bench, tmp_path, capfd):
    folder, _ = bench
    out = tmp_path / "poses.csv"
    out.write_text("mine")
    assert uvgs(f"images:{folder / 'pictures'}", *setup(folder), "--out", out) == 2
    assert "--force" in capfd.readouterr().err
    assert out.read_text() == "mine"
    assert uvgs(f"images:{folder / 'pictures'}", *setup(folder), "--out", out, "--force") == 0


def test_no_pose_at_all_is_inconclusive(bench, tmp_path):
    folder, _ = bench
    out = tmp_path / "poses.csv"
    assert uvgs(f"images:{folder / 'pictures'}?glob=p2.png", *setup(folder), "--out", out) == 3
    assert read_poses(out)[0].reason == "selection/too_few_blobs"


def test_each_mistake_is_one_line_with_its_exit_code(bench, tmp_path, capfd):
    folder, _ = bench
    pictures = f"images:{folder / 'pictures'}"
    out = ("--out", tmp_path / "poses.csv")
    (tmp_path / "empty").mkdir()
    small = tmp_path / "small"
    small.mkdir()
    cv2.imwrite(str(small / "s.png"), np.zeros((100, 100), dtype=np.uint8))
    three = tmp_path / "three.toml"
    three.write_text("[[leds]]".join((folder / "beacon.toml").read_text().split("[[leds]]")[:4]))
    cases = [
        ((f"images:{tmp_path / 'empty'}", *setup(folder), *out), 4, "empty"),
        ((f"images:{tmp_path / 'missing'}", *setup(folder), *out), 4, "missing"),
        ((f"images:{small}", *setup(folder), *out, "--force"), 4, "100x100"),
        ((pictures, "--beacon", folder / "beacon.toml", *out, "--force"), 2, "--camera"),
        ((pictures, "--camera", folder / "camera.yaml", "--beacon", three, *out, "--force"), 2, "at least 4 LEDs"),
        ((folder / "pictures", *setup(folder), *out, "--force"), 2, "images:"),
        ((pictures, *setup(folder), "--out", tmp_path / "poses.xyz"), 2, "ending"),
    ]
    for words, code, text in cases:
        assert uvgs(*words) == code, words
        said = capfd.readouterr().err
        assert text in said
        assert "Traceback" not in said


def test_a_runs_kept_pictures_solve_to_the_same_poses_again(tmp_path, pytestconfig, monkeypatch, capfd):
    from uvgs_bench.store.run import read_run

    monkeypatch.chdir(pytestconfig.rootpath)
    with pytest.raises(SystemExit) as caught:
        main(["gantry-sweep", "procedures/quick_line.toml", "--out", str(tmp_path / "runs"), "--sim-speed", "100"])
    assert not caught.value.code
    folder = next((tmp_path / "runs").iterdir())
    assert uvgs(folder, "--out", tmp_path / "again.csv", "--quiet") == 0
    again = {record.source: record.pose for record in read_poses(tmp_path / "again.csv")}
    samples = [sample for sample in read_run(folder).samples if sample.is_solved]
    assert len(samples) >= 10
    for sample in samples:
        # The file keeps a quaternion, the journal a matrix: they differ by rounding only.
        assert again[sample.capture_file].is_close(sample.outcome.camera_from_beacon, 1e-13, 0.0)
    capfd.readouterr()
