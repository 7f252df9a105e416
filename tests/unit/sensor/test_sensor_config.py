from __future__ import annotations

import pytest

from uvgs_bench.errors import ConfigError
from uvgs_bench.sensor import UvgsConfig
from uvgs_bench.store.documents import read_document


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alpha": 0.0}, "alpha"),
        ({"window_px": 40}, "odd"),
        ({"max_area_px2": 1.0}, "exceed"),
        ({"max_range_m": 0.05}, "max_range_m"),
        ({"min_margin": 0.5}, "min_margin"),
        ({"max_blobs": 3}, "max_blobs"),
        ({"threshold_floor": -0.1}, "threshold_floor"),
    ],
)
def test_values_without_meaning_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        UvgsConfig(**change)


def test_a_sensor_file_reads_strictly(tmp_path):
    path = tmp_path / "sensor.toml"
    path.write_text('schema = 1\ndetection = "paper"\nalpha = 0.5\nhue_deg = [330.0, 30.0]\n')
    config = read_document(path, UvgsConfig)
    assert (config.detection, config.alpha, config.hue_deg) == ("paper", 0.5, (330.0, 30.0))
    path.write_text("schema = 1\nthreshold_kk = 2.0\n")
    with pytest.raises(ConfigError, match="threshold_k'"):
        read_document(path, UvgsConfig)
    path.write_text('schema = 1\ndetection = "slow"\n')
    with pytest.raises(ConfigError, match="detection"):
        read_document(path, UvgsConfig)
