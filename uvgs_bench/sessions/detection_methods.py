"""The ways to a pose that the detection benchmark compares: uVGS, OpenCV's ArUco and the AprilTag library.

All get the true lens and the true size of what they look for, and work on raw pictures: tag corners are sent through
``Lens.unproject``, so that no picture is undistorted and no distortion is ignored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from time import perf_counter, process_time
from typing import Any, Literal

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.tag_views import Tag
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor import Capture, Uvgs
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.sensor.outcome import Miss

APRILTAG_FAMILY = "DICT_APRILTAG_36h11"

# OpenCV's square has y up and z towards the reader, the tag frame here y down and z away.
_TURNED = np.diag([1.0, -1.0, -1.0])
# The library, and OpenCV's copy of its quad finder, take (0, 0) as the corner of the first pixel, not its centre.
_APRILTAG_CORNER_PX = 0.5


@dataclass(frozen=True, slots=True)
class Attempt:
    """What one method made of one picture.

    Args:
        pose: The pose of the target, or None.
        reason: Why there is none, in a few stable words.
        duration_s: Processor time of the whole process from the picture to the answer, s.
        wall_s: The same by the wall clock, s; longer when others use the machine.
        stage_s: Parts of the duration, s, by name; empty when the method does not tell.
    """

    pose: Pose | None
    reason: str
    duration_s: float
    wall_s: float
    stage_s: dict[str, float]


Method = Callable[[ImageArray], Attempt]
Refinement = Literal["SUBPIX", "APRILTAG"]
CornerFinder = Callable[[ImageArray], FloatArray | None]


def uvgs_method(lens: Lens, beacon: Beacon) -> Method:
    """The sensor with its default parameters and without a prior, warmed up.

    Args:
        lens: The true lens.
        beacon: The true beacon.

    Returns:
        The method.
    """
    sensor = Uvgs(Calibration(lens, "simulated"), beacon, clock=process_time)
    sensor.warm_up()

    def solve(image: ImageArray) -> Attempt:
        wall, start = perf_counter(), process_time()
        outcome = sensor.solve(Capture(image, 0))
        duration_s, wall_s = process_time() - start, perf_counter() - wall
        if isinstance(outcome, Miss):
            return Attempt(None, f"{outcome.stage}: {outcome.reason}", duration_s, wall_s, outcome.stage_s)
        return Attempt(outcome.camera_from_beacon, "", duration_s, wall_s, outcome.stage_s)

    return solve


def tag_method(lens: Lens, tag: Tag, find_corners: CornerFinder) -> Method:
    """A tag finder followed by IPPE on undistorted corners.

    Args:
        lens: The true lens.
        tag: The tag with its true size.
        find_corners: Gives the raw corners of the wanted tag, top left first, clockwise, shape (4, 2), px, or None.

    Returns:
        The method.
    """

    def solve(image: ImageArray) -> Attempt:
        wall, start = perf_counter(), process_time()
        corners_px = find_corners(image)
        found_s = process_time()
        pose = None if corners_px is None else pose_of_square(lens, tag.side_m, corners_px)
        end, wall_s = process_time(), perf_counter() - wall
        reason = "" if pose is not None else "tag not found" if corners_px is None else "no pose from the corners"
        return Attempt(pose, reason, end - start, wall_s, {"corners": found_s - start, "pose": end - found_s})

    return solve


def pose_of_square(lens: Lens, side_m: float, corners_px: FloatArray) -> Pose | None:
    """The pose of a square from its corners, by OpenCV's IPPE_SQUARE: the one of its two poses that fits better.

    Args:
        lens: The lens.
        side_m: Side of the square, m.
        corners_px: Top left, top right, bottom right, bottom left, shape (4, 2), raw px.

    Returns:
        ``camera_from_board`` with the square's middle as origin, x right, y down, z away from the reader; or None.

    Source: Collins and Bartoli, Infinitesimal Plane-Based Pose Estimation, IJCV 2014.
    """
    import cv2

    rays = lens.unproject(corners_px)
    if not np.isfinite(rays).all():
        return None
    h = 0.5 * side_m
    square = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
    slopes = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    is_solved, rotation, translation = cv2.solvePnP(square, slopes, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    if not is_solved or not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return Pose(so3_exp(np.ravel(rotation).astype(np.float64)) @ _TURNED, np.ravel(translation), "camera", "board")


def aruco_corners(dictionary: str, number: int, refinement: Refinement = "SUBPIX") -> CornerFinder:
    """OpenCV's ArucoDetector with default parameters and refined corners.

    Args:
        dictionary: Family, as OpenCV names it.
        number: The wanted tag.
        refinement: ``SUBPIX`` (the usual choice) or ``APRILTAG`` (slower, far more accurate), as in
            ``CORNER_REFINE_...``.

    Returns:
        The finder.
    """
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = getattr(cv2.aruco, f"CORNER_REFINE_{refinement}")
    shift_px = _APRILTAG_CORNER_PX if refinement == "APRILTAG" else 0.0
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    detector = cv2.aruco.ArucoDetector(family, parameters)

    def find(image: ImageArray) -> FloatArray | None:
        corners, numbers, _ = detector.detectMarkers(image)
        if numbers is None or number not in numbers:
            return None
        place = np.ravel(numbers).tolist().index(number)
        return np.asarray(corners[place], dtype=np.float64).reshape(4, 2) - shift_px

    return find


def apriltag_corners(number: int, decimate: float) -> CornerFinder | None:
    """The AprilTag 3 library, one thread, all else as shipped.

    Args:
        number: The wanted tag of the family 36h11.
        decimate: Its ``quad_decimate``: 2 as shipped, 1 for full resolution.

    Returns:
        The finder, or None when the package ``pupil-apriltags`` is not installed.
    """
    try:
        bindings: Any = import_module("pupil_apriltags")
    except ImportError:
        return None
    detector = bindings.Detector(families="tag36h11", nthreads=1, quad_decimate=decimate)
    # Its destructor frees the family before the detector that still points into it; so the family is never freed.
    detector.tag_families = {}

    def find(image: ImageArray) -> FloatArray | None:
        for found in detector.detect(image):
            if found.tag_id == number:
                # It starts at the corner that is at the bottom right in OpenCV's drawing and goes the other way round.
                ordered = np.roll(np.asarray(found.corners, dtype=np.float64)[::-1], 2, axis=0)
                return ordered - _APRILTAG_CORNER_PX
        return None

    return find
