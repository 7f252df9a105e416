"""The bench file: read strictly, in m and rad, with its paths resolved."""

from __future__ import annotations

from math import pi
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.bench import read_bench

EXAMPLE = Path(__file__).parents[3] / "calib" / "bench.toml"

BENCH = """
schema = 1
name = "b"
camera = "cam.yaml"
beacon = "sub/beacon.toml"
camera_source = "uvc:0"
mount = "camera_on_carriage"
[gantry]
port = "grbl:/dev/ttyACM0"
keep_out = [ { X_mm = [10.0, 20.0] } ]
[[gantry.axes]]
name = "X"
direction = [2.0, 0.0, 0.0]
min_mm = 0.0
max_mm = 300.0
max_feed_mm_min = 1200.0
acceleration_mm_s2 = 150.0
backlash_mm = 0.5
[[gantry.axes]]
name = "A"
kind = "rotary"
direction = [0.0, 0.0, 1.0]
min_deg = -90.0
max_deg = 90.0
max_feed_deg_min = 3600.0
acceleration_deg_s2 = 180.0
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def test_units_and_paths(tmp_path: Path) -> None:
    bench = read_bench(written(tmp_path, BENCH))
    x, a = bench.envelope.axes
    assert (x.lower, x.upper, x.max_speed, x.acceleration, x.backlash) == pytest.approx((0.0, 0.3, 0.02, 0.15, 0.0005))
    assert (a.lower, a.upper, a.max_speed, a.acceleration, a.backlash) == pytest.approx(
        (-pi / 2, pi / 2, pi / 3, pi, 0)
    )
    assert np.array_equal(x.direction, [1.0, 0.0, 0.0])
    assert bench.envelope.keep_out[0] == pytest.approx(np.array([[0.01, -pi / 2], [0.02, pi / 2]]))
    assert bench.camera_file == str(tmp_path / "cam.yaml")
    assert bench.beacon_file == str(tmp_path / "sub" / "beacon.toml")
    assert (bench.mount, bench.gantry_port, bench.camera_source) == ("camera_on_carriage", "grbl:/dev/ttyACM0", "uvc:0")
    assert bench.sensor_file is None
    assert bench.mounted is None
    assert bench.simulated is None
    assert not bench.is_simulated


@pytest.mark.parametrize(
    ("mount", "frames"),
    [("beacon_on_carriage", ("carriage", "beacon")), ("camera_on_carriage", ("camera", "carriage"))],
)
def test_the_mount_as_built_is_read_in_the_frames_it_means(tmp_path: Path, mount: str, frames: tuple[str, str]) -> None:
    table = "[mounted]\nposition_mm = [12.0, -25.0, 8.0]\neuler_zyx_deg = [90.0, 0.0, 0.0]\n"
    text = BENCH.replace('"camera_on_carriage"', f'"{mount}"').replace("[gantry]", table + "[gantry]")
    mounted = read_bench(written(tmp_path, text)).mounted
    assert mounted is not None
    assert (mounted.target, mounted.source) == frames
    np.testing.assert_allclose(mounted.apply(np.array([1.0, 0.0, 0.0])), [0.012, 0.975, 0.008], atol=1e-12)


def test_the_example_says_the_defaults() -> None:
    bench = read_bench(EXAMPLE)
    assert bench.simulated == SimulatedTruth()
    assert bench.is_simulated


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("max_mm = 300.0", "max_cm = 30.0", r"gantry\.axes\.0\.max_cm: unknown key"),
        ("max_mm = 300.0", "", "axis X needs max_mm"),
        ("min_deg = -90.0", "min_mm = -90.0", "axis A is rotary: min_mm has the wrong unit"),
        ("max_mm = 300.0", "max_mm = -1.0", "lower bound must be below"),
        ('name = "A"', 'name = "X"', "different names"),
        ("X_mm = [10.0, 20.0]", "Y_mm = [10.0, 20.0]", "unknown key 'Y_mm', expected one of: X_mm, A_deg"),
        ("X_mm = [10.0, 20.0]", "X_mm = [20.0, 10.0]", r"must be \[lower, upper\]"),
        ('mount = "camera_on_carriage"', 'mount = "on_top"', "mount: "),
        ("schema = 1", "schema = 2", "schema: is 2, expected 1"),
        ('name = "b"\n', "", "name: this key is required"),
        ("[gantry]", "[simulated]\nsed = 3\n[gantry]", r"simulated\.sed: unknown key, did you mean 'seed'"),
        ("[gantry]", "[simulated.camera]\nbit_depth = 20\n[gantry]", "bit_depth must be 8 to 16"),
        ("[gantry]", "[simulated.gantry]\nscale_ppm = []\n[gantry]", "scale_ppm needs at least one entry"),
    ],
)
def test_what_cannot_be_meant_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in BENCH
    path = written(tmp_path, BENCH.replace(old, new))
    with pytest.raises(ConfigError, match=message) as raised:
        read_bench(path)
    assert str(raised.value).startswith(str(path))
