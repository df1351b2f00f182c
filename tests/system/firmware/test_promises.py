"""Promises of the reference firmware that random traffic does not test.

These are promises to its board, which the emulator does not have, and sequences that are rare.
"""

import struct
from pathlib import Path

import pytest

from snakesim_can_backend.protocol.commands import make_command, make_emergency, make_sync
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    ModuleParameter,
    ModuleState,
    Opcode,
    ParameterOperation,
    frame_id,
)
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.firmware_replay import Answer, run_reference, run_torques
from snakesim_testing.can.module_rig import make_parameter_request, make_setpoint

NODE = 5
RATED_NM = 4.0
RATED_RAD_S = 6.25
INIT = f"init {NODE} 7 {RATED_NM} {RATED_RAD_S} 800 1050 18000 0"
BOOTED_US = 100_000
OUTBOX_FRAMES = 16
# Frames in an answer begin with their id.
GYRO_PREFIX = f"{frame_id(Opcode.GYRO, NODE):03X}#"
JOINT_STATE_PREFIX = f"{frame_id(Opcode.JOINT_STATE, NODE):03X}#"


def describe_sensors(
    *,
    speed_mrad_s: int = 0,
    is_valid: bool = True,
    voltage_mv: int = 24_000,
    winding_tenths_c: int = 200,
    is_leaking: bool = False,
) -> str:
    """An event with the sensor values of a module. By default it is healthy and at room temperature."""
    return (
        f"sensors {int(is_valid)} 0 {speed_mrad_s} 0 0 {voltage_mv} 0 {winding_tenths_c} 200 {int(is_leaking)}"
        + " 0" * 22
    )


def describe_frame(frame: CanFrame, time_us: int = BOOTED_US) -> str:
    return f"frame {time_us} {frame.id:x} {frame.data.hex() or '-'}"


def describe_command(action: CommandAction) -> str:
    return describe_frame(make_command(action, NODE))


def run_booted(replay: Path, events: list[str]) -> list[Answer]:
    """Return the answers of a module that has booted."""
    boot = [INIT, describe_sensors(), f"poll {BOOTED_US}"]
    return run_reference(replay, [*boot, *events])[1:]


def test_bridge_watchdog_is_fed_by_arming_and_setpoints_only(replay: Path) -> None:
    setpoint_without_sync = make_setpoint(1, node_id=NODE)
    setpoint_with_wrong_checksum = CanFrame(setpoint_without_sync.id, bytes(6))
    answers = run_booted(
        replay,
        [
            f"poll {BOOTED_US + 100}",
            describe_command(CommandAction.ARM),
            describe_frame(make_setpoint(0, node_id=NODE)),
            describe_frame(setpoint_without_sync),
            describe_frame(setpoint_with_wrong_checksum),
            describe_frame(make_sync(1, 0)),
            describe_frame(
                make_parameter_request(1, operation=ParameterOperation.READ, node_id=NODE)
            ),
            f"poll {BOOTED_US + 1000}",
            describe_frame(make_setpoint(2, node_id=NODE)),
            f"poll {BOOTED_US + 2000}",
        ],
    )
    assert [answer.feeds_bridge for answer in answers] == [
        False,
        True,
        True,
        *[False] * 5,
        True,
        False,
    ]


def test_bridge_watchdog_is_fed_once_while_the_module_brakes(replay: Path) -> None:
    answers = run_booted(
        replay,
        [
            describe_command(CommandAction.ARM),
            describe_sensors(speed_mrad_s=900),
            describe_command(CommandAction.STOP),
            f"poll {BOOTED_US + 50_000}",
            describe_command(CommandAction.STOP),
            f"poll {BOOTED_US + 99_999}",
            f"poll {BOOTED_US + 100_000}",
        ],
    )
    assert [answer.feeds_bridge for answer in answers] == [True, True, *[False] * 4]
    assert [answer.state for answer in answers[1:]] == [
        *[ModuleState.STOPPING] * 4,
        ModuleState.DISARMED,
    ]


def test_first_setpoint_after_arming_feeds_the_bridge_watchdog_before_any_sync(
    replay: Path,
) -> None:
    arm_and_command = [
        describe_command(CommandAction.ARM),
        describe_frame(make_setpoint(0, node_id=NODE)),
    ]
    events = [*arm_and_command, describe_command(CommandAction.DISARM), *arm_and_command]
    feeds = [answer.feeds_bridge for answer in run_booted(replay, events)]
    assert feeds == [True, True, False, True, True]


