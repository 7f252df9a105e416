"""How long the sensor takes, stage by stage, on simulated captures, next to a peer on pictures of the same size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.store.bench import read_passing_beacon

PEER = "cv2.aruco"
_REPEATS = 5
# A camera of 100 Hz.
_PRIOR_AGE_NS = 10_000_000
_MARKER_PX = 160


@dataclass(frozen=True, slots=True)
class Timing:
    """Durations of one stage.

    Args:
        name: The stage.
        p10_s: 10th percentile, s: what it costs while nothing else wants the machine.
        median_s: Median, s.
        p99_s: 99th percentile, s.
    """

    name: str
    p10_s: float
    median_s: float
    p99_s: float


@dataclass(frozen=True, slots=True)
class PipelineBenchmark:
    """What the run measured.

    Args:
        width_px: Picture width, px.
        height_px: Picture height, px.
        captures: Number of different captures.
        poses: How many of them gave a pose.
        stages: Each stage of the sensor.
        total: One whole ``solve``, seen from outside.
        tracked: One whole ``solve`` with a pose of the moment before as prior, where it stayed within its windows.
        tracked_poses: How many captures did.
        peer: The peer's detection on pictures of the same size with one marker of about the beacon's span.
        peer_found: In how many pictures the peer found its marker.
    """

    width_px: int
    height_px: int
    captures: int
    poses: int
    stages: tuple[Timing, ...]
    total: Timing
    tracked: Timing
    tracked_poses: int
    peer: Timing
    peer_found: int

    @property
    def ratio(self) -> float:
        """How many times longer the peer takes, by medians of the same run."""
        return self.peer.median_s / self.total.median_s


def benchmark_pipeline(
    bench: Path, config: UvgsConfig, sink: EventSink, *, count: int = 60, seed: int = 0
) -> PipelineBenchmark:
    """Time the sensor on rendered captures, one thread, kernels warm, each capture several times.

    Args:
        bench: Bench file with a simulated camera and beacon.
        config: Sensor parameters.
        sink: Where progress goes.
        count: Number of captures.
        seed: Seed of the scene.

    Returns:
        The timings.

    Raises:
        ConfigError: The bench file is broken.
    """
    import cv2

    scene = read_passing_beacon(bench, seed)
    camera = SimulatedCamera(scene, "sim:", None, count=count)
    uvgs = Uvgs(Calibration(scene.true_lens, "simulated"), scene.true_beacon, config, clock=perf_counter)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detector = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters())
    marker = cv2.aruco.generateImageMarker(dictionary, 7, _MARKER_PX)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    stages: dict[str, list[float]] = {}
    totals: list[float] = []
    tracked: list[float] = []
    peers: list[float] = []
    poses = found = 0
    sink(StageStarted("benchmark", count))
    try:
        uvgs.warm_up()
        for done, capture in enumerate(camera, start=1):
            marked = _with_marker(capture, marker)
            detector.detectMarkers(marked)
            for _ in range(_REPEATS):
                begin = perf_counter()
                outcome = uvgs.solve(capture)
                totals.append(perf_counter() - begin)
                for stage, duration_s in outcome.stage_s.items():
                    stages.setdefault(stage, []).append(duration_s)
            if isinstance(outcome, PoseEstimate):
                prior = replace(outcome, t_ns=outcome.t_ns - _PRIOR_AGE_NS)
                spent = []
                for _ in range(_REPEATS):
                    begin = perf_counter()
                    followed = uvgs.solve(capture, prior)
                    spent.append(perf_counter() - begin)
                if isinstance(followed, PoseEstimate) and followed.tracked_count:
                    tracked += spent
            for _ in range(_REPEATS):
                begin = perf_counter()
                _, ids, _ = detector.detectMarkers(marked)
                peers.append(perf_counter() - begin)
            poses += isinstance(outcome, PoseEstimate)
            found += ids is not None and len(ids) > 0
            sink(StageAdvanced("benchmark", done))
    finally:
        cv2.setNumThreads(threads)
    lens = scene.true_lens
    result = PipelineBenchmark(
        lens.width_px, lens.height_px, count, poses,
        tuple(_timing(name, values) for name, values in stages.items()),
        _timing("total", totals), _timing("tracked", tracked or [float("nan")]), len(tracked) // _REPEATS,
        _timing(PEER, peers), found,
    )  # fmt: skip
    sink(StageFinished("benchmark", f"{poses} poses of {count} captures"))
    return result


def _timing(name: str, values_s: list[float]) -> Timing:
    values: FloatArray = np.array(values_s)
    return Timing(name, *(float(v) for v in np.percentile(values, [10, 50, 99])))


def _with_marker(capture: Capture, marker: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> ImageArray:
    """The picture with a printed marker on a white border pasted near its middle, as 8 bit mono."""
    image = capture.image if capture.image.ndim == 2 else capture.image.max(axis=2)
    out = image.astype(np.uint8).copy()
    side = _MARKER_PX + 40
    y, x = (out.shape[0] - side) // 2, (out.shape[1] - side) // 2
    out[y : y + side, x : x + side] = 200
    out[y + 20 : y + 20 + _MARKER_PX, x + 20 : x + 20 + _MARKER_PX] = np.where(marker > 0, 200, 20)
    return out
