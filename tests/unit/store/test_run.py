"""A run written and read again is the same run, whatever interrupted its writing."""

from __future__ import annotations

import errno
import json
import math
import tomllib
from collections.abc import Iterator
from dataclasses import fields, replace
from io import FileIO
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.errors import RunError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.outcome import Miss, PoseEstimate
from uvgs_bench.store import run as run_module
from uvgs_bench.store import run_writer
from uvgs_bench.store.run import RunManifest, RunWriter, Sample, Seam, read_run
from uvgs_bench.store.run_format import line_from_sample, manifest_from_tables, sample_from_line, tables_from_manifest
from uvgs_bench.store.toml_text import toml_text

AXES = (
    Axis("X", "linear", np.array([1.0, 1e-3, 0.0]), -0.3, 0.0, 0.05, 0.2, 1e-4 / 3.0),
    Axis("A", "rotary", np.array([0.0, 0.0, 1.0]), -1.0, math.pi / 3.0, 0.5, 1.0),
)


def manifest(**changes: object) -> RunManifest:
    base = RunManifest(
        id="20260101T000000Z_demo",
        created_utc="2026-01-01T00:00:00.000Z",
        procedure_name='odd "name" \\ with\ttab, Ω and \x7f',
        mount="beacon_on_carriage",
        axes=AXES,
        seed=7,
        hashes={"calibration.yaml": "ab" * 32},
        versions={"uvgs_bench": "0.1", "key with = and .": "x"},
        gantry_info={"$130": "300.000"},
        station_count=3,
        captures_per_station=2,
        settle_s=0.1 + 0.2,
    )
    return replace(base, **changes)  # type: ignore[arg-type]


def pose_estimate(rng: np.random.Generator, rms_px: float = 0.1, margin: float = math.inf) -> PoseEstimate:
    led_px = rng.uniform(0.0, 1000.0, (4, 2))
    led_px[3] = np.nan
    return PoseEstimate(
        camera_from_beacon=Pose.exp(rng.normal(size=6), "camera", "beacon"),
        covariance=rng.normal(size=(6, 6)),
        t_ns=123456789012345678,
        beacon="tetra",
        led_px=led_px,
        residual_px=led_px * 1e-3,
        rms_px=rms_px,
        margin=margin,
        blob_count=4,
        runner_up=Pose.exp(rng.normal(size=6), "camera", "beacon"),
        stage_s={"solve": 1e-5 / 3.0},
        flags=("weak_evidence",),
        beacon_covariance=rng.normal(size=(6, 6)),
        calibration_covariance=rng.normal(size=(6, 6)),
        tracked_count=3,
    )


def sample(
    index: int, outcome: PoseEstimate | Miss | None = None, station: int | None = None, **more: object
) -> Sample:
    rng = np.random.default_rng(index)
    fields_ = {
        "index": index, "station": index // 2 if station is None else station, "waypoint": index // 2, "repeat": 0,
        "shot": index % 2, "role": "judge", "t_ns": 1000 + index, "target": rng.normal(size=2),
        "position": rng.normal(size=2), "outcome": pose_estimate(rng) if outcome is None else outcome,
    }  # fmt: skip
    return Sample(**(fields_ | more))  # type: ignore[arg-type]


def miss(t_ns: int = 5) -> Miss:
    return Miss("blobs", "too_few_blobs", "2 of 4", t_ns, "tetra", 2, {"blobs": 0.25})


def same(a: object, b: object) -> bool:
    """Equality to the last bit, NaN equal to NaN."""
    if isinstance(a, np.ndarray):
        return np.array_equal(a, np.asarray(b), equal_nan=True)
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))  # type: ignore[arg-type]
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