def test_bridge_watchdog_is_not_fed_after_a_reboot(replay: Path) -> None:
    arm_and_reboot = [
        describe_frame(make_command(CommandAction.ARM, NODE)),
        describe_frame(make_command(CommandAction.REBOOT, NODE)),
        f"poll {2 * BOOTED_US}",
    ]
    assert [answer.feeds_bridge for answer in run_booted(replay, arm_and_reboot)] == [
        True,
        False,
        False,
    ]


def test_save_asks_the_board_once_to_write_its_flash(replay: Path) -> None:
    answers = run_booted(
        replay,
        [
            describe_frame(make_parameter_request(ModuleParameter.DAMPING, 2.0, node_id=NODE)),
            describe_frame(
                make_parameter_request(
                    ModuleParameter.DAMPING, operation=ParameterOperation.SAVE, node_id=NODE
                )
            ),
            f"poll {BOOTED_US}",
        ],
    )
    assert [answer.writes_flash for answer in answers] == [False, True, False]


@pytest.mark.parametrize(
    ("parameter", "saved", "value_after_start"),
    [
        (ModuleParameter.WATCHDOG, "0.05", 0.05),
        (ModuleParameter.WATCHDOG, "10", 0.1),
        (ModuleParameter.WATCHDOG, "0", 0.1),
        (ModuleParameter.WATCHDOG, "nan", 0.1),
        (ModuleParameter.STIFFNESS, "30", 30.0),
        (ModuleParameter.STIFFNESS, "-1", 0.0),
        (ModuleParameter.STIFFNESS, "inf", 0.0),
        (ModuleParameter.TORQUE_LIMIT, "1e9", RATED_NM),
        (ModuleParameter.STOP_MODE, "0.5", 1.0),
        (ModuleParameter.TAIL, "1", 1.0),
        (ModuleParameter.RATED_TORQUE, "30", RATED_NM),
        (ModuleParameter.RATED_SPEED, "30", RATED_RAD_S),
    ],
)
def test_saved_value_out_of_range_is_that_of_a_new_module(
    replay: Path, parameter: ModuleParameter, saved: str, value_after_start: float
) -> None:
    read = make_parameter_request(parameter, operation=ParameterOperation.READ, node_id=NODE)
    events = [f"flash {parameter} {saved}", INIT, describe_sensors(), f"poll {BOOTED_US}"]
    answer = run_reference(replay, [*events, describe_frame(read)])[-1]
    assert read_parameter_value(answer) == pytest.approx(value_after_start)


def read_parameter_value(answer: Answer) -> float:
    """Return the value in the only frame of an answer, a ParameterAnswer."""
    (frame,) = answer.frames
    identifier, _, data = frame.partition("#")
    assert int(identifier, 16) == frame_id(Opcode.PARAMETER_ANSWER, NODE)
    (value,) = struct.unpack("<f", bytes.fromhex(data)[2:])
    return value


def test_ratings_beyond_the_range_of_the_bus_become_its_end(replay: Path) -> None:
    for parameter in (
        ModuleParameter.RATED_TORQUE,
        ModuleParameter.RATED_SPEED,
        ModuleParameter.TORQUE_LIMIT,
        ModuleParameter.SPEED_LIMIT,
    ):
        read = make_parameter_request(parameter, operation=ParameterOperation.READ, node_id=NODE)
        events = [f"init {NODE} 7 50 40 800 1050 18000 0", describe_sensors(), f"poll {BOOTED_US}"]
        answer = run_reference(replay, [*events, describe_frame(read)])[-1]
        assert read_parameter_value(answer) == pytest.approx(32.767)


def test_frames_of_a_full_outbox_are_dropped_and_older_ones_are_sent(replay: Path) -> None:
    """A module that cannot send, for example on a bus without other nodes, keeps the oldest frames."""
    count = OUTBOX_FRAMES + 3
    requests = [
        describe_frame(make_parameter_request(index, operation=9, node_id=NODE))
        for index in range(count)
    ]
    answers = run_booted(replay, ["mailbox 0", *requests, "mailbox 1", f"poll {BOOTED_US}"])
    assert [answer.dropped_frames for answer in answers] == [*[0] * OUTBOX_FRAMES, 1, 2, 3, 3]
    sent_indices = [int(frame.partition("#")[2][:2], 16) for frame in answers[-1].frames]
    assert sent_indices == list(range(OUTBOX_FRAMES))
    # The outbox is a ring, whose frames now begin elsewhere.
    again = run_booted(
        replay, [*requests[:5], "mailbox 0", *requests, "mailbox 1", f"poll {BOOTED_US}"]
    )
    assert again[-1].frames == answers[-1].frames


