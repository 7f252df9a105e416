"""The firmware is built, small enough, true to its own table of codes, and its core passes its tests."""

from __future__ import annotations

import csv
import re

import pytest

from tests.helpers.firmware_board import FIRMWARE, FirmwareBuilds
from uvgs_bench.devices.gantry.grbl_codes import find_dialect

FLASH_BYTES, RAM_BYTES = 28 * 1024, 1536
SOURCES = sorted((FIRMWARE / "uvgs_gantry" / "src").glob("*.cpp"))


def codes() -> list[dict[str, str]]:
    with (FIRMWARE / "codes.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def meanings(kind: str, *firmware: str) -> dict[int, str]:
    """Later firmware overrides: number 10 means something else in each."""
    rows = sorted(codes(), key=lambda row: firmware.index(row["firmware"]) if row["firmware"] in firmware else -1)
    return {int(row["code"]): row["meaning"] for row in rows if row["kind"] == kind and row["firmware"] in firmware}


def test_flash_and_memory_leave_room(firmware_builds: FirmwareBuilds) -> None:
    match = re.search(r"flash (\d+) of (\d+) bytes, RAM (\d+) of (\d+) bytes", firmware_builds.output("size"))
    assert match
    flash, flash_limit, ram, ram_limit = (int(number) for number in match.groups())
    assert (flash_limit, ram_limit) == (FLASH_BYTES, RAM_BYTES)
    assert flash <= FLASH_BYTES
    assert ram <= RAM_BYTES


def test_core(firmware_builds: FirmwareBuilds) -> None:
    output = firmware_builds.output("test")
    assert re.search(r"^8 passed, 0 failed$", output, re.MULTILINE), output
    assert re.search(r"1\d{7} steps, 0 lost, ran dry 0 times", output), output


@pytest.mark.parametrize(
    ("identity", "firmware"),
    [
        ({"VER": "1.1h.20190830:"}, ("grbl",)),
        ({"VER": "1.1f.20260101:", "FIRMWARE": "grblHAL"}, ("grbl", "grblHAL")),
        ({"VER": "1.1h.20261122:uvgs_gantry", "FIRMWARE": "uvgs_gantry"}, ("grbl", "uvgs_gantry")),
    ],
)
def test_the_drivers_tables_are_those_of_the_file(identity: dict[str, str], firmware: tuple[str, ...]) -> None:
    dialect = find_dialect(identity)
    assert dialect.errors == meanings("error", *firmware)
    assert dialect.alarms == meanings("alarm", *firmware)


def test_the_firmware_answers_only_with_numbers_of_the_file() -> None:
    known = {kind: set(meanings(kind, "grbl", "uvgs_gantry")) for kind in ("error", "alarm")}
    text = "\n".join(path.read_text(encoding="utf-8") for path in SOURCES)
    named = re.search(r"constexpr uint8_t OK = 0, (.*?);", text, re.DOTALL)
    assert named
    errors = {int(number) for number in re.findall(r"= (\d+)", named.group(1))}
    for name in ("settings.cpp", "gcode.cpp"):
        source = (FIRMWARE / "uvgs_gantry" / "src" / name).read_text(encoding="utf-8")
        errors |= {int(number) for number in re.findall(r"return (\d+);", source)}
    errors.discard(0)
    alarms = {int(number) for number in re.findall(r"ALARM_(?!SILENCE)\w+ = (\d+)", text)}
    assert len(errors) > 20
    assert errors <= known["error"]
    assert {1, 2, 3, 6, 10} <= alarms <= known["alarm"]


def test_the_sketch_opens_in_the_arduino_ide() -> None:
    """The folder has the sketch's name, its sources lie in src/, and nothing outside of it is included."""
    sketch = FIRMWARE / "uvgs_gantry" / "uvgs_gantry.ino"
    assert sketch.exists()
    for path in [sketch, *(FIRMWARE / "uvgs_gantry" / "src").iterdir()]:
        assert "../" not in re.sub(r"//.*", "", path.read_text(encoding="utf-8")), path
