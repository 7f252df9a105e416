"""``uvgs node --ros2`` beside a real camera driver and listener of rclpy, in the environment ``make ros2`` sets up."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

from tests.helpers.node_bench import FILES, check_answers, write_node_bench

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".venv-ros2" / "bin" / "python"
PEER = ROOT / "tests" / "helpers" / "ros2_peer.py"


def has_ros() -> bool:
    probe = [str(PYTHON), "-c", "import rclpy, sensor_msgs.msg, uvgs_bench"]
    return PYTHON.exists() and subprocess.run(probe, capture_output=True, check=False).returncode == 0


pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(not has_ros(), reason="no ROS 2 here: make ros2 sets up an environment with rclpy"),
]


def test_the_node_answers_as_offline_takes_parameters_and_ends_clean(tmp_path: Path) -> None:
    offline = write_node_bench(tmp_path)
    # A domain of its own, on this machine only.
    environment = os.environ | {"ROS_DOMAIN_ID": str(os.getpid() % 90 + 10), "ROS_LOCALHOST_ONLY": "1"}
    command = [str(PYTHON), "-m", "uvgs_bench", "node", "--ros2", "--beacon", str(tmp_path / "beacon.toml")]
    command += ["--no-track", "--ros-args", "-p", "min_margin:=4.5"]
    node = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    peer = [str(PYTHON), str(PEER), *(str(tmp_path / name) for name in FILES)]
    try:
        subprocess.run(peer, env=environment, check=True, timeout=200)
        node.send_signal(signal.SIGINT)
        _, errors = node.communicate(timeout=30)
    finally:
        node.kill()
    assert node.returncode == 0, errors
    assert "Traceback" not in errors
    assert "/tf is not published" in errors or "tf2" not in errors
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["answered"]
    check_answers(told["poses"], offline)
    assert told["refused"]
    assert "threshold_k must not be negative" in told["reason"]
    assert told["parameter"] == 2.0
    assert told["taken"]
    assert told["changed"]
