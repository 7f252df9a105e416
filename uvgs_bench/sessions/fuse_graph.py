"""Hand a mission to the factor graph in the order it became known."""

from __future__ import annotations

from time import process_time_ns

import numpy as np

from uvgs_bench.geometry import read_only
from uvgs_bench.navigation.error_state_filter import UpdateRecord
from uvgs_bench.navigation.factor_graph import FixedLagGraph
from uvgs_bench.navigation.fusion_data import FusionInput, FusionResult
from uvgs_bench.navigation.gtsam_bridge import GraphConfig, load_gtsam
from uvgs_bench.navigation.states import NavigationState
from uvgs_bench.sessions.fuse import FusionOptions, filter_config, first_state, in_order, output_instants
from uvgs_bench.units import NS_PER_US


def fuse_by_graph(source: FusionInput, sources: tuple[str, ...], options: FusionOptions) -> FusionResult:
    """Fuse a mission by the graph.

    Args:
        source: The input.
        sources: Whose poses to use.
        options: How.

    Returns:
        What it said.

    Raises:
        ConfigError: GTSAM is not installed, or LED factors are asked for and the source has no lens.
        RunError: There is nothing to begin with.
    """
    load_gtsam()
    start = first_state(source, sources)
    graph = FixedLagGraph(
        start,
        filter_config(source, options),
        GraphConfig(factors=options.factors, learns_beacon=options.learn_beacon),
        source.world_from_beacon,
        source.body_from_camera,
        source.lens,
        source.leds_m,
    )
    sensed = {pose.t_ns: pose for pose in source.sensed}
    states: list[NavigationState] = []
    updates: list[UpdateRecord] = []
    spent: list[int] = []
    outputs = output_instants(source, start.t_ns)
    for _, _, what in in_order(source, source.measurements(sources), outputs, start.t_ns):
        if isinstance(what, int):
            t_ns = int(source.imu.t_ns[what])
            graph.add_imu(t_ns, source.imu.acceleration_mps2[what], source.imu.rate_radps[what])
        elif what is None:
            states.append(graph.state)
        else:
            begin = process_time_ns()
            updates.append(graph.add_pose(what, sensed.get(what.t_ns) if what.source == "uvgs" else None))
            spent.append(process_time_ns() - begin)
    return FusionResult(
        "graph",
        sources,
        tuple(states),
        tuple(updates),
        read_only(np.array(spent, dtype=np.float64) / NS_PER_US),
    )
