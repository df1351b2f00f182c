"""ROBOTIS' own SDK talks to emulated servos, over a pseudo terminal, as to real ones."""

from collections.abc import Iterator

import pytest
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    PortHandler,
    Protocol2PacketHandler,
)

from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend
from snakesim_serial_backend.dynamixel.emulator import FIRMWARE, MODEL, EmulatedDynamixel
from snakesim_serial_backend.dynamixel.packets import ALERT, DynamixelErrorCode
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.wire import PseudoTerminal
from snakesim_testing.hal.small_robots import make_run_config

SDK = Protocol2PacketHandler()
JOINTS = 3
STEP_S = 0.01


class Port(PortHandler):
    """The SDK's port; nothing more comes when all is read that the servos have said, however busy the computer is."""

    def __init__(self, pty: PseudoTerminal, emulator: EmulatedDynamixel) -> None:
        super().__init__(pty.path)
        self._pty, self._emulator, self._read = pty, emulator, 0
        assert self.setBaudRate(1_000_000)

    def clearPort(self) -> None:  # noqa: N802
        while self._read < self._pty.sent_bytes:
            self.readPort(1000)

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        written = super().writePort(packet) or 0
        self._pty.expected_bytes = (self._pty.expected_bytes or 0) + written
        self._emulator()
        return written

    def readPort(self, length: int) -> bytes:  # noqa: N802
        data = super().readPort(length)
        self._read += len(data)
        return data

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self._read >= self._pty.sent_bytes


class Bench:
    """Emulated servos, and the SDK's port on them. Time is the test's."""

    def __init__(self) -> None:
        config = make_run_config(backend="dynamixel", robot__chain__modules=JOINTS, rate_hz=100)
        self.clock, self.pty = DriverClock(config), PseudoTerminal()
        self.emulator: EmulatedDynamixel = DynamixelBackend.make_robot_emulator(
            config, DynamixelSettings(physics_model="inertia"), [self.pty], self.clock, None
        )
        self.port = Port(self.pty, self.emulator)

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.clock.robot_time_ns += round(STEP_S * 1e9)
            self.emulator()

    def enable(self) -> None:
        for servo in range(1, JOINTS + 1):
            assert SDK.write1ByteTxRx(self.port, servo, at.OPERATING_MODE, 5) == (COMM_SUCCESS, 0)
            assert SDK.write2ByteTxRx(self.port, servo, at.GAINS, 3000) == (COMM_SUCCESS, 0)
            assert SDK.write1ByteTxRx(self.port, servo, at.TORQUE_ENABLE, 1) == (COMM_SUCCESS, 0)

    def position(self, servo: int) -> int:
        value, result, _ = SDK.read4ByteTxRx(self.port, servo, at.PRESENT + 6)
        assert result == COMM_SUCCESS
        return value

    def close(self) -> None:
        self.port.closePort()
        self.emulator.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    one = Bench()
    yield one
    one.close()


def test_sdk_ping_and_broadcast_ping_are_answered(bench: Bench) -> None:
    assert SDK.ping(bench.port, 2) == (MODEL, COMM_SUCCESS, 0)
    assert SDK.ping(bench.port, 9)[1] == COMM_RX_TIMEOUT
    found, result = SDK.broadcastPing(bench.port)
    assert result == COMM_SUCCESS
    assert found == {servo: [MODEL, FIRMWARE] for servo in (1, 2, 3)}


def test_sdk_goals_move_all_servos_and_sync_reads_return_positions(bench: Bench) -> None:
    bench.enable()
    before = [bench.position(servo) for servo in (1, 2, 3)]
    goals = GroupSyncWrite(bench.port, SDK, at.GOAL_POSITION, 4)
    for servo, position in zip((1, 2, 3), before, strict=True):
        goals.addParam(servo, list((position + 100 * servo).to_bytes(4, "little", signed=True)))
    assert goals.txPacket() == COMM_SUCCESS
    bench.position(1)  # the answer comes after the goals
    bench.pass_time(1.0)
    read = GroupSyncRead(bench.port, SDK, at.PRESENT, 10)
    for servo in (1, 2, 3):
        read.addParam(servo)
    for ask in (read.txRxPacket, read.fastSyncRead):
        assert ask() == COMM_SUCCESS
        moved = [
            read.getData(servo, at.PRESENT + 6, 4) - was
            for servo, was in zip((1, 2, 3), before, strict=True)
        ]
        assert moved == pytest.approx([100, 200, 300], abs=15)


