"""A follower behind UDP: lockstep with a real socket, garbage passed over, silence said in one line."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from uvgs_bench.devices import udp_link
from uvgs_bench.devices.follow_link import open_follow_link
from uvgs_bench.errors import ConfigError, GantryError, GantryTimeout
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.follower import FollowerConfig, rest_command

START = Pose(np.eye(3), [1.0, 2.0, 3.0], "world", "body")


class Peer:
    """Answers each question by a function; keeps what it was told."""

    def __init__(self, answer: Callable[[dict[str, object]], list[bytes]]) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.told: list[dict[str, object]] = []
        self._answer = answer
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def spec(self) -> str:
        return f"udp:127.0.0.1:{self.socket.getsockname()[1]}"

    def _serve(self) -> None:
        while True:
            data, sender = self.socket.recvfrom(4096)
            if data == b"end":
                return
            message = json.loads(data)
            self.told.append(message)
            for reply in self._answer(message):
                self.socket.sendto(reply, sender)

    def close(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            own.sendto(b"end", self.socket.getsockname())
        self._thread.join(5.0)
        self.socket.close()


@pytest.fixture
def peers() -> Iterator[list[Peer]]:
    made: list[Peer] = []
    yield made
    for peer in made:
        peer.close()


def reply(message: dict[str, object], x_m: float) -> bytes:
    t_ns = message["until_ns"]
    return json.dumps({"t_ns": t_ns, "position_m": [x_m, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}).encode()


def test_its_first_pose_is_the_start_and_it_goes_on_from_there(peers: list[Peer]):
    peers.append(Peer(lambda m: [b"\xff", b"{}", b'{"t_ns": 5}', reply(m, 7.0 + 1e-9 * float(str(m["until_ns"])))]))
    link = open_follow_link(peers[0].spec, START)
    np.testing.assert_allclose(link.state_at(0).world_from_body.t_m, START.t_m, atol=1e-12)
    later = link.state_at(1_000_000_000)
    np.testing.assert_allclose(later.world_from_body.t_m, [2.0, 2.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(later.velocity_mps, [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(link.state_at(250_000_000).world_from_body.t_m, [1.25, 2.0, 3.0], atol=1e-9)
    link.close()
    link.close()
    assert link.has_own_time


def test_a_silent_follower_is_said(peers: list[Peer], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(udp_link, "_REPLY_S", 0.02)
    not_a_pose = b'{"t_ns": 0, "position_m": [NaN, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}'
    peers.append(Peer(lambda m: [not_a_pose]))
    link = open_follow_link(peers[0].spec, START)
    with pytest.raises(GantryTimeout, match="no pose within"):
        link.state_at(0)
    link.send(rest_command(0, FollowerConfig()))
    link.close()


def test_nobody_there_and_specs_that_mean_nothing():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        free = own.getsockname()[1]
    link = open_follow_link(f"udp:127.0.0.1:{free}", START)
    with pytest.raises(GantryError, match=r"127\.0\.0\.1"):
        link.state_at(0)
    link.close()
    for spec in ("flyre", "udp:host", "udp:host:0", "udp::5", "udp:host:99999"):
        with pytest.raises(ConfigError, match="--plant"):
            open_follow_link(spec, START)
