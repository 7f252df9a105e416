"""What is true on the simulated bench: the ``[simulated]`` table of ``bench.toml``, read strictly, keys in file units.

The defaults are a decent home-built gantry in a lit laboratory. Nothing here is known to the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_from_euler_zyx
from uvgs_bench.units import m_from_mm, rad_from_deg

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class TruePose:
    """A rigid transform as people write it.

    Args:
        position_mm: Origin of the source frame in the target frame, mm.
        euler_zyx_deg: Intrinsic Z-Y-X angles: yaw, pitch, roll, deg.
    """

    position_mm: Vector = (0.0, 0.0, 0.0)
    euler_zyx_deg: Vector = (0.0, 0.0, 0.0)

    def pose(self, target: str, source: str) -> Pose:
        """The transform as ``target_from_source``, in m."""
        yaw, pitch, roll = (rad_from_deg(angle) for angle in self.euler_zyx_deg)
        x, y, z = (m_from_mm(value) for value in self.position_mm)
        return Pose(rotation_from_euler_zyx(yaw, pitch, roll), (x, y, z), target, source)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class TrueCamera:
    """The simulated camera: lens, point spread, sensor.

    Args:
        model: Lens model, key of ``LENSES``.
        width_px: Picture width, px.
        height_px: Picture height, px.
        parameters_px: fx, fy, cx, cy (px), then the coefficients (no unit) of the model.
        psf_sigma_px: Standard deviation of the Gaussian point spread, px.
        peak_dn_at_1m: Grey value at the centre of an LED seen on its axis from 1 m at ``peak_exposure_ms``, DN, before
            the pixels integrate it.
        peak_exposure_ms: The exposure for which ``peak_dn_at_1m`` and ``background_dn`` are said, ms.
        exposure_ms: Exposure, ms.
        delay_ms: How much later than mid-exposure a capture is stamped, ms.
        bit_depth: Bits of the converter; pictures deeper than 8 bit are uint16.
        black_dn: Value of no light, DN.
        background_dn: Ambient light, DN.
        gain_e_per_dn: Electrons for one DN.
        full_well_e: Electrons at which a pixel saturates.
        read_noise_dn: Standard deviation of the read noise, DN.
        is_colour: Whether pictures are BGR instead of mono.
    """

    model: str = "plumb_bob"
    width_px: int = 1280
    height_px: int = 960
    parameters_px: tuple[float, ...] = (1002.4, 1001.7, 643.2, 476.9, -0.08, 0.045, 0.0004, -0.0003, 0.0)
    psf_sigma_px: float = 0.9
    peak_dn_at_1m: float = 180.0
    peak_exposure_ms: float = 4.0
    exposure_ms: float = 4.0
    delay_ms: float = 0.0
    bit_depth: int = 8
    black_dn: float = 4.0
    background_dn: float = 4.0
    gain_e_per_dn: float = 40.0
    full_well_e: float = 11000.0
    read_noise_dn: float = 0.6
    is_colour: bool = False

    def __post_init__(self) -> None:
        if not 8 <= self.bit_depth <= 16:
            raise ValueError(f"bit_depth must be 8 to 16, got {self.bit_depth}")
        positive = ("width_px", "height_px", "psf_sigma_px", "peak_exposure_ms", "exposure_ms", "gain_e_per_dn")
        for name in (*positive, "full_well_e"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("peak_dn_at_1m", "black_dn", "background_dn", "read_noise_dn"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class TrueGantry:
    """What is wrong with the gantry. Tuples have one entry per axis; the last one holds for all further axes.

    Args:
        scale_ppm: Too long by this much, parts per million of travel.
        squareness_mrad: How far each pair of linear axes leans together (less than a right angle), mrad, in the order
            1-2, 1-3, 2-3 (X-Y, X-Z, Y-Z).
        backlash_mm: Whole reversal, mm; a rotary axis has none.
        repeatability_mm: Standard deviation of where it stops, mm; a rotary axis stops exactly.
    """

    scale_ppm: tuple[float, ...] = (100.0, -60.0, 80.0)
    squareness_mrad: Vector = (0.2, -0.15, 0.1)
    backlash_mm: tuple[float, ...] = (0.02,)
    repeatability_mm: tuple[float, ...] = (0.01,)

    def __post_init__(self) -> None:
        for name in ("scale_ppm", "backlash_mm", "repeatability_mm"):
            if not getattr(self, name):
                raise ValueError(f"{name} needs at least one entry")
        if min(*self.backlash_mm, *self.repeatability_mm, 0.0) < 0.0:
            raise ValueError("backlash_mm and repeatability_mm must not be negative")


@dataclass(frozen=True, slots=True)
class TrueLight:
    """A steady light that is no LED of the beacon.

    Args:
        frame: The frame it stands in.
        position_mm: Its place in that frame, mm.
        peak_dn_at_1m: As for the LEDs, DN; it shines everywhere.
        diameter_mm: Its diameter, mm.
        hue: As a beacon's hue: a name, or a range in degrees.
    """

    frame: Literal["camera", "gantry", "carriage"]
    position_mm: Vector
    peak_dn_at_1m: float = 120.0
    diameter_mm: float = 10.0
    hue: str | tuple[float, float] = "white"


@dataclass(frozen=True, slots=True)
class Glints:
    """Reflections at random places of a picture.

    Args:
        probability: Chance of each of ``count`` glints to be in a capture.
        count: How many there can be.
        peak_dn: Largest grey value of one, DN; drawn evenly from 0 to this.
        sigma_px: Its Gaussian radius, px.
    """

    probability: float = 0.0
    count: int = 2
    peak_dn: float = 120.0
    sigma_px: float = 1.2

    def __post_init__(self) -> None:
        _check_probability(self.probability)


@dataclass(frozen=True, slots=True)
class Occlusion:
    """LEDs that are hidden.

    Args:
        probability: Chance of each LED to be hidden in a capture.
        leds: Names of LEDs that are always hidden.
    """

    probability: float = 0.0
    leds: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_probability(self.probability)


def _check_probability(value: float) -> None:
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"probability must be 0 to 1, got {value}")


@dataclass(frozen=True, slots=True)
class SimulatedTruth:
    """The whole truth of a simulated bench.

    Args:
        seed: Seed of everything random on it.
        camera: Lens and sensor.
        camera_from_gantry: Where the gantry stands before the camera (with ``mount = "camera_on_carriage"``:
            camera_from_carriage).
        carriage_from_beacon: How the beacon sits on the carriage (with ``mount = "camera_on_carriage"``:
            gantry_from_beacon).
        gantry: What is wrong with the gantry.
        emission_exponent: An LED shines as the cosine to its axis to this power, and not beyond its half angle.
        led_offset_mm: By LED name, how far it truly is from where the beacon file says, beacon frame, mm.
        other_offset_mm: By beacon name, how far a beacon of ``[[others]]`` truly is from where it was surveyed, in axes
            of the bench's own beacon, mm.
        lights: Other steady lights.
        glints: Reflections.
        occlusion: Hidden LEDs.
        switched_light: Whether the beacon is lit in every other capture only, the first one lit, as a retroreflector
            beside a switched lamp is.
    """

    seed: int = 1
    camera: TrueCamera = field(default_factory=TrueCamera)
    camera_from_gantry: TruePose = TruePose((196.0, -151.0, 1066.0), (1.1, -0.8, 91.4))
    carriage_from_beacon: TruePose = TruePose((12.0, -25.0, 8.0), (3.0, -4.0, -86.0))
    gantry: TrueGantry = field(default_factory=TrueGantry)
    emission_exponent: float = 1.0
    led_offset_mm: dict[str, Vector] = field(default_factory=dict)
    other_offset_mm: dict[str, Vector] = field(default_factory=dict)
    lights: tuple[TrueLight, ...] = ()
    glints: Glints = field(default_factory=Glints)
    occlusion: Occlusion = field(default_factory=Occlusion)
    switched_light: bool = False
