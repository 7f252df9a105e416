"""The spec string of a camera, ``scheme:target?option=value&...``, taken apart and checked."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from math import isfinite
from urllib.parse import parse_qsl

from uvgs_bench.errors import ConfigError


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """A spec taken apart.

    Args:
        text: The spec as the user wrote it.
        scheme: What kind of source.
        target: Folder, file, device number or name; the whole text when it is an address like ``rtsp://host/stream``.
        options: What stands behind the question mark.
    """

    text: str
    scheme: str
    target: str
    options: dict[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str) -> CameraSpec:
        """Take a spec apart.

        Args:
            text: The spec.

        Returns:
            Its parts; the scheme is not yet looked up.

        Raises:
            ConfigError: There is no scheme, or the options are not ``name=value``.
        """
        scheme, colon, rest = text.partition(":")
        if not colon:
            raise ConfigError(
                "expected a camera like 'images:FOLDER', 'video:FILE', 'bag:FILE', 'uvc:0', 'rtsp://HOST/STREAM' "
                "or 'sim:'",
                text,
            )
        if rest.startswith("//"):
            # An address: what stands behind its question mark is the server's business.
            return cls(text, scheme, text)
        target, _, query = rest.partition("?")
        try:
            # A plus sign in a file pattern is a plus sign, not a space.
            options = dict(parse_qsl(query.replace("+", "%2B"), keep_blank_values=True, strict_parsing=bool(query)))
        except ValueError:
            raise ConfigError(f"expected options as name=value&name=value, got '{query}'", text) from None
        return cls(text, scheme, target, options)

    def check_options(self, known: tuple[str, ...]) -> None:
        """Refuse options a source does not know.

        Args:
            known: Names of the options it knows.

        Raises:
            ConfigError: An option is unknown; the message names the nearest known one.
        """
        for name in self.options:
            if name not in known:
                raise ConfigError(f"unknown option '{name}'{did_you_mean(name, known)}", self.text)

    def numbers(self, *, words: tuple[str, ...] = ()) -> dict[str, float]:
        """The options that are numbers.

        Args:
            words: Names of the options that are none.

        Returns:
            Value by name; above zero, only a gain may be zero.

        Raises:
            ConfigError: One is no number, or no such number is possible.
        """
        found: dict[str, float] = {}
        for name, text in self.options.items():
            if name in words:
                continue
            try:
                value = float(text)
            except ValueError:
                raise ConfigError(f"expected {name} as a number, got '{text}'", self.text) from None
            is_possible = isfinite(value) and (value > 0.0 or (value == 0.0 and name.startswith("gain")))
            if not is_possible or (name in ("width", "height") and not value.is_integer()):
                what = "a whole number of px" if name in ("width", "height") else "a number above 0"
                raise ConfigError(f"expected {name} as {what}, got '{text}'", self.text)
            found[name] = value
        return found


def did_you_mean(name: str, known: tuple[str, ...]) -> str:
    """The end of a complaint about an unknown name: the nearest known one, or all of them."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if near:
        return f", did you mean '{near[0]}'?"
    return f", expected one of: {', '.join(known)}" if known else ", none is expected here"
