"""The firmware for tests: built once, run in lockstep with the test's time, natively or as AVR code in simavr."""

from __future__ import annotations

import fcntl
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
_NS_PER_US = 1000


KINDS = ["native", "avr"]
TOOLS = {
    "host": ["g++", "make"],
    "avr": ["avr-g++", "make"],
    "size": ["avr-g++", "make"],
    "simavr": ["g++", "make"],
    "test": ["g++", "make"],
}


def build(target: str, into: Path) -> str:
    """Run a target of the firmware's Makefile; its output.

    Fails with what the tools said. Without the tools the test is skipped, which CI takes for a failure.
    """
    missing = [tool for tool in TOOLS[target] if shutil.which(tool) is None]
    if target == "simavr" and not Path("/usr/include/simavr/sim_avr.h").exists():
        missing.append("libsimavr-dev")
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)} (Debian: gcc-avr avr-libc libsimavr-dev g++ make)")
    with (into / f"{target}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(
            ["make", "-C", str(FIRMWARE), target, f"BUILD={into}"],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@dataclass(frozen=True)
class Table:
    """What stands on the table, counted from the pins of the board."""

    t_us: int
    motor_steps: tuple[int, int, int]
    led_duty: int
    trigger_pulses: int
    motors_on: bool

    @classmethod
    def read(cls, line: str) -> Self:
        words = line.removeprefix("S ").split()
        t_us, x, y, z, duty, pulses, motors = (int(word) for word in words[:7])
        return cls(t_us, (x, y, z), duty, pulses, bool(motors))


class BoardProgram:
    """A virtual board as a program: commands of ``firmware/host/desk.h`` in, answers out, a line each."""

    def __init__(self, command: list[str]) -> None:
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def table(self) -> Table:
        """What the pins say now."""
        self._tell("Q")
        return Table.read(self._answer())

    def turn_by_hand(self, *steps: int) -> None:
        """Turn the motors behind the firmware's back."""
        self._tell("M " + " ".join(map(str, steps)))

    def close(self) -> None:
        """End the program."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(20)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _tell(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, f"the board's program ended with {self._process.wait(10)}"
        return line.rstrip("\n")


class LockstepBoard(BoardProgram):
    """A board that runs exactly as long as it is told; speaks to ``replay`` as the mock controller does."""

    def __init__(self, command: list[str], boot_us: int = 50_000) -> None:
        super().__init__([*command, "--lockstep"])
        self.t_us = 0
        self._offset_us = 0
        self._unfinished = b""
        self.greeting = self.run_until_us(boot_us).decode("ascii")
        # The time of a conversation begins when the board is up.
        self._offset_us = boot_us

    def receive(self, byte: int, t_ns: int) -> None:
        """A byte reaches the board at an instant of the conversation."""
        self._tell(f"B {t_ns // _NS_PER_US + self._offset_us} {byte:02X}")

    def take_output(self, t_ns: int) -> bytes:
        """Let the board run until an instant of the conversation; the whole lines it said meanwhile."""
        self._unfinished += self.run_until_us(t_ns // _NS_PER_US + self._offset_us)
        end = self._unfinished.rfind(b"\n") + 1
        lines, self._unfinished = self._unfinished[:end], self._unfinished[end:]
        return lines

    def begin_conversation(self) -> None:
        """Instants of a conversation count from now."""
        self._offset_us = self.t_us

    def run_until_us(self, t_us: int) -> bytes:
        """Let the board run until an instant of its own time."""
        self.t_us = max(self.t_us, t_us)
        self._tell(f"A {self.t_us}")
        return bytes.fromhex(self._answer().removeprefix("O ").strip())

    def say(self, line: str, for_ms: int = 100) -> list[str]:
        """Send a line and let the board run; the lines it said."""
        return self.send(line.encode("ascii") + b"\n", for_ms)

    def send(self, data: bytes, for_ms: int = 100) -> list[str]:
        """Send bytes and let the board run; the lines it said."""
        if data:
            self._tell(f"B {self.t_us} {data.hex()}")
        received = self.run_until_us(self.t_us + for_ms * 1000)
        return [line for line in received.decode("ascii").replace("\r\n", "\n").split("\n") if line]

    def do(self, command: str, for_ms: int = 100) -> list[str]:
        """Do something to the board, as written in ``firmware/host/desk.h``, and let it run; the lines it said."""
        self._tell(command)
        return self.send(b"", for_ms)

    def step_intervals(self) -> tuple[int, int, int, int, int]:
        """Since the last call: count, least, median and most cycles between X steps; cycles of the longest pulse."""
        self._tell("J")
        count, least, median, most, pulse = (int(word) for word in self._answer().split()[1:])
        return count, least, median, most, pulse


class FirmwareBuilds:
    """The firmware's programs, each built when first asked for.

    Args:
        directory: Where they are built.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._outputs: dict[str, str] = {}

    def output(self, target: str) -> str:
        """What the Makefile said about a target."""
        if target not in self._outputs:
            self._outputs[target] = build(target, self.directory)
        return self._outputs[target]

    def command(self, kind: str) -> list[str]:
        """The command of a board: ``native`` or ``avr``."""
        if kind == "native":
            self.output("host")
            return [str(self.directory / "uvgs_board")]
        self.output("avr")
        self.output("simavr")
        return [str(self.directory / "avr_runner"), str(self.directory / "uvgs_gantry.elf")]

    def board(self, kind: str, *options: str) -> LockstepBoard:
        """A board just powered up."""
        return LockstepBoard([*self.command(kind), *options])
