"""A page on this machine that shows a running stream and, to whoever has its key, lets it be changed.

The server listens on the loopback only. Reading needs a request that names the loopback as its host, so that a foreign
page whose name was bound to this address reads nothing. Changing needs besides the page's own origin and the key, which
is drawn anew at each start and stands behind the # of the printed address: browsers send that part to nobody.
"""

from __future__ import annotations

import secrets
import threading
from http.server import ThreadingHTTPServer
from pathlib import Path

from uvgs_bench.errors import ConfigError
from uvgs_bench.view.broadcast import Broadcast
from uvgs_bench.view.controls import Controls, Motion
from uvgs_bench.view.page_requests import Desk, PageRequests
from uvgs_bench.view.snapshot import Snapshots

HOST = "127.0.0.1"


class LivePage:
    """The open page.

    Args:
        broadcast: What it shows.
        controls: What it may change.
        snapshots: Folder of its snapshots.
        port: Its port; 0 takes a free one.
        motion: The gantry it may move; None refuses all motion.

    Raises:
        ConfigError: The port is taken or not permitted.
    """

    def __init__(
        self, broadcast: Broadcast, controls: Controls, snapshots: Path, *, port: int, motion: Motion | None = None
    ) -> None:
        self.key = secrets.token_urlsafe(16)
        """What a request that changes something must know."""
        self._desk = Desk(broadcast, controls, Snapshots(snapshots), motion, self.key)
        try:
            self._server = _Server((HOST, port), self._desk)
        except OSError as error:
            reason = error.strerror or str(error)
            raise ConfigError(f"cannot serve there: {reason}; name another port", f"--view-port {port}") from None
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), name="page", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port it is served on."""
        return int(self._server.server_address[1])

    @property
    def address(self) -> str:
        """Where to look, with the key."""
        return f"http://{HOST}:{self.port}/#{self.key}"

    def close(self) -> None:
        """End it; streams to browsers end too. Safe to call twice."""
        self._desk.is_closed = True
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    # A browser that does not read must not hold up the end of the program.
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], desk: Desk) -> None:
        self.desk = desk
        super().__init__(address, PageRequests)

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away is no news; anything else is a bug and goes where bugs of threads go."""
        import sys

        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            kind = type(error)
            threading.excepthook(
                threading.ExceptHookArgs((kind, error, error.__traceback__, threading.current_thread()))
            )
