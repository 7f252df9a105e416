"""A run with planted errors, in memory or on disk, and a judgement of it whose verdicts the test chooses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from uvgs_bench.accuracy.judgement import Alert, Judgement, Limit, LimitVerdict, Verdict
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_error import error_table
from uvgs_bench.accuracy.registration import fit_registration
from uvgs_bench.accuracy.statistics import availability, summarise
from uvgs_bench.beacon.geometry import Beacon, Led
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor.outcome import Miss, PoseEstimate
from uvgs_bench.store.run import Run, RunManifest, RunWriter, Sample

HOSTILE = "<script>alert(1)</script> #strong[x] \"quoted\" & $math$ 'n' \\sum"
"""A name that would break a page that does not escape it."""

CAMERA_FROM_GANTRY = Pose(so3_exp(np.array([0.02, -0.03, 0.01])), np.array([-0.25, -0.2, 0.7]), "camera", "gantry")
CARRIAGE_FROM_BEACON = Pose(so3_exp(np.array([0.01, 0.02, -0.02])), np.array([0.0, 0.0, 0.0]), "carriage", "beacon")
SIGMAS = np.array([2e-3, 2e-3, 6e-4, 1.5e-4, 1.5e-4, 6e-4])
LED_M = np.array([[0.0, -0.05, 0.0], [0.05, 0.03, 0.0], [-0.05, 0.03, 0.0], [0.0, 0.0, -0.04]])


def axes() -> tuple[Axis, ...]:
    return tuple(
        Axis(name, "linear", np.eye(3)[k], 0.0, upper, 0.05, 0.2, 2e-5)
        for k, (name, upper) in enumerate((("X", 0.5), ("Y", 0.4), ("Z", 0.6)))
    )


def calibration() -> Calibration:
    lens = Lens("plumb_bob", 640, 480, read_only([600.0, 601.0, 320.5, 239.5, -0.1, 0.05, 1e-4, -2e-4, 0.0]))
    sigma = np.array([0.2, 0.2, 0.15, 0.15, 1e-3, 3e-3, 1e-4, 1e-4, 2e-3])
    notes = {"board": "charuco_9x6", "created_utc": "2026-01-02T03:04:05Z"}
    return Calibration(lens, "synthetic", np.diag(sigma**2), 0.231, 0.262, 24, 960, 3, notes)


def beacon(name: str = "tetra_small") -> Beacon:
    leds = tuple(Led(f"L{k + 1}", p, np.array([0.0, 0.0, -1.0]), 1.2, 0.003) for k, p in enumerate(LED_M))
    return Beacon(name, leds)


def synthetic_run(
    path: Path = Path("reports/20260102T030405Z_synthetic"),
    *,
    stations: int = 30,
    shots: int = 3,
    seed: int = 1,
    procedure: str = "synthetic",
    miss_every: int = 17,
    ended: str = "completed",
    limits: tuple[Limit, ...] = (),
) -> Run:
    """Stations at random over the volume; every third fits the registration; depth carries a bias and a slope."""
    rng = np.random.default_rng(seed)
    uppers = np.array([axis.upper for axis in axes()])
    samples: list[Sample] = []
    t_ns = 5_000_000_000
    for station in range(stations):
        position = np.round(rng.uniform(0.0, uppers), 6)
        true = CAMERA_FROM_GANTRY @ gantry_from_carriage(axes(), position) @ CARRIAGE_FROM_BEACON
        slope = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2e-3 * (true.t_m[2] - 1.0)])
        for shot in range(shots):
            t_ns += 700_000_000
            index = len(samples)
            if miss_every and index % miss_every == miss_every - 1:
                outcome: PoseEstimate | Miss = Miss(
                    "blobs", "too_few_blobs", "found 3 blobs, 4 are needed", t_ns, "tetra_small", 3
                )
            else:
                outcome = _estimate(true, slope + SIGMAS * rng.standard_normal(6), t_ns, rng)
            role = "register" if station % 3 == 0 else "judge"
            samples.append(Sample(index, station, station, 0, shot, role, t_ns, position, position, outcome))
    manifest = RunManifest(
        id=path.name,
        created_utc="2026-01-02T03:04:05.000Z",
        procedure_name=procedure,
        mount="beacon_on_carriage",
        axes=axes(),
        limits=limits,
        seed=seed,
        hashes={"calibration.yaml": "c0ffee" * 10, "beacon.toml": "beef" * 16},
        versions={"uvgs_bench": "0.1.0", "numpy": "2.4", "opencv": "5.0.0"},
        gantry_info={"firmware": "Grbl", "version": "1.1h"},
        camera_spec="sim:bench",
        gantry_spec="grbl:sim://bench",
        simulated=True,
        plan_hash="ab" * 32,
        station_count=stations,
        captures_per_station=shots,
    )
    return Run(path, manifest, tuple(samples), ended, "", calibration(), beacon(), "2026-01-02T03:14:05.000Z")  # type: ignore[arg-type]


def _estimate(true: Pose, error: FloatArray, t_ns: int, rng: np.random.Generator) -> PoseEstimate:
    observed = Pose(so3_exp(error[:3]) @ true.R, true.t_m + error[3:], "camera", "beacon")
    # The covariance is of the left tangent: v = translation error - omega x t.
    x, y, z = true.t_m
    T = np.eye(6)
    T[3:, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    residual = 0.05 * rng.standard_normal((4, 2))
    return PoseEstimate(
        camera_from_beacon=observed,
        covariance=read_only(T @ np.diag(SIGMAS**2) @ T.T),
        t_ns=t_ns,
        beacon="tetra_small",
        led_px=read_only(calibration().lens.project(observed.apply(LED_M)) + residual),
        residual_px=read_only(residual),
        rms_px=float(np.sqrt((residual**2).mean())),
        margin=8.0,
        blob_count=4,
    )


def with_pictures(run: Run, every: int = 1) -> Run:
    """Keep a small rendered picture for samples, in the run's folder."""
    import cv2

    rows, columns = np.mgrid[0:480, 0:640].astype(np.float64)
    (run.path / "captures").mkdir(parents=True, exist_ok=True)
    samples = []
    for sample in run.samples:
        if sample.index % every == 0:
            name = f"captures/{sample.index:06d}.png"
            image = np.full((480, 640), 8.0)
            if isinstance(sample.outcome, PoseEstimate):
                for u, v in sample.outcome.led_px:
                    image += 220.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2.0 * 1.6**2))
            cv2.imwrite(str(run.path / name), np.clip(image, 0, 255).astype(np.uint8))
            sample = replace(sample, capture_file=name)
        samples.append(sample)
    return replace(run, samples=tuple(samples))


