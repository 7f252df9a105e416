"""Foxglove's protocol as a client hears it over a real websocket; skipped where the packages are missing."""

from __future__ import annotations

import json
import struct
import sys

import pytest

from tests.helpers.live_states import BEACON, sensor, shown_state
from uvgs_bench.errors import ConfigError
from uvgs_bench.view.broadcast import Broadcast
from uvgs_bench.view.foxglove import FoxgloveServer

pytestmark = pytest.mark.opencv


@pytest.fixture
def broadcast():
    made = Broadcast(shown_state(), {BEACON: sensor()})
    yield made
    made.close()


def test_a_client_gets_every_channel(broadcast):
    pytest.importorskip("foxglove")
    client = pytest.importorskip("websockets.sync.client")
    server = FoxgloveServer(broadcast, 0)
    try:
        with client.connect(server.address, subprotocols=["foxglove.sdk.v1"], max_size=None) as link:
            info, channels = {}, {}
            while len(channels) < 6:
                told = json.loads(link.recv(timeout=20))
                if told["op"] == "serverInfo":
                    info = told
                for channel in told.get("channels", []):
                    channels[channel["id"]] = channel["topic"]
            # Nobody can change anything through it.
            assert info["capabilities"] == []
            wanted = [{"id": number, "channelId": number} for number in channels]
            link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            heard: dict[str, bytes] = {}
            while len(heard) < 6:
                message = link.recv(timeout=20)
                if isinstance(message, bytes) and message[0] == 1:
                    (number, _t_ns) = struct.unpack_from("<IQ", message, 1)
                    heard[channels[number]] = message[13:]
        assert set(heard) == {
            "/uvgs/image", "/uvgs/annotations", "/uvgs/pose", "/tf", "/uvgs/camera_info", "/uvgs/state",
        }  # fmt: skip
        state = json.loads(heard["/uvgs/state"])
        assert state["number"] == 3
        assert state["beacons"][0]["status"] == "ok"
        assert b"\xff\xd8" in heard["/uvgs/image"]
        assert BEACON.encode() in heard["/tf"]
        assert b"plumb_bob" in heard["/uvgs/camera_info"]
    finally:
        server.close()


def test_a_taken_port_is_one_clear_line(broadcast):
    pytest.importorskip("foxglove")
    server = FoxgloveServer(broadcast, 0)
    try:
        with pytest.raises(ConfigError, match="name another port"):
            FoxgloveServer(broadcast, int(server.address.rpartition(":")[2]))
    finally:
        server.close()


def test_without_the_package_it_says_what_to_install(broadcast, monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match="foxglove-sdk"):
        FoxgloveServer(broadcast, 0)
