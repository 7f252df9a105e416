"""What the simulated bench sees of the mock controller: where the motors are and were, and which way they came."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest

from tests.helpers.grbl_ports import linear_axes
from uvgs_bench.devices.clock import ScaledClock
from uvgs_bench.devices.gantry import Axis, Envelope, open_gantry
from uvgs_bench.devices.sim.grbl_device import RX_BYTES, GrblDevice
from uvgs_bench.devices.sim.grbl_motors import Motors
from uvgs_bench.devices.sim.protocol_sim import Serial
from uvgs_bench.units import ns_from_s


class Host:
    """Sends lines at chosen times."""

    def __init__(self, device: GrblDevice) -> None:
        self.device = device
        self.t_s = 0.0
        self.wait(1.0)

    def wait(self, duration_s: float) -> list[str]:
        self.t_s += duration_s
        return self.device.take_output(self.t_ns).decode().split("\r\n")[:-1]

    @property
    def t_ns(self) -> int:
        return ns_from_s(self.t_s)

    def send(self, text: str, wait_s: float = 0.1) -> list[str]:
        for byte in text.encode("latin-1"):
            self.device.receive(byte, self.t_ns)
        return self.wait(wait_s)


@pytest.fixture
def host() -> Host:
    host = Host(GrblDevice.for_axes(linear_axes()))
    assert host.send("$H\n", 60.0) == ["ok"]
    return host


def test_after_homing_motor_positions_are_machine_positions(host: Host) -> None:
    np.testing.assert_allclose(host.device.position_at(host.t_ns), [-0.001] * 3, atol=1e-12)
    assert host.send("?")[0].startswith("<Idle|MPos:-1.000,-1.000,-1.000|Bf:15,128|FS:0,0")


def test_before_homing_the_controller_does_not_know_where_it_is() -> None:
    host = Host(GrblDevice.for_axes(linear_axes()))
    np.testing.assert_allclose(host.device.position_at(host.t_ns), [-0.05] * 3, atol=1e-12)
    assert "MPos:0.000,0.000,0.000" in host.send("?")[0]


def test_the_past_can_be_asked(host: Host) -> None:
    """From -1 to -101 mm at 50 mm/s and 200 mm/s^2: after 1 s it has gone 6.25 + 0.75 * 50 mm."""
    start_ns = host.t_ns
    host.send("$J=G90X-101F3000\n", 10.0)
    at = lambda t_s: host.device.position_at(start_ns + ns_from_s(t_s))[0]  # noqa: E731
    np.testing.assert_allclose([at(0.0), at(1.0), at(2.25), at(9.0)], [-0.001, -0.04475, -0.101, -0.101], atol=1e-9)
    np.testing.assert_allclose(host.device.velocity_at(start_ns + ns_from_s(1.0)), [-0.05, 0, 0], atol=1e-9)


def motors(host: Host) -> Motors:
    return host.device.motions_until(host.t_ns)


def test_motions_and_stops_are_counted(host: Host) -> None:
    stops, number = motors(host).stops_count(host.t_ns / 1e9), motors(host).number(host.t_ns / 1e9)
    begin_ns = host.t_ns
    host.send("$J=G91X-10Y-10F3000\n", 5.0)
    host.send("$J=G91X5F3000\n", 5.0)
    assert motors(host).number(host.t_ns / 1e9) == number + 2
    assert motors(host).number(begin_ns / 1e9 + 2.0) == number + 1
    # Homing leaves the carriage 1 mm off its switches.
    np.testing.assert_allclose(motors(host).start(number + 1), [-1.0] * 3, atol=1e-9)
    np.testing.assert_allclose(motors(host).start(number + 2), [-11.0, -11.0, -1.0], atol=1e-9)
    assert motors(host).stops_count(host.t_ns / 1e9) == stops + 2
    assert motors(host).stops_count(begin_ns / 1e9 + 0.1) == stops


def test_a_new_power_up_forgets_the_position_but_moves_nothing(host: Host) -> None:
    host.send("$J=G90X-50Y-40Z-30F3000\n", 10.0)
    host.send("$110=1234\n")
    host.device.power_cycle(host.t_ns)
    assert host.wait(1.0) == ["", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    assert "<Alarm|MPos:0.000,0.000,0.000" in host.send("?")[0]
    np.testing.assert_allclose(host.device.position_at(host.t_ns), [-0.05, -0.04, -0.03], atol=1e-12)
    assert "$110=1234.000" in host.send("$$\n")
    assert host.send("$H\n", 60.0) == ["ok"]
    np.testing.assert_allclose(host.device.position_at(host.t_ns), [-0.001] * 3, atol=1e-12)


def test_bytes_that_do_not_fit_the_receive_buffer_are_dropped(host: Host) -> None:
    host.send("G4P1\n", 0.0)
    assert host.send("\n" * (RX_BYTES + 50), 2.0) == ["ok"] * (RX_BYTES + 1)


def test_fifteen_blocks_fit_the_planner_and_the_sixteenth_waits(host: Host) -> None:
    host.send("G91\n")
    answers = host.send("G1X-1F60\n" * 10, 0.0) + host.send("G1X-1F60\n" * 8, 0.1)
    assert answers.count("ok") == 15
    assert "Bf:0," in host.send("?")[0]
    assert host.send("", 30.0).count("ok") == 3


def test_the_same_bytes_at_the_same_times_give_the_same_answers() -> None:
    def talk() -> list[list[str]]:
        host = Host(GrblDevice.for_axes(linear_axes()))
        talk = [host.send("$H\n", 30.0), host.send("$J=G90X-80F2000\n", 0.7), host.send("\x85?", 0.3)]
        return [*talk, host.send("?", 1.0), host.send("?")]

    assert talk() == talk()


def test_axes_above_zero_have_no_switch_and_no_soft_limit() -> None:
    turntable = Axis("A", "rotary", np.array([0.0, 0.0, 1.0]), -1.0, 1.0, 0.5, 2.0)
    device = GrblDevice.for_axes((*linear_axes(), turntable))
    assert device._switches[3] == inf
    host = Host(device)
    assert host.send("$H\n", 60.0) == ["ok"]
    assert host.send("$J=G90A45F1000\n", 10.0) == ["ok"]
    np.testing.assert_allclose(device.position_at(host.t_ns)[3], np.pi / 4, atol=1e-12)


def test_a_port_of_its_own_answers_and_keeps_to_its_timeout() -> None:
    port = Serial(None, timeout=0.5)
    port.port = "sim://?speed=100"
    port.open()
    assert port.read(200).endswith(b"unlock]\r\n")
    port.write(b"$I\n")
    assert port.read(4) == b"[VER"
    assert port.in_waiting >= 0
    port.reset_input_buffer()
    port.close()
    port.close()
    with pytest.raises(Exception, match="not open"):
        port.read(1)
    with pytest.raises(Exception, match="not open"):
        port.write(b"?")


def test_the_simulated_port_serves_the_driver_without_a_bench() -> None:
    clock = ScaledClock(200.0)
    with open_gantry("grbl:sim://?speed=200", Envelope(linear_axes()), clock=clock, log=lambda *_: None) as gantry:
        assert gantry.home().is_trusted
        assert gantry.port == "sim://?speed=200"
