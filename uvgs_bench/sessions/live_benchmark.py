"""Whether the sensor keeps up with a live camera: pictures arrive from another process at a fixed rate."""

from __future__ import annotations

import multiprocessing as mp
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.cameras.live_queue import LiveQueue
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.errors import CaptureError
from uvgs_bench.interop.trajectories import open_pose_writer
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.outlets import PoseFile
from uvgs_bench.sessions.stream import StreamRules, solve_source
from uvgs_bench.sessions.tally import LATENCY, Tally
from uvgs_bench.store.bench import read_passing_beacon
from uvgs_bench.units import NS_PER_S, ns_from_s, s_from_ns

STAGE = "live"
_PICTURES = 40
_FIRST_S = 0.5
_SILENCE_S = 5.0


@dataclass(frozen=True, slots=True)
class LiveBenchmark:
    """What the run measured.

    Args:
        width_px: Picture width, px.
        height_px: Picture height, px.
        rate_hz: Pictures per second that were sent.
        sent: Pictures sent.
        answered: Captures that were solved and written.
        dropped: Captures the sensor came too late for.
        poses: Captures with a pose.
        median_s: Median time from the instant of a picture to its written answer, s.
        p99_s: 99th percentile of it, s.
        longest_s: Longest of it, s.
    """

    width_px: int
    height_px: int
    rate_hz: float
    sent: int
    answered: int
    dropped: int
    poses: int
    median_s: float
    p99_s: float
    longest_s: float


def benchmark_live(
    bench: Path,
    folder: Path,
    sink: EventSink,
    *,
    rate_hz: float = 100.0,
    duration_s: float = 60.0,
    track: bool = False,
    seed: int = 0,
) -> LiveBenchmark:
    """Solve pictures that another process delivers at a fixed rate, through the queue, the stream and a CSV file.

    Args:
        bench: Bench file with a simulated camera and beacon; its pictures are rendered before and sent in turn.
        folder: Where the pose file is written.
        sink: Where progress goes.
        rate_hz: Pictures per second.
        duration_s: How long, s.
        track: Whether the sensor looks where the last pose puts the LEDs.
        seed: Seed of the scene.

    Returns:
        Counts and latencies.

    Raises:
        ConfigError: The bench file is broken.
        CaptureError: The sending process died.
    """
    import gc

    scene = read_passing_beacon(bench, seed)
    rendered = [capture.image for capture in islice(SimulatedCamera(scene, "sim:", None), _PICTURES)]
    pictures = np.stack(rendered).astype(rendered[0].dtype)
    uvgs = Uvgs(Calibration(scene.true_lens, "simulated"), scene.true_beacon, UvgsConfig(), clock=time.perf_counter)
    uvgs.warm_up()
    gc.freeze()
    name, total = uvgs.beacon.name, max(1, round(rate_hz * duration_s))
    tally = Tally((name,))
    sink(StageStarted(STAGE, total))
    with (
        _loopback(pictures, rate_hz, total) as camera,
        closing(LiveQueue(camera, lambda: camera, lambda _news: None, patience_s=0.0)) as queue,
        closing(PoseFile(open_pose_writer(folder / "live.csv", force=True))) as outlet,
    ):
        rules = StreamRules(track=track)
        for answered in solve_source(queue, {name: uvgs}, ignore_events, rules, is_live=True):
            outlet.put(answered)
            tally.take(answered.lines, queue.age_s(answered.capture))
            if tally.captures % round(rate_hz) == 0:
                sink(StageAdvanced(STAGE, tally.captures))
        dropped = queue.dropped
    gc.unfreeze()
    sink(StageFinished(STAGE, f"{tally.captures} of {total} captures answered"))
    times = tally.stages[LATENCY]
    return LiveBenchmark(
        int(pictures.shape[2]), int(pictures.shape[1]), rate_hz, total, tally.captures, dropped, tally.poses,
        times.quantile_s(0.5), times.quantile_s(0.99), times.longest_s,
    )  # fmt: skip


class LoopbackCamera(ClosingSource):
    """Pictures that another process says are ready, copied out of shared memory as a driver's buffer is.

    Args:
        pictures: All pictures, shape (N, H, W).
        line: Where the number and instant of each ready picture comes from.
    """

    def __init__(self, pictures: NDArray[Any], line: Connection) -> None:
        super().__init__("loopback:", is_live=True, length=None)
        self._pictures = pictures
        self._line = line
        self._next = 0

    def grab(self) -> Capture | None:
        """The next picture, or None after the last.

        Raises:
            CaptureError: Nothing comes.
        """
        try:
            if not self._line.poll(_SILENCE_S):
                raise CaptureError("nothing comes", self.spec)
            number, t_ns = self._line.recv()
        except EOFError:
            return None
        image = self._pictures[number].copy()
        self._next += 1
        return Capture(image, t_ns, self.spec, self._next - 1)


@contextmanager
def _loopback(pictures: NDArray[Any], rate_hz: float, count: int) -> Iterator[LoopbackCamera]:
    memory = SharedMemory(create=True, size=pictures.nbytes)
    receive, send = mp.Pipe(duplex=False)
    try:
        shared: NDArray[Any] = np.ndarray(pictures.shape, pictures.dtype, memory.buf)
        shared[:] = pictures
        sender = mp.get_context("spawn").Process(target=_send, args=(send, len(pictures), rate_hz, count), daemon=True)
        sender.start()
        send.close()
        try:
            yield LoopbackCamera(shared, receive)
        finally:
            sender.terminate()
            sender.join()
            del shared
    finally:
        receive.close()
        memory.close()
        memory.unlink()


def _send(line: Connection, pictures: int, rate_hz: float, count: int) -> None:
    start_ns = time.monotonic_ns() + ns_from_s(_FIRST_S)
    for k in range(count):
        t_ns = start_ns + round(k * NS_PER_S / rate_hz)
        time.sleep(max(0.0, s_from_ns(t_ns - time.monotonic_ns())))
        line.send((k % pictures, t_ns))
    line.close()
