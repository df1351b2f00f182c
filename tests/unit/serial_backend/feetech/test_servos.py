"""The Feetech driver commands emulated servos in lockstep, through the lifecycle states of a robot.

`tests/contract/test_can_driver_types.py` tests errors, restarts and lost joints.
"""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from snakesim_drivers.kit.mixed import MixedBackend
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.programs.preflight import apply_backend_modes
from snakesim_hal.wire.messages import JointMode
from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.backend import FeetechBackend
from snakesim_serial_backend.feetech.emulator import EmulatedFeetech, EmulatedFeetechServo
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_testing.benches.emulated_drives import DrivesOfAnyType
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

JOINTS = 4
RATE_HZ = 100  # one tick is 10 ms
ALL_ON = [True] * JOINTS
ALL_OFF = [False] * JOINTS

# Durations in ticks.
FAULT_REPORT_TICKS = 10  # until a fault is reported: each servo reports its state every fourth tick
ARM_TICKS = 20  # until all servos of an armed robot have their torque
OFF_TICKS = 3  # until the torque of all servos is off
RESET_TICKS = 20  # until a disarmed robot has reset its faults
REARM_TICKS = 30  # until all servos have their torque again after a stop
REAL_PORTS = ["/dev/ttyACM0"]  # such a port may have real servos
EMULATED_PORTS = ["/dev/pts/7"]  # pseudo terminals have none


class ServoRobot(DriveRig):
    """A robot with a Feetech backend and its emulated servos."""

    def __init__(self, settings: FeetechSettings | None = None, **dotted: Any) -> None:
        config = make_run_config(
            backend="feetech", robot__chain__modules=JOINTS, rate_hz=RATE_HZ, **dotted
        )
        config = apply_backend_modes(config, FeetechBackend)
        settings = settings or FeetechSettings(physics_model="inertia", bring_up_limit_s=0.5)
        super().__init__(config, FeetechBackend(config, settings))
        self._observed_drives = DrivesOfAnyType(self.backend)

    @property
    def emulator(self) -> EmulatedFeetech:
        return drives_of(self.backend)._emulator

    def list_torque_states(self) -> list[bool]:
        """Return for each servo whether its torque is on."""
        return [servo.is_torque_on for servo in self.emulator.servos]

    def pause_driver(self, seconds: float) -> None:
        """Let time pass at the servos while the driver is paused."""
        self._observed_drives.freeze_driver(seconds, lambda _seconds: None)
        self.tick += round(seconds * RATE_HZ)


@pytest.fixture
def robot() -> Iterator[ServoRobot]:
    opened = ServoRobot()
    yield opened
    opened.backend.close()


@pytest.fixture
def change_delivered_servos(
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[Callable[[list[EmulatedFeetechServo]], None]], None]:
    """Return a function that changes the servos of later robots, before the driver finds them."""

    create_emulator = EmulatedFeetech.__init__

    def change_servos(change: Callable[[list[EmulatedFeetechServo]], None]) -> None:
        def create_changed_emulator(emulator: EmulatedFeetech, *arguments: Any) -> None:
            create_emulator(emulator, *arguments)
            change(emulator.servos)

        monkeypatch.setattr(EmulatedFeetech, "__init__", create_changed_emulator)

    return change_servos


def check_settings(**settings: Any) -> None:
    """Check the configuration of a robot with these settings of its servos."""
    config = apply_backend_modes(
        make_run_config(backend="feetech", robot__chain__modules=JOINTS), FeetechBackend
    )
    FeetechBackend.check(config, FeetechSettings(**settings))


def test_real_servos_are_refused_until_the_missing_watchdog_is_accepted() -> None:
    with raises_error(ConfigError, code="drive/no-watchdog", field="accept_no_watchdog"):
        check_settings(ports=REAL_PORTS, stall_torque_nm=2.0)
    with raises_error(ConfigError, code="drive/unsupported-setting", field="stall_torque_nm"):
        check_settings(ports=REAL_PORTS, accept_no_watchdog=True)

    check_settings(ports=REAL_PORTS, accept_no_watchdog=True, stall_torque_nm=2.0)


