"""The SDK of Feetech, PyPI `feetech-servo-sdk`, commands emulated servos over a pseudo terminal.

The package exists only as source, and our lock file contains only built packages. Without it, these tests are skipped.
"""

from collections.abc import Iterator
from typing import Any

import pytest

from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.backend import FeetechBackend
from snakesim_serial_backend.feetech.emulator import MODEL
from snakesim_serial_backend.feetech.packets import ServoError
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_serial_backend.wire import PseudoTerminal
from snakesim_testing.hal.small_robots import make_run_config

sdk: Any = pytest.importorskip("scservo_sdk", reason="PyPI `feetech-servo-sdk` is not installed")
JOINTS = 3
STEP_S = 0.01


class ServoRig:
    """Emulated servos, and a port of the SDK to them. The test advances the time."""

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
        rig = self

        class Port(sdk.PortHandler):
            """The port of the SDK. It times out exactly when it has read all that the servos have sent."""

            read_bytes = 0

            def clearPort(self) -> None:  # noqa: N802
                while self.read_bytes < rig.pty.sent_bytes:
                    self.readPort(1000)

            def writePort(self, packet: list[int]) -> int:  # noqa: N802
                written = super().writePort(packet) or 0
                rig.pty.expected_bytes = (rig.pty.expected_bytes or 0) + written
                rig.emulator()
                return written

            def readPort(self, length: int) -> bytes:  # noqa: N802
                data = super().readPort(length)
                self.read_bytes += len(data)
                return data

            def isPacketTimeout(self) -> bool:  # noqa: N802
                return self.read_bytes >= rig.pty.sent_bytes

        port = Port(self.pty.path)
        assert port.setBaudRate(1_000_000)
        return port

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.clock.robot_time_ns += round(STEP_S * 1e9)
            self.emulator()

    def read_position(self, servo: int) -> int:
        value, result, _ = self.packets.read2ByteTxRx(self.port, servo, registers.PRESENT)
        assert result == sdk.COMM_SUCCESS
        return value

    def close(self) -> None:
        self.port.closePort()
        self.emulator.close()


@pytest.fixture
def rig() -> Iterator[ServoRig]:
    opened = ServoRig()
    yield opened
    opened.close()


def test_sdk_ping_returns_the_model(rig: ServoRig) -> None:
    assert rig.packets.ping(rig.port, 2) == (MODEL, sdk.COMM_SUCCESS, 0)
    assert rig.packets.ping(rig.port, 9)[1] == sdk.COMM_RX_TIMEOUT


def test_sdk_goals_move_all_servos_and_sync_reads_return_positions(rig: ServoRig) -> None:
    start_positions = [rig.read_position(servo) for servo in (1, 2, 3)]
    goals = sdk.GroupSyncWrite(rig.port, rig.packets, registers.GOALS, 2)
    for servo, position in zip((1, 2, 3), start_positions, strict=True):
        assert goals.addParam(servo, list((position + 50 * servo).to_bytes(2, "little")))
    assert goals.txPacket() == sdk.COMM_SUCCESS
    rig.read_position(1)  # the servo has received the goals when it answers
    rig.pass_time(1.0)
    reading = sdk.GroupSyncRead(rig.port, rig.packets, registers.PRESENT, 4)
    for servo in (1, 2, 3):
        reading.addParam(servo)
    assert reading.txRxPacket() == sdk.COMM_SUCCESS
    distances = [
        reading.getData(servo, registers.PRESENT, 2) - start
        for servo, start in zip((1, 2, 3), start_positions, strict=True)
    ]
    assert distances == pytest.approx([50, 100, 150], abs=15)


def test_servos_hold_their_last_goal_without_the_sdk(rig: ServoRig) -> None:
    """Hold the goal without end, because these servos have no watchdog."""
    rig.packets.write2ByteTxRx(rig.port, 1, registers.GOALS, rig.read_position(1) + 100)
    rig.pass_time(3.0)
    assert rig.emulator.servos[0].is_torque_on
    goal = rig.emulator.servos[0].read_word(registers.GOALS)
    assert rig.read_position(1) == pytest.approx(goal, abs=15)


def test_eeprom_changes_only_with_open_lock_and_torque_off(rig: ServoRig) -> None:
    write_byte = rig.packets.write1ByteTxRx
    write_byte(rig.port, 1, registers.DELAY, 0)
    assert rig.emulator.servos[0].table[registers.DELAY] == 250, "the EEPROM is locked"
    write_byte(rig.port, 1, registers.LOCK, 0)
    write_byte(rig.port, 1, registers.TORQUE_ENABLE, 1)
    write_byte(rig.port, 1, registers.DELAY, 0)
    assert rig.emulator.servos[0].table[registers.DELAY] == 250, "torque is on"
    write_byte(rig.port, 1, registers.TORQUE_ENABLE, 0)
    write_byte(rig.port, 1, registers.DELAY, 0)
    assert rig.emulator.servos[0].table[registers.DELAY] == 0


def test_sdk_answer_of_overheated_servo_has_error_and_no_torque(rig: ServoRig) -> None:
    rig.packets.write1ByteTxRx(rig.port, 1, registers.TORQUE_ENABLE, 1)
    rig.emulator.inject(parse_injection("overheat:joint_1@0-9"), begins=True)
    rig.pass_time(0.1)
    value, result, error = rig.packets.read1ByteTxRx(rig.port, 1, registers.TORQUE_ENABLE)
    assert (value, result, error) == (0, sdk.COMM_SUCCESS, ServoError.OVERHEATING)
