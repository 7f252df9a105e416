"""How ``uvgs run`` bears a long bag: memory along the way, and captures per second. A script, no test.

Writes a bag of mono pictures of the beacon (a few drawn ones, over and over), runs the real command on it, and prints
what it needed. ``python tests/long_bag.py --minutes 5`` writes 11 GB; ``--dark`` pictures have no noise and compress to
a hundredth, for an hour.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.helpers import spots
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

RATE_HZ = 30
PICTURES = 30
START_NS = 1_700_000_000 * 10**9


def pictures(dark: bool) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    drawn = []
    for _ in range(PICTURES):
        px = spots.lens().project(spots.random_pose(rng, cone_deg=20.0).apply(spots.beacon().positions_m))
        image = spots.draw(px, rng)
        drawn.append(np.where(image < 40, 0, image).astype(np.uint8) if dark else image)
    return drawn


def write(path: Path, count: int, kind: str, dark: bool) -> None:
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
    from rosbags.typesys import Stores, get_typestore

    is_ros1 = kind.startswith("ros1")
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    types = store.types
    if is_ros1:
        writer = rosbag1.Writer(path)
        if kind == "ros1-lz4":
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    else:
        plugin = rosbag2.StoragePlugin.SQLITE3 if kind == "db3" else rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if kind == "mcap-zstd":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    images = pictures(dark)
    height, width = images[0].shape
    with writer:
        topic = writer.add_connection("/cam/image_raw", "sensor_msgs/msg/Image", typestore=store)
        for i in range(count):
            t_ns = START_NS + i * 10**9 // RATE_HZ
            stamp = types["builtin_interfaces/msg/Time"](*divmod(t_ns, 10**9))
            head = types["std_msgs/msg/Header"]
            header = head(i, stamp, "cam") if is_ros1 else head(stamp, "cam")
            data = images[i % PICTURES].ravel()
            message = types["sensor_msgs/msg/Image"](header, height, width, "mono8", 0, width, data)
            serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            writer.write(topic, t_ns, serialize(message, "sensor_msgs/msg/Image"))


def resident_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, IndexError):
        return 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--kind", choices=("ros1", "ros1-lz4", "mcap", "mcap-zstd", "db3"), default="mcap")
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--folder", type=Path, default=None, help="where the bag goes; needs 2.2 GB a minute")
    options = parser.parse_args()
    count = round(options.minutes * 60 * RATE_HZ)
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        bag = folder / ("long.bag" if options.kind.startswith("ros1") else "long")
        write(bag, count, options.kind, options.dark)
        size = sum(f.stat().st_size for f in ([bag] if bag.is_file() else bag.iterdir()))
        print(
            f"{options.kind}: {count} captures, {options.minutes:g} min at {RATE_HZ} Hz, {size / 1e9:.2f} GB",
            flush=True,
        )
        write_calibration(folder / "camera.yaml", spots.calibration())
        write_beacon(folder / "beacon.toml", spots.beacon())
        words = ["run", f"bag:{bag}", "--camera", folder / "camera.yaml", "--beacon", folder / "beacon.toml"]
        words += ["--out", folder / "poses.csv", "--quiet", "--json"]
        begun = time.monotonic()
        with (folder / "said.json").open("wb") as said:
            command = subprocess.Popen([sys.executable, "-m", "uvgs_bench", *map(str, words)], stdout=said)
            seen: list[float] = []
            usage = None
            while usage is None:
                done, status, found = os.wait4(command.pid, os.WNOHANG)
                if done:
                    usage = found
                    command.returncode = os.waitstatus_to_exitcode(status)
                else:
                    seen.append(resident_mb(command.pid))
                    time.sleep(0.5)
        wall_s = time.monotonic() - begun
        cpu_s = usage.ru_utime + usage.ru_stime
        found = json.loads((folder / "said.json").read_text())
        assert (command.returncode, found["captures"]) == (0, count), found
        eighths = [max(part) for part in np.array_split(np.array(seen), min(8, len(seen)))]
        print(f"poses {found['poses']} of {found['captures']}")
        print(
            f"memory along the way, MB: {' '.join(f'{mb:.0f}' for mb in eighths)}; peak {usage.ru_maxrss / 1e3:.0f} MB"
        )
        rate_hz = count / cpu_s
        print(f"{cpu_s:.1f} s of CPU: {rate_hz:.0f} captures/s on one core, {rate_hz / RATE_HZ:.1f} x real time")
        print(f"{wall_s:.1f} s of wall time, {count / wall_s:.0f} captures/s")


if __name__ == "__main__":
    main()