def test_emulated_servos_need_no_accepted_watchdog_and_stall_torque() -> None:
    check_settings(ports=EMULATED_PORTS)


def test_servos_are_described_without_watchdog_and_torque(robot: ServoRobot) -> None:
    description = robot.backend.describe()

    assert [joint.watchdog for joint in description.joints] == [False] * JOINTS
    assert all("torque" not in joint.measures for joint in description.joints)
    assert all(
        joint.modes == [JointMode.PASSIVE, JointMode.POSITION] for joint in description.joints
    )
    assert (
        "no joint has a watchdog: it holds its last angle if the host dies"
        in describe_what_moves(description)
    )


def test_mixed_robot_names_the_joints_without_watchdog() -> None:
    config = make_run_config(
        backend="mixed",
        robot__chain__modules=2,
        robot__drive={"driver": "dynamixel"},
        robot__joints={"joint_2": {"driver": "feetech"}},
        clock_mode="lockstep",
        rate_hz=50,
    )
    config = apply_backend_modes(config, MixedBackend)
    backend = MixedBackend(config, MixedBackend.Settings(physics_model="inertia"))

    description = backend.describe()
    backend.close()

    assert [joint.watchdog for joint in description.joints] == [True, False]
    assert ["torque" in joint.measures for joint in description.joints] == [True, False]
    assert "; no watchdog: joint_2: it holds" in describe_what_moves(description)


# A pause after which the driver must not simply continue: the robot may have moved, or a person may be near it.
LONG_PAUSE_S = 1.0
SHORT_PAUSE_S = 0.07  # as of a busy computer


def test_servos_hold_their_angle_while_the_driver_is_paused(robot: ServoRobot) -> None:
    robot.run(ARM_TICKS, "armed")

    robot.pause_driver(LONG_PAUSE_S)

    assert robot.list_torque_states() == ALL_ON, "servos have no watchdog that switches them off"


def test_servos_are_switched_off_after_long_pause_of_driver(robot: ServoRobot) -> None:
    robot.run(ARM_TICKS, "armed")
    robot.pause_driver(LONG_PAUSE_S)

    faults = robot.run(FAULT_REPORT_TICKS, "armed")

    assert {(fault.what, fault.joint) for fault in faults} == {
        ("drive_fault", f"joint_{i + 1}") for i in range(JOINTS)
    }
    assert all("held its last angle for 1.0" in fault.cause for fault in faults), faults
    assert robot.list_torque_states() == ALL_OFF


def test_servos_after_a_long_pause_stay_off_until_armed_again(robot: ServoRobot) -> None:
    robot.run(ARM_TICKS, "armed")
    robot.pause_driver(LONG_PAUSE_S)
    assert robot.run(FAULT_REPORT_TICKS, "armed"), "the pause is a fault"

    assert robot.run(5, "fault") == [], "the same pause is reported again"
    assert robot.run(RESET_TICKS, "disarmed") == []
    assert robot.list_torque_states() == ALL_OFF, "a reset alone must not switch torque on"

    assert robot.run(REARM_TICKS, "armed") == []
    assert robot.list_torque_states() == ALL_ON


def test_short_pause_of_the_driver_is_no_fault(robot: ServoRobot) -> None:
    robot.run(ARM_TICKS, "armed")

    robot.pause_driver(SHORT_PAUSE_S)

    assert robot.run(FAULT_REPORT_TICKS, "armed") == []
    assert robot.list_torque_states() == ALL_ON


def test_servos_hold_on_cut_bus_and_are_off_after_it(robot: ServoRobot) -> None:
    robot.run(ARM_TICKS, "armed")

    robot.go_wrong("cut:bus_1@0-9")
    assert "interface_down" in {fault.what for fault in robot.run(30, "armed")}
    assert robot.list_torque_states() == ALL_ON, "no message reaches a servo on the cut bus"

    robot.go_wrong("cut:bus_1@0-9", begins=False)
    robot.run(20, "fault")
    assert robot.list_torque_states() == ALL_OFF


