"""What the page's server answers, request by request."""

from __future__ import annotations

import hmac
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from importlib.resources import files
from math import isfinite
from pathlib import Path
from urllib.parse import urlsplit

from uvgs_bench.errors import UvgsError
from uvgs_bench.view.broadcast import Broadcast
from uvgs_bench.view.controls import Controls, Motion
from uvgs_bench.view.packet import Packet
from uvgs_bench.view.snapshot import Snapshots

BOUNDARY = "uvgs-picture"
_LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/drawing.js": ("drawing.js", "text/javascript; charset=utf-8"),
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_MOST_STREAMS = 32
_MOST_BODY = 4096
_SILENCE_S = 1.0
_SLOW_S = 10.0


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of an order.

    Args:
        is_done: Whether it was taken.
        said: One line for people.
    """

    is_done: bool
    said: str


class Desk:
    """What all requests share.

    Args:
        broadcast: What is shown.
        controls: What may be changed.
        snapshots: Where snapshots go.
        motion: The gantry, or None when it may not be moved.
        key: What a request that changes something must know.
    """

    def __init__(
        self, broadcast: Broadcast, controls: Controls, snapshots: Snapshots, motion: Motion | None, key: str
    ) -> None:
        self.broadcast = broadcast
        self.controls = controls
        self.motion = motion
        self.key = key
        self.is_closed = False
        self._snapshots = snapshots
        self._streams = threading.BoundedSemaphore(_MOST_STREAMS)

    @contextmanager
    def streaming(self) -> Iterator[bool]:
        """Within this a client is sent a stream; False when there are too many already."""
        is_free = self._streams.acquire(blocking=False)
        try:
            if is_free:
                with self.broadcast.listening():
                    yield True
            else:
                yield False
        finally:
            if is_free:
                self._streams.release()

    def setup(self) -> dict[str, object]:
        """What a page needs to know before the first capture, and again when a parameter changed."""
        exposure = self.controls.exposure()
        return {
            "sliders": [asdict(slider) for slider in self.controls.sliders()],
            "exposure": None if exposure is None else asdict(exposure),
            "axes": None if self.motion is None else [{"name": n, "unit": u} for n, u in self.motion.axes],
            "beacons": {
                name: {
                    "leds": [led.name for led in uvgs.beacon.leds],
                    "positions_m": uvgs.beacon.positions_m.tolist(),
                }
                for name, uvgs in self.broadcast.sensors.items()
            },
        }

    def order(self, path: str, body: dict[str, object]) -> Answer | None:
        """Do what a request asks. None when there is no such order; raises ValueError when its values are no values."""
        orders: dict[str, Callable[[], str | None]] = {
            "/tune": lambda: self.controls.tune(_changes(body)),
            "/expose": lambda: self.controls.expose(_number(body, "exposure_s")),
        }
        keeps: dict[str, Callable[[], Path]] = {"/save": self.controls.save, "/snapshot": self._snapshot}
        if self.motion is not None:
            motion = self.motion
            orders |= {
                "/home": motion.home,
                "/jog": lambda: motion.jog(_text(body, "axis"), _number(body, "offset")),
                "/stop": motion.stop,
            }
        if path in orders:
            refusal = orders[path]()
            return Answer(refusal is None, "taken" if refusal is None else refusal)
        if path in keeps:
            try:
                return Answer(True, f"saved {keeps[path]()}")
            except UvgsError as error:
                return Answer(False, str(error))
        return None

    def _snapshot(self) -> Path:
        packet = self.broadcast.newest()
        if packet is None:
            raise UvgsError("there is no capture yet")
        return self._snapshots.take(packet, {slider.name: slider.value for slider in self.controls.sliders()})


class PageRequests(BaseHTTPRequestHandler):
    """One request."""

    protocol_version = "HTTP/1.1"
    timeout = _SLOW_S
    server_version = "uvgs"
    sys_version = ""

    @property
    def _desk(self) -> Desk:
        desk = self.server.desk  # type: ignore[attr-defined]
        assert isinstance(desk, Desk)
        return desk

    def log_message(self, format: str, *arguments: object) -> None:
        """Requests are no news."""

    def do_GET(self) -> None:
        """The page, its parts, the pictures and the data."""
        if not self._is_from_here():
            return self._refuse(HTTPStatus.FORBIDDEN, "this page is for 127.0.0.1 and localhost only")
        path = urlsplit(self.path).path
        if path in _FILES:
            name, kind = _FILES[path]
            return self._send(HTTPStatus.OK, kind, _file(name))
        if path == "/events":
            return self._stream("text/event-stream", self._events)
        if path == "/stream.mjpg":
            return self._stream(f"multipart/x-mixed-replace; boundary={BOUNDARY}", self._pictures)
        return self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def do_POST(self) -> None:
        """An order of the page."""
        length = self.headers.get("Content-Length", "")
        if not length.isascii() or not length.isdigit() or int(length) > _MOST_BODY:
            return self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {_MOST_BODY} bytes")
        # Before anything is refused: a body that nobody reads resets the connection, and the answer is lost.
        text = self.rfile.read(int(length))
        if not self._is_from_here():
            return self._refuse(HTTPStatus.FORBIDDEN, "this page is for 127.0.0.1 and localhost only")
        if self.headers.get("Origin") != f"http://{self.headers.get('Host', '')}":
            return self._refuse(HTTPStatus.FORBIDDEN, "orders are taken from the page itself only")
        key = self.headers.get("X-Uvgs-Key", "")
        if not hmac.compare_digest(key.encode(), self._desk.key.encode()):
            return self._refuse(HTTPStatus.FORBIDDEN, "open the whole address that uvgs run printed to change anything")
        if self.headers.get_content_type() != "application/json":
            return self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected JSON")
        path = urlsplit(self.path).path
        if path in ("/home", "/jog", "/stop") and self._desk.motion is None:
            return self._refuse(HTTPStatus.FORBIDDEN, "the gantry may be moved only with --allow-motion")
        try:
            body = json.loads(text or b"{}")
            if not isinstance(body, dict):
                raise ValueError("expected an object")
            answer = self._desk.order(path, body)
        except (ValueError, RecursionError) as error:
            return self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        if answer is None:
            return self._refuse(HTTPStatus.NOT_FOUND, "there is no such order")
        status = HTTPStatus.OK if answer.is_done else HTTPStatus.CONFLICT
        return self._send(status, "application/json", json.dumps(asdict(answer)).encode())

    def _is_from_here(self) -> bool:
        """Whether the browser thinks that it talks to the loopback, and no other page asked it to."""
        try:
            name = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        except ValueError:
            return False
        return name in _LOOPBACK and self.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")

    def _refuse(self, status: HTTPStatus, said: str) -> None:
        self.close_connection = True
        self._send(status, "application/json", json.dumps({"is_done": False, "said": said}).encode())

    def _send(self, status: HTTPStatus, kind: str, payload: bytes) -> None:
        self.send_response(status)
        self._headers(kind)
        self.send_header("Content-Length", str(len(payload)))
        self.end_headers()
        self.wfile.write(payload)

    def _headers(self, kind: str) -> None:
        self.send_header("Content-Type", kind)
        for name, value in _HEADERS.items():
            self.send_header(name, value)

    def _stream(self, kind: str, parts: Callable[[], Iterator[bytes]]) -> None:
        """Send parts until the client leaves: each part is the newest there is, however slow the client."""
        self.close_connection = True
        with self._desk.streaming() as is_free:
            if not is_free:
                self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are open")
                return
            self.send_response(HTTPStatus.OK)
            self._headers(kind)
            self.send_header("Connection", "close")
            self.end_headers()
            for part in parts():
                self.wfile.write(part)

    def _newest(self) -> Iterator[Packet | None]:
        """The newest packets, or None after a silence, until the stream is over."""
        broadcast, number = self._desk.broadcast, 0
        while not self._desk.is_closed:
            packet = broadcast.wait_newer(number, _SILENCE_S)
            if packet is None and broadcast.is_over:
                return
            number = number if packet is None else packet.number
            yield packet

    def _events(self) -> Iterator[bytes]:
        setup: dict[str, object] = {}
        is_first = True
        for packet in self._newest():
            if (now := self._desk.setup()) != setup:
                setup = now
                yield _event("setup", setup)
            if packet is None:
                yield b": still here\n\n"
                continue
            data = packet.data
            if is_first:
                data = data | {"past": self._desk.broadcast.past_points(packet.number)}
                is_first = False
            yield _event("capture", data)
        yield _event("over", {})

    def _pictures(self) -> Iterator[bytes]:
        # Browsers show a picture when the boundary after it has come: so it is sent with the picture.
        yield f"--{BOUNDARY}\r\n".encode()
        for packet in self._newest():
            if packet is not None:
                head = f"Content-Type: image/jpeg\r\nContent-Length: {len(packet.jpeg)}\r\n\r\n"
                yield head.encode() + packet.jpeg + f"\r\n--{BOUNDARY}\r\n".encode()


def _event(name: str, data: object) -> bytes:
    return f"event: {name}\ndata: {json.dumps(data, allow_nan=False)}\n\n".encode()


@cache
def _file(name: str) -> bytes:
    return files("uvgs_bench.view").joinpath("web", name).read_bytes()


def _changes(body: dict[str, object]) -> dict[str, object]:
    changes = body.get("changes")
    if not isinstance(changes, dict):
        raise ValueError("changes: expected an object")
    return {str(name): _number(changes, name) for name in changes}


def _number(body: dict[str, object], name: str) -> float:
    value = body.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ValueError(f"{name}: expected a number")
    return float(value)


def _text(body: dict[str, object], name: str) -> str:
    value = body.get(name)
    if not isinstance(value, str):
        raise ValueError(f"{name}: expected a text")
    return value
