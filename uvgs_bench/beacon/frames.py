"""Which frame LED positions are stated in, and what their covariance is there.

A frame is fixed by conditions on the LEDs themselves or by something outside. Changing it moves the doubt between LEDs;
distances between LEDs and their doubt stay the same.

Source: A. Baarda, S-transformations and criterion matrices (1973): T = 1 - M (F M)^-1 F, with rigid motions M and
conditions F.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import hat

FrameKind = Literal["nominal", "leds", "board", "gantry"]


@dataclass(frozen=True, slots=True)
class FrameChoice:
    """How the beacon frame is set.

    Args:
        kind: ``nominal`` (best fit of all LEDs onto the nominal ones), ``leds``, ``board`` or ``gantry`` (gantry axes,
            origin in the middle of the LEDs).
        leds: With ``leds``: origin, a point on +x, and a point of the x-y plane with positive y.
    """

    kind: FrameKind = "nominal"
    leds: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str) -> FrameChoice:
        """Read ``nominal``, ``board``, ``gantry``, or three LED names separated by commas. Raises ConfigError."""
        if text in ("nominal", "board", "gantry"):
            return cls(text)  # type: ignore[arg-type]
        names = tuple(part.strip() for part in text.split(","))
        if len(names) != 3 or len(set(names)) != 3:
            raise ConfigError(
                f"expected nominal, board, gantry, or three LED names separated by commas, got '{text}'", "--frame"
            )
        return cls("leds", names)

    @property
    def text(self) -> str:
        """The gauge in one line."""
        return {
            "nominal": "best fit of all LEDs onto the nominal positions (sum of displacements and turns is zero)",
            "leds": "origin at {}, +x through {}, {} in the x-y plane with positive y".format(
                *(*self.leds, "", "", "")
            ),
            "board": "the frame of the board fixed to the beacon",
            "gantry": "gantry axes, origin in the middle of the LEDs",
        }[self.kind]


def rigid_motions(points_m: FloatArray) -> FloatArray:
    """How points move with a turn (first three columns) and a shift of all, shape (3n, 6)."""
    return np.concatenate([np.hstack([-hat(np.ascontiguousarray(p)), np.eye(3)]) for p in points_m])


def fit_rigid(
    a_m: FloatArray, b_m: FloatArray, weights: FloatArray | None = None, sign: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Rotation and translation that lay points ``a`` onto ``b`` with least (weighted) squares.

    Args:
        a_m: Points, shape (n, 3), m.
        b_m: Their partners, shape (n, 3), m.
        weights: Shape (n,), or None for equal ones.
        sign: Determinant of the answer: -1 asks for a reflection.

    Returns:
        R (3, 3) and t (3,) with ``b ~ R a + t``.

    Source: W. Kabsch, A solution for the best rotation to relate two sets of vectors (1976).
    """
    w = np.ones(len(a_m)) if weights is None else weights
    a0, b0 = np.average(a_m, axis=0, weights=w), np.average(b_m, axis=0, weights=w)
    U, _, Vt = np.linalg.svd(((b_m - b0) * w[:, None]).T @ (a_m - a0))
    R = U @ np.diag([1.0, 1.0, sign * float(np.sign(np.linalg.det(U @ Vt)))]) @ Vt
    return R, b0 - R @ a0


def fit_rigid_robust(a_m: FloatArray, b_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As ``fit_rigid``, but without the one point that fits worst, where the others then agree far better."""

    def fit_without(k: int) -> tuple[float, FloatArray, FloatArray]:
        kept = np.arange(len(a_m)) != k
        R, t = fit_rigid(a_m[kept], b_m[kept])
        return float(np.sqrt(np.mean((a_m[kept] @ R.T + t - b_m[kept]) ** 2))), R, t

    whole = fit_without(-1)
    best = min((fit_without(k) for k in range(len(a_m))), key=lambda fit: fit[0])
    _, R, t = best if best[0] < 0.4 * whole[0] else whole
    return R, t


def place(
    leds_m: FloatArray, covariance_m2: FloatArray, nominal_m: FloatArray, frame: FrameChoice, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Bring positions and covariance into a frame.

    Args:
        leds_m: Positions in the frame they were adjusted in, shape (n, 3), m.
        covariance_m2: Their covariance there; along rigid motions it may mean nothing, shape (3n, 3n), m^2.
        nominal_m: Nominal positions, shape (n, 3), m.
        frame: The frame.
        names: LED names.

    Returns:
        Positions and covariance in the frame.

    Raises:
        ConfigError: The frame names an LED that does not exist, or three LEDs on a line.
    """
    n = len(leds_m)
    F = np.zeros((6, 3 * n))
    if frame.kind == "board":
        return leds_m.copy(), covariance_m2.copy()
    if frame.kind == "nominal":
        R, t = fit_rigid(leds_m, nominal_m)
        F[:3] = rigid_motions(nominal_m - nominal_m.mean(axis=0))[:, :3].T
        F[3:] = np.tile(np.eye(3), n) / n
    elif frame.kind == "gantry":
        R, t = np.eye(3), -leds_m.mean(axis=0)
        F = np.tile(np.eye(3), n) / n
    else:
        a, b, c = (_number(name, names) for name in frame.leds)
        x = leds_m[b] - leds_m[a]
        z = np.cross(x, leds_m[c] - leds_m[a])
        if not np.linalg.norm(z) > 0.02 * np.linalg.norm(x) * np.linalg.norm(leds_m[c] - leds_m[a]):
            raise ConfigError(f"LEDs {', '.join(frame.leds)} are nearly on a line and set no frame", "--frame")
        R = np.array([x, np.cross(z, x), z])
        R /= np.linalg.norm(R, axis=1)[:, None]
        t = -R @ leds_m[a]
        for row, column in enumerate((3 * a, 3 * a + 1, 3 * a + 2, 3 * b + 1, 3 * b + 2, 3 * c + 2)):
            F[row, column] = 1.0
    placed = leds_m @ R.T + t
    turn = np.kron(np.eye(n), R)
    M = rigid_motions(placed)[:, -len(F) :]
    T = np.eye(3 * n) - M @ np.linalg.solve(F @ M, F)
    C = T @ turn @ covariance_m2 @ turn.T @ T.T
    return placed, 0.5 * (C + C.T)


def _number(name: str, names: Sequence[str]) -> int:
    if name not in names:
        raise ConfigError(f"no LED is called '{name}', the beacon has {', '.join(names)}", "--frame")
    return list(names).index(name)
