"""The one true bench, shared by the mock controller and the simulated camera, and the list of those that are live."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.beacon.geometry import Beacon, Led
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.clock import Clock, ScaledClock
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.devices.gantry.grbl_protocol import si_from_controller
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import CalibrationError, ConfigError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.units import m_from_mm, rad_from_mrad, s_from_ns

if TYPE_CHECKING:
    from uvgs_bench.devices.bench import Bench
    from uvgs_bench.devices.sim.grbl_device import GrblDevice

_PPM = 1e-6
_live: dict[str, SimulatedBench] = {}
_numbers = itertools.count(1)


class SimulatedBench:
    """The true bench. Where things are depends on bench time and the controller only, never on the speed.

    Backlash is a dead band: the carriage stands still until a reversing motor has taken it up. One simplification:
    every stop draws a new stopping error for every axis, which holds until the next stop.

    Args:
        truth: What is true.
        beacon: The beacon as its file says; the truth's offsets are added to it.
        axes: The nominal axes.
        mount: ``beacon_on_carriage`` or ``camera_on_carriage``.
        speed: How much faster than real time the bench runs, > 0.
        seed: Seed in place of the truth's.
        others: Beacons fixed to this one: beacon_from_other as surveyed, and the beacon as its file says.
        clock: Bench time in place of one that runs ``speed`` times faster than real time.

    Raises:
        ConfigError: The truth names an LED or a beacon that is not there, or its lens is impossible.
    """

    def __init__(
        self,
        truth: SimulatedTruth,
        beacon: Beacon,
        axes: tuple[Axis, ...],
        mount: str,
        *,
        speed: float = 1.0,
        seed: int | None = None,
        others: Sequence[tuple[Pose, Beacon]] = (),
        clock: Clock | None = None,
    ) -> None:
        self.truth = truth
        self.axes = axes
        self.mount = mount
        self.seed = truth.seed if seed is None else seed
        self.clock: Clock = ScaledClock(speed) if clock is None else clock
        self.true_beacon = displaced_beacon(truth, beacon)
        self.true_lens = true_lens(truth)
        self.companions = _displaced_others(truth, others)
        self._true_axes = true_axes(truth, axes)
        is_carried = mount == "beacon_on_carriage"
        self._outer = truth.camera_from_gantry.pose("camera", "gantry" if is_carried else "carriage")
        self._inner = truth.carriage_from_beacon.pose("carriage" if is_carried else "gantry", "beacon")
        self._backlash_m = _per_linear_axis(truth.gantry.backlash_mm, axes)
        self._repeatability_m = _per_linear_axis(truth.gantry.repeatability_mm, axes)
        self._device: GrblDevice | None = None
        self._carried: list[FloatArray] = []
        self.name = f"bench-{next(_numbers)}"
        _live[self.name] = self

    @property
    def device(self) -> GrblDevice:
        """The mock controller; it keeps its power, and so its settings, as long as the bench lives."""
        if self._device is None:
            from uvgs_bench.devices.sim.grbl_device import GrblDevice

            self._device = GrblDevice.for_axes(self.axes)
        return self._device

    @property
    def gantry_spec(self) -> str:
        """Spec of the gantry on this bench."""
        return f"grbl:sim://{self.name}"

    @property
    def camera_spec(self) -> str:
        """Spec of the camera on this bench."""
        return f"sim:{self.name}"

    def true_axis_position(self, t_ns: int) -> FloatArray:
        """Motor-side axis positions at an instant, shape (A,), m or rad."""
        return read_only(self.device.position_at(t_ns))

    def true_gantry_from_carriage(self, t_ns: int) -> Pose:
        """Where the carriage truly is at an instant."""
        device = self.device
        motor = np.asarray(device.position_at(t_ns), dtype=np.float64)
        return self.carriage_at(motor, self._lag(motor, t_ns), device.motions_until(t_ns).stops_count(s_from_ns(t_ns)))

    def _lag(self, motor: FloatArray, t_ns: int) -> FloatArray:
        """Which share of half the backlash the carriage lags behind its motors, -1 to 1, shape (A,).

        Every motion is monotonic on every axis, so that it moves the play from one end to the other at most once.
        """
        half = 0.5 * self._backlash_m
        motors = self.device.motions_until(t_ns)
        number = motors.number(s_from_ns(t_ns))
        while len(self._carried) <= number:
            start = si_from_controller(self.axes, motors.start(len(self._carried)))
            before = self._carried[-1] if self._carried else start
            self._carried.append(np.clip(before, start - half, start + half))
        carried = np.clip(self._carried[number], motor - half, motor + half)
        return np.divide(motor - carried, half, out=np.zeros_like(motor), where=half > 0.0)

    def carriage_at(self, motor: FloatArray, direction: FloatArray, stop_count: int) -> Pose:
        """Where the carriage truly is for a motor position, however it got there.

        Args:
            motor: Motor-side axis positions, shape (A,), m or rad.
            direction: Which way each axis came, shape (A,): +1 upwards or -1 downwards with the play taken up, between
                the two while the play is being taken up.
            stop_count: How many stops there were; seeds the stopping error.

        Returns:
            True ``gantry_from_carriage``.
        """
        stopping = np.random.default_rng((self.seed, 1, stop_count)).standard_normal(len(self.axes))
        carried = motor - 0.5 * self._backlash_m * direction + self._repeatability_m * stopping
        return gantry_from_carriage_true(self._true_axes, carried)

    def true_camera_from_beacon(self, t_ns: int) -> Pose:
        """Where the beacon truly is before the camera at an instant."""
        return self.camera_from_beacon_at(self.true_gantry_from_carriage(t_ns))

    def camera_from_beacon_at(self, gantry_from_carriage: Pose) -> Pose:
        """Where the beacon truly is before the camera for a true place of the carriage."""
        is_carried = self.mount == "beacon_on_carriage"
        return self._outer @ (gantry_from_carriage if is_carried else gantry_from_carriage.inverse()) @ self._inner

    def true_camera_from(self, frame: str, t_ns: int) -> Pose:
        """``camera_from_<frame>`` at an instant, for the frames camera, gantry and carriage."""
        if frame == "camera":
            return Pose.identity("camera", "camera")
        moving = self.true_gantry_from_carriage(t_ns)
        if self.mount == "beacon_on_carriage":
            return self._outer if frame == "gantry" else self._outer @ moving
        return self._outer if frame == "carriage" else self._outer @ moving.inverse()

    def close(self) -> None:
        """Take the bench off the list. Safe to call twice."""
        _live.pop(self.name, None)


def simulated_bench(name: str) -> SimulatedBench:
    """Look up a live bench.

    Args:
        name: Its name.

    Returns:
        The bench.

    Raises:
        KeyError: No bench of this name is live in this process.
    """
    return _live[name]


def live_benches() -> tuple[str, ...]:
    """Names of the benches that are live in this process."""
    return tuple(_live)


def start_simulated_bench(
    bench: Bench,
    beacon: Beacon,
    *,
    speed: float = 1.0,
    seed: int | None = None,
    others: Sequence[Beacon] = (),
    clock: Clock | None = None,
) -> SimulatedBench:
    """Start the simulated bench a bench file describes.

    Args:
        bench: The bench; without ``[simulated]`` the default truth is used.
        beacon: Its beacon as the file says.
        speed: How much faster than real time it runs, > 0.
        seed: Seed in place of the truth's.
        others: The bench's other beacons as their files say, in its order.
        clock: Bench time in place of one that runs ``speed`` times faster than real time.

    Returns:
        The live bench; close it to take it off the list.

    Raises:
        ConfigError: The truth does not fit the beacon.
    """
    truth = bench.simulated or SimulatedTruth()
    # What is true is said against the axes as declared, whatever was measured since.
    axes = bench.nominal_axes or bench.envelope.axes
    placed = [(other.beacon_from_other, file) for other, file in zip(bench.others, others, strict=True)]
    return SimulatedBench(truth, beacon, axes, bench.mount, speed=speed, seed=seed, others=placed, clock=clock)


def true_lens(truth: SimulatedTruth) -> Lens:
    """The true lens.

    Raises:
        ConfigError: Its model or parameters are impossible.
    """
    camera = truth.camera
    try:
        return Lens(camera.model, camera.width_px, camera.height_px, np.array(camera.parameters_px))
    except CalibrationError as error:
        raise ConfigError(str(error), key="simulated.camera") from None


def displaced_beacon(truth: SimulatedTruth, beacon: Beacon) -> Beacon:
    """The beacon with its LEDs where they truly are.

    Raises:
        ConfigError: The truth names an LED the beacon does not have.
    """
    for key, names in (("led_offset_mm", tuple(truth.led_offset_mm)), ("occlusion.leds", truth.occlusion.leds)):
        for name in names:
            if name not in beacon.led_names:
                known = ", ".join(beacon.led_names)
                raise ConfigError(f"beacon {beacon.name} has no LED '{name}', it has {known}", key=f"simulated.{key}")
    leds = tuple(
        Led(
            led.name,
            led.position_m + m_from_mm(np.array(truth.led_offset_mm.get(led.name, (0.0, 0.0, 0.0)))),
            led.axis,
            led.half_angle_rad,
            led.diameter_m,
        )
        for led in beacon.leds
    )
    return Beacon(beacon.name, leds, beacon.hue)


def _displaced_others(truth: SimulatedTruth, others: Sequence[tuple[Pose, Beacon]]) -> tuple[tuple[Pose, Beacon], ...]:
    """Where the other beacons truly stand."""
    names = [beacon.name for _, beacon in others]
    for name in truth.other_offset_mm:
        if name not in names:
            known = ", ".join(names) or "none"
            raise ConfigError(
                f"the bench has no other beacon '{name}', it has {known}", key="simulated.other_offset_mm"
            )
    placed = []
    for pose, beacon in others:
        offset_m = m_from_mm(np.array(truth.other_offset_mm.get(beacon.name, (0.0, 0.0, 0.0))))
        placed.append((Pose(pose.R, pose.t_m + offset_m, pose.target, pose.source), beacon))
    return tuple(placed)


def true_axes(truth: SimulatedTruth, axes: tuple[Axis, ...]) -> tuple[tuple[str, FloatArray], ...]:
    """Kind and true direction of each axis; the length of a linear direction carries the scale error.

    A positive squareness leans the later axis of a pair towards the earlier one.
    """
    lean = dict(zip(((0, 1), (0, 2), (1, 2)), truth.gantry.squareness_mrad, strict=True))
    linear = [i for i, axis in enumerate(axes) if axis.kind == "linear"]
    result = []
    for i, axis in enumerate(axes):
        direction = np.array(axis.direction)
        if i in linear:
            later = linear.index(i)
            for earlier in range(later):
                angle = rad_from_mrad(lean.get((earlier, later), 0.0))
                direction = direction + angle * axes[linear[earlier]].direction
            direction = direction / np.linalg.norm(direction)
        result.append((axis.kind, read_only(direction * (1.0 + _PPM * _entry(truth.gantry.scale_ppm, i)))))
    return tuple(result)


def gantry_from_carriage_true(axes: tuple[tuple[str, FloatArray], ...], position: FloatArray) -> Pose:
    """The kinematic chain with true directions; a rotary axis turns by its scaled angle."""
    pose = Pose.identity("gantry", "carriage")
    for (kind, direction), value in zip(axes, position, strict=True):
        step = np.concatenate(
            (np.zeros(3), direction * value) if kind == "linear" else (direction * value, np.zeros(3))
        )
        pose = pose @ Pose.exp(step, "carriage", "carriage")
    return pose


def _entry(values: tuple[float, ...], index: int) -> float:
    return values[min(index, len(values) - 1)]


def _per_linear_axis(values_mm: tuple[float, ...], axes: tuple[Axis, ...]) -> FloatArray:
    entries = [_entry(values_mm, i) if axis.kind == "linear" else 0.0 for i, axis in enumerate(axes)]
    return read_only(m_from_mm(np.array(entries)))
