"""A sensor file that is changed in place keeps what people wrote in it, and says exactly what is wanted."""

from __future__ import annotations

from dataclasses import replace

import pytest

from uvgs_bench.errors import ConfigError
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.store.documents import read_document
from uvgs_bench.store.sensor_file import update_sensor_file

TEXT = """# Our cellar, measured in March.
schema = 1
threshold_k = 2.5   # threshold_k = 9 was too much
hue_deg = [80.0, 140.0]
max_blobs=12# many lamps
"""


def test_comments_and_other_values_stay(tmp_path):
    path = tmp_path / "sensor.toml"
    path.write_text(TEXT)
    before = read_document(path, UvgsConfig)
    wanted = replace(before, threshold_k=3.25, max_blobs=14, min_contrast=0.1)
    update_sensor_file(path, wanted)
    assert read_document(path, UvgsConfig) == wanted
    text = path.read_text()
    assert text.splitlines() == [
        "# Our cellar, measured in March.",
        "schema = 1",
        "threshold_k = 3.25   # threshold_k = 9 was too much",
        "hue_deg = [80.0, 140.0]",
        "max_blobs = 14# many lamps",
        "min_contrast = 0.1",
    ]


def test_a_new_file_says_only_what_differs(tmp_path):
    path = tmp_path / "reports" / "sensor.toml"
    wanted = UvgsConfig(min_area_px2=5.0)
    update_sensor_file(path, wanted)
    assert path.read_text() == "schema = 1\nmin_area_px2 = 5.0\n"
    assert read_document(path, UvgsConfig) == wanted


def test_what_is_no_sensor_file_is_left_alone(tmp_path):
    path = tmp_path / "sensor.toml"
    path.write_text("schema = 1\nnothing = 3\n")
    with pytest.raises(ConfigError):
        update_sensor_file(path, UvgsConfig(min_area_px2=5.0))
    assert path.read_text() == "schema = 1\nnothing = 3\n"