@pytest.mark.parametrize(("speed_limit_rad_s", "torque_nm"), [(0.0, 0.0), (0.5, 2.0)])
def test_slow_speed_limit_allows_torque_at_rest_and_zero_allows_none(
    replay: Path, speed_limit_rad_s: float, torque_nm: float
) -> None:
    limit_speed = make_parameter_request(
        ModuleParameter.SPEED_LIMIT, speed_limit_rad_s, node_id=NODE
    )
    events = [
        INIT,
        describe_sensors(),
        f"poll {BOOTED_US}",
        describe_frame(limit_speed),
        describe_command(CommandAction.ARM),
        describe_frame(make_setpoint(0, JointMode.TORQUE, 2.0, 3.0, NODE)),
        describe_frame(make_sync(1, 0)),
        "torque 0 0",
    ]
    assert run_torques(replay, events) == [(torque_nm, False)]


@pytest.mark.parametrize(
    "sensors",
    [
        describe_sensors(is_valid=False),
        describe_sensors(voltage_mv=17_999),
        describe_sensors(winding_tenths_c=1050),
        describe_sensors(is_leaking=True),
    ],
    ids=["sensor", "voltage", "heat", "leak"],
)
def test_module_with_the_cause_of_a_fault_is_not_armed_for_a_moment(
    replay: Path, sensors: str
) -> None:
    """The cause appears between two polls, so that it is not latched yet when the Command arrives."""
    events = [sensors, describe_command(CommandAction.ARM), f"poll {BOOTED_US}"]
    armed, polled = run_booted(replay, events)
    assert (armed.state, armed.feeds_bridge, armed.frames) == (ModuleState.DISARMED, False, ())
    assert polled.state == ModuleState.FAULT


@pytest.mark.parametrize(
    ("events", "mode"),
    [
        ([describe_command(CommandAction.STOP)], JointMode.VELOCITY),
        (
            [describe_command(CommandAction.DISARM), describe_command(CommandAction.ARM)],
            JointMode.PASSIVE,
        ),
        (
            [
                describe_frame(make_emergency()),
                describe_command(CommandAction.CLEAR),
                describe_command(CommandAction.ARM),
            ],
            JointMode.PASSIVE,
        ),
    ],
)
def test_setpoint_before_a_change_of_state_is_never_followed(
    replay: Path, events: list[str], mode: JointMode
) -> None:
    arm = [
        describe_command(CommandAction.ARM),
        describe_sensors(speed_mrad_s=900),
        describe_frame(make_setpoint(0, JointMode.TORQUE, 2.0, 3.0, NODE)),
    ]
    answer = run_booted(replay, [*arm, *events, describe_frame(make_sync(1, 0))])[-1]
    assert (answer.mode, answer.target) == (mode, 0.0)


def test_imu_is_sent_in_turn_by_the_number_of_syncs_since_the_boot(replay: Path) -> None:
    """Node 5 with `imu_every` 3 answers the second and the fifth Sync, also after a reboot."""
    syncs = [describe_frame(make_sync(count, 0), 2 * BOOTED_US) for count in range(6)]
    events = [
        f"flash {ModuleParameter.IMU_EVERY} 3",
        INIT,
        "sensors 1 0 0 0 0 24000 0 200 200" + " 0" * 14 + " 1" + " 0" * 8,
        f"poll {BOOTED_US}",
        *syncs[:4],
        describe_command(CommandAction.REBOOT),
        f"poll {2 * BOOTED_US}",
        *syncs,
    ]
    answers = run_reference(replay, events)
    has_gyro = [any(frame.startswith(GYRO_PREFIX) for frame in answer.frames) for answer in answers]
    assert has_gyro[-6:] == [False, True, False, False, True, False]


def test_joint_state_has_the_values_at_its_sync_and_not_those_of_the_last_poll(
    replay: Path,
) -> None:
    events = [describe_sensors(speed_mrad_s=321), describe_frame(make_sync(1, 0))]
    (answer,) = run_booted(replay, events)
    states = [frame for frame in answer.frames if frame.startswith(JOINT_STATE_PREFIX)]
    velocities_mrad_s = [
        struct.unpack_from("<h", bytes.fromhex(frame.partition("#")[2]), 2)[0] for frame in states
    ]
    assert velocities_mrad_s == [321]
