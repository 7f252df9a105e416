"""Who answers at a port: firmware, settings and stored offsets, read until the line proves to be whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.devices.gantry.gantry import ControllerInfo
from uvgs_bench.devices.gantry.grbl_codes import find_dialect
from uvgs_bench.devices.gantry.grbl_link import GrblLink
from uvgs_bench.devices.gantry.grbl_settings import ControllerSettings, read_settings, settings_warnings
from uvgs_bench.errors import GantryError, GantryRefused

_REPLY_S = 5.0
_READINGS = 5
# The last touch of a probe is no setting.
_PASSING = ("PRB", "TLO")
_UNTOLD = "the controller tells neither speeds nor accelerations nor travel: check them against the bench file yourself"
_HEARTBEAT = "202"
_NO_HEARTBEAT = (
    "no heartbeat ($202=0): when this computer dies, a move under way runs to its end; `uvgs gantry settings 202=2000` "
    "lets the controller stop after 2 s"
)


def identify(link: GrblLink, axes: Sequence[Axis]) -> tuple[ControllerInfo, ControllerSettings]:
    """Ask a controller who it is and how it is set, and set the dialect of the conversation.

    Args:
        link: The conversation, just begun.
        axes: The axes of the bench in the controller's order.

    Returns:
        Who answers, and what the driver needs of its settings.

    Raises:
        GantryError: The line is bad, or a setting makes the controller unusable.
    """
    identity = _heard_twice(link, lambda: _messages(link, "$I"))
    settings = _heard_twice(link, lambda: _settings(link))
    parameters = _heard_twice(link, lambda: _parameters(link))
    dialect = link.dialect = find_dialect(identity)
    checked = read_settings(settings, axes, link.port, dialect)
    warnings = settings_warnings(settings, axes)
    if not dialect.lists_settings:
        warnings = (*warnings, _UNTOLD)
    if dialect.has_checksums:
        settings |= _heard_twice(link, lambda: _own_settings(link))
        link.steps = checked.steps
        if settings.get(_HEARTBEAT) == "0":
            warnings = (*warnings, _NO_HEARTBEAT)
    for warning in warnings:
        link.wire.remark(warning)
    version = identity.get("VER", "").rstrip(":")
    return ControllerInfo(dialect.name, version, identity.get("OPT", ""), settings, parameters, warnings), checked


def _messages(link: GrblLink, line: str) -> dict[str, str]:
    return {a.name: a.text for a in link.command(line, _REPLY_S) if isinstance(a, protocol.Message)}


def _settings(link: GrblLink) -> dict[str, str]:
    return {a.number: a.value for a in link.command("$$", _REPLY_S) if isinstance(a, protocol.Setting)}


def _own_settings(link: GrblLink) -> dict[str, str]:
    try:
        return {a.number: a.value for a in link.command("$S", _REPLY_S) if isinstance(a, protocol.Setting)}
    except GantryRefused:
        return {}


def _parameters(link: GrblLink) -> dict[str, str]:
    try:
        return {name: text for name, text in _messages(link, "$#").items() if name not in _PASSING}
    except GantryRefused:
        # Not every controller answers it while it is locked.
        return {}


def _heard_twice(link: GrblLink, ask: Callable[[], dict[str, str]]) -> dict[str, str]:
    """An answer, once heard twice alike in a row: nothing else proves a digit whole."""
    before: dict[str, str] | None = None
    for _ in range(_READINGS):
        answer = ask()
        if answer == before:
            return answer
        before = answer
    raise GantryError("the controller's settings read differently each time: the line is bad", link.port)
