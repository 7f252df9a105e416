"""How long the sensor takes, stage by stage, on simulated captures, next to a peer on pictures of the same size."""

from __future__ import annotations

import gc
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from time import perf_counter

import numpy as np

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.blobs import full_scale_dn
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.process_cost import ProcessCost, first_pose_cost, run_cost
from uvgs_bench.store.bench import read_bench, read_passing_beacon

PEER = "cv2.aruco"
_REPEATS = 5
# A camera of 100 Hz.
_PRIOR_AGE_NS = 10_000_000
_MARKER_PX = 160
CROWD = 12
"""Lights in all in a crowded picture."""
_LIGHT_SIGMA_PX = 1.5
_LIGHT_SHARE = 0.6


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
        stages: Each stage of the sensor on the whole picture.
        total: One whole ``solve``, seen from outside.
        colour: The same picture in colour.
        crowded: The same picture with as many other lights that there are ``CROWD`` in all.
        crowded_poses: How many captures gave a pose among them.
        tracked: One whole ``solve`` with a pose of the moment before as prior, where it stayed within its windows.
        tracked_poses: How many captures did.
        peer: The peer's detection on pictures of the same size with one marker of about the beacon's span.
        peer_found: In how many pictures the peer found its marker.
        first_pose: A process from its start to its first pose, or None when it failed.
        run: A process of ``uvgs run`` on the simulated camera, or None when it failed.
    """

    width_px: int
    height_px: int
    captures: int
    poses: int
    stages: tuple[Timing, ...]
    total: Timing
    colour: Timing
    crowded: Timing
    crowded_poses: int
    tracked: Timing
    tracked_poses: int
    peer: Timing
    peer_found: int
    first_pose: ProcessCost | None
    run: ProcessCost | None

    @property
    def wholes(self) -> tuple[Timing, ...]:
        """Every whole ``solve``, as they are compared with the peer."""
        return self.total, self.tracked, self.colour, self.crowded

    def ratio(self, timing: Timing) -> float:
        """How many times longer the peer takes, by medians of the same run."""
        return self.peer.median_s / timing.median_s


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
    calibration = Calibration(scene.true_lens, "simulated")
    uvgs = Uvgs(calibration, scene.true_beacon, config, clock=perf_counter)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detector = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters())
    marker = cv2.aruco.generateImageMarker(dictionary, 7, _MARKER_PX)
    rng = np.random.default_rng((seed, 6))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    stages: dict[str, list[float]] = {}
    spent: dict[str, list[float]] = {name: [] for name in ("total", "tracked", "colour", "crowded", PEER)}
    poses = found = crowded_poses = 0
    pictured: ImageArray | None = None
    sink(StageStarted("benchmark", count))
    try:
        uvgs.warm_up(colour=True)
        # As a run does: no collection walks through what is loaded.
        gc.freeze()
        for done, capture in enumerate(camera, start=1):
            marked = _with_marker(capture, marker)
            detector.detectMarkers(marked)
            outcome, times = _solve_often(uvgs, capture, None, stages)
            spent["total"] += times
            if isinstance(outcome, PoseEstimate):
                poses += 1
                pictured = capture.image
                followed, times = _solve_often(uvgs, capture, replace(outcome, t_ns=outcome.t_ns - _PRIOR_AGE_NS))
                if isinstance(followed, PoseEstimate) and followed.tracked_count:
                    spent["tracked"] += times
            if capture.image.ndim == 2:
                in_colour = np.ascontiguousarray(np.repeat(capture.image[:, :, None], 3, axis=2))
                spent["colour"] += _solve_often(uvgs, replace(capture, image=in_colour))[1]
            crowd = replace(capture, image=_with_lights(capture.image, CROWD - len(uvgs.beacon.leds), rng))
            outcome, times = _solve_often(uvgs, crowd)
            spent["crowded"] += times
            crowded_poses += isinstance(outcome, PoseEstimate)
            for _ in range(_REPEATS):
                begin = perf_counter()
                _, ids, _ = detector.detectMarkers(marked)
                spent[PEER].append(perf_counter() - begin)
            found += ids is not None and len(ids) > 0
            sink(StageAdvanced("benchmark", done))
    finally:
        cv2.setNumThreads(threads)
    lens, beacon = scene.true_lens, Path(read_bench(bench).beacon_file)
    result = PipelineBenchmark(
        lens.width_px, lens.height_px, count, poses,
        tuple(_timing(name, values) for name, values in stages.items()),
        _timing("whole picture", spent["total"]),
        _timing("colour", spent["colour"]),
        _timing(f"{CROWD} lights", spent["crowded"]), crowded_poses,
        _timing("tracked", spent["tracked"]), len(spent["tracked"]) // _REPEATS,
        _timing(PEER, spent[PEER]), found,
        None if pictured is None else first_pose_cost(calibration, beacon, pictured),
        run_cost(calibration, beacon, bench),
    )  # fmt: skip
    sink(StageFinished("benchmark", f"{poses} poses of {count} captures"))
    return result


def _solve_often(
    uvgs: Uvgs, capture: Capture, prior: PoseEstimate | None = None, stages: dict[str, list[float]] | None = None
) -> tuple[Outcome, list[float]]:
    """The outcome, and the duration of each of some repetitions, s; the duration of stages is added to ``stages``."""
    times = []
    for _ in range(_REPEATS):
        begin = perf_counter()
        outcome = uvgs.solve(capture, prior)
        times.append(perf_counter() - begin)
        if stages is not None:
            for stage, duration_s in outcome.stage_s.items():
                stages.setdefault(stage, []).append(duration_s)
    return outcome, times


def _with_lights(image: ImageArray, count: int, rng: np.random.Generator) -> ImageArray:
    """The picture with so many spots more, at random places away from its border."""
    out = image.copy()
    half = int(np.ceil(5.0 * _LIGHT_SIGMA_PX))
    reach = np.arange(-half, half + 1)
    spot = _LIGHT_SHARE * np.exp(-0.5 * (reach[:, None] ** 2 + reach[None] ** 2) / _LIGHT_SIGMA_PX**2)
    full_scale = full_scale_dn(image)
    for _ in range(count):
        y, x = (int(rng.integers(2 * half, side - 2 * half)) for side in image.shape[:2])
        window = out[y - half : y + half + 1, x - half : x + half + 1]
        light = full_scale * (spot if image.ndim == 2 else spot[:, :, None])
        window[:] = np.minimum(window + light, full_scale).astype(image.dtype)
    return out


def _timing(name: str, values_s: list[float]) -> Timing:
    values: FloatArray = np.array(values_s or [nan])
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
