"""A capture kept on demand: its pixels losslessly, and beside them what the sensor made of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from uvgs_bench.store.documents import write_atomically
from uvgs_bench.view.packet import Packet


class Snapshots:
    """A folder that gets a picture and a JSON file per snapshot.

    Args:
        folder: The folder; made with the first one.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def take(self, packet: Packet, parameters: Mapping[str, float]) -> Path:
        """Write one.

        Args:
            packet: What is kept.
            parameters: The values of the sliders, kept beside it.

        Returns:
            The picture.

        Raises:
            UvgsError: It cannot be written.
        """
        import cv2

        done, payload = cv2.imencode(".png", packet.shown.capture.image)
        assert done, "an image of a capture can always be encoded"
        stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}_{packet.number:06d}"
        picture = self.folder / f"{stem}.png"
        left_out = ("past", "zooms")
        data = {key: value for key, value in packet.data.items() if key not in left_out}
        data["parameters"] = dict(parameters)
        write_atomically(picture, payload.tobytes())
        write_atomically(picture.with_suffix(".json"), json.dumps(data, indent=1, allow_nan=False) + "\n")
        return picture
