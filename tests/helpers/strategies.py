"""Property-test strategies shared by all laws."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from uvgs_bench.geometry import Pose

unit_floats = st.floats(-1.0, 1.0, allow_nan=False, allow_subnormal=False)


@st.composite
def rotation_vectors(draw, max_angle_rad: float = np.pi - 1e-9):
    """Rotation vectors, with the awkward angles (0, tiny, around the series limits, near pi) drawn often."""
    direction = np.array([draw(unit_floats) for _ in range(3)])
    norm = np.linalg.norm(direction)
    direction = np.array([1.0, 0.0, 0.0]) if norm < 1e-3 else direction / norm
    awkward = [0.0, 1e-12, 1e-8, 1e-5, 0.00999, 0.01001, 0.0999, 0.1001, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-9]
    angle = draw(st.one_of(st.sampled_from([a for a in awkward if a <= max_angle_rad]), st.floats(0.0, max_angle_rad)))
    return direction * angle


@st.composite
def twists(draw, max_angle_rad: float = np.pi - 1e-9):
    """Twists (omega, v) with translations up to 3 m."""
    v = np.array([draw(st.floats(-3.0, 3.0, allow_subnormal=False)) for _ in range(3)])
    return np.concatenate([draw(rotation_vectors(max_angle_rad)), v])


@st.composite
def poses(draw, target: str = "camera", source: str = "beacon"):
    """Poses of two frames."""
    return Pose.exp(draw(twists()), target, source)