@pytest.fixture(autouse=True)
def _without_setup(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The set-up copies have tests of their own; and files of writers that are never closed are closed at the end."""
    monkeypatch.setattr(run_module, "_read_setup", lambda folder: (None, None))
    streams = []

    class Watched(FileIO):
        def __init__(self, *args: object) -> None:
            super().__init__(*args)  # type: ignore[arg-type]
            streams.append(self)

    monkeypatch.setattr(run_writer, "FileIO", Watched)
    yield
    for stream in streams:
        stream.close()


def test_a_sample_survives_its_line_bit_by_bit() -> None:
    for index in range(200):
        written = sample(index, replace(sample(index).outcome, margin=[math.inf, 3.5][index % 2]))  # type: ignore[arg-type]
        assert same(written, sample_from_line(line_from_sample(written)))
    written = sample(1, miss(), capture_file="captures/000001.png", attempt=2)
    assert same(written, sample_from_line(line_from_sample(written)))


def test_the_parts_of_the_doubt_are_kept_apart_and_older_lines_stay_readable() -> None:
    line = json.loads(line_from_sample(sample(3)))
    read = sample_from_line(json.dumps(line)).outcome
    assert isinstance(read, PoseEstimate)
    assert np.array_equal(read.noise_covariance, read.covariance - read.beacon_covariance)  # type: ignore[operator]
    assert np.array_equal(read.total_covariance, read.covariance + read.calibration_covariance)  # type: ignore[operator]
    for key in ("beacon_covariance", "calibration_covariance", "flags", "tracked_count"):
        del line[key]
    old = sample_from_line(json.dumps(line)).outcome
    assert isinstance(old, PoseEstimate)
    assert np.array_equal(old.covariance, read.covariance)
    assert (old.beacon_covariance, old.calibration_covariance, old.flags, old.tracked_count) == (None, None, (), 0)


def test_a_manifest_survives_its_tables_bit_by_bit() -> None:
    judgement = pytest.importorskip("uvgs_bench.accuracy.judgement")
    written = manifest(limits=(judgement.Limit("position_rms_mm", "max", 0.1 + 0.2, "mm"),))
    read = manifest_from_tables(tomllib.loads(toml_text(tables_from_manifest(written))))
    assert same(replace(written, axes=()), replace(read, axes=()))
    assert all(same(a, b) for a, b in zip(written.axes, read.axes, strict=True))
    assert read.mounted is None
    for mount, names in (
        ("beacon_on_carriage", ("carriage", "beacon")), ("camera_on_carriage", ("camera", "carriage")),
    ):  # fmt: skip
        mounted = Pose.exp(np.array([0.1, -2.0, 0.3, 1.0 / 3.0, 0.0, -0.1]), *names)
        tables = tomllib.loads(toml_text(tables_from_manifest(manifest(mount=mount, mounted=mounted))))
        again = manifest_from_tables(tables).mounted
        assert again is not None
        assert (again.target, again.source) == names
        assert same(again.R, mounted.R)
        assert same(again.t_m, mounted.t_m)


def test_a_run_is_readable_while_it_is_written(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path / "run", manifest(), {"note.txt": b"x"})
    assert read_run(tmp_path / "run").samples == ()
    for index in range(3):
        written = writer.append(sample(index))
        run = read_run(tmp_path / "run")
        assert run.ended == ""
        assert not run.is_complete
        assert same(run.samples[-1], written)
    assert run.committed_stations() == {0}
    assert run.next_station() == 1
    writer.close("interrupted", "Ctrl-C")
    writer.close("completed")
    run = read_run(tmp_path / "run")
    assert (run.ended, run.end_reason) == ("interrupted", "Ctrl-C")
    assert (tmp_path / "run" / "setup" / "note.txt").read_bytes() == b"x"
    assert not (tmp_path / "run" / ".reserve").exists()


def test_a_torn_last_line_is_dropped_and_cut_on_reopening(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path / "run", manifest(), {})
    for index in range(3):
        writer.append(sample(index))
    journal = tmp_path / "run" / "samples.jsonl"
    with journal.open("ab") as stream:
        stream.write(line_from_sample(sample(3)).encode()[:40])
    run = read_run(tmp_path / "run")
    assert len(run.samples) == 3
    assert "torn" in run.remarks[0]
    again = RunWriter.reopen(run, 0)
    assert again.clock_offset_ns > run.samples[-1].t_ns
    assert again.attempt_of(0) == 0
    assert again.attempt_of(1) == 1
    again.begin_again(Seam("2026-01-01T01:00:00.000Z", 10, -5, again.sample_count, 0, 1e-5, 1e-4))
    for index in (3, 4):
        again.append(sample(index, station=1, attempt=1))
    again.close("completed")
    read = read_run(tmp_path / "run")
    assert [s.index for s in read.samples] == [0, 1, 3, 4]
    assert read.seams[0].first_index == 3
    assert read.remarks == ()


def test_a_broken_line_before_the_last_is_an_error(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path / "run", manifest(), {})
    writer.append(sample(0))
    journal = tmp_path / "run" / "samples.jsonl"
    journal.write_bytes(b'{"index": 0}\n' + journal.read_bytes())
    with pytest.raises(RunError, match=r"samples\.jsonl: line 1 is no sample"):
        read_run(tmp_path / "run")


def test_missing_folder_foreign_folder_and_unknown_schema_are_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="nowhere: no such run folder"):
        read_run(tmp_path / "nowhere")
    with pytest.raises(RunError, match=r"has no run\.toml"):
        read_run(tmp_path)
    RunWriter.create(tmp_path / "run", manifest(), {})
    toml = tmp_path / "run" / "run.toml"
    toml.write_text(toml.read_text().replace("schema = 1", "schema = 9"))
    with pytest.raises(RunError, match="schema is 9, this program reads 1"):
        read_run(tmp_path / "run")
    with pytest.raises(RunError, match="exists already"):
        RunWriter.create(tmp_path / "run", manifest(), {})


@pytest.mark.opencv
def test_pictures_are_kept_losslessly_and_only_the_worst_if_so_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2

    monkeypatch.setattr(run_writer, "_WORST_COUNT", 3)
    rng = np.random.default_rng(1)
    image = rng.integers(0, 2**16, (12, 16), dtype=np.uint16)
    rms = [0.1, 0.5, 0.2, 0.4, 0.3, 0.05]
    for keep, expected in (("all", range(7)), ("worst", (1, 3, 4, 6)), ("none", ())):
        path = tmp_path / keep
        writer = RunWriter.create(path, manifest(keep=keep), {})
        for index, value in enumerate(rms):
            writer.append(sample(index, pose_estimate(rng, value)), image)
        writer.append(sample(6, miss()), image)
        run = read_run(path)
        assert [s.index for s in run.samples if s.capture_file] == list(expected)
        for s in run.samples:
            if s.capture_file:
                assert np.array_equal(cv2.imread(str(path / s.capture_file), cv2.IMREAD_UNCHANGED), image)


def test_a_full_disk_is_an_error_and_the_run_still_closes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = RunWriter.create(tmp_path / "run", manifest(), {})
    writer.append(sample(0))
    room = 100

    def nearly_full(stream: object, content: memoryview) -> None:
        stream.write(content[:room])  # type: ignore[attr-defined]
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(run_writer, "_write_whole", nearly_full)
    with pytest.raises(RunError, match="the disk is full"):
        writer.append(sample(1))
    with pytest.raises(RunError, match="the disk is full"):
        writer.check()
    writer.close("failed", "the disk is full")
    run = read_run(tmp_path / "run")
    assert (run.ended, len(run.samples)) == ("failed", 1)


def test_the_wire_log_never_raises_but_its_failure_is_not_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = RunWriter.create(tmp_path / "run", manifest(), {})
    writer.wire(12, ">", "G0 X1\r\n")
    assert (tmp_path / "run" / "gantry.log").read_text() == "12 > G0 X1\\r\\n\n"

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(run_writer, "_write_whole", full)
    writer.wire(13, "<", "ok")
    with pytest.raises(RunError, match="disk is full"):
        writer.check()


def test_toml_text_refuses_what_it_cannot_say_and_round_trips_the_rest() -> None:
    tables = {
        "a": 1, "b": [[1.5, 1e-320], [math.inf]], "empty": [], "t": {"x y": True, "deep": {"k": "v\n"}},
        "list": [{"n": 1, "inner": {"m": 2}}, {"n": 2}],
    }  # fmt: skip
    assert tomllib.loads(toml_text(tables)) == tables
    assert tomllib.loads(toml_text({"a": None, "b": 1})) == {"b": 1}
    with pytest.raises(TypeError, match=r"t\.bad"):
        toml_text({"t": {"bad": object()}})


def test_a_journal_cut_anywhere_is_read_up_to_the_cut_and_goes_on(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path / "run", manifest(station_count=2), {})
    for index in range(3):
        writer.append(sample(index))
    journal = tmp_path / "run" / "samples.jsonl"
    content = journal.read_bytes()
    ends = [i + 1 for i, byte in enumerate(content) if byte == 0x0A]
    for cut in sorted({*range(0, len(content), 97), *ends, *(end - 1 for end in ends)}):
        journal.write_bytes(content[:cut])
        run = read_run(tmp_path / "run")
        assert len(run.samples) == sum(end <= cut for end in ends)
        again = RunWriter.reopen(run, 0)
        again.append(sample(again.sample_count, station=1, attempt=again.attempt_of(1)))
        read = read_run(tmp_path / "run")
        assert read.remarks == ()
        assert len({s.index for s in read.samples}) == len(read.samples)
