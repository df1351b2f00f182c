"""Our moteus frames and the library of mjbots encode and decode each other, also with our emulators."""

import math
from typing import Any

import can
import moteus
import pytest
from moteus.protocol import parse_message, parse_registers

from snakesim_can_backend.bus.bus import VirtualWire, to_python_can
from snakesim_can_backend.moteus import protocol
from snakesim_can_backend.moteus.backend import MoteusBackend
from snakesim_can_backend.moteus.controllers import (
    HEALTH_REQUESTS,
    IDENTITY_REQUESTS,
    MOTION_REQUESTS,
    get_configured_gains,
)
from snakesim_can_backend.moteus.settings import MoteusSettings
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.drivers.drive_rig import drives_of
from snakesim_testing.messages import raises_error

VALUE_TYPES = (moteus.INT8, moteus.INT16, moteus.INT32, moteus.F32)
JOINTS = 4
CONFIG = make_can_config(JOINTS, backend="moteus")


def make_library_client(number: int = 1, **options: Any) -> moteus.Controller:
    """Return the client of the library for one controller. Only its frames are used."""
    return moteus.Controller(id=number, transport=object(), **options)  # pyright: ignore[reportArgumentType]


def to_frame(command: Any, number: int = 1) -> CanFrame:
    """Convert a command of the library to our type of frame."""
    return CanFrame(
        (0x8000 if command.reply_required else 0) | command.source << 8 | number,
        bytes(command.data),
    )


def test_moteus_registers_and_modes_equal_those_of_its_library() -> None:
    library_names = {
        "MODE": "MODE", "POSITION": "POSITION", "VELOCITY": "VELOCITY", "TORQUE": "TORQUE", "POWER": "POWER",
        "MOTOR_TEMPERATURE": "MOTOR_TEMPERATURE", "HOME_STATE": "HOME_STATE", "VOLTAGE": "VOLTAGE",
        "BOARD_TEMPERATURE": "TEMPERATURE", "FAULT": "FAULT", "COMMAND": "COMMAND_POSITION",
        "WATCHDOG": "COMMAND_TIMEOUT", "MAP_VERSION": "REGISTER_MAP_VERSION", "SERIAL": "SERIAL_NUMBER",
    }  # fmt: skip
    assert {
        member.name: moteus.Register[library_names[member.name]] for member in protocol.Register
    } == {member.name: member.value for member in protocol.Register}
    modes = {member.name: moteus.Mode[member.name].value for member in protocol.MoteusMode}
    assert modes == {member.name: member.value for member in protocol.MoteusMode}


@pytest.mark.parametrize(
    "target",
    [
        {
            "position": 0.25,
            "velocity": 0.0,
            "feedforward_torque": 0.0,
            "kp_scale": 0.5,
            "kd_scale": 0.75,
        },
        {
            "position": math.nan,
            "velocity": -1.5,
            "feedforward_torque": 0.0,
            "kp_scale": 0.0,
            "kd_scale": 1.0,
        },
        {
            "position": math.nan,
            "velocity": 0.0,
            "feedforward_torque": -2.5,
            "kp_scale": 0.0,
            "kd_scale": 0.0,
        },
    ],
    ids=["position", "velocity", "torque"],
)
def test_moteus_command_frame_equals_that_of_its_library(target: dict[str, float]) -> None:
    resolutions = dict.fromkeys(
        (*target, "maximum_torque", "watchdog_timeout", "velocity_limit", "accel_limit"), moteus.F32
    )
    resolution = moteus.PositionResolution()
    for name, resolution_type in resolutions.items():
        setattr(resolution, name, resolution_type)
    limits: dict[str, Any] = {
        "maximum_torque": 3.0,
        "watchdog_timeout": 0.125,
        "velocity_limit": -1.0,
        "accel_limit": -1.0,
    }
    library_frame = make_library_client(5, position_resolution=resolution).make_position(
        **dict[str, Any](limits | target)
    )
    our_frame = protocol.make_frame(
        0,
        5,
        protocol.encode_subframe(
            protocol.WRITE, protocol.INT8, protocol.Register.MODE, protocol.MoteusMode.POSITION
        ),
        protocol.encode_subframe(
            protocol.WRITE, protocol.FLOAT, protocol.Register.COMMAND, *target.values(), 3.0
        ),
        protocol.encode_subframe(
            protocol.WRITE, protocol.FLOAT, protocol.Register.WATCHDOG, 0.125, -1.0, -1.0
        ),
    )
    assert parse_registers(our_frame.data).command == pytest.approx(
        parse_registers(library_frame.data).command, nan_ok=True
    )
    assert to_frame(library_frame, 5).id == our_frame.id
    assert len(our_frame.data) == 48
    writes = [
        subframe
        for subframe in protocol.decode_subframes(bytes(library_frame.data))
        if subframe.kind == protocol.WRITE
    ]
    values = {
        subframe.register + offset: value
        for subframe in writes
        for offset, value in enumerate(subframe.values)
    }
    assert values == pytest.approx(parse_registers(library_frame.data).command, nan_ok=True)


def test_moteus_stop_frame_and_extended_ids_equal_its_library() -> None:
    stop = protocol.encode_subframe(
        protocol.WRITE, protocol.INT8, protocol.Register.MODE, protocol.MoteusMode.STOPPED
    )
    assert protocol.make_frame(0, 1, stop) == to_frame(make_library_client().make_stop())
    query = protocol.make_frame(0, 1, *MOTION_REQUESTS, reply=True)
    assert query.id == to_frame(make_library_client().make_query()).id == 0x8001
    assert to_python_can(query, fd=True).is_extended_id
    assert not to_python_can(CanFrame(0x100, b""), fd=True).is_extended_id
    assert len(protocol.make_frame(0, 1, *HEALTH_REQUESTS).data) == 6
    assert len(protocol.make_frame(0, 1, *MOTION_REQUESTS).data) == 5
    assert parse_registers(protocol.make_frame(0, 1, *IDENTITY_REQUESTS).data).query == [
        (0x102, moteus.INT32),
        (0x00C, moteus.INT8),
    ]


