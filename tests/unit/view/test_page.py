"""The page's server over real sockets: who may read, who may change, and that a slow reader holds up nobody."""

from __future__ import annotations

import http.client
import json
import socket
import time

import pytest

from tests.helpers.live_states import BEACON, FakeControls, FakeMotion, sensor, shown_state, solved
from uvgs_bench.errors import ConfigError
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.view.broadcast import Broadcast
from uvgs_bench.view.page import LivePage
from uvgs_bench.view.page_requests import BOUNDARY

pytestmark = pytest.mark.opencv


class Bench:
    """An open page and what stands behind it."""

    def __init__(self, folder, motion=None):
        self.state = shown_state()
        self.controls, self.motion = FakeControls(), motion
        self.broadcast = Broadcast(self.state, {BEACON: sensor()})
        self.page = LivePage(self.broadcast, self.controls, folder, port=0, motion=motion)
        self.host = f"127.0.0.1:{self.page.port}"

    def request(self, method, path, body=None, **headers):
        link = http.client.HTTPConnection("127.0.0.1", self.page.port, timeout=20)
        try:
            link.request(method, path, body, {"Host": self.host, **headers})
            answer = link.getresponse()
            return answer.status, answer.headers, answer.read()
        finally:
            link.close()

    def order(self, path, body, **headers):
        given = {"Origin": f"http://{self.host}", "X-Uvgs-Key": self.page.key, "Content-Type": "application/json"}
        text = body if isinstance(body, bytes) else json.dumps(body).encode()
        status, _, payload = self.request("POST", path, text, **{**given, **headers})
        return status, json.loads(payload)

    def stream(self, path):
        link = socket.create_connection(("127.0.0.1", self.page.port), timeout=20)
        link.sendall(f"GET {path} HTTP/1.1\r\nHost: {self.host}\r\n\r\n".encode())
        return link

    def close(self):
        self.page.close()
        self.broadcast.close()


@pytest.fixture
def bench(tmp_path):
    made = Bench(tmp_path / "snaps")
    yield made
    made.close()


def events(link, count):
    """So many events of a stream: name and data."""
    with link.makefile("rb") as lines:
        while lines.readline() != b"\r\n":
            pass
        found = []
        name = ""
        while len(found) < count:
            line = lines.readline().decode().rstrip("\n")
            if line.startswith("event: "):
                name = line[7:]
            elif line.startswith("data: "):
                found.append((name, json.loads(line[6:])))
        return found


