"""Fuse a source, with everything that lets a reader judge the result beside it."""

from __future__ import annotations

from pathlib import Path

from uvgs_bench.errors import ConfigError, RunError
from uvgs_bench.navigation.delays import Misfit, find_misfit
from uvgs_bench.navigation.fusion_data import BOTH, FalsePoses, FusionInput, Method, with_false_poses
from uvgs_bench.navigation.fusion_outcome import FusedRun, FusionOutcome, misfit_lines, untold
from uvgs_bench.navigation.fusion_score import score, score_raw
from uvgs_bench.sessions.events import EventSink, StageFinished, StageStarted
from uvgs_bench.sessions.fuse import FusionOptions, filter_config, fuse
from uvgs_bench.sessions.fusion_setup import FusionSetup, imu_remarks, read_bag_input
from uvgs_bench.units import s_from_ns

_STAGE = "fuse"
# Squared innovations of six numbers: their mean is 6; beyond this inputs are surer than right.
_NIS_HIGH = 12.0


def read_source(spec: str, setup: FusionSetup | None, seed: int, sink: EventSink = lambda event: None) -> FusionInput:
    """Read or simulate what is to be fused.

    Args:
        spec: ``sim:square``, ``sim:occlusion``, ``sim:gt2``; a run folder; or bags: ``bag:FILE[,FILE]``, or a path.
        setup: What a bag does not say; needed for bags only.
        seed: Seed of what is simulated.
        sink: Where progress goes.

    Returns:
        The input.

    Raises:
        ConfigError: The mission is unknown, or a bag comes without a set-up.
        UvgsError: A file cannot be read.
    """
    if spec.startswith("sim:"):
        from uvgs_bench.sessions.simulate_mission import mission, simulate_mission

        return simulate_mission(mission(spec.removeprefix("sim:")), seed, sink)
    from uvgs_bench.store.run import is_run

    path = Path(spec.removeprefix("bag:").partition(",")[0])
    if not spec.startswith("bag:") and is_run(path):
        from uvgs_bench.sessions.fuse_run import read_run_input

        return read_run_input(path, seed)
    if not path.exists():
        raise RunError("no such file; expected sim:square, sim:occlusion, sim:gt2, a run folder, or bags", spec)
    if setup is None:
        raise ConfigError(
            "a bag does not say how the camera is mounted and where the beacon stands; name --setup", spec
        )
    return read_bag_input([Path(part) for part in spec.removeprefix("bag:").split(",")], setup)


def run_fusion(
    source: FusionInput,
    method: Method,
    options: FusionOptions,
    false: FalsePoses | None = None,
    sink: EventSink = lambda event: None,
) -> FusionOutcome:
    """Fuse a source and what it is compared with.

    Args:
        source: The input.
        method: The method.
        options: How.
        false: False poses to mix in, or None.
        sink: Where progress goes.

    Returns:
        The fusion, then the same without the sensor, without the other localiser, and without false poses, as far as
        there is anything to leave out.

    Raises:
        ConfigError: The method's extra is not installed.
        RunError: There is nothing to begin with.
    """
    clean, false_ns = source, frozenset[int]()
    if false is not None:
        source, false_ns = with_false_poses(source, false)
    sources = BOTH if source.native and source.sensed else ("uvgs",) if source.sensed else ("native",)
    sink(StageStarted(_STAGE, None))
    runs = [_run("fused", source, method, sources, options, false_ns)]
    if false is not None:
        runs.append(_run("without false poses", clean, method, sources, options))
    if len(sources) > 1:
        runs.append(_run("native alone", source, method, ("native",), options))
        runs.append(_run("without native", source, method, ("uvgs",), options, false_ns))
    misfit = _misfit(source, options)
    problems = [*misfit_lines(misfit)] if misfit is not None else []
    said = imu_remarks(source) if method != "ar_swap" else ()
    problems += said
    main = runs[0]
    for name, nis in main.score.nis.items():
        if len(nis) > 20 and method != "ar_swap" and float(nis.mean()) > _NIS_HIGH:
            problems.append(f"poses of {name} are farther off than they state: mean NIS {nis.mean():.1f}, 6 expected")
    for name, counts in main.score.counts.items():
        refused = counts.get("refused", 0)
        if refused > 0.2 * sum(counts.values()):
            problems.append(f"{refused} of {sum(counts.values())} poses of {name} were refused")
    remarks = [*source.remarks]
    if misfit is not None and untold(misfit):
        remarks.append(untold(misfit))
    elif misfit is None:
        remarks.append("clock offset and mounting were not looked for: too few readings beside too few poses")
    if source.starved_ns:
        first, last = source.starved_ns[0][0], source.starved_ns[-1][0]
        remarks.append(
            f"the native localiser had too few landmarks at {len(source.starved_ns)} instants between "
            f"{s_from_ns(first):.0f} and {s_from_ns(last):.0f} s"
        )
    sink(StageFinished(_STAGE, f"{len(main.result.states)} states"))
    return FusionOutcome(source, tuple(runs), score_raw(source), misfit, false_ns, tuple(problems), tuple(remarks))


def _run(
    name: str,
    source: FusionInput,
    method: Method,
    sources: tuple[str, ...],
    options: FusionOptions,
    false_ns: frozenset[int] = frozenset(),
) -> FusedRun:
    result = fuse(source, method, sources, options)
    return FusedRun(name, result, score(source, result, false_ns))


def _misfit(source: FusionInput, options: FusionOptions) -> Misfit | None:
    if len(source.imu) < 2:
        return None
    return find_misfit(
        source.imu, source.sensed, source.world_from_beacon, source.body_from_camera, filter_config(source, options)
    )