@pytest.mark.parametrize("lifecycle", ["disarmed", "estop"])
def test_torque_is_off_whenever_the_robot_is_not_armed(robot: ServoRobot, lifecycle: Any) -> None:
    robot.run(ARM_TICKS, "armed")

    robot.run(OFF_TICKS, lifecycle)

    assert robot.list_torque_states() == ALL_OFF


def test_closing_the_backend_switches_torque_off() -> None:
    robot = ServoRobot()
    robot.run(ARM_TICKS, "armed")
    servos = robot.emulator.servos

    robot.backend.close()

    assert [servo.is_torque_on for servo in servos] == ALL_OFF


def test_joint_that_becomes_passive_has_no_torque(robot: ServoRobot) -> None:
    robot.run(ARM_TICKS, "armed")

    robot.mode = JointMode.PASSIVE
    robot.run(OFF_TICKS, "armed")
    assert robot.list_torque_states() == ALL_OFF

    robot.mode = JointMode.POSITION
    assert robot.run(REARM_TICKS, "armed") == []
    assert robot.list_torque_states() == ALL_ON


def test_silent_servo_gets_no_goal_until_it_reports_its_state(robot: ServoRobot) -> None:
    silent_servo = robot.emulator.servos[1]
    other_servo = robot.emulator.servos[2]
    new_target_rad = 0.3
    robot.run(ARM_TICKS, "armed")
    robot.go_wrong("mute:joint_2@0-9")
    robot.run(2, "armed")
    goal_before = silent_servo.read_word(registers.GOALS)

    robot.target = new_target_rad
    robot.run(1, "armed")

    assert silent_servo.read_word(registers.GOALS) == goal_before
    assert other_servo.read_word(registers.GOALS) == registers.to_position(new_target_rad)


def test_torque_limit_register_is_a_fraction_of_stall_torque() -> None:
    settings = FeetechSettings(physics_model="inertia", stall_torque_nm=8.0)
    robot = ServoRobot(settings)
    robot.limit_nm = 2.0

    robot.run(5, "armed")

    per_mille_of_stall_torque = 250  # 2 Nm of 8 Nm
    torque_limits = {servo.read_word(registers.TORQUE_LIMIT) for servo in robot.emulator.servos}
    assert torque_limits == {per_mille_of_stall_torque}
    robot.backend.close()


def test_registers_are_written_only_where_they_differ(
    robot: ServoRobot, change_delivered_servos: Any
) -> None:
    """The driver sets the delay of answers to 0, clears one bit of the phase, keeps the others, and locks."""
    servo = robot.emulator.servos[0]
    assert servo.table[registers.DELAY] == 0
    assert servo.table[registers.LOCK] == registers.LOCKED, "the EEPROM is not protected again"

    other_phase_bits = 12

    def change_phase(servos: list[EmulatedFeetechServo]) -> None:
        servos[0].table[registers.PHASE] = other_phase_bits | registers.MULTI_TURN_FEEDBACK

    change_delivered_servos(change_phase)
    changed_robot = ServoRobot()
    assert changed_robot.emulator.servos[0].table[registers.PHASE] == other_phase_bits
    changed_robot.backend.close()


