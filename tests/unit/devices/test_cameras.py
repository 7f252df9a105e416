"""Cameras by spec string: folders, videos, live devices, and what is wrong with each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.cameras import CAMERAS, open_camera
from uvgs_bench.devices.cameras.images import STEP_NS, natural_key, read_image
from uvgs_bench.devices.cameras.source import ExposureControl
from uvgs_bench.devices.cameras.uvc import UvcCamera
from uvgs_bench.devices.clock import RealClock
from uvgs_bench.errors import CaptureError, ConfigError

cv2 = pytest.importorskip("cv2")
pytestmark = pytest.mark.opencv
EXAMPLE_BENCH = Path(__file__).parents[3] / "calib" / "bench.toml"


def picture(value: int, shape: tuple[int, ...] = (24, 32), kind: type = np.uint8) -> np.ndarray:
    image = np.full(shape, value, dtype=kind)
    image[3:9, 5:20] = value + 9
    return image


def video(path: Path, count: int = 7) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 20.0, (64, 48))
    assert writer.isOpened()
    for i in range(count):
        writer.write(np.full((48, 64, 3), 10 * i % 250, dtype=np.uint8))
    writer.release()
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in (10, 2, 1):
        cv2.imwrite(str(tmp_path / f"img{i}.png"), picture(i))
    (tmp_path / "notes.txt").write_text("no picture")
    return tmp_path


def test_pictures_come_in_natural_order_with_fixed_steps(folder: Path) -> None:
    with open_camera(f"images:{folder}") as camera:
        assert not camera.is_live
        assert camera.length == 3
        captures = list(camera)
        assert camera.grab() is None
    assert [c.source for c in captures] == ["img1.png", "img2.png", "img10.png"]
    assert [c.index for c in captures] == [0, 1, 2]
    assert [c.t_ns for c in captures] == [0, STEP_NS, 2 * STEP_NS]
    assert [int(c.image[0, 0]) for c in captures] == [1, 2, 10]


def test_glob_chooses(folder: Path) -> None:
    cv2.imwrite(str(folder / "right1.png"), picture(77))
    assert [c.source for c in open_camera(f"images:{folder}?glob=right*.png")] == ["right1.png"]


def test_natural_key_counts() -> None:
    assert sorted(["b10", "b9", "a", "B1", "10", "9"], key=natural_key) == ["9", "10", "a", "B1", "b9", "b10"]


@pytest.mark.parametrize(
    ("image", "shape", "kind"),
    [
        (picture(40000, kind=np.uint16), (24, 32), np.uint16),
        (picture(40, (24, 32, 3)), (24, 32, 3), np.uint8),
        (picture(40, (24, 32, 4)), (24, 32, 3), np.uint8),
    ],
)
def test_depth_and_colour_stay_as_they_are(
    tmp_path: Path, image: np.ndarray, shape: tuple[int, ...], kind: type
) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), image)
    read = read_image(path)
    assert read.shape == shape
    assert read.dtype == kind
    assert np.array_equal(read, image[..., :3] if image.ndim == 3 else image)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".tif"])
def test_truncated_picture_is_named(folder: Path, ending: str) -> None:
    noise = np.random.default_rng(3).integers(0, 255, (24, 32), dtype=np.uint8)
    path = folder / f"img3{ending}"
    cv2.imwrite(str(path), noise)
    payload = path.read_bytes()
    path.write_bytes(payload[: len(payload) * 2 // 3])
    camera = open_camera(f"images:{folder}")
    camera.grab()
    camera.grab()
    with pytest.raises(CaptureError, match=rf"img3\{ending}"):
        camera.grab()


@pytest.mark.parametrize("payload", [b"", b"this is no picture at all"])
def test_unreadable_picture_is_named(folder: Path, payload: bytes) -> None:
    (folder / "img0.png").write_bytes(payload)
    with pytest.raises(CaptureError, match=r"img0\.png"):
        open_camera(f"images:{folder}").grab()


def test_another_size_names_both(folder: Path) -> None:
    cv2.imwrite(str(folder / "img2.png"), picture(2, (20, 30)))
    with pytest.raises(CaptureError, match=r"img2\.png: is 30x20 px, but img1\.png is 32x24 px"):
        list(open_camera(f"images:{folder}"))


def test_video_frames_and_times(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mkv")
    with open_camera(f"video:{path}") as camera:
        captures = list(camera)
    assert [int(c.image[0, 0, 0]) for c in captures] == [10 * i for i in range(7)]
    # 20 frames per second; the container keeps whole milliseconds.
    assert [c.t_ns for c in captures] == pytest.approx([50_000_000 * i for i in range(7)], abs=1_000_000)


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("images:/nowhere/at/all", CaptureError, "no such folder"),
        ("images:{file}", CaptureError, "is no folder"),
        ("images:{empty}", CaptureError, "holds no pictures"),
        ("images:{empty}?glob=a*", CaptureError, r"no picture matches 'a\*'"),
        ("images:{empty}?glob=/a*", ConfigError, "expected a pattern within the folder"),
        ("images:{empty}?glob=a+b*", CaptureError, r"no picture matches 'a\+b\*'"),
        ("images:{empty}?globb=a*", ConfigError, "unknown option 'globb', did you mean 'glob'"),
        ("video:/nowhere.mkv", CaptureError, "no such file"),
        ("video:{file}", CaptureError, "no video"),
        ("uvc:987", CaptureError, "no such camera /dev/video987; cameras found: "),
        ("image:{empty}", ConfigError, "unknown kind of camera 'image', did you mean 'images'"),
        ("zzz:1", ConfigError, "expected one of: images, video, bag, uvc, rtsp"),
        ("{empty}", ConfigError, "expected a camera like"),
        ("images:{empty}?glob", ConfigError, "name=value"),
        ("sim:no-such-bench", CaptureError, "no simulated bench"),
        ("sim:", CaptureError, "no simulated bench"),
        ("sim:{bench}?cuont=3", ConfigError, "did you mean 'count'"),
        ("sim:{bench}?count=three", ConfigError, "expected count as a number"),
    ],
)
def test_bad_specs_say_what_is_wrong(tmp_path: Path, spec: str, error: type[Exception], message: str) -> None:
    empty, file = tmp_path / "empty", tmp_path / "file.mkv"
    empty.mkdir()
    file.write_text("no video")
    with pytest.raises(error, match=message) as raised:
        open_camera(spec.format(empty=empty, file=file, bench=EXAMPLE_BENCH))
    assert "\n" not in str(raised.value)


def test_truncated_video_says_where_it_ends(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mkv", 60)
    payload = path.read_bytes()
    path.write_bytes(payload[: len(payload) // 2])
    with pytest.raises(CaptureError, match=r"a\.mkv: (ends after \d+ of 60 frames|is no video)"):
        list(open_camera(f"video:{path}"))


def bag(path: Path) -> Path:
    from tests.unit.devices.test_bag_camera import GREY, image, store, write

    return write(path, {"/cam": [image(store(), "mono8", GREY + i, i) for i in (0, 1)]})


def recorded_specs(tmp_path: Path) -> dict[str, str]:
    cv2.imwrite(str(tmp_path / "a1.png"), picture(1))
    cv2.imwrite(str(tmp_path / "a2.png"), picture(2))
    return {
        "images": f"images:{tmp_path}",
        "video": f"video:{video(tmp_path / 'v.mkv', 2)}",
        "bag": f"bag:{bag(tmp_path / 'b.bag')}",
        "sim": f"sim:{EXAMPLE_BENCH}?count=2",
    }


# What needs a plug has tests of its own.
LIVE = {"uvc", "rtsp", "http", "https", "aravis", "realsense", "ros1", "ros2", "sim-board"}


@pytest.mark.parametrize("scheme", sorted(set(CAMERAS) - LIVE))
def test_contract(tmp_path: Path, scheme: str) -> None:
    spec = recorded_specs(tmp_path)[scheme]
    first, second = open_camera(spec), open_camera(spec)
    assert first.spec == spec
    assert first.length == 2
    captures = list(first)
    assert [c.index for c in captures] == [0, 1]
    assert captures[0].t_ns < captures[1].t_ns
    assert first.grab() is None
    for one, other in zip(captures, second, strict=True):
        assert np.array_equal(one.image, other.image)
    for camera in (first, second):
        camera.close()
        camera.close()


class QueuedDevice:
    """Frames that waited in a driver: stamps in ms on the machine's clock, the oldest first."""

    def __init__(self, ages_ms: list[float]) -> None:
        self._ages_ms = ages_ms
        self.taken = 0
        self.is_released = False

    def grab(self) -> bool:
        self.taken += 1
        return self.taken <= len(self._ages_ms)

    def get(self, _property: int) -> float:
        return RealClock().now_ns() / 1e6 - self._ages_ms[self.taken - 1]

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((4, 5, 3), self.taken, dtype=np.uint8)

    def release(self) -> None:
        self.is_released = True


