"""The test with two beacons on one rigid piece: how constant the pose between them stays, whatever moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uvgs_bench.accuracy.quantity_catalogue import Quantity
from uvgs_bench.accuracy.tangent import rotation_logs
from uvgs_bench.accuracy.time_blocks import stretches, time_blocks
from uvgs_bench.accuracy.two_clusters import two_cluster_quantities
from uvgs_bench.errors import ConfigError, RunError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import mean_rotation
from uvgs_bench.interop.trajectories import read_poses


@dataclass(frozen=True, slots=True, eq=False)
class TwoBeacons:
    """What a file of poses of two beacons shows.

    Args:
        first: Name of the beacon whose frame is taken.
        second: Name of the other.
        mean: Mean pose of the second in the first one's frame.
        quantities: Scatter of position and attitude about it.
        together: Captures that show both.
        captures: Captures that show either.
        independent: How many independent captures those together are worth.
    """

    first: str
    second: str
    mean: Pose
    quantities: tuple[Quantity, ...]
    together: int
    captures: int
    independent: float


def judge_two_beacons(path: Path, first: str = "", second: str = "", seed: int = 0) -> TwoBeacons:
    """Hold the poses of two beacons against one another; needs no gantry and no registration.

    Args:
        path: Pose file of ``uvgs run`` with several beacons, ``*.csv``.
        first: Name of the beacon whose frame is taken; the file's first when empty.
        second: Name of the other; the file's other when empty.
        seed: Seed of the intervals.

    Returns:
        The figures, with intervals over blocks of captures longer than the errors stay alike.

    Raises:
        FormatError: The file is no pose file.
        ConfigError: It does not hold two beacons, or not those.
        RunError: No capture shows both.
    """
    records = read_poses(path)
    names = list(dict.fromkeys(record.beacon for record in records))
    if not first and not second and len(names) != 2:
        raise ConfigError(f"holds {', '.join(names) or 'no beacon'}: name two of them", str(path), "--first --second")
    first = first or next((name for name in names if name != second), "")
    second = second or next((name for name in names if name != first), "")
    for key, name in (("--first", first), ("--second", second)):
        if name not in names:
            raise ConfigError(f"no beacon '{name}', the file holds {', '.join(names)}", str(path), key)
    if first == second:
        raise ConfigError("must be two different beacons", str(path), "--first --second")
    # Held poses are not fresh and count as none.
    seen = {
        name: {record.index: record for record in records if record.beacon == name and record.pose is not None}
        for name in (first, second)
    }
    both = sorted(set(seen[first]) & set(seen[second]))
    if not both:
        raise RunError(f"no capture shows both {first} and {second}", str(path))
    poses = [[seen[name][index].pose for index in both] for name in (first, second)]
    R = [np.array([pose.R for pose in of_one if pose is not None]) for of_one in poses]
    t_m = [np.array([pose.t_m for pose in of_one if pose is not None]) for of_one in poses]
    back = R[0].transpose(0, 2, 1)
    between_R, between_m = back @ R[1], np.einsum("nij,nj->ni", back, t_m[1] - t_m[0])
    centre_R, centre_m = mean_rotation(between_R), between_m.mean(axis=0)
    t_ns = np.array([seen[first][index].t_ns for index in both], dtype=np.int64)
    wander = np.concatenate([rotation_logs(centre_R.T @ between_R), between_m - centre_m], axis=1)
    block, worth = time_blocks(wander, stretches(t_ns, np.zeros(len(both), dtype=np.int64)))
    return TwoBeacons(
        first,
        second,
        Pose(centre_R, centre_m, "beacon", "beacon"),
        two_cluster_quantities((R[0], t_m[0]), (R[1], t_m[1]), block, np.random.default_rng(seed)),
        len(both),
        len(set(seen[first]) | set(seen[second])),
        worth,
    )
