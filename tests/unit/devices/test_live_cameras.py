"""Live cameras: late consumers, lost cameras, network streams, settings by options."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from tests.helpers.video_servers import free_port, jpegs, mjpeg_server, rtsp_server
from uvgs_bench.devices.cameras import open_camera
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.cameras.live_queue import AFTER_GAP, CameraNews, LiveQueue
from uvgs_bench.devices.cameras.network import without_password
from uvgs_bench.devices.cameras.source import ExposureControl, FreeRunning, ReadBack, Setting
from uvgs_bench.devices.cameras.uvc import UvcCamera
from uvgs_bench.devices.clock import RealClock
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.sensor.capture import Capture

cv2 = pytest.importorskip("cv2")
pytestmark = pytest.mark.opencv
IMAGE = np.full((4, 6), 7, dtype=np.uint8)


class Scripted(ClosingSource):
    """A live camera that delivers when it is told to, and can be unplugged."""

    def __init__(self, count: int | None = None, fails_at: int | None = None) -> None:
        super().__init__("scripted:", is_live=True, length=None)
        self.released = threading.Semaphore(0)
        self.taken = 0
        self.is_closed = False
        self._count, self._fails_at = count, fails_at

    def grab(self) -> Capture | None:
        if self.taken == self._fails_at or self.is_closed:
            raise CaptureError("unplugged", self.spec)
        if self.taken == self._count:
            return None
        self.released.acquire(timeout=10.0)
        self.taken += 1
        return Capture(IMAGE, RealClock().now_ns(), self.spec, self.taken - 1)

    def close(self) -> None:
        self.is_closed = True

    def release(self, count: int) -> None:
        for _ in range(count):
            self.released.release()


def queue_of(camera: Scripted, news: list[CameraNews] | None = None, **options: object) -> LiveQueue:
    told = [] if news is None else news
    return LiveQueue(camera, lambda: camera, told.append, **options)  # type: ignore[arg-type]


def wait_until(is_true: object) -> None:
    for _ in range(1000):
        if is_true():  # type: ignore[operator]
            return
        time.sleep(0.005)
    raise AssertionError("did not happen within 5 s")


def test_a_late_consumer_gets_the_newest_and_the_dropped_are_counted() -> None:
    camera = Scripted(count=10)
    with queue_of(camera) as queue:
        captures = iter(queue)
        camera.release(1)
        assert next(captures).index == 0
        camera.release(9)
        wait_until(lambda: camera.taken == 10)
        assert [capture.index for capture in captures] == [8, 9]
        assert queue.dropped == 7


def test_a_consumer_in_time_gets_every_capture() -> None:
    camera = Scripted(count=6)
    with queue_of(camera) as queue:
        seen = []
        camera.release(1)
        for capture in queue:
            seen.append(capture.index)
            camera.release(1)
    assert seen == list(range(6))
    assert queue.dropped == 0
    assert camera.is_closed


def test_first_captures_are_thrown_away() -> None:
    camera = Scripted(count=5)
    camera.release(5)
    with queue_of(camera, warm_up=3) as queue:
        assert [capture.index for capture in queue] == [0, 1]


def test_a_lost_camera_is_waited_for_and_the_gap_is_flagged() -> None:
    first, second = Scripted(fails_at=2), Scripted(count=2)
    first.release(2)
    second.release(2)
    attempts, news = [], []

    def reopen() -> Scripted:
        attempts.append(time.monotonic())
        if len(attempts) < 2:
            raise CaptureError("still away", "scripted:")
        return second

    with LiveQueue(first, reopen, news.append) as queue:
        seen = [(capture.index, queue.flags_of(capture)) for capture in queue]
    assert [index for index, _ in seen][-2:] == [2, 3]
    assert dict(seen)[2] == (AFTER_GAP,)
    assert dict(seen)[3] == ()
    assert [n.kind for n in news] == ["lost", "returned"]
    assert queue.gaps_s == [news[1].gap_s]
    # Two attempts half a second apart.
    assert 0.9 < queue.gaps_s[0] < 5.0
    assert first.is_closed


def test_patience_ends() -> None:
    camera = Scripted(fails_at=0)

    def away() -> Scripted:
        raise CaptureError("no such camera", "scripted:")

    with (
        LiveQueue(camera, away, lambda _: None, patience_s=0.1) as queue,
        pytest.raises(CaptureError, match="not back"),
    ):
        list(queue)
    with queue_of(Scripted(fails_at=0), patience_s=0.0) as queue, pytest.raises(CaptureError, match="unplugged"):
        list(queue)


def test_a_bug_in_a_driver_comes_out_where_captures_are_consumed() -> None:
    class Broken(Scripted):
        def grab(self) -> Capture | None:
            raise ZeroDivisionError

    with queue_of(Broken()) as queue, pytest.raises(ZeroDivisionError):
        list(queue)


def test_the_exposure_of_a_lost_camera_is_asked_for_again() -> None:
    class Exposed(Scripted):
        exposure_s, exposure_limits_s, full_scale_dn, settling_captures = 0.004, (1e-5, 0.1), 255.0, 1

        def set_exposure_s(self, exposure_s: float) -> float:
            if self.is_closed:
                raise CaptureError("closed", self.spec)
            self.exposure_s = exposure_s
            return exposure_s

    first, second = Exposed(fails_at=1), Exposed(count=1)
    assert isinstance(first, ExposureControl)
    first.release(1)
    second.release(1)
    with LiveQueue(first, lambda: second, lambda _: None) as queue:
        control = queue.exposure
        assert control is not None
        assert control.set_exposure_s(0.002) == 0.002
        list(queue)
    assert second.exposure_s == 0.002
    assert queue_of(Scripted()).exposure is None


class Driver:
    """A Video4Linux driver that keeps gain within 0 to 16 and knows no white balance."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, float]] = []
        self.values: dict[int, float] = {}

    def get(self, name: int) -> float:
        return self.values.get(name, -1.0)

    def set(self, name: int, value: float) -> bool:
        self.asked.append((name, value))
        if name == cv2.CAP_PROP_WB_TEMPERATURE:
            return False
        self.values[name] = min(value, 16.0) if name == cv2.CAP_PROP_GAIN else value
        return True

    def release(self) -> None:
        pass