def test_live_camera_drops_frames_exposed_before_the_call() -> None:
    device = QueuedDevice([900.0, 600.0, -5.0, -40.0, -80.0])
    with UvcCamera("uvc:0", device, RealClock()) as camera:
        # Two old frames, one that may have begun before the call, then the one that did not.
        assert camera.grab().image[0, 0, 0] == 4
    assert device.is_released


class ExposedDevice:
    """A driver that knows exposure in steps of 100 us, no finer than 200 us, and a gain that nobody may touch."""

    def __init__(self, obeys: bool = True) -> None:
        self.values = {cv2.CAP_PROP_AUTO_EXPOSURE: 3.0, cv2.CAP_PROP_EXPOSURE: 157.0, cv2.CAP_PROP_GAIN: 11.0}
        self._obeys = obeys

    def get(self, name: int) -> float:
        return self.values.get(name, 0.0)

    def set(self, name: int, value: float) -> bool:
        if self._obeys:
            self.values[name] = max(value, 2.0) if name == cv2.CAP_PROP_EXPOSURE else value
        return self._obeys

    def release(self) -> None:
        pass


def test_the_exposure_of_a_live_camera_is_set_and_read_back() -> None:
    device = ExposedDevice()
    camera = UvcCamera("uvc:0", device, RealClock())
    assert isinstance(camera, ExposureControl)
    assert camera.exposure_s == pytest.approx(0.0157)
    assert camera.set_exposure_s(0.00318) == pytest.approx(0.0032)
    assert camera.set_exposure_s(1e-9) == pytest.approx(2e-4)
    assert camera.set_exposure_s(9.0) == pytest.approx(camera.exposure_limits_s[1])
    assert device.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1.0
    assert device.values[cv2.CAP_PROP_GAIN] == 11.0
    camera.close()
    with pytest.raises(CaptureError, match="closed"):
        camera.set_exposure_s(0.001)


