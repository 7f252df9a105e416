"""The simulated camera: it sees the beacon where the carriage truly is at that instant."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from math import ceil, inf
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.sim.bench import live_benches, simulated_bench
from uvgs_bench.devices.sim.render import DEFAULT_DIAMETER_M, Emitter, Renderer, Spot
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import m_from_mm, ns_from_s, s_from_ms

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

# The room that reads files lies above this one, so it is asked for by name, as every plug is.
_SCENE_OF_FILE = ("uvgs_bench.store.bench", "read_passing_beacon")
# A spot that moves less than this between two instants leaves a smooth trail.
_TRAIL_STEP_PX = 0.3
_MAX_INSTANTS = 64
_EXPOSURE_LIMITS_S = (1e-5, 0.1)


class Scene(Protocol):
    """What the camera looks at."""

    truth: SimulatedTruth
    seed: int

    @property
    def true_lens(self) -> Lens:
        """The true lens."""
        ...

    @property
    def true_beacon(self) -> Beacon:
        """The beacon with its LEDs where they truly are."""
        ...

    @property
    def companions(self) -> Sequence[tuple[Pose, Beacon]]:
        """Other beacons fixed to this one: beacon_from_companion, and the companion as its file says."""
        ...

    def true_camera_from_beacon(self, t_ns: int) -> Pose:
        """Where the beacon truly is at an instant."""
        ...

    def true_camera_from(self, frame: str, t_ns: int) -> Pose:
        """Where the frame camera, gantry or carriage truly is at an instant."""
        ...


class SimulatedCamera(ClosingSource):
    """A camera before a simulated scene, live on a clock or stepping through time as a recording does.

    Args:
        scene: What it looks at.
        spec: The spec string it is known by.
        clock: The bench clock for a live camera, or None to step.
        count: Number of captures when stepping, or None for no end.
        step_s: Time between captures when stepping, s.
    """

    def __init__(
        self, scene: Scene, spec: str, clock: Clock | None, *, count: int | None = None, step_s: float = 0.1
    ) -> None:
        super().__init__(spec, is_live=clock is not None, length=count)
        self._scene = scene
        self._clock = clock
        self._step_ns = ns_from_s(step_s)
        self._renderer = Renderer(scene.true_lens, scene.truth.camera, scene.seed)
        self._exposure_s = s_from_ms(scene.truth.camera.exposure_ms)
        self._next = 0
        self._is_closed = False

    @classmethod
    def open(cls, spec: CameraSpec, _clock: Clock) -> SimulatedCamera:
        """Open ``sim:NAME`` of a live bench, or ``sim:bench.toml`` with the options ``count``, ``seed`` and ``with``.

        The file's bench stands still; its beacon passes before the camera on a smooth seeded path. ``with`` names
        files of further beacons, separated by commas, that ride beside it.

        Raises:
            CaptureError: No bench of this name is live and there is no such file.
            ConfigError: An option is unknown or no number, or the file is broken.
        """
        if spec.target in live_benches():
            spec.check_options(())
            bench = simulated_bench(spec.target)
            return cls(bench, spec.text, bench.clock)
        path = Path(spec.target)
        if not spec.target or not path.is_file():
            there = ", ".join(live_benches()) or "none"
            raise CaptureError(f"no simulated bench of this name is running ({there}) and no such file", spec.text)
        spec.check_options(("count", "seed", "with"))
        companions = tuple(Path(name) for name in spec.options.get("with", "").split(",") if name)
        numbers: dict[str, int] = {}
        for name, value in spec.options.items():
            if name == "with":
                continue
            if not value.isdigit():
                raise ConfigError(f"expected {name} as a number, got '{value}'", spec.text)
            numbers[name] = int(value)
        module, function = _SCENE_OF_FILE
        scene: Scene = getattr(import_module(module), function)(path, numbers.get("seed"), companions)
        return cls(scene, spec.text, None, count=numbers.get("count"))

    def grab(self) -> Capture | None:
        """Expose now and return the capture, or the next step's; None after the last step.

        Raises:
            CaptureError: The camera is closed.
        """
        if self._is_closed:
            raise CaptureError("the camera is closed", self.spec)
        if self.length is not None and self._next >= self.length:
            return None
        if self._clock is None:
            begin_ns = self._next * self._step_ns
        else:
            begin_ns = self._clock.now_ns()
            self._clock.sleep(self._exposure_s)
        capture = self.capture_at(begin_ns, self._next)
        self._next += 1
        return capture

    def now_ns(self) -> int:
        """Bench time, ns; of a camera that steps, when its next exposure begins."""
        return self._next * self._step_ns if self._clock is None else self._clock.now_ns()

    def capture_at(self, begin_ns: int, index: int) -> Capture:
        """The capture whose exposure begins at an instant that has passed.

        Args:
            begin_ns: Begin of the exposure, bench time, ns.
            index: Number of the capture; with the seed it decides all noise.

        Returns:
            The capture, stamped at mid-exposure plus the camera's delay.
        """
        rng = self._renderer.generator(index)
        instants_ns = self._instants(begin_ns)
        is_lit = not self._scene.truth.switched_light or index % 2 == 0
        emitters = [*(self._leds(instants_ns, rng) if is_lit else ()), *self._lights(instants_ns)]
        image = self._renderer.expose(emitters, self._glints(rng), self._exposure_s, rng)
        mid_ns = begin_ns + ns_from_s(0.5 * self._exposure_s)
        stamp_ns = mid_ns + ns_from_s(s_from_ms(self._scene.truth.camera.delay_ms))
        return Capture(image, stamp_ns, f"{self.spec}#{index}", index, self._exposure_s)

    @property
    def exposure_s(self) -> float:
        """The exposure of the next capture, s."""
        return self._exposure_s

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        """Shortest and longest exposure, s."""
        return _EXPOSURE_LIMITS_S

    @property
    def full_scale_dn(self) -> float:
        """Largest value of the converter, DN."""
        return float((1 << self._scene.truth.camera.bit_depth) - 1)

    @property
    def settling_captures(self) -> int:
        """None: every capture states its own exposure."""
        return 0

    def set_exposure_s(self, exposure_s: float) -> float:
        """Expose the next capture so long, s, within the limits; the answer is what it will be."""
        self._exposure_s = min(max(exposure_s, _EXPOSURE_LIMITS_S[0]), _EXPOSURE_LIMITS_S[1])
        return self._exposure_s

    def close(self) -> None:
        """Stop taking captures. Safe to call twice."""
        self._is_closed = True

    def _instants(self, begin_ns: int) -> list[int]:
        """Evenly spread instants of the exposure, as many as the trail of the fastest LED needs."""
        exposure_ns = ns_from_s(self._exposure_s)
        leds_m = self._scene.true_beacon.positions_m
        ends = [
            self._scene.true_lens.project(self._scene.true_camera_from_beacon(t_ns).apply(leds_m))
            for t_ns in (begin_ns, begin_ns + exposure_ns)
        ]
        trail_px = np.linalg.norm(ends[1] - ends[0], axis=1)
        longest_px = float(np.max(trail_px, initial=0.0, where=np.isfinite(trail_px)))
        count = min(_MAX_INSTANTS, max(1, ceil(longest_px / _TRAIL_STEP_PX))) if longest_px < inf else _MAX_INSTANTS
        return [begin_ns + (2 * k + 1) * exposure_ns // (2 * count) for k in range(count)]

    def _leds(self, instants_ns: Sequence[int], rng: np.random.Generator) -> list[Emitter]:
        poses = [self._scene.true_camera_from_beacon(t_ns) for t_ns in instants_ns]
        emitters = self._leds_of(self._scene.true_beacon, poses, rng)
        for beacon_from_companion, companion in self._scene.companions:
            emitters += self._leds_of(companion, [pose @ beacon_from_companion for pose in poses], rng)
        return emitters

    def _leds_of(self, beacon: Beacon, poses: Sequence[Pose], rng: np.random.Generator) -> list[Emitter]:
        truth = self._scene.truth
        hidden = rng.random(len(beacon.leds)) < truth.occlusion.probability
        emitters = []
        for led, is_hidden in zip(beacon.leds, hidden, strict=True):
            if is_hidden or led.name in truth.occlusion.leds:
                continue
            axis = None if led.axis is None else np.array([pose.R @ led.axis for pose in poses])
            emitters.append(
                Emitter(
                    centre_m=np.array([pose.apply(led.position_m) for pose in poses]),
                    axis=axis,
                    peak_dn_at_1m=truth.camera.peak_dn_at_1m,
                    diameter_m=DEFAULT_DIAMETER_M if led.diameter_m is None else led.diameter_m,
                    half_angle_rad=led.half_angle_rad,
                    exponent=truth.emission_exponent,
                    hue=beacon.hue,
                )
            )
        return emitters

    def _lights(self, instants_ns: Sequence[int]) -> list[Emitter]:
        emitters = []
        for light in self._scene.truth.lights:
            place_m = m_from_mm(np.array(light.position_mm))
            poses = [self._scene.true_camera_from(light.frame, t_ns) for t_ns in instants_ns]
            centre_m = np.array([pose.apply(place_m) for pose in poses])
            diameter_m = m_from_mm(light.diameter_mm)
            emitters.append(Emitter(centre_m, None, light.peak_dn_at_1m, diameter_m, hue=light.hue))
        return emitters

    def _glints(self, rng: np.random.Generator) -> list[Spot]:
        glints, camera = self._scene.truth.glints, self._scene.truth.camera
        if glints.probability <= 0.0:
            return []
        spots = []
        for _ in range(glints.count):
            chance, u, v, brightness = rng.random(4)
            if chance < glints.probability:
                u_px, v_px = u * camera.width_px - 0.5, v * camera.height_px - 0.5
                spots.append(Spot(u_px, v_px, brightness * glints.peak_dn, glints.sigma_px))
        return spots
