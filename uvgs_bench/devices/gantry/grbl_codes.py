"""What the numbers of GRBL's ``error:N`` and ``ALARM:N`` mean, by dialect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

_ERRORS = {
    1: "a word must begin with a letter",
    2: "a number is missing or malformed",
    3: "unknown $ line",
    4: "a value must not be negative",
    5: "homing is switched off ($22=0)",
    6: "the step pulse must be at least 3 us",
    7: "reading the EEPROM failed; defaults were restored",
    8: "only possible when the controller is idle",
    9: "G-code is locked out by an alarm or a jog",
    10: "soft limits need homing ($22=1)",
    11: "the line is too long",
    12: "the step rate would be too high",
    13: "the safety door is open",
    14: "the startup line is too long to be stored",
    15: "the jog target is beyond the travel",
    16: "a jog line is missing '=' or has forbidden words",
    17: "laser mode needs PWM",
    20: "unsupported G-code",
    21: "two words of one modal group",
    22: "no feed is set",
    23: "an integer is needed",
    24: "two words use the axes",
    25: "a word is repeated",
    26: "no axis word",
    27: "the line number is out of range",
    28: "a value is missing",
    29: "G59.1 to G59.3 are not supported",
    30: "G53 needs G0 or G1",
    31: "axis words that nothing uses",
    32: "an arc needs axis words in its plane",
    33: "the motion target is invalid",
    34: "the arc radius is invalid",
    35: "an arc needs offset words in its plane",
    36: "value words that nothing uses",
    37: "G43.1 on an axis that is not the tool axis",
    38: "the tool number is too large",
}
_GRBLHAL_ERRORS = {
    39: "a value is out of range",
    40: "a tool change is pending",
    43: "the feed is above the maximum",
    45: "a limit switch is engaged",
    46: "homing is required",
    50: "the emergency stop is pressed",
    51: "a motor reports a fault",
    52: "the setting's value is out of range",
    79: "not allowed in a critical event",
}
_ALARMS = {
    1: "a hard limit switch was hit; the position is lost",
    2: "the target is beyond the soft limits",
    3: "reset while moving; the position is lost",
    4: "the probe was not in its start state",
    5: "the probe did not touch",
    6: "homing was aborted by a reset",
    7: "homing was aborted by the safety door",
    8: "homing: the pull-off did not clear the switch",
    9: "homing: no limit switch was found",
    10: "homing: the second motor's switch was not found",
}
_GRBLHAL_ALARMS = {
    10: "the emergency stop is pressed",
    11: "homing is required",
    12: "a limit switch is engaged",
    13: "probe protection was triggered",
    14: "the spindle did not reach its speed",
    16: "the self-test failed",
    17: "a motor reports a fault",
    18: "homing failed",
}


_FLUIDNC_ALARMS = {
    10: "the spindle did not answer",
    11: "a control pin was active at the start",
    12: "homing: a limit switch is closed and it is not known which",
    13: "hard stop",
    14: "homing is required",
    15: "the controller has just started; homing is required",
}
_UVGS_ERRORS = {
    46: "homing is required",
    50: "the emergency stop is pressed",
    52: "the setting's value is out of range",
    60: "the checksum of the line is wrong",
    61: "the line number is not the next",
    62: "the measured move or trigger was broken off",
}
_UVGS_ALARMS = {10: "the emergency stop was pressed; the position is lost"}

BAD_CHECKSUM = 60
"""The error number that says a line was damaged and not run."""


MALFORMED = frozenset({1, 2, 3, 11, 16, 20, 21, 22, 23, 24, 25, 26, 28, 30, 31, 36})
"""Error numbers that complain of how a line reads, which no line of the driver deserves."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """A firmware that speaks GRBL's protocol, as far as it differs.

    Args:
        name: ``grbl``, ``grblHAL``, ``FluidNC`` or ``uvgs_gantry``.
        errors: Meaning of error numbers.
        alarms: Meaning of alarm numbers.
        has_jog: Whether ``$J=`` exists.
        lists_settings: Whether ``$$`` tells steps, speeds and homing; FluidNC keeps them in a file of its own.
        has_checksums: Whether a line may have a number and a checksum, and a repeated line is not run twice.
    """

    name: str
    errors: dict[int, str]
    alarms: dict[int, str]
    has_jog: bool = True
    lists_settings: bool = True
    has_checksums: bool = False

    def meaning(self, kind: Literal["error", "alarm"], code: int) -> str:
        """What a number means, in words."""
        table = self.errors if kind == "error" else self.alarms
        return table.get(code, f"a number that {self.name} does not document")


def find_dialect(identity: dict[str, str]) -> Dialect:
    """Tell the dialect from the answer to ``$I``.

    Args:
        identity: The bracketed answers by name, for example ``{"VER": "1.1h.20190830:", "OPT": "V,15,128"}``.

    Returns:
        The dialect; plain grbl when nothing says otherwise. Jogs exist from grbl 1.1 on.
    """
    firmware, version = identity.get("FIRMWARE", "").lower(), identity.get("VER", "")
    if firmware == "grblhal":
        return Dialect("grblHAL", _ERRORS | _GRBLHAL_ERRORS, _ALARMS | _GRBLHAL_ALARMS)
    if firmware == "uvgs_gantry":
        return Dialect("uvgs_gantry", _ERRORS | _UVGS_ERRORS, _ALARMS | _UVGS_ALARMS, has_checksums=True)
    if "fluidnc" in version.lower():
        return Dialect("FluidNC", _ERRORS, _ALARMS | _FLUIDNC_ALARMS, lists_settings=False)
    return Dialect("grbl", _ERRORS, _ALARMS, has_jog=not version.startswith(("0.", "1.0")))