def write_run(run: Run, path: Path) -> Path:
    """Put a run on disk as the sweep does."""
    from uvgs_bench.store.beacons import write_beacon
    from uvgs_bench.store.calibrations import calibration_text

    beacon_file = path.parent / "beacon_of_run.toml"
    write_beacon(beacon_file, run.beacon, force=True)
    setup = {"calibration.yaml": calibration_text(run.calibration).encode(), "beacon.toml": beacon_file.read_bytes()}
    writer = RunWriter.create(path, replace(run.manifest, id=path.name, keep="none"), setup)
    for sample in run.samples:
        writer.append(sample)
    if run.ended:
        writer.close(run.ended, run.end_reason)
    return path


def observations_of(run: Run) -> Observations:
    nan = np.full(3, np.nan)
    solved = [isinstance(s.outcome, PoseEstimate) for s in run.samples]
    poses = [s.outcome.camera_from_beacon if isinstance(s.outcome, PoseEstimate) else None for s in run.samples]
    carriage = [gantry_from_carriage(run.manifest.axes, s.position) for s in run.samples]
    return Observations(
        station=np.array([s.station for s in run.samples], dtype=np.int64),
        role=tuple(s.role for s in run.samples),
        t_ns=np.array([s.t_ns for s in run.samples], dtype=np.int64),
        axis_position=read_only([s.position for s in run.samples]),
        R_gs=read_only([p.R for p in carriage]),
        t_gs_m=read_only([p.t_m for p in carriage]),
        R_cb=read_only([np.full((3, 3), np.nan) if p is None else p.R for p in poses]),
        t_cb_m=read_only([nan if p is None else p.t_m for p in poses]),
        covariance=read_only(
            [
                s.outcome.covariance if isinstance(s.outcome, PoseEstimate) else np.full((6, 6), np.nan)
                for s in run.samples
            ]
        ),
        is_solved=np.array(solved, dtype=np.bool_),
        reason=tuple(s.reason for s in run.samples),
    )


LIMIT_VERDICTS = (
    LimitVerdict(Limit.of("position_rms_mm", 2.0), 0.713, 0.642, 0.801, 20, "pass", "0.80 mm at most, within 2 mm"),
    LimitVerdict(Limit.of("attitude_rms_deg", 0.15), 0.165, 0.148, 0.184, 20, "inconclusive", "the interval holds it"),
    LimitVerdict(Limit.of("availability_percent", 99.0), 94.4, 90.1, 97.2, 30, "fail", "97.2 % at most, below 99 %"),
)


def synthetic_judgement(
    run: Run,
    verdict: Verdict = "pass",
    verdicts: Sequence[LimitVerdict] = LIMIT_VERDICTS[:1],
    alerts: Sequence[Alert] = (Alert("warning", "only 10 stations fit the registration"),),
) -> Judgement:
    """The numbers are computed from the run; verdicts and alerts are as given."""
    obs = observations_of(run)
    rng = np.random.default_rng(0)
    fits = obs.has_role("register")
    registration = fit_registration(obs, fits)
    held_out, in_sample = obs.select(~fits), obs.select(fits)
    table, in_table = error_table(held_out, registration), error_table(in_sample, registration)
    return Judgement(
        registration=registration,
        in_sample_table=in_table,
        table=table,
        in_sample_summary=summarise(in_table, rng),
        summary=summarise(table, rng),
        availability=availability(obs, rng),
        verdicts=tuple(verdicts),
        verdict=verdict,
        alerts=tuple(alerts),
        split="Every third station fits the registration, the others judge.",
    )


def empty_judgement(run: Run, why: str) -> Judgement:
    """What remains when the frames cannot be registered."""
    return Judgement(
        registration=None,
        in_sample_table=None,
        table=None,
        in_sample_summary=None,
        summary=None,
        availability=availability(observations_of(run), np.random.default_rng(0)),
        verdicts=(),
        verdict="inconclusive",
        alerts=(Alert("error", why),),
        split="No station could judge.",
    )
