"""The controller's clock against the bench clock: a line through timed questions, with doubts that hold."""

from __future__ import annotations

from binascii import crc_hqx

import numpy as np
import pytest

from tests.helpers.grbl_ports import MockGantry, linear_axes
from uvgs_bench.devices.gantry import Envelope
from uvgs_bench.devices.gantry.controller_clock import ClockFit, fit_clock
from uvgs_bench.devices.gantry.grbl_link import Exchange
from uvgs_bench.devices.gantry.grbl_protocol import Message, read_place
from uvgs_bench.devices.sim.grbl_uvgs import UvgsDevice
from uvgs_bench.errors import GantryError

RATE = 1.003  # a ceramic resonator is off by some parts in a thousand
START_NS = 7_000_000_000_123


def exchanges(seed: int, count: int = 50, jitter_s: float = 1e-3, held_up: float = 0.0) -> list[Exchange]:
    """Questions ten times a second; each way takes 0.3 ms and up to ``jitter_s`` more, some 30 ms more."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        asked_s = 0.1 * k
        there_s, back_s = 3e-4 + rng.uniform(0.0, jitter_s, 2) + 0.03 * (rng.random(2) < held_up)
        out.append(
            Exchange(
                START_NS + round(1e9 * asked_s),
                START_NS + round(1e9 * (asked_s + there_s + back_s)),
                1e6 * (asked_s + there_s) / RATE,
            )
        )
    return out


def error_s(fit: ClockFit, controller_us: float) -> float:
    return (fit.bench_ns(controller_us) - START_NS) / 1e9 - controller_us / 1e6 * RATE


def test_fifty_questions_with_a_millisecond_of_jitter() -> None:
    offsets, z, rates = [], [], []
    for seed in range(200):
        fit = fit_clock(exchanges(seed))
        offset = error_s(fit, fit.reference_us)
        offsets.append(offset)
        z.append(offset / fit.offset_sigma_s)
        rates.append((fit.rate - RATE) / fit.rate_sigma)
        assert abs(offset) <= fit.bound_s
    assert np.max(np.abs(offsets)) < 2e-4
    # 200 intervals of 95 % cover 95 +- 1.5 %; three times that.
    assert np.mean(np.abs(z) < 1.96) > 0.90
    assert np.mean(np.abs(rates) < 1.96) > 0.90


def test_questions_that_were_held_up_are_left_out() -> None:
    fit = fit_clock(exchanges(1, held_up=0.1))
    assert fit.used_count < 50
    # At the ends of 5 s as in the middle.
    for controller_us in (0.0, 2.5e6, 5e6):
        assert abs(error_s(fit, controller_us)) < 2e-4
        assert fit.sigma_s(controller_us) < 2e-4


def test_too_few_are_refused() -> None:
    with pytest.raises(GantryError, match="5 exchanges"):
        fit_clock(exchanges(1)[:4])
    with pytest.raises(GantryError, match="one instant"):
        fit_clock([Exchange(0, 1000, 5.0)] * 9)


def test_a_damaged_stamp_is_no_stamp() -> None:
    assert read_place(Message("POS", "0|Idle|12345|1,2,3|0|-|-|-|1*0000")) is None
    assert read_place(Message("POS", "garbage")) is None
    for body, is_whole in (("0|Idle|12345|1,2,3|0|-|-|-|1", True), ("0|Idle|12345|1,2,x|0|-|-|-|1", False)):
        check = f"{crc_hqx(f'POS:{body}'.encode('ascii'), 0xFFFF):04X}"
        assert (read_place(Message("POS", f"{body}*{check}")) is not None) == is_whole


@pytest.fixture
def ours(monkeypatch: pytest.MonkeyPatch):
    axes = linear_axes()
    device = UvgsDevice.for_axes(axes)
    device.clock_rate = 1.0 / RATE
    mock = MockGantry(monkeypatch, device, Envelope(axes))
    yield mock
    mock.gantry.close()


def test_our_firmware_tells_its_time(ours: MockGantry) -> None:
    said = []
    for _ in range(50):
        said.append(ours.gantry.exchange())
        ours.clock.sleep(0.1)
    fit = fit_clock(said)
    assert fit.rate == pytest.approx(RATE, abs=1e-5)
    # The mock's clock starts with bench time 0; 0.2 ms is what is asked for.
    assert abs(fit.bench_ns(1e6) / 1e9 - RATE) < 2e-4


def test_other_controllers_have_no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    assert MockGantry(monkeypatch).gantry.exchange() is None


def test_a_recorded_move_is_where_the_motors_were(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = MockGantry(monkeypatch)
    mock.gantry.home()
    with mock.gantry.recording() as positions:
        mock.gantry.move_to([-0.05, -0.02, -0.03], 0.03)
    # The stepped clock of these tests looks every 50 ms.
    assert len(positions) > 15
    stamps = [p.t_ns for p in positions]
    assert stamps == sorted(stamps)
    moving = 0
    for stamped in positions:
        early, late = (mock.device.position_at(stamped.t_ns + d) for d in (-stamped.doubt_ns, stamped.doubt_ns))
        low, high = np.minimum(early, late), np.maximum(early, late)
        # m; half a step and the last digit.
        assert np.all(stamped.position >= low - 2.5e-6)
        assert np.all(stamped.position <= high + 2.5e-6)
        moving += bool(np.any(high - low > 1e-6))
    assert moving > 10
    assert max(p.doubt_ns for p in positions) < 5_000_000


def test_a_recorded_move_of_our_firmware_has_the_times_of_its_clock(ours: MockGantry) -> None:
    """Answers are held up by 0 to 60 ms: the host's times scatter by that, the controller's do not."""
    ours.gantry.home()
    rng = np.random.default_rng(4)
    heard = ours.gantry._link.wire.read_line

    def late(deadline_ns: int) -> str | None:
        line = heard(deadline_ns)
        if line is not None and line.startswith("[POS"):
            ours.clock.sleep(0.06 * float(rng.random()) ** 2)
        return line

    ours.gantry._link.wire.read_line = late  # type: ignore[method-assign]
    with ours.gantry.recording() as positions:
        ours.gantry.move_to([-0.05, -0.02, -0.03], 0.03)
    assert len(positions) > 10
    doubt_s = np.array([p.doubt_ns for p in positions]) / 1e9
    # s; the quickest of the answers bounds all of them.
    assert np.median(doubt_s) < 0.01
    along = np.array([-0.05, -0.02, -0.03]) / np.linalg.norm([-0.05, -0.02, -0.03])
    for stamped in positions:
        early, late_m = (
            ours.device.position_at(stamped.t_ns + d) @ along for d in (-stamped.doubt_ns, stamped.doubt_ns)
        )
        # m; half a step on each axis.
        assert early - 4e-6 <= stamped.position @ along <= late_m + 4e-6
