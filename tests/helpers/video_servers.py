"""Small real servers of moving pictures on loopback: MJPEG over HTTP, and RTSP with JPEG over TCP (RFC 2326, 2435)."""

from __future__ import annotations

import socket
import socketserver
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

_MTU = 1200
_CLOCK_HZ = 90000


def jpegs(images: Sequence[np.ndarray]) -> list[bytes]:
    """The pictures as JPEG with the standard tables, chroma halved both ways, as RFC 2435 wants them."""
    out = []
    for image in images:
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        out.append(data.tobytes())
    return out


@contextmanager
def mjpeg_server(pictures: Sequence[bytes], rate_hz: float, *, port: int = 0) -> Iterator[int]:
    """Serve pictures in turn until they end; yields the port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            try:
                for data in pictures:
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    self.wfile.write(head.encode() + data + b"\r\n")
                    time.sleep(1.0 / rate_hz)
            except OSError:
                pass

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def rtsp_server(pictures: Sequence[bytes], rate_hz: float) -> Iterator[int]:
    """Serve pictures in turn, over and over, until the client hangs up; yields the port."""

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            while (words := self.rfile.readline().decode().split()) != []:
                headers = {}
                while line := self.rfile.readline().decode().strip():
                    key, _, value = line.partition(":")
                    headers[key.lower()] = value.strip()
                method = words[0]
                self._answer(method, headers, words[1])
                if method == "PLAY":
                    self._play()
                    return

        def _answer(self, method: str, headers: dict[str, str], url: str) -> None:
            extra, body = "", ""
            if method == "OPTIONS":
                extra = "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
            elif method == "DESCRIBE":
                body = (
                    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\n"
                    "m=video 0 RTP/AVP 26\r\na=control:track1\r\n"
                )
                extra = f"Content-Base: {url}/\r\nContent-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
            elif method == "SETUP":
                extra = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1;timeout=60\r\n"
            elif method == "PLAY":
                extra = "Session: 1\r\nRange: npt=0-\r\n"
            self.wfile.write(f"RTSP/1.0 200 OK\r\nCSeq: {headers['cseq']}\r\n{extra}\r\n{body}".encode())

        def _play(self) -> None:
            number, start_s = 0, time.monotonic()
            try:
                for k in range(10**6):
                    stamp = int((time.monotonic() - start_s) * _CLOCK_HZ)
                    for payload, is_last in _rtp_payloads(pictures[k % len(pictures)]):
                        kind = 26 | (0x80 if is_last else 0)
                        packet = struct.pack(">BBHII", 0x80, kind, number & 0xFFFF, stamp, 7) + payload
                        self.wfile.write(b"$\x00" + struct.pack(">H", len(packet)) + packet)
                        number += 1
                    time.sleep(1.0 / rate_hz)
            except OSError:
                pass

    class Server(socketserver.ThreadingTCPServer):
        allow_reuse_address = True
        daemon_threads = True

    server = Server(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()


def _rtp_payloads(data: bytes) -> Iterator[tuple[bytes, bool]]:
    """A JPEG as RFC 2435 payloads: its tables and scan without the headers."""
    tables, place, size = b"", 2, (0, 0)
    while True:
        marker, length = struct.unpack(">HH", data[place : place + 4])
        body = data[place + 4 : place + 2 + length]
        if marker == 0xFFDB:
            while body:
                tables, body = tables + body[1:65], body[65:]
        elif marker == 0xFFC0:
            height, width = struct.unpack(">HH", body[1:5])
            size = width, height
            assert body[7] == 0x22, "expected chroma halved both ways"
        place += 2 + length
        if marker == 0xFFDA:
            break
    scan = data[place:-2]
    offset = 0
    while offset < len(scan):
        head = struct.pack(">I", offset) + bytes((1, 255, size[0] // 8, size[1] // 8))
        if offset == 0:
            head += struct.pack(">BBH", 0, 0, len(tables)) + tables
        piece = scan[offset : offset + _MTU]
        offset += len(piece)
        yield head + piece, offset >= len(scan)


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
