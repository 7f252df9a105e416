"""``uvgs fuse`` from end to end: bags, missions, outputs, and what it says of inputs that do not fit."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.fusion_bag import START_NS, drawn_source, write_bag
from tests.helpers.fusion_flight import fly, state_at
from uvgs_bench.cli.app import main
from uvgs_bench.geometry import Pose
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.interop.fused_states import FUSED_COLUMNS, TOPIC
from uvgs_bench.interop.navigation_messages import ODOMETRY, pose_from_message

BODY_FROM_CAMERA = Pose.exp((-1.2092, 1.2092, -1.2092, 0.1, 0.0, 0.05), "body", "camera")
WORLD_FROM_BEACON = Pose.exp((-1.2092, 1.2092, -1.2092, 1.2, 0.1, 0.0), "world", "beacon")
SETUP = """schema = 1
rest_s = 0.8
sigma_floor_mm = 0.0
sigma_floor_deg = 0.0
[body_from_camera]
position_mm = [100.0, 0.0, 50.0]
euler_zyx_deg = [-90.0, 0.0, -90.0]
[world_from_beacon]
position_mm = [1200.0, 100.0, 0.0]
euler_zyx_deg = [-90.0, 0.0, -90.0]
[topics]
poses = "/uvgs/tetra/pose"
"""


def run(*arguments):
    with pytest.raises(SystemExit) as left:
        main([str(a) for a in arguments])
    return left.value.code


@pytest.fixture(scope="module")
def source():
    # The set-up file's angles are exact; those of the flight must be.
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = Pose(ahead, np.array([0.1, 0.0, 0.05]), "body", "camera")
    beacon = Pose(ahead, np.array([1.2, 0.1, 0.0]), "world", "beacon")
    whole = drawn_source(fly(9), beacon, camera)
    # Nine seconds are enough: rest, two legs and a corner.
    return replace(
        whole,
        imu=whole.imu.between(0, 9_000_000_000),
        sensed=tuple(pose for pose in whole.sensed if pose.t_ns < 9_000_000_000),
        native=tuple(m for m in whole.native if m.t_ns < 9_000_000_000),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory, source):
    here = tmp_path_factory.mktemp("fusion")
    (here / "setup.toml").write_text(SETUP)
    write_bag(here / "all.bag", source)
    return here


@pytest.mark.parametrize("ending", ["bag", "mcap"])
def test_a_bag_is_fused_to_the_truth(folder, source, tmp_path, capsys, ending):
    bag = folder / f"all.{ending}"
    if not bag.exists():
        write_bag(bag, source)
    out = tmp_path / "fused.csv"
    code = run("fuse", bag, "--setup", folder / "setup.toml", "--out", out, "--json", "-q")
    said = json.loads(capsys.readouterr().out)
    assert code == 0, said["problems"]
    assert said["runs"][0]["updates"]["uvgs"]["fused"] > 70
    assert any("counts as delay" in line for line in said["remarks"])
    with out.open() as text:
        rows = list(csv.DictReader(text))
    assert tuple(rows[0]) == FUSED_COLUMNS
    errors = []
    for row in rows:
        true = state_at(int(row["t_ns"]) - START_NS).pose.t_m
        errors.append(np.linalg.norm(true - [float(row[name]) for name in ("x_m", "y_m", "z_m")]))
    # Poses of 1 mrad and 0.5 mm seen from 1.1 m: some 1.5 mm each, less when fused.
    assert np.sqrt(np.mean(np.square(errors))) < 0.0015


def test_states_are_written_to_every_format_alike(folder, tmp_path, capsys):
    outs = [tmp_path / f"fused.{ending}" for ending in ("csv", "tum", "jsonl", "bag", "mcap")]
    arguments = [word for out in outs for word in ("--out", out)]
    run("fuse", folder / "all.bag", "--setup", folder / "setup.toml", *arguments, "-q")
    capsys.readouterr()
    with outs[0].open() as text:
        table = list(csv.DictReader(text))
    lines = [line.split() for line in outs[1].read_text().splitlines() if not line.startswith("#")]
    records = [json.loads(line) for line in outs[2].read_text().splitlines()]
    assert len(table) == len(lines) == len(records) > 150
    k = 100
    row = table[k]
    place = [float(row[name]) for name in ("x_m", "y_m", "z_m")]
    assert [float(v) for v in lines[k][1:4]] == place == records[k]["t_m"]
    assert f"{lines[k][0].replace('.', '')}" == row["t_ns"] == str(records[k]["t_ns"])
    P = np.array(records[k]["covariance"])
    assert float(row["sigma_x_m"]) == pytest.approx(np.sqrt(P[0, 0]))
    assert float(row["cov_rx_x_rad_m"]) == pytest.approx(P[6, 0])
    for bag in outs[3:]:
        with open_bags([bag]) as bags:
            messages = [message.decode() for message in bags.messages({TOPIC})]
        stamped = pose_from_message(messages[k], ODOMETRY)
        assert stamped.t_ns == records[k]["t_ns"]
        np.testing.assert_array_equal(stamped.position_m, place)
        np.testing.assert_allclose(np.diag(stamped.covariance), np.diag(P)[[6, 7, 8, 0, 1, 2]], rtol=1e-12)


def test_an_existing_file_is_kept(folder, tmp_path, capsys):
    out = tmp_path / "kept.csv"
    out.write_text("mine")
    assert run("fuse", folder / "all.bag", "--setup", folder / "setup.toml", "--out", out) == 2
    assert "--force" in capsys.readouterr().err
    assert out.read_text() == "mine"


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"offset": 0.06}, 3, "clocks: the sensor's stamps are"),
        ({"with_imu": False}, 4, "no readings of an inertial unit"),
        ({"missing": True}, 4, "hold no angular_velocity"),
        ({"doubted": False}, None, "state no covariance"),
    ],
)
def test_inputs_that_do_not_fit_are_named(source, folder, tmp_path, capsys, change, code, words):
    bag = tmp_path / "bad.bag"
    offset_s = change.pop("offset", 0.0)
    spoilt = replace(source, imu=source.imu.shifted(round(-offset_s * 1e9)))
    write_bag(bag, spoilt, **change)
    left = run("fuse", bag, "--setup", folder / "setup.toml", "-q")
    printed = capsys.readouterr()
    assert words in " ".join((printed.out + printed.err).split())
    if code is not None:
        assert left == code


def test_gaps_of_the_unit_are_named(source, folder, tmp_path, capsys):
    imu = source.imu
    keep = (imu.t_ns < 5_000_000_000) | (imu.t_ns > 5_700_000_000)
    holed = type(imu)(imu.t_ns[keep], imu.acceleration_mps2[keep], imu.rate_radps[keep])
    bag = tmp_path / "gap.bag"
    write_bag(bag, replace(source, imu=holed))
    assert run("fuse", bag, "--setup", folder / "setup.toml", "--json", "-q") == 3
    said = json.loads(capsys.readouterr().out)
    assert any("pauses 1 times" in line for line in said["problems"])
    # From the last reading before to the first after.
    assert said["runs"][0]["imu_gaps"][0]["length_s"] == pytest.approx(0.72, abs=0.005)


def test_another_localiser_is_used_when_named(folder, tmp_path, capsys):
    setup = tmp_path / "both.toml"
    setup.write_text(SETUP + 'native = "/loc/pose"\n')
    assert run("fuse", folder / "all.bag", "--setup", setup, "--json", "-q") in (0, 3)
    said = json.loads(capsys.readouterr().out)
    assert [way["name"] for way in said["runs"]] == ["fused", "native alone", "without native"]
    assert said["runs"][0]["updates"]["native"]["fused"] > 5


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["sim:moon"], 2, "no mission 'moon', expected one of square, occlusion, gt2"),
        (["nowhere.bag"], 4, "no such file"),
        (["{bag}"], 2, "name --setup"),
        (["{bag}", "--setup", "{setup}", "--false-poses", "2:0.3"], 2, "share from 0 to 1"),
        (["{bag}", "--setup", "{setup}", "--smooth", "--method", "ar_swap"], 2, "filter's states only"),
        (["{bag}", "--setup", "{setup}", "--learn-beacon"], 2, "option of --method graph"),
        (["{bag}", "--setup", "{setup}", "--out", "x.txt"], 2, "unknown ending '.txt'"),
        (["{bag}", "--setup", "{setup}", "--out", "x.csv", "--out", "x.csv"], 2, "named twice"),
        (["{bag}", "--setup", "{bag}"], 4, "is no text"),
    ],
)
def test_wrong_input_is_one_clear_line(folder, capsys, arguments, code, words):
    places = {"bag": str(folder / "all.bag"), "setup": str(folder / "setup.toml")}
    assert run("fuse", *[word.format(**places) for word in arguments], "-q") == code
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said


def test_unknown_topics_and_keys_are_named(folder, tmp_path, capsys):
    setup = tmp_path / "wrong.toml"
    setup.write_text(SETUP.replace("/uvgs/tetra/pose", "/uvgs/tetra/pose2"))
    assert run("fuse", folder / "all.bag", "--setup", setup, "-q") == 2
    assert "/uvgs/tetra/pose" in capsys.readouterr().err
    setup.write_text(SETUP.replace("rest_s", "rests_s"))
    assert run("fuse", folder / "all.bag", "--setup", setup, "-q") == 2
    assert "rest_s" in capsys.readouterr().err


def test_poses_alone_need_no_inertial_unit(source, folder, tmp_path, capsys):
    bag = tmp_path / "poses.bag"
    write_bag(bag, source, with_imu=False)
    assert run("fuse", bag, "--setup", folder / "setup.toml", "--method", "ar_swap", "--json", "-q") == 0
    assert json.loads(capsys.readouterr().out)["runs"][0]["states"] > 150


def test_the_missing_extra_is_one_line(folder, capsys, monkeypatch):
    import builtins

    real = builtins.__import__

    def without(name, *arguments, **options):
        if name == "gtsam":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    assert run("fuse", folder / "all.bag", "--setup", folder / "setup.toml", "--method", "graph", "-q") == 2
    assert "pip install 'uvgs-bench[fusion]'" in capsys.readouterr().err


def test_false_poses_are_refused_and_counted(folder, capsys):
    run("fuse", folder / "all.bag", "--setup", folder / "setup.toml", "--false-poses", "0.1:0.3", "--json", "-q")
    said = json.loads(capsys.readouterr().out)
    assert said["false_poses"] > 3
    assert said["runs"][0]["false_believed"] == 0
    assert said["runs"][1]["name"] == "without false poses"


def test_smoothing_looks_ahead(folder, tmp_path, capsys):
    sigmas = []
    for extra in ((), ("--smooth",)):
        out = tmp_path / f"s{len(extra)}.csv"
        run("fuse", folder / "all.bag", "--setup", folder / "setup.toml", "--out", out, *extra, "-q")
        with out.open() as text:
            sigmas.append(np.mean([float(row["sigma_x_m"]) for row in csv.DictReader(text)]))
    capsys.readouterr()
    assert sigmas[1] < 0.9 * sigmas[0]


@pytest.mark.parametrize("rest_s", [0.8, 0.0])
def test_fusion_does_not_begin_at_a_false_pose(source, rest_s):
    from uvgs_bench.sessions.fuse import first_state

    resting = [k for k, pose in enumerate(source.sensed) if pose.t_ns <= 800_000_000]
    false = resting[-1] if rest_s else 0
    poses = list(source.sensed)
    poses[false] = replace(
        poses[false], camera_from_beacon=poses[false].camera_from_beacon.perturbed((0.0, 0.0, 0.0, 0.2, 0.2, 0.0))
    )
    start = first_state(replace(source, sensed=tuple(poses), rest_s=rest_s), ("uvgs",))
    # Poses of 1 mrad seen from 1.1 m.
    assert np.linalg.norm(start.world_from_body.t_m - state_at(start.t_ns).pose.t_m) < 0.01
