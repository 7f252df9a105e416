"""A whole sweep with ``uvgs gantry-sweep``, the real driver, and our firmware's machine code in simavr."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.firmware_board import FirmwareBuilds
from tests.helpers.pin_bench import PinCamera, PinScene, TerminalBoard
from uvgs_bench.cli.app import main
from uvgs_bench.devices.cameras import registry
from uvgs_bench.devices.sim.bench import SimulatedBench
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.geometry import Pose
from uvgs_bench.store import read_run
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.units import mm_from_m

ROOT = Path(__file__).resolve().parents[2]
STEPS_PER_MM = 80
SWITCHES = (240, 320, 400)  # steps from where the carriage stands at power-up: 3, 4 and 5 mm
TRAVEL_MM = 30.0
SETTINGS = [
    "$22=1", "$20=1", "$1=255", "$10=3", "$26=5", "$24=300", "$25=1800", "$27=0.5", "$202=3000",
    *(f"${base + i}={value}" for base, value in ((100, STEPS_PER_MM), (110, 3000), (120, 500), (130, 30))
      for i in range(3)),
]  # fmt: skip
PROCEDURE = """
schema = 1
name = "corner"
pattern = "grid"
feed_mm_min = 2400.0
settle_s = 0.05
captures_per_station = 1
register = "every_third"
seed = 1
[grid]
lower = { X_mm = -6.0, Y_mm = -6.0, Z_mm = -4.0 }
upper = { X_mm = -2.0, Y_mm = -2.0, Z_mm = -2.0 }
counts = { X = 2, Y = 2, Z = 2 }
"""


def small_bench(folder: Path) -> Path:
    """The example bench with axes of 30 mm, its camera moved so that their middle is where the middle was."""
    text = (ROOT / "calib" / "bench.toml").read_text(encoding="utf-8")
    bench = read_bench(ROOT / "calib" / "bench.toml")
    assert bench.simulated is not None
    middle = np.array([0.5 * (axis.lower + axis.upper) for axis in bench.envelope.axes])
    now = np.full(3, -0.5e-3 * TRAVEL_MM)
    true: Pose = bench.simulated.camera_from_gantry.pose("camera", "gantry")
    x, y, z = mm_from_m(true.apply((middle - now)[None])[0])
    text = re.sub(r"min_mm = -\d+\.0", f"min_mm = -{TRAVEL_MM}", text)
    text = re.sub(
        r"(\[simulated\.camera_from_gantry\][^\n]*\nposition_mm = )\[.*?\]", rf"\1[{x:.4f}, {y:.4f}, {z:.4f}]", text
    )
    # What the controller is set to below.
    text = text.replace("acceleration_mm_s2 = 200.0", "acceleration_mm_s2 = 500.0")
    for kind in ("cameras", "beacons"):
        text = text.replace(f'"{kind}/', f'"{ROOT / "calib" / kind}/')
    path = folder / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_sweep_with_the_machine_code_reports_the_counted_steps(
    firmware_builds: FirmwareBuilds, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench_file = small_bench(tmp_path)
    procedure = tmp_path / "corner.toml"
    procedure.write_text(PROCEDURE, encoding="utf-8")
    setup = read_bench(bench_file)
    switches = ",".join(str(steps) for steps in SWITCHES)
    with TerminalBoard([*firmware_builds.command("avr"), "--switches", switches]) as board:
        board.set_up(SETTINGS)
        true = SimulatedBench(
            setup.simulated or SimulatedTruth(), read_beacon(setup.beacon_file), setup.envelope.axes, setup.mount
        )
        # Machine zero is where the switches close.
        PinCamera.scene = scene = PinScene(true, board, SWITCHES, STEPS_PER_MM)
        monkeypatch.setitem(registry.CAMERAS, "pins", "tests.helpers.pin_bench:PinCamera")
        try:
            with pytest.raises(SystemExit) as left:
                main([
                    "gantry-sweep", str(procedure), "--bench", str(bench_file), "--port", f"grbl:{board.port}",
                    "--camera-source", "pins:board", "--out", str(tmp_path), "--quiet", "--json",
                ])  # fmt: skip
        finally:
            true.close()
        counted_at_the_end = board.table().motor_steps
    # Eight places say too little to pass or fail, and that is said.
    assert left.value.code in (0, 3)
    run = read_run(next(path for path in tmp_path.iterdir() if path.name.endswith("_corner")))
    assert run.ended == "completed"
    assert "uvgs_gantry" in run.manifest.gantry_info.values()
    assert len(run.samples) == 8
    for sample in run.samples:
        steps = mm_from_m(np.asarray(sample.position)) * STEPS_PER_MM
        # Reports have three decimals of a millimetre: 0.04 steps.
        assert np.max(np.abs(steps - np.round(steps))) < 0.05
        assert tuple(int(value) for value in np.round(steps)) in scene.seen_steps
        assert np.max(np.abs(sample.position - sample.target)) < 0.5e-3 / STEPS_PER_MM + 1e-6
        assert sample.outcome.__class__.__name__ == "PoseEstimate"
    last = np.round(mm_from_m(np.asarray(run.samples[-1].position)) * STEPS_PER_MM)
    assert counted_at_the_end == tuple(int(value) for value in last + np.array(SWITCHES))


@pytest.mark.parametrize(
    "words", [["home"], ["move", "X=-280", "--home", "--speed-mm-min", "600"]], ids=["home", "move"]
)
def test_when_the_host_is_killed_the_motors_stop(
    firmware_builds: FirmwareBuilds, tmp_path: Path, words: list[str]
) -> None:
    text = (ROOT / "calib" / "bench.toml").read_text(encoding="utf-8")
    (tmp_path / "bench.toml").write_text(re.sub(r"min_mm = -\d+\.0", "min_mm = -300.0", text), encoding="utf-8")
    settings = [
        *SETTINGS[:-12], "$202=2000", "$25=600",
        *(f"${base + i}={v}" for base, v in ((100, 80), (110, 3000), (120, 200), (130, 300)) for i in range(3)),
    ]  # fmt: skip
    with TerminalBoard([*firmware_builds.command("native"), "--switches", "240,320,400"]) as board:
        board.set_up(settings)
        if words == ["home"]:
            board.turn_by_hand(0, 0, -16000)
        begun = board.table().motor_steps
        command = [sys.executable, "-m", "uvgs_bench", "gantry", *words]
        host = subprocess.Popen(
            [*command, "--bench", str(tmp_path / "bench.toml"), "--port", f"grbl:{board.port}"],
            cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        deadline = time.monotonic() + 60.0
        # Some 20 mm into the way to the switch of Z, or away from that of X.
        while time.monotonic() < deadline and host.poll() is None:
            now = board.table().motor_steps
            if (now[2] - begun[2] > 1600) if words == ["home"] else (now[0] < SWITCHES[0] - 1600):
                break
            time.sleep(0.02)
        host.kill()
        host.wait()
        killed = board.table().motor_steps
        time.sleep(2.6)
        stopped = board.table().motor_steps
        time.sleep(0.5)
        assert board.table().motor_steps == stopped
    # It was moving, and 10 mm/s for at most 2 s, and braking, are less than 21 mm; how late the look was, another 2 mm.
    assert 0 < max(abs(a - b) for a, b in zip(stopped, killed, strict=True)) < 23 * STEPS_PER_MM
