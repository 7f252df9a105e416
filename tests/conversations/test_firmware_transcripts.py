"""Our firmware, natively and as AVR machine code in simavr, says what a real GRBL 1.1h says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conversations.replay import Exchange, read_scenes, replay
from tests.helpers.firmware_board import KINDS, FirmwareBuilds, LockstepBoard

HERE = Path(__file__).parent
RECORDED = HERE.parents[2] / "shared" / "data" / "grbl" / "grbl_1.1h.txt"
IDENTITY = ["[VER:1.1h.20261122:uvgs_gantry]", "[OPT:V,15,128]", "[FIRMWARE:uvgs_gantry]", "[BOOT:1,power]", "ok"]


def grbl_like_board(builds: FirmwareBuilds, kind: str) -> LockstepBoard:
    """A board as flashed, and told to let unhomed axes move as GRBL does: the one thing in which it is stricter."""
    board = builds.board(kind)
    assert "Grbl 1.1h ['$' for help]" in board.greeting
    assert board.say("$201=0") == ["ok"]
    board.begin_conversation()
    return board


def exchanges_of(path: Path) -> list[Exchange]:
    exchanges = [exchange for scene in read_scenes(path).values() for exchange in scene]
    for exchange in exchanges:
        if exchange.data == b"$I\n":
            # It says honestly who it is.
            exchange.expected = IDENTITY
    return exchanges


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["lines", "motion", "homing"])
def test_written_conversation(firmware_builds: FirmwareBuilds, kind: str, name: str) -> None:
    with grbl_like_board(firmware_builds, kind) as board:
        assert not replay(exchanges_of(HERE / f"{name}.txt"), board)


@pytest.mark.shared_data
@pytest.mark.parametrize("kind", KINDS)
def test_recorded_conversation_with_real_grbl(firmware_builds: FirmwareBuilds, kind: str) -> None:
    if not RECORDED.exists():
        pytest.skip(f"no recording at {RECORDED}")
    exchanges = exchanges_of(RECORDED)
    assert len(exchanges) == 111
    with grbl_like_board(firmware_builds, kind) as board:
        assert not replay(exchanges, board)


def test_a_wrong_answer_is_noticed(firmware_builds: FirmwareBuilds) -> None:
    exchanges = exchanges_of(HERE / "lines.txt")
    exchanges[8].expected = ["error:1"]
    with grbl_like_board(firmware_builds, "native") as board:
        assert len(replay(exchanges, board)) == 1
