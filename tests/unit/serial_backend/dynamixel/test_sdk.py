"""The SDK of ROBOTIS commands emulated servos over a pseudo terminal, as it commands real ones."""

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
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend
from snakesim_serial_backend.dynamixel.emulator import FIRMWARE, MODEL, EmulatedDynamixel
from snakesim_serial_backend.dynamixel.packets import ALERT, DynamixelErrorCode
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.wire import PseudoTerminal
from snakesim_testing.hal.small_robots import make_run_config

SDK = Protocol2PacketHandler()
JOINTS = 3
STEP_S = 0.01


class SdkPort(PortHandler):
    """The port of the SDK. It times out exactly when it has read all that the servos have sent."""

    def __init__(self, pty: PseudoTerminal, emulator: EmulatedDynamixel) -> None:
        super().__init__(pty.path)
        self._pty = pty
        self._emulator = emulator
        self._read_bytes = 0
        assert self.setBaudRate(1_000_000)

    def clearPort(self) -> None:  # noqa: N802
        while self._read_bytes < self._pty.sent_bytes:
            self.readPort(1000)

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        written = super().writePort(packet) or 0
        self._pty.expected_bytes = (self._pty.expected_bytes or 0) + written
        self._emulator()
        return written

    def readPort(self, length: int) -> bytes:  # noqa: N802
        data = super().readPort(length)
        self._read_bytes += len(data)
        return data

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self._read_bytes >= self._pty.sent_bytes


class ServoRig:
    """Emulated servos, and a port of the SDK to them. The test advances the time."""

    def __init__(self) -> None:
        config = make_run_config(backend="dynamixel", robot__chain__modules=JOINTS, rate_hz=100)
        self.clock = DriverClock(config)
        self.pty = PseudoTerminal()
        self.emulator: EmulatedDynamixel = DynamixelBackend.make_robot_emulator(
            config, DynamixelSettings(physics_model="inertia"), [self.pty], self.clock, None
        )
        self.port = SdkPort(self.pty, self.emulator)

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.clock.robot_time_ns += round(STEP_S * 1e9)
            self.emulator()

    def enable_servos(self) -> None:
        """Switch the torque of all servos on, in the mode of current-based position."""
        for servo in range(1, JOINTS + 1):
            assert SDK.write1ByteTxRx(self.port, servo, registers.OPERATING_MODE, 5) == (
                COMM_SUCCESS,
                0,
            )
            assert SDK.write2ByteTxRx(self.port, servo, registers.GAINS, 3000) == (COMM_SUCCESS, 0)
            assert SDK.write1ByteTxRx(self.port, servo, registers.TORQUE_ENABLE, 1) == (
                COMM_SUCCESS,
                0,
            )

    def read_position(self, servo: int) -> int:
        value, result, _ = SDK.read4ByteTxRx(self.port, servo, registers.PRESENT + 6)
        assert result == COMM_SUCCESS
        return value

    def close(self) -> None:
        self.port.closePort()
        self.emulator.close()


@pytest.fixture
def rig() -> Iterator[ServoRig]:
    opened = ServoRig()
    yield opened
    opened.close()


def test_sdk_ping_and_broadcast_ping_are_answered(rig: ServoRig) -> None:
    assert SDK.ping(rig.port, 2) == (MODEL, COMM_SUCCESS, 0)
    assert SDK.ping(rig.port, 9)[1] == COMM_RX_TIMEOUT
    answers, result = SDK.broadcastPing(rig.port)
    assert result == COMM_SUCCESS
    assert answers == {servo: [MODEL, FIRMWARE] for servo in (1, 2, 3)}


def test_sdk_goals_move_all_servos_and_sync_reads_return_positions(rig: ServoRig) -> None:
    rig.enable_servos()
    start_positions = [rig.read_position(servo) for servo in (1, 2, 3)]
    goals = GroupSyncWrite(rig.port, SDK, registers.GOAL_POSITION, 4)
    for servo, position in zip((1, 2, 3), start_positions, strict=True):
        goals.addParam(servo, list((position + 100 * servo).to_bytes(4, "little", signed=True)))
    assert goals.txPacket() == COMM_SUCCESS
    rig.read_position(1)  # the servo has received the goals when it answers
    rig.pass_time(1.0)
    reading = GroupSyncRead(rig.port, SDK, registers.PRESENT, 10)
    for servo in (1, 2, 3):
        reading.addParam(servo)
    for send_request in (reading.txRxPacket, reading.fastSyncRead):
        assert send_request() == COMM_SUCCESS
        distances = [
            reading.getData(servo, registers.PRESENT + 6, 4) - start
            for servo, start in zip((1, 2, 3), start_positions, strict=True)
        ]
        assert distances == pytest.approx([100, 200, 300], abs=15)