def test_a_live_camera_that_keeps_its_exposure_says_so() -> None:
    with pytest.raises(CaptureError, match="cannot be taken from its own automatic"):
        UvcCamera("uvc:0", ExposedDevice(obeys=False), RealClock()).set_exposure_s(0.001)
    silent = ExposedDevice()
    silent.values[cv2.CAP_PROP_EXPOSURE] = 0.0
    with pytest.raises(CaptureError, match="does not say"):
        _ = UvcCamera("uvc:0", silent, RealClock()).exposure_s


def test_exposures_of_the_simulated_camera_change_the_pictures_and_recordings_have_none(folder: Path) -> None:
    with open_camera(f"sim:{EXAMPLE_BENCH}?count=2") as camera:
        assert isinstance(camera, ExposureControl)
        first = camera.grab()
        assert camera.set_exposure_s(0.5 * camera.exposure_s) == camera.exposure_s
        second = camera.grab()
        assert camera.set_exposure_s(9.0) == camera.exposure_limits_s[1]
    assert first is not None
    assert second is not None
    assert (first.exposure_s, second.exposure_s) == (0.004, 0.002)
    assert int(second.image.max()) < 0.7 * int(first.image.max())
    assert not isinstance(open_camera(f"images:{folder}"), ExposureControl)


def test_companions_ride_beside_the_beacon(tmp_path: Path) -> None:
    beacon = EXAMPLE_BENCH.parent / "beacons" / "tetra_small.toml"
    alone, accompanied = (open_camera(f"sim:{EXAMPLE_BENCH}?count=1{more}") for more in ("", f"&with={beacon}"))
    bright = [int((camera.grab().image > 60).sum()) for camera in (alone, accompanied)]  # type: ignore[union-attr]
    assert bright[1] == pytest.approx(2 * bright[0], rel=0.2)
    with pytest.raises(ConfigError, match="nowhere"):
        open_camera(f"sim:{EXAMPLE_BENCH}?with=nowhere.toml")


def test_live_camera_that_stops_says_so() -> None:
    camera = UvcCamera("uvc:0", QueuedDevice([]), RealClock())
    with pytest.raises(CaptureError, match="stopped delivering"):
        camera.grab()
    camera.close()
    with pytest.raises(CaptureError, match="closed"):
        camera.grab()
