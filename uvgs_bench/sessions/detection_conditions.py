"""What the detection benchmark varies, and the pictures of one condition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.devices.sim.tag_views import SideBySide, Tag, facing_pose
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.units import rad_from_deg, s_from_ms

BASE_PAPER_DN = 40.0
"""White paper where ambient light is not varied, DN above black at 4 ms."""

_SLOTS = (0.25, 0.75)
_JITTER_PX = 20.0


@dataclass(frozen=True, slots=True)
class Condition:
    """What one group of captures has in common.

    Args:
        group: What is varied: ``range``, ``view angle``, ``ambient``, ``exposure``, ``motion``, ``defocus``.
        label: Its value for people.
        range_m: Distance of both targets from the camera, m.
        view_angle_rad: Angle between the line of sight and the targets' axes, rad.
        paper_dn: Ambient light: what white paper gives at the exposure the camera's truth names, DN above black.
        exposure_s: Exposure, s.
        motion_px: Movement of both targets during the exposure, px.
        psf_sigma_px: Standard deviation of the point spread, px.
    """

    group: str
    label: str
    range_m: float = 1.0
    view_angle_rad: float = rad_from_deg(20.0)
    paper_dn: float = BASE_PAPER_DN
    exposure_s: float = s_from_ms(4.0)
    motion_px: float = 0.0
    psf_sigma_px: float = 0.9


def default_conditions(*, quick: bool = False) -> tuple[Condition, ...]:
    """The printed conditions: one thing varied at a time around 1 m, 20 deg, 4 ms, paper 40 DN, sharp and at rest.

    Over range, the exposure follows the LEDs: 4 ms where they are discs in the picture (up to 1 m), then growing with
    the square of the range, up to 16 ms.

    Args:
        quick: One condition of each group only.
    """
    conditions = [
        Condition(
            "range", f"{range_m:g} m", range_m=range_m, exposure_s=s_from_ms(min(16.0, 4.0 * max(1.0, range_m**2)))
        )
        for range_m in (0.5, 1.0, 2.0, 3.0, 4.0)
    ]
    conditions += [
        Condition("view angle", f"{angle:g} deg", view_angle_rad=rad_from_deg(angle))
        for angle in (0.0, 40.0, 60.0, 75.0)
    ]
    conditions += [Condition("ambient", f"paper {dn:g} DN", paper_dn=dn) for dn in (5.0, 15.0, 100.0, 200.0)]
    conditions += [Condition("exposure", f"{ms:g} ms", exposure_s=s_from_ms(ms)) for ms in (0.5, 1.0, 16.0)]
    conditions += [Condition("exposure", "1 ms at 0.5 m", range_m=0.5, exposure_s=s_from_ms(1.0))]
    conditions += [Condition("motion", f"{px:g} px", motion_px=px) for px in (3.0, 8.0, 15.0)]
    conditions += [Condition("defocus", f"sigma {px:g} px", psf_sigma_px=px) for px in (2.0, 4.0)]
    if not quick:
        return tuple(conditions)
    chosen = {"2 m", "40 deg", "paper 15 DN", "1 ms", "8 px", "sigma 2 px"}
    return tuple(condition for condition in conditions if condition.label in chosen)


def picture(
    stage: SideBySide, beacon: Beacon, tag: Tag | None, condition: Condition, index: int
) -> tuple[ImageArray, tuple[Pose, Pose]]:
    """One picture of a condition with its truth.

    Args:
        stage: The camera.
        beacon: The beacon.
        tag: The tag, or None; poses and noise do not depend on it.
        condition: The condition.
        index: Number of the capture; with the seed it decides everything random. Odd captures swap the two sides.

    Returns:
        The picture; ``camera_from_beacon`` and ``camera_from_board`` of the tag at mid-exposure.
    """
    rng = stage.generator(index)
    slots = _SLOTS if index % 2 == 0 else _SLOTS[::-1]
    lens = stage.lens
    poses = []
    for slot, source in zip(slots, ("beacon", "board"), strict=True):
        jitter = rng.uniform(-_JITTER_PX, _JITTER_PX, 2)
        px = (slot * lens.width_px + jitter[0], 0.5 * lens.height_px + jitter[1])
        poses.append(facing_pose(lens, px, condition.range_m, condition.view_angle_rad, rng, source))
    towards = rng.uniform(0.0, 2.0 * np.pi)
    length_m = condition.motion_px * condition.range_m / lens.fx_px
    moved_m = length_m * np.array([np.cos(towards), np.sin(towards), 0.0])
    image = stage.view(beacon, poses[0], tag, poses[1], condition.exposure_s, moved_m, rng)
    return image, (poses[0], poses[1])
