"""The one family of errors: everything a user can meet derives from :class:`UvgsError`.

An expected absence (no pose in a picture) is a value, never an exception; broken input or hardware is one of these;
a bug is an assertion. Each class carries the exit code of the command line, so that no command decides it again.
"""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """What a ``uvgs`` command returns to the shell."""

    DONE = 0
    LIMITS_MISSED = 1
    USAGE = 2
    INCONCLUSIVE = 3
    INPUT = 4
    HARDWARE = 5
    SAFETY_STOP = 6
    INTERRUPTED = 130


class UvgsError(Exception):
    """Base of all errors a user can meet. The message is one clear line."""

    exit_code: ExitCode = ExitCode.INPUT


class ConfigError(UvgsError):
    """A document says something that cannot be meant: unknown key, wrong unit, impossible value.

    Args:
        message: What was expected, in one line.
        path: The file (or option) that says it.
        key: The dotted key inside the file, or empty.
    """

    exit_code = ExitCode.USAGE

    def __init__(self, message: str, path: str = "", key: str = "") -> None:
        where = ": ".join(part for part in (path, key) if part)
        super().__init__(f"{where}: {message}" if where else message)
        self.path = path
        self.key = key


class UnreadableDocument(ConfigError):
    """A document is not there or cannot be read, whatever it says."""

    exit_code = ExitCode.INPUT


class FrameMismatch(UvgsError):
    """Two poses were composed whose frames do not meet."""

    exit_code = ExitCode.USAGE


class CalibrationError(UvgsError):
    """A camera or beacon calibration cannot be computed or does not fit the data it is used on."""

    exit_code = ExitCode.INPUT


class TooFewViews(CalibrationError):
    """A calibration cannot be computed because the pictures do not say enough."""

    exit_code = ExitCode.INCONCLUSIVE


class RegistrationError(UvgsError):
    """The frames of a run cannot be registered: too few stations, no motion."""

    exit_code = ExitCode.INCONCLUSIVE


class PlanError(UvgsError):
    """No procedure on this bench gives what is wanted of it."""

    exit_code = ExitCode.INCONCLUSIVE


class CaptureError(UvgsError):
    """A camera source cannot be opened or read.

    Args:
        message: What went wrong, in one line.
        source: The source spec or file name.
    """

    exit_code = ExitCode.INPUT

    def __init__(self, message: str, source: str = "") -> None:
        super().__init__(f"{source}: {message}" if source else message)
        self.source = source


class CameraLost(CaptureError):
    """A live camera delivered and stopped: unplugged, out of reach, or its driver died."""

    exit_code = ExitCode.HARDWARE


class GantryError(UvgsError):
    """The gantry or the line to it failed.

    Args:
        message: What went wrong, in one line.
        port: The port as the user named it.
    """

    exit_code = ExitCode.HARDWARE

    def __init__(self, message: str, port: str = "") -> None:
        super().__init__(f"{port}: {message}" if port else message)
        self.port = port


class GantryAlarm(GantryError):
    """The controller raised an alarm; its position may be wrong.

    Args:
        message: What the code means.
        port: The port as the user named it.
        code: The controller's alarm number.
    """

    exit_code = ExitCode.SAFETY_STOP

    def __init__(self, message: str, port: str = "", code: int = 0) -> None:
        super().__init__(message, port)
        self.code = code


class GantryRefused(GantryError):
    """The controller refused a line.

    Args:
        message: What the code means.
        port: The port as the user named it.
        code: The controller's error number.
        line: The refused line.
    """

    def __init__(self, message: str, port: str = "", code: int = 0, line: str = "") -> None:
        super().__init__(message, port)
        self.code = code
        self.line = line


class GantryTimeout(GantryError):
    """The controller did not answer in time."""


class GantryLost(GantryError):
    """The port vanished or the controller reset itself: the position is lost."""

    exit_code = ExitCode.SAFETY_STOP


class EnvelopeError(GantryError):
    """A move would leave the envelope; nothing was sent.

    Args:
        message: Which axis, which value, which bounds.
        axis: Name of the offending axis.
    """

    exit_code = ExitCode.USAGE

    def __init__(self, message: str, axis: str = "") -> None:
        super().__init__(message)
        self.axis = axis


class RunError(UvgsError):
    """A run folder is missing, incomplete or does not match what it is used with.

    Args:
        message: What was expected, in one line.
        path: The run folder or the file in it.
    """

    exit_code = ExitCode.INPUT

    def __init__(self, message: str, path: str = "") -> None:
        super().__init__(f"{path}: {message}" if path else message)
        self.path = path


class FormatError(UvgsError):
    """A file of somebody else's format is broken.

    Args:
        message: What was expected, in one line.
        path: The file.
        offset: Byte or line where it broke, or -1.
    """

    exit_code = ExitCode.INPUT

    def __init__(self, message: str, path: str = "", offset: int = -1) -> None:
        at = f"{path}:{offset}" if offset >= 0 else path
        super().__init__(f"{at}: {message}" if at else message)
        self.path = path
        self.offset = offset
