from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.errors import ConfigError, FormatError, UvgsError
from uvgs_bench.geometry import Pose
from uvgs_bench.interop.trajectories import CSV_COLUMNS, CsvPoses, LineNote, open_pose_writer, read_poses
from uvgs_bench.sensor import Capture, Miss, PoseEstimate
from uvgs_bench.sensor.handover import Held

IMAGE = np.zeros((2, 2), dtype=np.uint8)
POSE = Pose(np.eye(3), np.array([0.1, -0.2, 0.9]), "camera", "beacon")
ESTIMATE = PoseEstimate(
    POSE,
    np.diag([1e-6, 4e-6, 9e-6, 0, 0, 0]),
    1_500_000_001,
    "b",
    np.full((4, 2), np.nan),
    np.zeros((4, 2)),
    0.05,
    7.5,
    4,
)
MISS = Miss("correspondence", "ambiguous", "two poses", 1_600_000_000, "b", 5)


def write(path):
    with open_pose_writer(path) as writer:
        writer.write(Capture(IMAGE, ESTIMATE.t_ns, "a.png", 0), ESTIMATE)
        writer.write(Capture(IMAGE, MISS.t_ns, "b.png", 1), MISS)
    return path.read_text(encoding="utf-8")


def test_csv_has_exactly_the_agreed_columns_and_one_line_per_capture(tmp_path):
    lines = write(tmp_path / "p.csv").splitlines()
    assert lines[0] == (
        "index,source,t_ns,status,reason,beacon,x_m,y_m,z_m,qx,qy,qz,qw,sigma_x_m,sigma_y_m,sigma_z_m,"
        "sigma_rx_rad,sigma_ry_rad,sigma_rz_rad,rms_px,margin,blob_count,flags,is_active,held_age_s,exposure_s,"
        "next_exposure_s"
    )
    assert lines[1].startswith("0,a.png,1500000001,ok,,b,0.1,-0.2,0.9,0.0,0.0,0.0,1.0,")
    assert lines[2] == "1,b.png,1600000000,miss,correspondence/ambiguous,b,,,,,,,,,,,,,,,,5,,1,,,"
    assert len(lines) == 3
    assert all(line.count(",") == len(CSV_COLUMNS) - 1 for line in lines)


def test_sigmas_are_of_the_position_not_of_the_twist():
    # With v known exactly, dt = omega x t: sigma_x^2 = (z s_y)^2 + (y s_z)^2, and so on round.
    expected = np.sqrt([
        (0.9 * 2e-3) ** 2 + (0.2 * 3e-3) ** 2,
        (0.9 * 1e-3) ** 2 + (0.1 * 3e-3) ** 2,
        (0.2 * 1e-3) ** 2 + (0.1 * 2e-3) ** 2,
    ])  # fmt: skip
    np.testing.assert_allclose(ESTIMATE.position_sigma_m, expected, rtol=1e-12)
    np.testing.assert_allclose(ESTIMATE.rotation_sigma_rad, [1e-3, 2e-3, 3e-3], rtol=1e-12)


def test_tum_keeps_nanoseconds_and_leaves_misses_out(tmp_path):
    lines = write(tmp_path / "p.tum").splitlines()
    assert all(line.startswith("#") for line in lines[:2])
    assert lines[2:] == ["1.500000001 0.1 -0.2 0.9 0.0 0.0 0.0 1.0"]


def test_json_lines_are_strict_json(tmp_path):
    ok, miss = (json.loads(line) for line in write(tmp_path / "p.jsonl").splitlines())
    assert ok["status"] == "ok"
    assert ok["led_px"][0] == [None, None]
    assert np.array(ok["covariance"]).shape == (6, 6)
    assert (miss["stage"], miss["reason"]) == ("correspondence", "ambiguous")
    assert "NaN" not in (tmp_path / "p.jsonl").read_text()


HELD = Held(ESTIMATE, 100_000_000, MISS)


