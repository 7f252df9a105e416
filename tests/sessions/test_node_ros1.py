"""``uvgs node --ros1`` and ``uvgs run ros1:`` beside a real roscore, a real camera driver and a real listener."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.node_bench import FILES, check_answers, write_node_bench
from tests.helpers.video_servers import free_port
from uvgs_bench.sensor.outcome import PoseEstimate

SYSTEM_PYTHON = "/usr/bin/python3"
ROOT = Path(__file__).parents[2]
PEER = ROOT / "tests" / "helpers" / "ros1_peer.py"


def has_ros() -> bool:
    probe = "import rospy, genpy.dynamic, tf2_msgs, diagnostic_msgs"
    return (
        Path("/usr/bin/roscore").exists()
        and subprocess.run([SYSTEM_PYTHON, "-c", probe], capture_output=True, check=False).returncode == 0
        and sys.version_info[:2] == (3, 11)
    )


pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(not has_ros(), reason="Debian's ROS 1 (ros-core, python3-rospy) is not there for this Python"),
]


@pytest.fixture
def core(tmp_path: Path) -> Iterator[tuple[dict[str, str], subprocess.Popen]]:
    port = free_port()
    environment = os.environ | {
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
        "ROS_HOSTNAME": "127.0.0.1",
        "ROS_HOME": str(tmp_path / "ros"),
        "ROS_LOG_DIR": str(tmp_path / "ros"),
        "PYTHONUNBUFFERED": "1",
    }
    environment.pop("PYTHONPATH", None)
    process = subprocess.Popen(
        ["/usr/bin/roscore", "-p", str(port)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    probe = "import rosgraph, sys; sys.exit(not rosgraph.is_master_online())"
    for _ in range(100):
        if subprocess.run([SYSTEM_PYTHON, "-c", probe], env=environment, check=False).returncode == 0:
            break
        time.sleep(0.1)
    yield environment, process
    process.terminate()
    process.wait(20)


@pytest.fixture
def bench(tmp_path: Path) -> tuple[Path, list[PoseEstimate]]:
    return tmp_path, write_node_bench(tmp_path)


def peer_words(folder: Path) -> list[str]:
    return [SYSTEM_PYTHON, str(PEER), *(str(folder / name) for name in FILES)]


def uvgs(environment: dict[str, str], *words: object) -> subprocess.Popen:
    command = [sys.executable, "-m", "uvgs_bench", *(str(word) for word in words)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_the_node_answers_as_offline_takes_parameters_and_ends_clean(core, bench) -> None:
    environment, _ = core
    folder, offline = bench
    node = uvgs(environment, "node", "--ros1", "--image", "/cam/image_raw", "--beacon", folder / "beacon.toml",
                "--no-track", "__name:=uvgs", "__log:=/dev/null")  # fmt: skip
    try:
        subprocess.run(peer_words(folder), env=environment, check=True, timeout=150)
        node.send_signal(signal.SIGTERM)
        out, errors = node.communicate(timeout=30)
    finally:
        node.kill()
    assert node.returncode == 0, errors
    assert "Traceback" not in errors
    assert "parameters are kept" in errors + out or "threshold_k must not be negative" in errors + out
    told = json.loads((folder / "out.json").read_text())
    assert told["answered"]
    assert (told["transform"], told["parameter"]) == (["camera", "test"], 2.0)
    check_answers(told["poses"], offline)
    assert told["refused"]
    assert told["changed"]
    assert 1 in told["levels"]


def test_a_topic_is_a_camera_of_run_and_a_dead_master_ends_it(core, bench) -> None:
    environment, master = core
    folder, _ = bench
    peer = subprocess.Popen(peer_words(folder), env=environment)
    try:
        words = ("run", "ros1:/cam/image_raw", "--beacon", folder / "beacon.toml", "--out", folder / "p.csv")
        run = uvgs(environment, *words, "--limit", 6, "--json")
        out, errors = run.communicate(timeout=60)
        assert run.returncode == 0, errors
        assert json.loads(out)["poses"] == 6
        absent = uvgs(environment, "run", "ros1:/nothing?wait_s=0.5", *words[2:-1], folder / "q.csv")
        _, errors = absent.communicate(timeout=60)
        assert absent.returncode in (2, 5)
        assert "/cam/image_raw" in errors
        node = uvgs(
            environment, "node", "--ros1", "--beacon", folder / "beacon.toml", "--camera", folder / "camera.yaml"
        )
        until = time.monotonic() + 40.0
        while "publishing under /uvgs" not in node.stderr.readline():
            assert time.monotonic() < until
        master.terminate()
        _, errors = node.communicate(timeout=40)
        assert node.returncode == 5
        assert "ROS is gone" in errors or "master does not answer" in errors
        assert "Traceback" not in errors
    finally:
        peer.kill()
        peer.wait()


def test_the_launch_file_starts_the_node_with_the_papers_parameters(core, bench) -> None:
    environment, _ = core
    folder, _ = bench
    environment = environment | {
        "ROS_PACKAGE_PATH": str(ROOT / "docs" / "ros"),
        "UVGS": str(Path(sys.executable).with_name("uvgs")),
    }
    peer = subprocess.Popen(peer_words(folder), env=environment)
    launch = subprocess.Popen(
        ["/usr/bin/roslaunch", "--wait", "uvgs_sensor", "uvgs.launch", "image:=/cam/image_raw",
         f"camera:={folder / 'camera.yaml'}", f"beacon:={folder / 'beacon.toml'}", "hue_deg:=[350.0, 10.0]"],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert peer.wait(timeout=150) == 0
        launch.send_signal(signal.SIGINT)
        out, _ = launch.communicate(timeout=60)
    finally:
        peer.kill()
        launch.kill()
    assert "Traceback" not in out
    assert json.loads((folder / "out.json").read_text())["answered"]
