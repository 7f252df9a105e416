"""The proposal as a sensor file with its reasons, and pictures of what it changes."""

from __future__ import annotations

from pathlib import Path

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.sensor.outcome import Miss, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.debug_images import draw_debug_image
from uvgs_bench.sessions.tune import TuneResult, summary_line
from uvgs_bench.store.documents import write_atomically
from uvgs_bench.store.toml_text import toml_text

_PICTURES = 6


def sensor_text(result: TuneResult, source: str) -> str:
    """The proposal as a sensor file: only what differs from the built-in values, each with its reason.

    Args:
        result: The proposal.
        source: Where the captures came from, for people.

    Returns:
        TOML that ``read_document(path, UvgsConfig)`` reads back to the proposal.
    """
    from dataclasses import fields

    from uvgs_bench.sensor.config import UvgsConfig

    why = {change.key: change for change in result.changes}
    lines = [f"# Proposed by uvgs tune for {_one_line(source)}: {summary_line(result)}.", "schema = 1"]
    default = UvgsConfig()
    for item in fields(UvgsConfig):
        value = getattr(result.proposed, item.name)
        if value == getattr(default, item.name):
            continue
        if item.name in why:
            change = why[item.name]
            loss = f"; without it {change.worth} poses fewer" if change.worth > 0 else ""
            lines += ["", f"# {change.why}{loss}"]
        lines.append(toml_text({item.name: value}).strip())
    return "\n".join(lines) + "\n"


def write_sensor_file(path: Path, result: TuneResult, source: str, *, force: bool = False) -> None:
    """Write the proposal.

    Raises:
        ConfigError: The file exists and may not be replaced.
        UvgsError: It cannot be written.
    """
    write_atomically(path, sensor_text(result, source), force=force)


def write_pictures(
    folder: Path, result: TuneResult, calibration: Calibration, beacon: Beacon, *, force: bool = False
) -> list[Path]:
    """Draw a few captures with the given and with the proposed parameters, gained captures first.

    Args:
        folder: Where to; made when missing.
        result: The proposal with its captures.
        calibration: The camera.
        beacon: The beacon.
        force: Whether existing files may be replaced.

    Returns:
        The files written.

    Raises:
        ConfigError: A file exists and may not be replaced.
        UvgsError: A file cannot be written.
    """
    import cv2

    rows = list(zip(result.captures, result.outcomes_before, result.outcomes_proposed, strict=True))
    rows.sort(key=lambda row: 2 * isinstance(row[2], Miss) + isinstance(row[1], PoseEstimate))
    written = []
    for capture, before, proposed in rows[:_PICTURES]:
        for word, outcome, config in (("before", before, result.before), ("proposed", proposed, result.proposed)):
            if word == "proposed" and result.proposed == result.before:
                continue
            picture = draw_debug_image(capture, outcome, Uvgs(calibration, beacon, config))
            done, payload = cv2.imencode(".png", picture)
            assert done, "a BGR picture of 8 bit can always be encoded"
            path = folder / f"{capture.index:06d}_{word}.png"
            write_atomically(path, payload.tobytes(), force=force)
            written.append(path)
    return written


def _one_line(text: str) -> str:
    return " ".join(text.split())
