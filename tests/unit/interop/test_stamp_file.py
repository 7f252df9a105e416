"""``stamps.csv`` beside pictures: instants are kept, and a file that does not fit is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uvgs_bench.devices.cameras import open_camera
from uvgs_bench.errors import CaptureError, FormatError
from uvgs_bench.interop.stamp_file import PictureStamp, read_stamps, stamps_text

pytestmark = pytest.mark.opencv
STAMPS = (
    PictureStamp("b.png", 1_700_000_000_000_000_001, None, "a.bag/cam#0"),
    PictureStamp("a.png", 1_700_000_000_033_333_334, "rggb", 'odd, "name"'),
)


@pytest.fixture
def folder(tmp_path):
    for i, stamp in enumerate(STAMPS):
        cv2.imwrite(str(tmp_path / stamp.file), np.full((4, 4, 3), i, dtype=np.uint8))
    (tmp_path / "stamps.csv").write_text(stamps_text(STAMPS))
    return tmp_path


def test_pictures_have_the_instants_and_the_order_of_the_file(folder):
    read = read_stamps(folder / "stamps.csv")
    assert [(s.file, s.t_ns, s.bayer, s.source) for s in read] == [(s.file, s.t_ns, s.bayer, s.source) for s in STAMPS]
    with open_camera(f"images:{folder}") as camera:
        captures = list(camera)
    assert [(c.source, c.t_ns, c.bayer, c.index) for c in captures] == [
        ("b.png", STAMPS[0].t_ns, None, 0),
        ("a.png", STAMPS[1].t_ns, "rggb", 1),
    ]
    with open_camera(f"images:{folder}?glob=a*.png") as camera:
        assert [c.t_ns for c in camera] == [STAMPS[1].t_ns]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,t_ns\nb.png,5\na.png,4\n", r"stamps\.csv:3: its t_ns is earlier"),
        ("file,t_ns\nb.png,5.5\n", r":2: expected columns file and t_ns \(whole ns\), got 'b.png' and '5.5'"),
        ("name,stamp\nb.png,5\n", ":2: expected columns file and t_ns"),
        ("file,t_ns,bayer\nb.png,5,rgbg\n", ":2: bayer: expected rggb"),
        ("file,t_ns\n", "no line, expected columns"),
        ("file,t_ns\nb.png,5\n", "names no instant for a.png"),
        ("file,t_ns\nb.png,5\na.png,6\nc.png,7\n", "names c.png, which is not there"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(folder, text, said):
    (folder / "stamps.csv").write_text(text)
    with pytest.raises(CaptureError, match=said):
        open_camera(f"images:{folder}")
    with pytest.raises(FormatError, match="cannot be read"):
        read_stamps(folder / "nowhere.csv")