def test_the_page_brings_all_it_needs_and_nothing_from_elsewhere(bench):
    for path, kind in (("/", "text/html"), ("/page.js", "text/javascript"), ("/drawing.js", "text/javascript"),
                       ("/page.css", "text/css")):  # fmt: skip
        status, headers, payload = bench.request("GET", path)
        assert status == 200
        assert headers["Content-Type"].startswith(kind)
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        text = payload.decode().replace("http://www.w3.org/2000/svg", "")
        assert "http://" not in text
        assert "https://" not in text
        # Relative addresses only, and no way for text to become markup.
        for forbidden in ('src="/', 'href="/', "innerHTML", "insertAdjacentHTML", "document.write", "eval("):
            assert forbidden not in text
        assert bench.page.key not in text
    assert bench.request("GET", "/secret")[0] == 404
    assert bench.request("GET", "/../page.py")[0] == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8700", "192.168.0.7:8700", "", "[::1", "127.0.0.1.evil.com"]
)
def test_a_name_bound_to_this_address_reads_nothing(bench, host):
    for path in ("/", "/events", "/stream.mjpg"):
        assert bench.request("GET", path, Host=host)[0] == 403
    # Its own origin would match such a host.
    assert bench.order("/tune", {"changes": {"threshold_k": 3}}, Host=host, Origin=f"http://{host}")[0] == 403
    assert bench.controls.asked == []


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1:9000", "[::1]:9000", "localhost"])
def test_a_tunnel_may_have_another_port(bench, host):
    assert bench.request("GET", "/", Host=host)[0] == 200
    assert bench.order("/tune", {"changes": {"threshold_k": 3}}, Host=host, Origin=f"http://{host}")[0] == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": ""},
        {"Origin": "http://127.0.0.1:1"},
        {"X-Uvgs-Key": ""},
        {"X-Uvgs-Key": "wrong"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
def test_orders_from_elsewhere_are_refused(tmp_path, headers):
    bench = Bench(tmp_path, FakeMotion())
    try:
        for path, body in (("/tune", {"changes": {"threshold_k": 3}}), ("/jog", {"axis": "X", "offset": 0.001}),
                           ("/home", {}), ("/expose", {"exposure_s": 0.001}), ("/snapshot", {})):  # fmt: skip
            assert bench.order(path, body, **headers)[0] == 403
        assert bench.controls.asked == bench.motion.asked == []
        assert not list(tmp_path.iterdir())
    finally:
        bench.close()


def test_without_permission_nothing_moves(bench):
    for path in ("/home", "/jog", "/stop"):
        status, told = bench.order(path, {"axis": "X", "offset": 0.001})
        assert status == 403
        assert "--allow-motion" in told["said"]


def test_with_permission_orders_reach_the_gantry(tmp_path):
    bench = Bench(tmp_path, FakeMotion())
    try:
        assert bench.order("/jog", {"axis": "X", "offset": -0.001})[0] == 200
        assert bench.order("/home", {})[0] == 200
        assert bench.order("/stop", {})[0] == 200
        assert bench.motion.asked == [("X", -0.001), "home", "stop"]
        for body in (
            {"axis": "X"},
            {"axis": 1, "offset": 1},
            {"axis": "X", "offset": "1"},
            {"axis": "X", "offset": True},
        ):
            assert bench.order("/jog", body)[0] == 400
        assert bench.order("/jog", b'{"axis": "X", "offset": NaN}')[0] == 400
        assert len(bench.motion.asked) == 3
    finally:
        bench.close()


def test_broken_orders_are_refused(bench):
    assert bench.order("/tune", b"{")[0] == 400
    assert bench.order("/tune", b"[1]")[0] == 400
    assert bench.order("/tune", b"[" * 4000)[0] == 400
    assert bench.order("/tune", {})[0] == 400
    assert bench.order("/tune", b"{}" + b" " * 5000)[0] == 413
    assert bench.order("/tune", {"changes": {}}, **{"Content-Type": "text/plain"})[0] == 415
    assert bench.order("/nothing", {})[0] == 404
    assert bench.order("/tune", {"changes": {"threshold_k": -1}}) == (
        409, {"is_done": False, "said": "threshold_k must not be negative"},
    )  # fmt: skip
    assert bench.order("/save", {}) == (409, {"is_done": False, "said": "the disk is full"})


def test_events_tell_the_setup_then_captures_and_a_change_of_it(bench):
    link = bench.stream("/events")
    with link:
        told = events(link, 2)
    assert [name for name, _ in told] == ["setup", "capture"]
    assert told[0][1]["sliders"][0]["name"] == "threshold_k"
    assert told[0][1]["axes"] is None
    assert told[0][1]["beacons"][BEACON]["leds"]
    assert told[1][1]["number"] == 3
    assert [row[0] for row in told[1][1]["past"]] == [1, 2, 3]
    assert bench.order("/tune", {"changes": {"threshold_k": 4.5}})[0] == 200
    link = bench.stream("/events")
    with link:
        assert events(link, 1)[0][1]["sliders"][0]["value"] == 4.5


def test_events_end_with_the_stream(bench):
    bench.state.end()
    link = bench.stream("/events")
    with link, link.makefile("rb") as lines:
        text = lines.read().decode()
    assert "event: over" in text


def test_pictures_stand_between_boundaries(bench):
    link = bench.stream("/stream.mjpg")
    with link, link.makefile("rb") as lines:
        head = {}
        while (line := lines.readline()) != b"\r\n":
            name, _, value = line.decode().partition(":")
            head[name.lower()] = value.strip()
        assert head["content-type"] == f"multipart/x-mixed-replace; boundary={BOUNDARY}"
        assert lines.readline() == f"--{BOUNDARY}\r\n".encode()
        assert lines.readline() == b"Content-Type: image/jpeg\r\n"
        length = int(lines.readline().split()[1])
        assert lines.readline() == b"\r\n"
        jpeg = lines.read(length)
        # The boundary comes with the picture: a browser shows it only then.
        assert lines.readline() == b"\r\n"
        assert lines.readline() == f"--{BOUNDARY}\r\n".encode()
    assert jpeg[:2] == b"\xff\xd8"
    assert jpeg[-2:] == b"\xff\xd9"


def test_a_reader_that_does_not_read_holds_up_nobody(bench):
    """The stream's thread goes on, and who comes later gets the newest capture at once."""
    stuck = [bench.stream("/stream.mjpg") for _ in range(3)]
    try:
        capture, outcome = solved()
        for _ in range(400):
            bench.state.put(capture, {BEACON: (outcome, LineNote())})
        ends_s = time.monotonic() + 20.0
        number = 0
        while number != 403:
            assert time.monotonic() < ends_s
            link = bench.stream("/events")
            with link:
                number = events(link, 2)[1][1]["number"]
    finally:
        for link in stuck:
            link.close()


def test_so_many_readers_and_no_more(bench):
    links = [bench.stream("/events") for _ in range(32)]
    try:
        for link in links:
            events(link, 1)
        status, _, payload = bench.request("GET", "/events")
        assert status == 503
        assert b"too many" in payload
    finally:
        for link in links:
            link.close()


def test_a_snapshot_keeps_every_pixel_and_what_was_said(bench, tmp_path):
    import cv2
    import numpy as np

    with bench.broadcast.listening():
        assert bench.broadcast.wait_newer(0, 20.0) is not None
    status, told = bench.order("/snapshot", {})
    assert status == 200
    picture, facts = sorted((tmp_path / "snaps").iterdir(), key=lambda path: path.suffix != ".png")
    assert told["said"] == f"saved {picture}"
    np.testing.assert_array_equal(cv2.imread(str(picture), cv2.IMREAD_UNCHANGED), bench.state.latest().capture.image)
    kept = json.loads(facts.read_text())
    assert kept["beacons"][0]["status"] == "ok"
    assert kept["parameters"] == {"threshold_k": 2.0}


def test_a_taken_port_is_one_clear_line(bench, tmp_path):
    with pytest.raises(ConfigError, match="name another port"):
        LivePage(bench.broadcast, bench.controls, tmp_path, port=bench.page.port)


def test_nothing_is_made_while_nobody_looks(bench):
    time.sleep(0.3)
    assert bench.broadcast.newest() is None
