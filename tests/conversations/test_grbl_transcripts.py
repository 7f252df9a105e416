"""The mock controller says what a real GRBL 1.1h says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conversations.replay import is_same, read_scenes, replay
from uvgs_bench.devices.gantry.grbl_protocol import Unknown, read_received
from uvgs_bench.devices.sim.grbl_device import GrblDevice

HERE = Path(__file__).parent
RECORDED = HERE.parents[2] / "shared" / "data" / "grbl" / "grbl_1.1h.txt"


def fresh_device() -> GrblDevice:
    device = GrblDevice(boot_s=0.01)
    assert b"Grbl 1.1h" in device.take_output(50_000_000)
    return device


@pytest.mark.parametrize("name", ["lines", "motion", "homing"])
def test_written_conversation(name: str) -> None:
    scenes = read_scenes(HERE / f"{name}.txt")
    assert len(scenes) >= 4
    assert not replay([exchange for scene in scenes.values() for exchange in scene], fresh_device())


@pytest.mark.shared_data
def test_recorded_conversation_with_real_grbl() -> None:
    if not RECORDED.exists():
        pytest.skip(f"no recording at {RECORDED}")
    scenes = read_scenes(RECORDED)
    exchanges = [exchange for scene in scenes.values() for exchange in scene]
    assert len(exchanges) == 111
    assert not replay(exchanges, fresh_device())


@pytest.mark.shared_data
@pytest.mark.parametrize("name", ["grbl_1.1h.txt", "grblhal_1.1f_simulator.txt"])
def test_every_line_a_real_controller_sent_has_a_meaning(name: str) -> None:
    path = RECORDED.parent / name
    if not path.exists():
        pytest.skip(f"no recording at {path}")
    lines = [line for scene in read_scenes(path).values() for exchange in scene for line in exchange.expected if line]
    assert len(lines) > 150
    unknown = [line for line in lines if isinstance(read_received(line), Unknown)]
    assert not unknown


def test_a_wrong_answer_is_noticed() -> None:
    exchanges = [exchange for scene in read_scenes(HERE / "lines.txt").values() for exchange in scene]
    exchanges[8].expected = ["error:1"]
    exchanges[-1].expected = ["<Idle|MPos:0.000,0.000,0.100|Bf:15,128|FS:0,0>"]
    assert len(replay(exchanges, fresh_device())) == 2


def test_tolerance_is_for_moving_instants_only() -> None:
    assert is_same("<Run|MPos:1.000,0.000,0.000|FS:200,0>", "<Run|MPos:1.060,0.000,0.000|FS:210,0>")
    assert not is_same("<Run|MPos:1.000,0.000,0.000|FS:200,0>", "<Run|MPos:1.200,0.000,0.000|FS:210,0>")
    assert not is_same("<Idle|MPos:1.000,0.000,0.000|FS:0,0>", "<Idle|MPos:1.004,0.000,0.000|FS:0,0>")
    assert not is_same("<Hold:0|MPos:1.003,0.000,0.000|FS:0,0>", "<Hold:1|MPos:1.003,0.000,0.000|FS:0,0>")
    assert not is_same("ok", "error:1")