@pytest.fixture
def bus() -> Any:
    """Emulated controllers of a robot, their clock, and the bus to them."""
    wire = VirtualWire("moteus-theirs", fd=True)
    clock = DriverClock(CONFIG)
    emulator = MoteusBackend.make_emulator(
        CONFIG, MoteusSettings(physics_model="inertia"), [wire], clock, None
    )
    with can.Bus(
        interface="virtual", channel="moteus-theirs", protocol=can.CanProtocol.CAN_FD
    ) as host_bus:
        yield host_bus, emulator, clock
    emulator.close()


def test_moteus_library_client_drives_and_reads_our_emulator(bus: Any) -> None:
    host_bus, emulator, clock = bus
    number = 3
    client = make_library_client(number)

    def send_command(command: Any) -> dict[int, Any]:
        host_bus.send(to_python_can(to_frame(command, number), fd=True))
        emulator()
        if (message := host_bus.recv(0)) is None:
            return {}
        result = parse_message(message)
        assert result.id == number
        assert message.is_fd
        return result.values

    assert send_command(client.make_query())[moteus.Register.MODE] == moteus.Mode.STOPPED
    for _ in range(100):
        send_command(client.make_position(position=0.05, velocity=0.0, watchdog_timeout=0.1))
        clock.robot_time_ns += 10_000_000
        emulator()
    for value_type, tolerance in zip(VALUE_TYPES, (0.01, 0.0002, 0.0002, 0.0002), strict=True):
        fields = dict.fromkeys((0, 1, 2, 3, 13, 14, 15), value_type)
        answer = send_command(client.make_custom_query(fields))
        assert answer[moteus.Register.MODE] == moteus.Mode.POSITION
        assert answer[moteus.Register.FAULT] == 0
        assert answer[moteus.Register.POSITION] == pytest.approx(0.05, abs=max(tolerance, 0.003))
        assert answer[moteus.Register.VOLTAGE] == pytest.approx(
            emulator.body.read_supply(2)[0], abs=0.3
        )
    clock.robot_time_ns += 150_000_000
    emulator()
    assert send_command(client.make_query())[moteus.Register.MODE] == moteus.Mode.TIMEOUT
    send_command(client.make_position(position=0.1, velocity=0.0))
    assert send_command(client.make_query())[moteus.Register.MODE] == moteus.Mode.TIMEOUT, (
        "only a stop ends the timeout"
    )
    send_command(client.make_stop())
    assert send_command(client.make_query())[moteus.Register.MODE] == moteus.Mode.STOPPED
    send_command(client.make_position(position=0.1, velocity=0.0))
    broadcast_client = make_library_client(127)
    host_bus.send(to_python_can(to_frame(broadcast_client.make_stop(), 127), fd=True))
    emulator()
    assert send_command(client.make_query())[moteus.Register.MODE] == moteus.Mode.STOPPED, (
        "127 is the broadcast address"
    )


def test_moteus_library_reads_every_frame_of_a_run() -> None:
    backend = MoteusBackend(CONFIG, MoteusSettings(physics_model="inertia"))
    drives = drives_of(backend)
    sent: list[CanFrame] = []
    send = drives.wire.send
    drives.wire.send = lambda frame: sent.append(frame) or send(frame)
    joints = backend.sample(0, 0).joints
    for tick in range(1, 20):
        joints = backend.sample(tick, tick * CONFIG.period_ns).joints
        backend.enact(
            SafeSetpoints(
                [JointMode.POSITION] * JOINTS, [0.2] * JOINTS, [1.5] * JOINTS, frozenset()
            ),
            "armed",
        )
        backend.advance()
    backend.close()
    parsed_frames = [parse_registers(frame.data) for frame in sent]
    assert all(parsed.command or parsed.query for parsed in parsed_frames)
    assert not any(parsed.errors for parsed in parsed_frames)
    command = next(parsed.command for parsed in parsed_frames if len(parsed.command) > 2)
    motor = CONFIG.robot.joint_table[0].motor
    kp = (
        command[moteus.Register.COMMAND_KP_SCALE]
        * get_configured_gains(CONFIG.robot.joint_table, MoteusSettings())[0]
    )
    assert command[moteus.Register.COMMAND_POSITION] == pytest.approx(0.2 / (2 * math.pi))
    assert kp == pytest.approx(motor.stiffness_nm_per_rad * 2 * math.pi)
    assert command[moteus.Register.COMMAND_POSITION_MAX_TORQUE] == 1.5
    assert joints.valid == [True] * JOINTS


@pytest.mark.parametrize("number", [0, 127])
def test_moteus_ids_of_host_and_broadcast_are_no_controllers(number: int) -> None:
    """Refuse 127, because the firmware uses it as broadcast: all controllers would follow one joint."""
    invalid_config = make_can_config(backend="moteus", robot__joints={"joint_2": {"id": number}})
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        MoteusBackend.check(invalid_config, MoteusSettings())
    MoteusBackend.check(
        make_can_config(backend="moteus", robot__joints={"joint_2": {"id": 126}}), MoteusSettings()
    )


def test_moteus_real_controllers_need_configuration_and_reference() -> None:
    with raises_error(ConfigError, code="drive/unsupported-setting", field="servo.pid_position.kp"):
        MoteusBackend.check(CONFIG, MoteusSettings(kp_nm_per_turn=0.01))
