"""What the page of ``uvgs run --view`` may change of the running sensor and its camera."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from uvgs_bench.errors import UvgsError

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.source import ExposureControl
    from uvgs_bench.sensor.capture import Capture
    from uvgs_bench.sessions.events import EventSink
    from uvgs_bench.sessions.retune import Retuner
    from uvgs_bench.view.controls import Slider

# Name, least, greatest, step: of the parameters that are set by looking at the picture.
_SLIDERS: tuple[tuple[str, float, float, float], ...] = (
    ("threshold_floor", 0.0, 0.6, 0.005),
    ("threshold_k", 0.0, 10.0, 0.1),
    ("min_contrast", 0.0, 0.5, 0.005),
    ("min_area_px2", 0.5, 60.0, 0.5),
    ("min_circularity", 0.0, 1.0, 0.01),
)
CHANGED = "parameters_changed"
"""Flag of the first capture that was solved with other parameters than the one before."""


class RunControls:
    """Takes what is asked from the page's threads and makes it between two captures.

    Args:
        retuner: The sensor's parameters.
        exposure: The camera's exposure, or None when it cannot be set.
        file: Where the parameters are saved.
        sink: Where changes are told.
        fixed: Why the parameters may not be changed; empty when they may.
        exposure_fixed: Why the exposure may not be changed; empty when it may.
    """

    def __init__(
        self,
        retuner: Retuner,
        exposure: ExposureControl | None,
        file: Path,
        sink: EventSink,
        *,
        fixed: str = "",
        exposure_fixed: str = "",
    ) -> None:
        self._retuner = retuner
        self._exposure = exposure
        self._file = file
        self._sink = sink
        self._fixed = fixed
        self._exposure_fixed = exposure_fixed
        self._lock = threading.Lock()
        self._wanted_s: float | None = None
        self._exposure_s = None if exposure is None else exposure.exposure_s
        self._is_changed = False

    def sliders(self) -> tuple[Slider, ...]:
        """The parameters that can be changed now."""
        from uvgs_bench.view.controls import Slider

        if self._fixed:
            return ()
        now = self._retuner.parameters
        return tuple(Slider(name, float(getattr(now, name)), low, high, step) for name, low, high, step in _SLIDERS)

    def exposure(self) -> Slider | None:
        """The exposure, s; None when it cannot be set."""
        from uvgs_bench.view.controls import Slider

        if self._exposure is None or self._exposure_s is None or self._exposure_fixed:
            return None
        shortest_s, longest_s = self._exposure.exposure_limits_s
        return Slider("exposure_s", self._exposure_s, shortest_s, longest_s, 0.0)

    def tune(self, changes: Mapping[str, object]) -> str | None:
        """Change parameters from the next capture on; only those that have a slider."""
        if self._fixed:
            return self._fixed
        unknown = set(changes) - {name for name, *_ in _SLIDERS}
        if unknown:
            return f"{sorted(unknown)[0]} has no slider"
        return self._retuner.ask(changes)

    def expose(self, exposure_s: float) -> str | None:
        """Change the exposure, s, after the next capture."""
        if self._exposure_fixed:
            return self._exposure_fixed
        slider = self.exposure()
        if slider is None:
            return "the exposure of this source cannot be set"
        if not slider.least <= exposure_s <= slider.greatest:
            return f"exposure_s must be between {slider.least:g} and {slider.greatest:g}"
        with self._lock:
            self._wanted_s = exposure_s
        return None

    def save(self) -> Path:
        """Write the parameters to the sensor file. Raises UvgsError."""
        from uvgs_bench.store.sensor_file import update_sensor_file

        with self._lock:
            update_sensor_file(self._file, self._retuner.parameters)
        return self._file

    def apply(self) -> None:
        """Make what was asked for; to be called between captures, by who reads them."""
        from uvgs_bench.sessions.events import Remark

        if self._retuner.apply():
            self._is_changed = True
            now = self._retuner.parameters
            values = ", ".join(f"{name} {getattr(now, name):g}" for name, *_ in _SLIDERS)
            self._sink(Remark("info", f"parameters changed: {values}"))
        with self._lock:
            wanted_s, self._wanted_s = self._wanted_s, None
        if wanted_s is not None and self._exposure is not None:
            try:
                self._exposure_s = self._exposure.set_exposure_s(wanted_s)
            except UvgsError as error:
                self._sink(Remark("warning", str(error)))

    def flags_of(self, _capture: Capture) -> tuple[str, ...]:
        """What a pose file says of the first capture after a change."""
        is_changed, self._is_changed = self._is_changed, False
        return (CHANGED,) if is_changed else ()