def test_sdk_fast_read_ends_at_a_silent_servo(bench: Bench) -> None:
    bench.emulator.inject(parse_injection("mute:joint_2@0-9"), begins=True)
    read = GroupSyncRead(bench.port, SDK, at.PRESENT, 10)
    for servo in (1, 2, 3):
        read.addParam(servo)
    assert read.txRxPacket() != COMM_SUCCESS
    assert read.data_dict[1]
    assert not read.data_dict[3]


def test_sdk_and_servo_refuse_the_same_writes(bench: Bench) -> None:
    port = bench.port
    assert SDK.write2ByteTxRx(port, 1, at.MODEL, 7) == (COMM_SUCCESS, DynamixelErrorCode.ACCESS)
    assert SDK.write1ByteTxRx(port, 1, at.OPERATING_MODE, 9) == (
        COMM_SUCCESS,
        DynamixelErrorCode.RANGE,
    )
    assert SDK.write2ByteTxRx(port, 1, at.GOALS, 3000) == (COMM_SUCCESS, DynamixelErrorCode.LIMIT)
    bench.enable()
    assert SDK.write1ByteTxRx(port, 1, at.OPERATING_MODE, 3) == (
        COMM_SUCCESS,
        DynamixelErrorCode.ACCESS,
    ), "torque is on"


def test_the_watchdog_stops_a_servo_until_it_is_cleared(bench: Bench) -> None:
    bench.enable()
    port = bench.port
    assert SDK.write1ByteTxRx(port, 1, at.WATCHDOG, 5) == (COMM_SUCCESS, 0)
    start = bench.position(1)
    assert SDK.write4ByteTxRx(port, 1, at.GOAL_POSITION, start + 2000) == (COMM_SUCCESS, 0)
    bench.pass_time(0.09)
    assert SDK.read1ByteTxRx(port, 1, at.WATCHDOG)[0] == 5
    bench.pass_time(0.2)
    assert SDK.read1ByteTxRx(port, 1, at.WATCHDOG)[0] == at.TRIPPED
    stopped = bench.position(1)
    assert SDK.write4ByteTxRx(port, 1, at.GOAL_POSITION, start) == (
        COMM_SUCCESS,
        DynamixelErrorCode.RANGE,
    )
    bench.pass_time(1.0)
    assert abs(bench.position(1) - stopped) < 200
    assert SDK.write1ByteTxRx(port, 1, at.WATCHDOG, 0) == (COMM_SUCCESS, 0)
    assert SDK.write4ByteTxRx(port, 1, at.GOAL_POSITION, start) == (COMM_SUCCESS, 0)


def test_sdk_alert_stays_in_answers_until_a_restart(bench: Bench) -> None:
    bench.enable()
    port = bench.port
    bench.emulator.inject(parse_injection("overheat:joint_1@0-9"), begins=True)
    bench.pass_time(0.1)
    errors, result, said = SDK.read1ByteTxRx(port, 1, at.HARDWARE_ERROR)
    assert errors == at.HardwareError.OVERHEATING
    assert result == COMM_SUCCESS
    assert said & ALERT == ALERT
    assert SDK.read1ByteTxRx(port, 1, at.TORQUE_ENABLE)[0] == 0
    assert SDK.write1ByteTxRx(port, 1, at.TORQUE_ENABLE, 1)[1] & ~ALERT == DynamixelErrorCode.FAILED
    bench.emulator.inject(parse_injection("overheat:joint_1@0-9"), begins=False)
    bench.emulator.body.thermal.winding_temperature_c[:] = 20.0
    assert SDK.reboot(port, 1)[0] == COMM_SUCCESS
    assert SDK.ping(port, 1)[1] == COMM_RX_TIMEOUT
    bench.pass_time(0.6)
    assert SDK.read1ByteTxRx(port, 1, at.HARDWARE_ERROR) == (0, COMM_SUCCESS, 0)
    assert SDK.read1ByteTxRx(port, 1, at.OPERATING_MODE)[0] == 5, "kept"
