from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.beacon import Beacon, Led, check_beacon
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.beacons import read_beacon, write_beacon

ROOT = Path(__file__).resolve().parents[3]
LED = '[[leds]]\nname = "{}"\nposition_mm = [{}, {}, {}]\n'
FOUR = LED.format("a", 0, 0, 0) + LED.format("b", 80, 0, 0) + LED.format("c", 0, 60, 0) + LED.format("d", 10, 20, 70)


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "b.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_shipped_beacon_reads_and_has_no_weakness():
    beacon = read_beacon(ROOT / "calib/beacons/tetra_small.toml")
    assert beacon.led_names == ("bottom", "left", "right", "apex")
    assert beacon.leds[3].position_m[2] == pytest.approx(-0.062, abs=1e-15)
    assert beacon.leds[0].half_angle_rad == pytest.approx(np.radians(70.0))
    assert check_beacon(beacon) == ()


def test_written_and_read_again_is_the_same_to_the_last_digits(tmp_path):
    rng = np.random.default_rng(4)
    A = rng.normal(size=(12, 12)) * 1e-5
    leds = tuple(
        Led(f'l"{i}', rng.uniform(-0.1, 0.1, 3), rng.normal(size=3), np.float64(1.1) if i else None, np.float64(0.0047))
        for i in range(4)
    )
    beacon = Beacon("mine", leds, hue=(330.0, 30.5), covariance_m2=A @ A.T)
    write_beacon(tmp_path / "out.toml", beacon)
    again = read_beacon(tmp_path / "out.toml")
    # One conversion to mm and back rounds twice.
    np.testing.assert_allclose(again.positions_m, beacon.positions_m, rtol=1e-15, atol=0)
    np.testing.assert_allclose(again.covariance_m2, beacon.covariance_m2, rtol=1e-14, atol=0)
    assert again.led_names == beacon.led_names
    assert again.hue == beacon.hue
    assert again.leds[0].half_angle_rad is None
    assert again.leds[1].half_angle_rad == pytest.approx(1.1, rel=1e-15)
    with pytest.raises(ConfigError, match="--force"):
        write_beacon(tmp_path / "out.toml", beacon)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('schema = 1\nname = "x"\n' + FOUR.split('[[leds]]\nname = "d"')[0], "at least 4 LEDs, got 3"),
        ('schema = 1\nname = "x"\n' + FOUR.replace("80, 0, 0", "0.3, 0, 0"), "a and b are 0.300 mm apart"),
        ('schema = 1\nname = "x"\n' + FOUR.replace('"b"', '"a"'), "unique"),
        ('schema = 1\nname = "x"\n' + FOUR.replace("position_mm = [80", "position_cm = [80"), "position_mm"),
        ('schema = 1\nname = "x"\nhue = "pink"\n' + FOUR, "hue must be one of"),
        ('schema = 1\nname = "x"\n' + FOUR + "half_angle_deg = 60\n", "needs an axis"),
        ('schema = 1\nname = "x"\ncovariance_mm2 = [[1, 2], [3]]\n' + FOUR, "equally long"),
        ('name = "x"\n' + FOUR, "schema"),
    ],
)
def test_each_mistake_is_named_with_the_file(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_beacon(path)
    assert str(path) in str(caught.value)