@pytest.mark.parametrize(
    ("address", "value", "reason"),
    [
        (registers.ID, 9, "does not answer: it is off, or has another id or baud rate"),
        (registers.MODEL, 5, "is of another model: model 773; the driver knows STS3215, STS3250"),
        (
            registers.MAX_POSITION,
            100,
            "has position limits of 0 to 2148 (registers 9 and 11), and its joint travels from",
        ),
        (
            registers.UNLOADING,
            0,
            "keeps its torque on in spite of overheating, overload (register 19 is 0)",
        ),
        (registers.MAX_TEMPERATURE, 95, "allows itself 95 °C (register 13)"),
        (registers.OVERLOAD_TORQUE, 0, "has the overload torque 0 (register 36)"),
        (registers.PROTECTIVE_TORQUE, 90, "keeps a protective torque of 90 %"),
        (registers.MIN_VOLTAGE, 250, "allows 25.0 to"),
        (registers.MAX_TORQUE, 0, "has a torque limit of 768 per mille (register 16)"),
    ],
)
def test_unsafe_register_is_named_at_start(
    change_delivered_servos: Any, address: int, value: int, reason: str
) -> None:
    def change_register(servos: list[EmulatedFeetechServo]) -> None:
        servos[1].table[address] = value  # of joint_2
        if address == registers.MAX_POSITION:
            servos[1].write_word(address, registers.MIDDLE + value)

    change_delivered_servos(change_register)

    with pytest.raises(BackendError) as refusal:
        ServoRobot()

    assert "joint_2 (id 2 on /dev/pts/" in str(refusal.value)
    assert reason in str(refusal.value)


def test_homing_offset_is_kept_and_another_one_is_refused(change_delivered_servos: Any) -> None:
    offset_counts = 100
    sign_bit = 1 << 11  # the offset is negative, which adds to the angle
    offset_word = offset_counts | sign_bit
    change_delivered_servos(
        lambda servos: servos[0].write_word(registers.HOMING_OFFSET, offset_word)
    )
    robot = ServoRobot()

    robot.run(1, "disarmed")
    assert robot.joints is not None
    assert robot.joints.angle_rad[0] == pytest.approx(offset_counts * registers.RAD, abs=0.002)
    assert robot.emulator.servos[0].read_word(registers.HOMING_OFFSET) == offset_word
    robot.backend.close()

    with raises_error(BackendError, code="drive/not-complete", field="homing_offsets"):
        ServoRobot(FeetechSettings(physics_model="inertia", homing_offsets={"joint_1": 7}))


@pytest.mark.parametrize(
    "drive", [{"zero_rad": 3.0}, {"gear": 8.0}, {"zero_rad": -3.0, "sign": -1}]
)
def test_travel_across_the_end_of_the_count_is_refused(drive: dict[str, Any]) -> None:
    """A servo counts a single turn, so the travel of its joint must not contain the end of the turn."""
    config = make_run_config(backend="feetech", robot__chain__modules=JOINTS, robot__drive=drive)
    with raises_error(ConfigError, code="drive/unsupported-setting", field="zero_rad"):
        FeetechBackend.check(apply_backend_modes(config, FeetechBackend), FeetechSettings())


@pytest.mark.parametrize("answers", ["collide", "follow each other"])
def test_second_servo_with_same_id_stops_robot_and_blocks_start(
    robot: ServoRobot, answers: str
) -> None:
    if answers == "collide":
        robot.emulator._second_servo_delays[1] = 0
    robot.run(ARM_TICKS, "armed")

    robot.go_wrong("duplicate:joint_2@0-9")
    faults = robot.run(FAULT_REPORT_TICKS, "armed")

    assert faults[0].joint == "joint_2"
    assert faults[0].what in ("duplicate_node", "drive_silent")
    assert robot.list_torque_states() == ALL_OFF
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        robot.backend._drives.bring_up()


def test_closing_whose_last_write_fails_closes_emulated_servos(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = ServoRobot()
    robot.run(ARM_TICKS, "armed")
    close_emulator = robot.emulator.close
    closed_parts: list[str] = []

    def close_and_note() -> None:
        close_emulator()
        closed_parts.append("emulator")

    def raise_write_error(*_arguments: object) -> None:
        raise BackendError("the port is gone")

    monkeypatch.setattr(robot.emulator, "close", close_and_note)
    monkeypatch.setattr(drives_of(robot.backend), "_write_to_servos", raise_write_error)
    with pytest.raises(BackendError, match="the port is gone"):
        robot.backend.close()
    assert closed_parts == ["emulator"]
