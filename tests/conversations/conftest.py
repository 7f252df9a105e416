"""What conversations share: the firmware, built once for all workers of a test run."""

from __future__ import annotations

import hashlib

import pytest

from tests.helpers.firmware_board import FIRMWARE, FirmwareBuilds


@pytest.fixture(scope="session")
def firmware_builds(tmp_path_factory: pytest.TempPathFactory) -> FirmwareBuilds:
    """The firmware's programs, kept by the content of their sources."""
    sources = sorted(p for p in FIRMWARE.rglob("*") if p.is_file() and "build" not in p.relative_to(FIRMWARE).parts)
    digest = hashlib.sha256(b"".join(str(p.relative_to(FIRMWARE)).encode() + p.read_bytes() for p in sources))
    # Next to the directories of the workers, so that all of them find it.
    directory = tmp_path_factory.getbasetemp().parent / f"uvgs_firmware_{digest.hexdigest()[:16]}"
    directory.mkdir(exist_ok=True)
    return FirmwareBuilds(directory)