def test_a_held_pose_never_looks_fresh_in_any_format(tmp_path):
    capture = Capture(IMAGE, MISS.t_ns, "b.png", 1, 0.004)
    for name in ("p.csv", "p.tum", "p.jsonl"):
        with open_pose_writer(tmp_path / name) as writer:
            writer.write(capture, HELD, LineNote(("saturated",), True, "", 0.002, "too_bright: 95%"))
    [record] = read_poses(tmp_path / "p.csv")
    assert record.pose is None
    assert record.held_pose.is_close(POSE, 1e-12, 1e-12)
    assert (record.t_ns, record.reason, record.flags) == (
        MISS.t_ns, "correspondence/ambiguous", ("held", "saturated"),
    )  # fmt: skip
    cells = (tmp_path / "p.csv").read_text().splitlines()[1].split(",")
    assert cells[3] == "held"
    assert cells[13:21] == [""] * 8
    assert cells[-3:] == ["0.1", "0.004", "0.002"]
    assert read_poses(tmp_path / "p.tum") == []
    assert (
        "# held 1.600000000 0.1 -0.2 0.9 0.0 0.0 0.0 1.0 age_s 0.1\n# next_exposure_s 0.002: too_bright: 95%\n"
        in (tmp_path / "p.tum").read_text()
    )
    line = json.loads((tmp_path / "p.jsonl").read_text())
    assert line["status"] == "held"
    assert "t_m" not in line
    assert (line["held"]["t_ns"], line["held"]["t_m"]) == (ESTIMATE.t_ns, [0.1, -0.2, 0.9])
    assert line["next_exposure_s"] == 0.002


def test_several_beacons_get_a_tum_file_each(tmp_path):
    with open_pose_writer(tmp_path / "p.tum", beacons=("b", "two words")) as writer:
        assert [path.name for path in writer.paths] == ["p_b.tum", "p_two_words.tum"]
        writer.write(Capture(IMAGE, 1, "", 0), ESTIMATE)
        writer.write(Capture(IMAGE, 2, "", 0), replace(ESTIMATE, beacon="two words"), LineNote(switched="commanded"))
    assert [record.t_ns for record in read_poses(tmp_path / "p_b.tum")] == [1]
    assert [record.t_ns for record in read_poses(tmp_path / "p_two_words.tum")] == [2]
    assert "# active from here on: commanded\n" in (tmp_path / "p_two_words.tum").read_text()
    with pytest.raises(ConfigError, match="--force"):
        open_pose_writer(tmp_path / "p.tum", beacons=("c", "b"))
    assert not (tmp_path / "p_c.tum").exists()


def test_files_of_the_first_version_stay_readable(tmp_path):
    older = ",".join(CSV_COLUMNS[:22])
    (tmp_path / "p.csv").write_text(f"{older}\n0,a.png,5,ok,,b,0.1,-0.2,0.9,0,0,0,1" + "," * 9 + "\n")
    [record] = read_poses(tmp_path / "p.csv")
    assert record.pose.is_close(POSE, 1e-12, 1e-12)
    assert record.flags == ()


def test_a_line_is_on_the_file_before_the_writer_is_closed(tmp_path):
    writer = CsvPoses(tmp_path / "p.csv")
    writer.write(Capture(IMAGE, 0, "a.png", 0), ESTIMATE)
    assert len(read_poses(tmp_path / "p.csv")) == 1
    writer.close()


def test_existing_files_and_unknown_endings_are_refused(tmp_path):
    write(tmp_path / "p.csv")
    with pytest.raises(ConfigError, match="--force"):
        open_pose_writer(tmp_path / "p.csv")
    open_pose_writer(tmp_path / "p.csv", force=True).close()
    with pytest.raises(ConfigError, match=r"'\.txt'.*\.csv"):
        open_pose_writer(tmp_path / "p.txt")
    (tmp_path / "file").write_text("")
    with pytest.raises(UvgsError, match="cannot be written"):
        open_pose_writer(tmp_path / "file" / "p.csv")


def test_a_full_disk_is_said_in_one_line():
    from pathlib import Path

    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(UvgsError, match="No space left"):
        CsvPoses(full, force=True)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("p.csv", "a,b\n1,2\n", "columns"),
        ("p.csv", ",".join(CSV_COLUMNS) + "\n0,a,0,maybe" + "," * 23 + "\n", "p.csv:2: status"),
        ("p.tum", "1.0 0 0 0 0 0 1\n", "p.tum:1: expected 8"),
        ("p.tum", "# ok\n1.0 0 0 0 0 0 0 0\n", "p.tum:2: .*quaternion"),
        ("p.tum", "1.0 0 0 x 0 0 0 1\n", "p.tum:1"),
        ("p.bin", "", "ending"),
    ],
)
def test_broken_files_are_named_with_the_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=message):
        read_poses(tmp_path / name)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FormatError, match="nowhere"):
        read_poses(tmp_path / "nowhere.csv")