def test_settings_are_set_in_order_and_read_back() -> None:
    driver = Driver()
    camera = UvcCamera("uvc:0", driver, RealClock())
    assert isinstance(camera, ReadBack)
    assert isinstance(camera, FreeRunning)
    asked = {"width": 640.0, "height": 480.0, "fps": 60.0, "exposure_ms": 2.5, "gain": 40.0, "white_balance_k": 4000.0}
    camera.configure(asked, "MJPG")
    assert driver.asked[0][0] == cv2.CAP_PROP_FOURCC
    assert {name for name, _ in driver.asked[1:3]} == {cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT}
    assert (cv2.CAP_PROP_AUTO_EXPOSURE, 1.0) in driver.asked
    assert (cv2.CAP_PROP_AUTO_WB, 0.0) in driver.asked
    kept = {setting.name: setting.is_kept for setting in camera.settings}
    assert kept == {"fps": True, "exposure_ms": True, "gain": False, "white_balance_k": False}
    assert Setting("gain", 40.0, 16.0) in camera.settings


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("uvc:0?exposure_ms=fast", "no such camera|expected exposure_ms as a number"),
        ("rtsp:camera", "expected an address like rtsp://HOST"),
        ("http://127.0.0.1:{port}/x", "nothing answers there"),
        ("realsense:no-such-serial", "no such RealSense camera|needs the extra 'realsense'"),
        ("aravis:no-such-camera", "no such camera|needs the system's Aravis"),
    ],
)
def test_absent_live_cameras_are_one_clear_line(spec: str, message: str) -> None:
    with pytest.raises(CaptureError, match=message) as raised:
        open_camera(spec.format(port=free_port()))
    assert "\n" not in str(raised.value)