def test_sdk_fast_read_ends_at_a_silent_servo(rig: ServoRig) -> None:
    rig.emulator.inject(parse_injection("mute:joint_2@0-9"), begins=True)
    reading = GroupSyncRead(rig.port, SDK, registers.PRESENT, 10)
    for servo in (1, 2, 3):
        reading.addParam(servo)
    assert reading.txRxPacket() != COMM_SUCCESS
    assert reading.data_dict[1]
    assert not reading.data_dict[3]


def test_sdk_and_servo_refuse_the_same_writes(rig: ServoRig) -> None:
    port = rig.port
    assert SDK.write2ByteTxRx(port, 1, registers.MODEL, 7) == (
        COMM_SUCCESS,
        DynamixelErrorCode.ACCESS,
    )
    assert SDK.write1ByteTxRx(port, 1, registers.OPERATING_MODE, 9) == (
        COMM_SUCCESS,
        DynamixelErrorCode.RANGE,
    )
    assert SDK.write2ByteTxRx(port, 1, registers.GOALS, 3000) == (
        COMM_SUCCESS,
        DynamixelErrorCode.LIMIT,
    )
    rig.enable_servos()
    assert SDK.write1ByteTxRx(port, 1, registers.OPERATING_MODE, 3) == (
        COMM_SUCCESS,
        DynamixelErrorCode.ACCESS,
    ), "registers in EEPROM are locked while torque is on"


def test_sdk_watchdog_stops_a_servo_until_it_is_cleared(rig: ServoRig) -> None:
    rig.enable_servos()
    port = rig.port
    assert SDK.write1ByteTxRx(port, 1, registers.WATCHDOG, 5) == (COMM_SUCCESS, 0)
    start_position = rig.read_position(1)
    assert SDK.write4ByteTxRx(port, 1, registers.GOAL_POSITION, start_position + 2000) == (
        COMM_SUCCESS,
        0,
    )
    rig.pass_time(0.09)
    assert SDK.read1ByteTxRx(port, 1, registers.WATCHDOG)[0] == 5
    rig.pass_time(0.2)
    assert SDK.read1ByteTxRx(port, 1, registers.WATCHDOG)[0] == registers.TRIPPED
    stop_position = rig.read_position(1)
    assert SDK.write4ByteTxRx(port, 1, registers.GOAL_POSITION, start_position) == (
        COMM_SUCCESS,
        DynamixelErrorCode.RANGE,
    )
    rig.pass_time(1.0)
    assert abs(rig.read_position(1) - stop_position) < 200
    assert SDK.write1ByteTxRx(port, 1, registers.WATCHDOG, 0) == (COMM_SUCCESS, 0)
    assert SDK.write4ByteTxRx(port, 1, registers.GOAL_POSITION, start_position) == (COMM_SUCCESS, 0)


def test_sdk_alert_stays_in_answers_until_a_restart(rig: ServoRig) -> None:
    rig.enable_servos()
    port = rig.port
    rig.emulator.inject(parse_injection("overheat:joint_1@0-9"), begins=True)
    rig.pass_time(0.1)
    errors, result, status_error = SDK.read1ByteTxRx(port, 1, registers.HARDWARE_ERROR)
    assert errors == registers.HardwareError.OVERHEATING
    assert result == COMM_SUCCESS
    assert status_error & ALERT == ALERT
    assert SDK.read1ByteTxRx(port, 1, registers.TORQUE_ENABLE)[0] == 0
    assert (
        SDK.write1ByteTxRx(port, 1, registers.TORQUE_ENABLE, 1)[1] & ~ALERT
        == DynamixelErrorCode.FAILED
    )
    rig.emulator.inject(parse_injection("overheat:joint_1@0-9"), begins=False)
    rig.emulator.body.thermal.winding_temperature_c[:] = 20.0
    assert SDK.reboot(port, 1)[0] == COMM_SUCCESS
    assert SDK.ping(port, 1)[1] == COMM_RX_TIMEOUT
    rig.pass_time(0.6)
    assert SDK.read1ByteTxRx(port, 1, registers.HARDWARE_ERROR) == (0, COMM_SUCCESS, 0)
    assert SDK.read1ByteTxRx(port, 1, registers.OPERATING_MODE)[0] == 5, (
        "a restart keeps the operating mode"
    )
