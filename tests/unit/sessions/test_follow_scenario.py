"""Scenarios and planted faults of following: read strictly, or refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from uvgs_bench.errors import ConfigError, UvgsError
from uvgs_bench.sessions.follow_procedure import leader_of
from uvgs_bench.sessions.follow_scenario import SCENARIOS, FollowFaults, parse_faults, read_scenario

ROOT = Path(__file__).resolve().parents[3]
BENCH = ROOT / "calib" / "bench.toml"


def test_faults_are_read_and_said_again():
    faults = parse_faults("loss=2s@10s, loss=500ms@3s,latency=80ms,drop=0.05,cpu=0.5")
    assert faults == FollowFaults(((3.0, 0.5), (10.0, 2.0)), 0.08, 0.05, 0.5)
    assert parse_faults(faults.text) == faults
    assert parse_faults("") == FollowFaults()
    assert faults.hidden_ns()[1] == (10_000_000_000, 12_000_000_000)


@pytest.mark.parametrize(
    "text",
    [
        "loss=2@3",
        "loss=2s",
        "latency=80",
        "drop=5%",
        "drop=1.0",
        "cpu=2",
        "speed=1",
        "drop=0.1,drop=0.2",
        "latency=1s@2s",
    ],
)
def test_faults_that_mean_nothing_are_refused(text: str):
    with pytest.raises(ConfigError, match="--inject"):
        parse_faults(text)


@pytest.mark.parametrize("name", SCENARIOS)
def test_shipped_scenarios_are_named_after_their_key_and_can_be_planned(name: str):
    scenario = read_scenario(name)
    assert scenario.name == name
    assert scenario.duration_s > 10.0
    assert scenario.station().t_m[2] == pytest.approx(-0.65)


def test_a_scenario_file_is_read_strictly(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_text('schema = 1\nname = "mine"\nrate_hz = 10.0\n[[leader.places]]\nposition_mm = [0.0, 0.0, 0.0]\n')
    assert leader_of(str(path), BENCH).rate_hz == 10.0
    path.write_text('schema = 1\nname = "mine"\nrate_hertz = 10.0\n[[leader.places]]\n')
    with pytest.raises(ConfigError, match="rate_hz"):
        leader_of(str(path), BENCH)
    with pytest.raises(UvgsError, match="no such file"):
        leader_of(str(tmp_path / "none.toml"), BENCH)
    with pytest.raises(ConfigError, match="unknown scenario"):
        leader_of("nix", BENCH)


def test_a_procedure_with_a_motion_leads():
    scenario = leader_of(str(ROOT / "procedures" / "svgs_maneuver_2f.toml"), BENCH)
    spans = [max(p.position_mm[k] for p in scenario.leader.places) for k in range(3)]
    assert scenario.leader.speed_mm_s == pytest.approx(25.0)
    # 300 mm to the right; the gantry's Z is the camera's minus y, but for a degree of tilt.
    assert spans[0] == pytest.approx(300.0, abs=12.0)
    with pytest.raises(ConfigError, match="trajectory"):
        leader_of(str(ROOT / "procedures" / "quick_line.toml"), BENCH)