def test_options_that_are_no_numbers_are_named() -> None:
    for spec, message in (
        ("realsense:?exposure_ms=fast", "expected exposure_ms as a number, got 'fast'"),
        ("realsense:?width=640.5", "expected width as a whole number of px"),
        ("realsense:?imager=depth", "expected imager as infrared or color"),
        ("aravis:?gian_db=3", "did you mean 'gain_db'"),
    ):
        with pytest.raises(ConfigError, match=message):
            open_camera(spec)


def test_passwords_are_not_shown() -> None:
    assert without_password("rtsp://u:secret@10.0.0.9/x?a=b") == "rtsp://u:***@10.0.0.9/x?a=b"
    assert without_password("rtsp://10.0.0.9:8554/x") == "rtsp://10.0.0.9:8554/x"


def grey_steps(count: int) -> list[np.ndarray]:
    return [np.full((48, 64, 3), 40 + 10 * k, dtype=np.uint8) for k in range(count)]


def test_pictures_over_http_arrive_in_order_and_a_new_stream_after_a_loss() -> None:
    port = free_port()
    news: list[CameraNews] = []
    pictures = jpegs(grey_steps(12))
    spec = f"http://127.0.0.1:{port}/stream"
    with mjpeg_server(pictures, 50.0, port=port):
        camera = open_camera(spec)
        assert camera.is_live
        with LiveQueue(camera, lambda: open_camera(spec), news.append) as queue:
            captures = iter(queue)
            seen = [next(captures) for _ in range(16)]
    levels = [round(float(capture.image.mean())) for capture in seen]
    # JPEG keeps a flat grey to 2 DN. Pictures of the first connection, then, flagged, of the second.
    flagged = [k for k, capture in enumerate(seen) if AFTER_GAP in queue.flags_of(capture)]
    assert len(flagged) == 1
    for part in (levels[: flagged[0]], levels[flagged[0] :]):
        assert part == sorted(part)
        assert all(abs((level - 40) % 10 - 5) >= 3 for level in part)
    assert [n.kind for n in news][:2] == ["lost", "returned"]


def test_pictures_over_rtsp() -> None:
    with rtsp_server(jpegs(grey_steps(20)), 50.0) as port:
        camera = open_camera(f"rtsp://127.0.0.1:{port}/stream")
        assert isinstance(camera, FreeRunning)
        captures = [camera.next_capture() for _ in range(5)]
        fresh = camera.grab()
        camera.close()
    assert captures[0].image.shape == (48, 64, 3)
    levels = [float(capture.image.mean()) for capture in captures]
    assert np.diff(levels) == pytest.approx(10.0, abs=3.0)  # DN, by JPEG
    assert fresh is not None
    with pytest.raises(CaptureError, match="closed"):
        camera.grab()


def test_the_fake_camera_of_aravis() -> None:
    try:
        camera = open_camera("aravis:Fake_1?exposure_ms=5&fps=50&width=256&height=200&gain_db=2&format=BayerRG8")
    except CaptureError as error:
        pytest.skip(f"Aravis is not installed: {error}")
    assert isinstance(camera, ExposureControl)
    assert isinstance(camera, ReadBack)
    assert all(setting.is_kept for setting in camera.settings)
    before_ns = RealClock().now_ns()
    capture = camera.grab()
    assert capture is not None
    assert (capture.image.shape, capture.bayer, capture.exposure_s) == ((200, 256, 3), "rggb", 0.005)
    assert before_ns <= capture.t_ns <= RealClock().now_ns()
    assert camera.set_exposure_s(0.002) == pytest.approx(0.002)
    assert camera.set_exposure_s(1e9) == camera.exposure_limits_s[1]
    camera.close()
    camera.close()
    with pytest.raises(CaptureError, match="closed"):
        camera.grab()
