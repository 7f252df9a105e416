"""What a registration cannot see: null directions, their words, and the gauge that picks one answer.

Source: metrology of AX = ZB on a gantry (rank 9 for translations only, 11 with one axis of rotation, 12 with two);
W. Baarda, S-transformations and criterion matrices, 1973, for covariances in a chosen gauge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.accuracy.tangent import hats, left_jacobian_inverses, rotation_logs
from uvgs_bench.geometry import FloatArray, Pose

# A direction is seen when the data pin it to a tenth of a radian, or of the working distance; exact blindness shows as
# rounding, far below this, and anything in between would be quoted with a doubt as large as itself.
_WORST_SEEN_SIGMA = 0.1
_RELATIVE_FLOOR = 1e-11


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Information of 12 parameters (left omega, v; right omega, v), parted into seen and unseen directions.

    Args:
        scale: What one unit of each parameter means: 1 rad or the working distance, shape (12,).
        values: Eigenvalues of the scaled information that are seen, shape (r,).
        seen: Their eigenvectors in scaled parameters, shape (12, r).
        unseen: The others, shape (12, 12 - r).
    """

    scale: FloatArray
    values: FloatArray
    seen: FloatArray
    unseen: FloatArray

    @property
    def rank(self) -> int:
        """Number of seen directions."""
        return len(self.values)

    def null_directions(self) -> FloatArray:
        """Unseen directions in plain parameters (rad and m), orthonormal rows, shape (12 - r, 12)."""
        if self.rank == len(self.scale):
            return np.empty((0, len(self.scale)))
        basis, _ = np.linalg.qr(self.scale[:, None] * self.unseen)
        return np.ascontiguousarray(basis.T)

    def covariance(self) -> FloatArray:
        """Inverse information in the seen directions, zero in the others, shape (12, 12)."""
        factor = self.factor()
        out: FloatArray = factor @ factor.T
        return out

    def factor(self) -> FloatArray:
        """The seen directions, each as long as its standard deviation: root of the covariance, shape (12, r)."""
        return np.asarray(self.scale[:, None] * self.seen / np.sqrt(self.values))


def part_information(H: FloatArray, length_m: float) -> Information:
    """Part a 12x12 information into seen and unseen directions.

    Args:
        H: Information (normal matrix) of the 12 parameters, shape (12, 12), 1/rad^2 and 1/m^2.
        length_m: Working distance: what counts as one unit of translation, m.

    Returns:
        The parted information.
    """
    scale = np.tile(np.array([1.0, 1.0, 1.0, length_m, length_m, length_m]), 2)
    values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    is_seen = values > max(1.0 / _WORST_SEEN_SIGMA**2, _RELATIVE_FLOOR * float(values[-1]))
    return Information(scale, values[is_seen], vectors[:, is_seen], vectors[:, ~is_seen])


def mounted_slice(mount: Mount) -> slice:
    """Which six of the 12 parameters belong to what rides the carriage."""
    return slice(6, 12) if mount == "beacon_on_carriage" else slice(0, 6)


def gauge_gradient(part: Pose, nominal: Pose, length_m: float) -> tuple[FloatArray, FloatArray]:
    """Deviation of the mounted part from its nominal pose, and its derivative by the part's left tangent.

    Args:
        part: The fitted pose of what rides the carriage.
        nominal: Where it is drawn to in unseen directions.
        length_m: What counts as one unit of translation, m.

    Returns:
        Deviation, shape (6,), and derivative, shape (6, 6), in scaled units.
    """
    turn = rotation_logs((part.R @ nominal.R.T)[None])[0]
    deviation = np.concatenate([turn, (part.t_m - nominal.t_m) / length_m])
    gradient = np.zeros((6, 6))
    gradient[:3, :3] = left_jacobian_inverses(np.concatenate([turn, np.zeros(3)])[None])[0, :3, :3]
    gradient[3:, :3] = -hats(part.t_m[None])[0] / length_m
    gradient[3:, 3:] = np.eye(3) / length_m
    return deviation, gradient


def in_gauge(covariance: FloatArray, null: FloatArray, gradient: FloatArray, mounted: slice) -> FloatArray:
    """Covariance when the unseen directions are held by the mounted part (Baarda's S-transformation).

    Args:
        covariance: Covariance in any gauge, shape (12, 12).
        null: Unseen directions, shape (k, 12).
        gradient: Derivative of the mounted part's deviation, shape (6, 6).
        mounted: The mounted part's parameters.

    Returns:
        Covariance, shape (12, 12), zero along what is held.
    """
    if len(null) == 0:
        return covariance
    T = gauge_transform(null, gradient, mounted)
    out: FloatArray = T @ covariance @ T.T
    return 0.5 * (out + out.T)


def gauge_transform(null: FloatArray, gradient: FloatArray, mounted: slice) -> FloatArray:
    """Change of the 12 parameters in the gauge of ``in_gauge``, for a change in any gauge, shape (12, 12)."""
    if len(null) == 0:
        return np.eye(12)
    G = np.zeros((len(null), null.shape[1]))
    G[:, mounted] = (gradient @ null[:, mounted].T).T @ gradient
    return np.asarray(np.eye(null.shape[1]) - null.T @ np.linalg.solve(G @ null.T, G))


def blind_spots(null: FloatArray, left: Pose, mount: Mount) -> tuple[str, ...]:
    """Say unseen directions in words.

    Args:
        null: Unseen directions, shape (k, 12).
        left: The left pose of the registration.
        mount: Which part rides the carriage.

    Returns:
        One line per kind of blindness; empty when everything is seen.
    """
    if len(null) == 0:
        return ()
    # In carriage axes: the right pose's left tangent, or the left pose's tangent carried over to its source frame.
    twists = null[:, 6:] if mount == "beacon_on_carriage" else null[:, :6] @ left.inverse().adjoint().T
    U, size, directions = np.linalg.svd(twists[:, :3])
    turning = int((size > 1e-3).sum())
    shifts = (U.T @ twists)[turning:, 3:]
    rider, other = ("beacon", "camera") if mount == "beacon_on_carriage" else ("camera", "beacon")
    lines = []
    if len(shifts) == 3:
        lines.append(
            f"the {rider}'s offset on the carriage cannot be told from the {other}'s offset from the gantry zero: "
            "only their sum is seen (3 directions)"
        )
    else:
        lines.extend(
            f"the {rider}'s offset along {_said(shift)} of the carriage cannot be told from the {other}'s offset from "
            "the gantry zero: only their sum is seen"
            for shift in shifts
        )
    lines.extend(
        f"the {rider}'s rotation about {_said(direction)} of the carriage cannot be told from the {other}'s rotation "
        "about the same direction: only their sum is seen"
        for direction in directions[:turning]
    )
    return tuple(lines)


def _said(direction: FloatArray) -> str:
    unit = direction / np.linalg.norm(direction)
    largest = int(np.abs(unit).argmax())
    # Adding zero turns a negative zero into one that reads well.
    unit = (unit * np.sign(unit[largest])).round(6) + 0.0
    if unit[largest] > 1.0 - 1e-6:
        return f"the {'xyz'[largest]} axis"
    return f"the direction ({unit[0]:.3f}, {unit[1]:.3f}, {unit[2]:.3f})"
