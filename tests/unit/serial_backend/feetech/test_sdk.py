"""Feetech's SDK, by PyPI `feetech-servo-sdk`, talks to emulated servos over a pseudo terminal, as to real ones.

The package exists as source alone, which our lock of built packages cannot hold: without it these tests are skipped.
"""

from collections.abc import Iterator
from typing import Any

import pytest

from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_serial_backend.feetech import registers as at
from snakesim_serial_backend.feetech.backend import FeetechBackend
from snakesim_serial_backend.feetech.emulator import MODEL
from snakesim_serial_backend.feetech.packets import ServoError
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_serial_backend.wire import PseudoTerminal
from snakesim_testing.hal.small_robots import make_run_config

sdk: Any = pytest.importorskip("scservo_sdk", reason="PyPI `feetech-servo-sdk` is not installed")
JOINTS = 3
STEP_S = 0.01


class Bench:
    """Emulated servos, and the SDK's port on them. Time is the test's."""

    def __init__(self) -> None:
        config = make_run_config(backend="feetech", robot__chain__modules=JOINTS, rate_hz=100)
        self.clock = DriverClock(config)
        self.pty = PseudoTerminal()
        settings = FeetechSettings(physics_model="inertia")
        self.emulator = FeetechBackend.make_robot_emulator(
            config, settings, [self.pty], self.clock, None
        )
        self.port = self._make_port()
        self.packets = sdk.PacketHandler(0)  # little-endian words, as STS servos have them

    def _make_port(self) -> Any:
        bench = self

        class Port(sdk.PortHandler):
            """The SDK's port; nothing more comes when all is read that the servos have sent."""

            read_bytes = 0

            def clearPort(self) -> None:  # noqa: N802
                while self.read_bytes < bench.pty.sent_bytes:
                    self.readPort(1000)

            def writePort(self, packet: list[int]) -> int:  # noqa: N802
                written = super().writePort(packet) or 0
                bench.pty.expected_bytes = (bench.pty.expected_bytes or 0) + written
                bench.emulator()
                return written

            def readPort(self, length: int) -> bytes:  # noqa: N802
                data = super().readPort(length)
                self.read_bytes += len(data)
                return data

            def isPacketTimeout(self) -> bool:  # noqa: N802
                return self.read_bytes >= bench.pty.sent_bytes

        port = Port(self.pty.path)
        assert port.setBaudRate(1_000_000)
        return port

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.clock.robot_time_ns += round(STEP_S * 1e9)
            self.emulator()

    def position(self, servo: int) -> int:
        value, result, _ = self.packets.read2ByteTxRx(self.port, servo, at.PRESENT)
        assert result == sdk.COMM_SUCCESS
        return value

    def close(self) -> None:
        self.port.closePort()
        self.emulator.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    one = Bench()
    yield one
    one.close()


def test_sdk_ping_returns_the_model(bench: Bench) -> None:
    assert bench.packets.ping(bench.port, 2) == (MODEL, sdk.COMM_SUCCESS, 0)
    assert bench.packets.ping(bench.port, 9)[1] == sdk.COMM_RX_TIMEOUT


def test_sdk_goals_move_all_servos_and_sync_reads_return_positions(bench: Bench) -> None:
    before = [bench.position(servo) for servo in (1, 2, 3)]
    goals = sdk.GroupSyncWrite(bench.port, bench.packets, at.GOALS, 2)
    for servo, position in zip((1, 2, 3), before, strict=True):
        assert goals.addParam(servo, list((position + 50 * servo).to_bytes(2, "little")))
    assert goals.txPacket() == sdk.COMM_SUCCESS
    bench.position(1)  # the answer comes after the goals
    bench.pass_time(1.0)
    read = sdk.GroupSyncRead(bench.port, bench.packets, at.PRESENT, 4)
    for servo in (1, 2, 3):
        read.addParam(servo)
    assert read.txRxPacket() == sdk.COMM_SUCCESS
    moved = [
        read.getData(servo, at.PRESENT, 2) - start
        for servo, start in zip((1, 2, 3), before, strict=True)
    ]
    assert moved == pytest.approx([50, 100, 150], abs=15)


def test_servos_hold_their_last_goal_without_the_sdk(bench: Bench) -> None:
    """They have no watchdog, and the emulator does not invent one."""
    bench.packets.write2ByteTxRx(bench.port, 1, at.GOALS, bench.position(1) + 100)
    bench.pass_time(3.0)
    assert bench.emulator.servos[0].is_torque_on
    goal = bench.emulator.servos[0].read_word(at.GOALS)
    assert bench.position(1) == pytest.approx(goal, abs=15)


def test_eeprom_changes_only_with_open_lock_and_torque_off(bench: Bench) -> None:
    write = bench.packets.write1ByteTxRx
    write(bench.port, 1, at.DELAY, 0)
    assert bench.emulator.servos[0].table[at.DELAY] == 250, "locked"
    write(bench.port, 1, at.LOCK, 0)
    write(bench.port, 1, at.TORQUE_ENABLE, 1)
    write(bench.port, 1, at.DELAY, 0)
    assert bench.emulator.servos[0].table[at.DELAY] == 250, "torque is on"
    write(bench.port, 1, at.TORQUE_ENABLE, 0)
    write(bench.port, 1, at.DELAY, 0)
    assert bench.emulator.servos[0].table[at.DELAY] == 0


def test_sdk_reads_overheating_in_every_answer_and_torque_is_off(bench: Bench) -> None:
    bench.packets.write1ByteTxRx(bench.port, 1, at.TORQUE_ENABLE, 1)
    bench.emulator.inject(parse_injection("overheat:joint_1@0-9"), begins=True)
    bench.pass_time(0.1)
    value, result, error = bench.packets.read1ByteTxRx(bench.port, 1, at.TORQUE_ENABLE)
    assert (value, result, error) == (0, sdk.COMM_SUCCESS, ServoError.OVERHEATING)
