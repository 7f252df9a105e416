"""A fitted lens with its doubt."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray, read_only


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a calibration may be used for, and why.

    Args:
        word: ``usable``, ``usable_within_radius``, ``not_usable`` or ``inconclusive``.
        radius_px: Distance from the principal point up to which it may be used, px; 0 when nowhere.
        reasons: Sentences for people, the decisive ones first.
        next_pictures: What to photograph next, most useful first.
    """

    word: str
    radius_px: float
    reasons: tuple[str, ...]
    next_pictures: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.word not in VERDICTS:
            raise CalibrationError(f"unknown verdict '{self.word}', expected one of {', '.join(VERDICTS)}")

    @property
    def is_usable(self) -> bool:
        """Whether poses may be computed with it, at least within the radius."""
        return self.word in ("usable", "usable_within_radius")


VERDICTS = ("usable", "usable_within_radius", "not_usable", "inconclusive")


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A fitted lens with its doubt.

    Args:
        lens: The projection model with its numbers.
        camera_name: Name of the camera, for people.
        covariance: Covariance of ``lens.parameters``, shape (P, P), in their units; None when unknown.
        rms_px: Root mean square of the residual lengths, sqrt(mean(dx^2 + dy^2)), px; None when unknown.
        held_out_rms_px: The same over views the lens was not fitted to, px; None when unknown.
        view_count: Number of board views used.
        corner_count: Number of corners used.
        rejected_count: Number of corners set aside as outliers.
        notes: Where it comes from: board, source, hashes, versions, ``created_utc``.
        joint_covariance: Covariance of ``lens.parameters`` and of the mean twist of all board poses (rotation rad,
            translation m, camera axes), shape (P + 6, P + 6); None when unknown. It carries the projection
            uncertainty: boards move along when the lens changes.
        verdict: What it may be used for; None when nobody judged it.
        halves_ratio: How many times more two halves of the pictures disagree than their covariances predict; None when
            nobody compared them.

    Raises:
        CalibrationError: The ratio is negative or not finite; or the covariance has another shape, is not finite, not
            symmetric, or has a negative variance.
    """

    lens: Lens
    camera_name: str = ""
    covariance: FloatArray | None = None
    rms_px: float | None = None
    held_out_rms_px: float | None = None
    view_count: int = 0
    corner_count: int = 0
    rejected_count: int = 0
    notes: dict[str, str] = field(default_factory=dict)
    joint_covariance: FloatArray | None = None
    verdict: Verdict | None = None
    halves_ratio: float | None = None

    def __post_init__(self) -> None:
        if self.halves_ratio is not None and not 0.0 <= self.halves_ratio < inf:
            raise CalibrationError(f"the ratio of the halves is {self.halves_ratio}, expected a number from 0 on")
        size = self.lens.parameters.size
        if self.joint_covariance is not None:
            joint = read_only(self.joint_covariance)
            if joint.shape != (size + 6, size + 6) or not np.isfinite(joint).all():
                raise CalibrationError(
                    f"the joint covariance of a {self.lens.model} lens is finite and has shape ({size + 6}, "
                    f"{size + 6}), got {joint.shape}"
                )
            object.__setattr__(self, "joint_covariance", joint)
        if self.covariance is None:
            return
        covariance = read_only(self.covariance)
        if covariance.shape != (size, size):
            raise CalibrationError(
                f"the covariance of a {self.lens.model} lens has shape ({size}, {size}), got {covariance.shape}"
            )
        deviation = np.sqrt(np.abs(np.diag(covariance)))
        if (
            not np.isfinite(covariance).all()
            or (np.diag(covariance) < 0.0).any()
            or (np.abs(covariance - covariance.T) > 1e-9 * np.outer(deviation, deviation) + 1e-300).any()
        ):
            raise CalibrationError("the covariance must be finite and symmetric, with variances that are not negative")
        object.__setattr__(self, "covariance", covariance)

    @property
    def sigmas(self) -> FloatArray | None:
        """Standard deviation of each parameter, shape (P,), or None when unknown."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))

    @property
    def doubt_factor(self) -> float:
        """How many times the deviations are too small by the evidence of two halves, at least 1; 1 when unknown."""
        return 1.0 if self.halves_ratio is None else max(1.0, self.halves_ratio)

    @property
    def rms_per_axis_px(self) -> float | None:
        """Root mean square of the residual components, sqrt(mean of dx^2 and dy^2 together), px."""
        return None if self.rms_px is None else self.rms_px / float(np.sqrt(2.0))

    def check_size(self, width_px: int, height_px: int, source: str = "picture") -> None:
        """Refuse pictures of another size than the lens was fitted to.

        Args:
            width_px: Picture width, px.
            height_px: Picture height, px.
            source: What the picture is, for the message.

        Raises:
            CalibrationError: The sizes differ.
        """
        lens = self.lens
        if (width_px, height_px) != (lens.width_px, lens.height_px):
            name = f"calibration '{self.camera_name}'" if self.camera_name else "the calibration"
            raise CalibrationError(
                f"{source} is {width_px}x{height_px} px but {name} is for {lens.width_px}x{lens.height_px} px"
            )
