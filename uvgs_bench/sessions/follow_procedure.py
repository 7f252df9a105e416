"""A procedure with a motion as the leader of a follow session: its path in gantry axes, as the camera sees it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import ConfigError
from uvgs_bench.sessions.follow_scenario import FollowPlace, FollowScenario, LeaderPlan, read_scenario
from uvgs_bench.sessions.planning import plan
from uvgs_bench.sessions.procedure import read_procedure
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.documents import read_toml
from uvgs_bench.units import mm_from_m

# The follower needs this long at its station before the leader goes, s.
_FIRST_WAIT_S = 6.0


def leader_of(name: str, bench: Path) -> FollowScenario:
    """A scenario by name, from a scenario file, or from a procedure with a motion.

    Args:
        name: Name or path.
        bench: The bench file whose axes a procedure means.

    Returns:
        The scenario.

    Raises:
        UnreadableDocument: There is no such file.
        ConfigError: The name or file says something that cannot be meant, or the procedure has no motion.
        EnvelopeError: The procedure leaves the envelope.
    """
    path = Path(name)
    if path.suffix != ".toml" or "pattern" not in read_toml(path):
        return read_scenario(name)
    procedure, described = read_procedure(path), read_bench(bench)
    motion = plan(procedure, described.envelope).motion
    if motion is None:
        raise ConfigError("a leader moves by a procedure with pattern = 'trajectory'", name, "pattern")
    linear = [i for i, axis in enumerate(described.envelope.axes) if axis.kind == "linear"]
    directions = np.array([described.envelope.axes[i].direction for i in linear])
    # As the camera sees it: the gantry is taken to stand before it as on the simulated bench.
    R = (described.simulated or SimulatedTruth()).camera_from_gantry.pose("camera", "gantry").R
    start = motion.points[0].position
    places = []
    for i, point in enumerate(motion.points):
        x, y, z = mm_from_m(R @ ((point.position - start)[linear] @ directions)).tolist()
        wait_s = max(point.dwell_s, _FIRST_WAIT_S) if i == 0 else point.dwell_s
        places.append(FollowPlace((x, y, z), dwell_s=wait_s, blend_mm=mm_from_m(point.blend)))
    acceleration = float(motion.limits.axis_acceleration[linear].min())
    leader = LeaderPlan(tuple(places), mm_from_m(motion.limits.speed), mm_from_m(acceleration))
    return FollowScenario(procedure.name, leader, f"the leader moves as in the procedure {procedure.name}")
