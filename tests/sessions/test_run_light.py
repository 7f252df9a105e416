"""``uvgs run`` and light: the exposure loop, switched lamps, and the warning before LED cores clip."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.helpers.sim_bench import error_sigmas, write_bench
from uvgs_bench.cli.app import main
from uvgs_bench.devices.cameras import open_camera
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.interop.trajectories import read_poses
from uvgs_bench.sensor import PoseEstimate, Uvgs
from uvgs_bench.sensor.difference import DifferenceConfig
from uvgs_bench.sensor.exposure import ExposurePolicy
from uvgs_bench.sessions.events import Event, Remark, ignore_events
from uvgs_bench.sessions.exposure_loop import ExposureLoop
from uvgs_bench.sessions.stream import Answered, StreamRules, solve_source
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_passing_beacon
from uvgs_bench.store.calibrations import read_calibration

pytestmark = pytest.mark.opencv
# Six lamps of the room, as bright as LEDs, anywhere in the picture: they stand still before the camera.
LAMPS = "".join(
    f'[[simulated.lights]]\nframe = "camera"\nposition_mm = [{x}, {y}, 1000.0]\npeak_dn_at_1m = 220.0\n'
    for x, y in ((-300, -200), (310, -150), (-250, 220), (120, 260), (330, 180), (-60, -310))
)


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *(str(word) for word in words)])
    return int(caught.value.code or 0)


def setup(folder: Path) -> tuple[object, ...]:
    return "--camera", folder / "camera.yaml", "--beacon", folder / "any.toml", "--quiet"


def sensors(folder: Path) -> dict[str, Uvgs]:
    return {"any": Uvgs(read_calibration(folder / "camera.yaml"), read_beacon(folder / "any.toml"))}


DEEP = {"bit_depth": 12, "peak_dn_at_1m": 220.0 * 16, "gain_e_per_dn": 2.5, "black_dn": 64.0, "background_dn": 64.0}


@pytest.mark.parametrize(("factor", "camera"), [(0.1, {}), (10.0, {}), (0.1, DEEP)])
def test_the_exposure_settles_from_ten_times_too_dark_and_too_bright(tmp_path, capfd, factor, camera):
    # 4 ms puts the peaks near 60 to 80 % over the ranges of the path.
    bench = write_bench(tmp_path, exposure_ms=4.0 * factor, **{"peak_dn_at_1m": 220.0, **camera})
    out = tmp_path / "p.jsonl"
    assert uvgs(f"sim:{bench}?count=14", *setup(tmp_path), "--out", out, "--auto-exposure", "--json") == 0
    summary = json.loads(capfd.readouterr().out)
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    exposures = [line["exposure_s"] for line in lines]
    assert exposures[0] == pytest.approx(0.004 * factor)
    changes = [i for i, line in enumerate(lines) if "next_exposure_s" in line]
    assert summary["exposure_changes"] == len(changes)
    # Every change is on record, and nothing changes without one.
    for i in range(13):
        expected = lines[i].get("next_exposure_s", exposures[i])
        assert exposures[i + 1] == expected
    assert lines[changes[0]]["exposure_reason"].split(":")[0] == ("too_dim" if factor < 1.0 else "clipped")
    # The beacon goes from 0.9 to 1.15 m: what comes after the first two steps follows it, one way only.
    assert len(changes) <= 4
    late = np.diff(exposures[3:])
    assert (late >= 0.0).all()
    for line in lines[3:]:
        assert line["status"] == "ok"
        assert "saturated" not in line["flags"]
    # A dark picture of 12 bit looks like a bright one of 10: the camera's own depth decides.
    assert 0.003 < exposures[4] < 0.006


class LaggingCamera:
    """The simulated camera obeying two captures late and not saying so, as USB cameras do."""

    settling_captures = 2

    def __init__(self, spec: str) -> None:
        self._camera = open_camera(spec)
        self.exposure_limits_s = self._camera.exposure_limits_s
        self.exposure_s = self._camera.exposure_s
        self.full_scale_dn = self._camera.full_scale_dn
        self.gain_db = 6.0
        self._queue = [self.exposure_s] * 2
        self.taken_s: list[float] = []

    def set_exposure_s(self, exposure_s: float) -> float:
        # Steps of 0.1 ms.
        self.exposure_s = max(round(exposure_s / 1e-4), 1) * 1e-4
        return self.exposure_s

    def __iter__(self):
        while True:
            self._queue.append(self.exposure_s)
            self._camera.set_exposure_s(self._queue.pop(0))
            capture = self._camera.grab()
            if capture is None:
                return
            self.taken_s.append(capture.exposure_s)
            yield replace(capture, exposure_s=None)


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_camera_that_obeys_late_and_says_nothing_settles_without_swinging(tmp_path, factor):
    bench = write_bench(tmp_path, exposure_ms=4.0 * factor, peak_dn_at_1m=220.0)
    camera, known = LaggingCamera(f"sim:{bench}?count=26"), sensors(tmp_path)
    loop = ExposureLoop(camera, known, ExposurePolicy())
    answers = list(solve_source(camera, known, ignore_events, exposure=loop))
    steps = np.sign(np.diff(camera.taken_s))
    turns = np.count_nonzero(np.diff(steps[steps != 0.0]))
    assert turns <= 1
    # What comes later follows the beacon, which goes away: one way, now and then.
    assert (steps[9:] >= 0.0).all()
    assert np.count_nonzero(steps[9:]) <= 3
    for answer in answers[9:]:
        assert isinstance(answer.outcomes["any"], PoseEstimate)
        # The band is 60 to 90 %; while a change is on its way the beacon goes on for three captures.
        assert 0.5 < int(answer.capture.image.max()) / 255.0 < 0.95
    assert camera.gain_db == 6.0


def test_limits_of_camera_and_user_are_kept_or_refused(tmp_path, capfd):
    bench = write_bench(tmp_path, exposure_ms=0.4)
    out = tmp_path / "p.csv"
    words = (f"sim:{bench}?count=4", *setup(tmp_path), "--out", out, "--auto-exposure", "--max-exposure-ms")
    assert uvgs(*words, 1.0) == 0
    assert [row.split(",")[-2] for row in out.read_text().splitlines()[1:]] == ["0.0004", "0.001", "0.001", "0.001"]
    assert uvgs(*words, 0.005, "--force") == 2
    assert uvgs(f"images:{tmp_path}", *setup(tmp_path), "--out", out, "--auto-exposure", "--force") == 4
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((480, 640), dtype=np.uint8))
    assert uvgs(f"images:{tmp_path}", *setup(tmp_path), "--out", out, "--auto-exposure", "--force") == 2
    assert "the exposure of this source cannot be set" in capfd.readouterr().err
    camera = LaggingCamera(f"sim:{bench}?count=1")
    camera.exposure_limits_s = (0.03, 0.1)
    with pytest.raises(ConfigError, match="not longer than the camera's shortest"):
        ExposureLoop(camera, sensors(tmp_path), ExposurePolicy())


def lit_poses(answers: list[Answered]) -> list[PoseEstimate]:
    return [outcome for answer in answers if isinstance(outcome := answer.outcomes["any"], PoseEstimate)]


def test_a_switched_target_is_solved_among_the_lamps_of_the_room(tmp_path, capfd):
    bench = write_bench(tmp_path, more="switched_light = true\n" + LAMPS, peak_dn_at_1m=150.0)
    scene, known = read_passing_beacon(bench), sensors(tmp_path)
    rules = StreamRules(difference=DifferenceConfig())
    answers = list(solve_source(open_camera(f"sim:{bench}?count=24"), known, ignore_events, rules, total=24))
    assert len(answers) == 12
    poses = lit_poses(answers)
    assert len(poses) >= 10
    # Six numbers each: 3 is far beyond any chance.
    assert max(error_sigmas(pose, scene) for pose in poses) < 3.0
    out = tmp_path / "p.csv"
    assert uvgs(f"sim:{bench}?count=24", *setup(tmp_path), "--out", out, "--difference", "--json") == 0
    assert json.loads(capfd.readouterr().out)["captures"] == 12
    assert [record.index for record in read_poses(out)] == list(range(0, 24, 2))


def test_a_lost_capture_costs_a_pair_and_never_gives_a_wrong_pose(tmp_path):
    bench = write_bench(tmp_path, more="switched_light = true\n", peak_dn_at_1m=150.0)
    scene = read_passing_beacon(bench)
    camera = SimulatedCamera(scene, "sim:", None)
    # A tenth of a second apart the LEDs move by some pixels; 2 ms apart wrongly paired ones lie over each other.
    for step_ns in (100_000_000, 2_000_000):
        stream = [camera.capture_at(i * step_ns, i) for i in range(25) if i != 7]
        rules = StreamRules(difference=DifferenceConfig())
        answers = list(solve_source(stream, sensors(tmp_path), ignore_events, rules))
        reasons = [getattr(answer.outcomes["any"], "reason", "") for answer in answers]
        assert reasons.count("") >= 9, reasons
        # Far apart, the LEDs of two lit captures do not disturb each other; close together they are refused.
        assert (reasons.count("") < len(reasons)) == (step_ns < 10_000_000)
        assert max(error_sigmas(pose, scene) for pose in lit_poses(answers)) < 3.0


def test_a_warning_comes_before_the_cores_clip(tmp_path, monkeypatch):
    bench = write_bench(tmp_path, peak_dn_at_1m=340.0, exposure_ms=2.5)
    said: list[Event] = []
    source = open_camera(f"sim:{bench}?count=5")
    list(solve_source(source, sensors(tmp_path), said.append))
    warnings = [event.text for event in said if isinstance(event, Remark) and event.level == "warning"]
    assert len(warnings) == 1
    words = re.fullmatch(r"any: LED cores clip below about ([\d.]+) m at 2.5 ms \(now ([\d.]+) m\)", warnings[0])
    assert words, warnings
    clip_m, now_m = (float(word) for word in words.groups())
    assert 0.1 < clip_m < now_m
    # The pictures do as they were said to: unclipped a fifth farther, clipped a fifth nearer.
    scene = read_passing_beacon(bench)
    for factor, is_clipped in ((1.2, False), (0.8, True)):
        facing = Pose(np.eye(3), np.array([0.0, 0.0, factor * clip_m]), "camera", "beacon")
        monkeypatch.setattr(type(scene), "true_camera_from_beacon", lambda _scene, _t_ns, pose=facing: pose)
        image = SimulatedCamera(scene, "sim:", None).capture_at(0, 0).image
        assert (int(image.max()) == 255) == is_clipped


def test_cores_that_clip_from_the_beginning_are_said_once(tmp_path):
    bench = write_bench(tmp_path, peak_dn_at_1m=600.0)
    for loop, expected in ((False, ["any: LED cores clip already at 0.94 m and 4 ms: expose shorter"]), (True, [])):
        said: list[Event] = []
        source, known = open_camera(f"sim:{bench}?count=4"), sensors(tmp_path)
        exposure = ExposureLoop(source, known, ExposurePolicy()) if loop else None
        list(solve_source(source, known, said.append, exposure=exposure))
        assert [e.text for e in said if isinstance(e, Remark) and e.level == "warning"] == expected


def test_lamps_far_brighter_than_the_leds_do_not_keep_the_exposure_too_short(tmp_path, capfd):
    # Twenty times as bright: with the lamps in the band the LEDs are lost in the noise.
    lamps = LAMPS.replace("220.0", "4000.0")
    bench = write_bench(tmp_path, exposure_ms=0.2, peak_dn_at_1m=220.0, more=lamps)
    out = tmp_path / "p.jsonl"
    assert uvgs(f"sim:{bench}?count=40", *setup(tmp_path), "--out", out, "--auto-exposure") == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    searched = [line for line in lines if line.get("exposure_reason", "").startswith("searching")]
    assert searched
    # The search ends with the first pose, and LEDs govern from then on, also where one passes before a lamp.
    first = next(i for i, line in enumerate(lines) if line["status"] == "ok")
    assert first == searched[-1]["index"] + 1
    assert all(0.003 < line["exposure_s"] < 0.008 for line in lines[first + 2 :])
    assert any(line["status"] == "miss" for line in lines[first:])
    assert sum(line["status"] == "ok" for line in lines[first:]) >= 12
    capfd.readouterr()
