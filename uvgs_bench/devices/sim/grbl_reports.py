"""Status reports of a mock GRBL 1.1, with real grbl's habit of telling offset and overrides only now and then."""

from __future__ import annotations

from uvgs_bench.devices.sim.grbl_gcode import Modal, Refused
from uvgs_bench.devices.sim.grbl_settings import printed
from uvgs_bench.geometry import FloatArray

_WCO_EVERY = {False: 10, True: 30}
_OV_EVERY = {False: 10, True: 20}


class Reporter:
    """Writes reports and remembers what was told when. Work offsets are always zero: the positions differ in name."""

    def __init__(self) -> None:
        self._wco_countdown = 0
        self._ov_countdown = 0

    def tell_overrides_next(self) -> None:
        """Put the overrides into the next report, as after a change of the spindle or a homing."""
        self._ov_countdown = 0

    def write(
        self,
        state: str,
        position: FloatArray,
        *,
        mask: int,
        buffers: tuple[int, int],
        feed_mm_min: float,
        modal: Modal,
        pins: str,
    ) -> str:
        """One report.

        Args:
            state: The state word, with its number.
            position: Machine position, shape (A,), mm or deg.
            mask: Setting 10: bit 0 machine position, bit 1 buffers.
            buffers: Free planner blocks and receive bytes.
            feed_mm_min: Speed along the path.
            modal: The parser's memory.
            pins: Closed switches.

        Returns:
            The line.
        """
        is_busy = state.partition(":")[0] in ("Run", "Jog", "Home", "Hold")
        # Adding 0.0 turns -0.0 into 0.0.
        fields = [state, ("MPos:" if mask & 1 else "WPos:") + ",".join(f"{value + 0.0:.3f}" for value in position)]
        if mask & 2:
            fields.append(f"Bf:{buffers[0]},{buffers[1]}")
        fields.append(f"FS:{int(feed_mm_min)},{modal.output_rpm:.0f}")
        if pins:
            fields.append(f"Pn:{pins}")
        if self._wco_countdown > 0:
            self._wco_countdown -= 1
        else:
            self._wco_countdown = _WCO_EVERY[is_busy] - 1
            self._ov_countdown = max(self._ov_countdown, 1)
            fields.append("WCO:" + ",".join("0.000" for _ in position))
        if self._ov_countdown > 0:
            self._ov_countdown -= 1
        else:
            self._ov_countdown = _OV_EVERY[is_busy] - 1
            fields.append("Ov:100,100,100")
            accessories = {"M3": "S", "M4": "C"}.get(modal.spindle, "") + ("F" if modal.coolant == "M8" else "")
            if accessories:
                fields.append(f"A:{accessories}")
        return "<" + "|".join(fields) + ">"


def answers(query: str, settings: dict[int, float], axis_count: int, version: str, options: str) -> list[str]:
    """What a dollar query prints before its ``ok``.

    Args:
        query: The text after the dollar sign: ``$``, ``I``, ``N`` or ``#``.
        settings: Numbered settings.
        axis_count: Number of axes.
        version: Firmware version.
        options: Build options, planner blocks and receive bytes.

    Returns:
        The lines.

    Raises:
        Refused: No such query.
    """
    zero = ",".join(["0.000"] * axis_count)
    stored = ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92")
    if query == "$":
        return [printed(number, settings[number]) for number in sorted(settings)]
    if query == "I":
        return [f"[VER:{version}:]", f"[OPT:{options}]"]
    if query == "N":
        return ["$N0=", "$N1="]
    if query == "#":
        return [*(f"[{name}:{zero}]" for name in stored), "[TLO:0.000]", f"[PRB:{zero}:0]"]
    raise Refused(3)
