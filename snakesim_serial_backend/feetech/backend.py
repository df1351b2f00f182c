"""The backend `feetech`: checks, and the ports that it opens."""

import math
from collections.abc import Collection, Sequence
from typing import ClassVar

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import answer_limit_s, assign_ports, joint_label, make_body
from snakesim_drivers.kit.drive_type import DriverTypeBackend, DriverTypeContext, group_by_port
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint, Measurement
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.feetech import registers as at
from snakesim_serial_backend.feetech.emulator import EmulatedFeetech
from snakesim_serial_backend.feetech.load import MAX_LOAD, cycle_bytes, cycle_s, fits_hz
from snakesim_serial_backend.feetech.packets import LAST_ID
from snakesim_serial_backend.feetech.port import Port
from snakesim_serial_backend.feetech.servo import Servo
from snakesim_serial_backend.feetech.servos import Servos, ServosContext
from snakesim_serial_backend.feetech.settings import NAME, FeetechSettings
from snakesim_serial_backend.wire import Pty, SerialWire, is_emulated, open_log

# A silence of this length ends an answer, whichever is longer.
MIN_GAP_S = 0.002
GAP_PER_PERIOD = 0.2
EMULATED_GAP_PER_PERIOD = 0.5  # of servos in another process, which a busy computer delays


class FeetechBackend(DriverTypeBackend):
    """The backend on Feetech STS servos, real or emulated."""

    Settings = FeetechSettings
    name = NAME
    supported_modes = ("position",)  # servos have no other mode that the driver uses, even if the robot file lists one
    unmeasured: ClassVar[Collection[Measurement]] = ("torque",)
    has_watchdog: ClassVar[bool] = False

    @classmethod
    def list_ports(cls, settings: FeetechSettings) -> Sequence[str]:
        return settings.ports

    @classmethod
    def list_bus_faults(cls, settings: FeetechSettings) -> Collection[str]:
        if settings.ports:
            return set()
        return {"cut"}

    @classmethod
    def check_drives(cls, config: RunConfig, settings: FeetechSettings, joints: Sequence[Joint]) -> None:
        if not all(is_emulated(port) for port in settings.ports):
            check_real_servos(settings)
        check_joints(config, joints)
        check_load(config.rate_hz / settings.decimation, settings, joints)

    @classmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        config = context.config
        settings: FeetechSettings = context.settings
        joints = context.joints
        clock = context.clock
        body = context.body
        log = open_log(settings.log, "backends.feetech.log")

        def open_servos(port_name: str, numbers: Sequence[int], readings: DriveReadings) -> Servos:
            """Open a port with the servos of these joints; emulated servos are on a pseudo terminal."""
            emulator = None
            if body is None:
                wire = SerialWire(port_name, settings.baud, log)
            else:
                pty = Pty()
                emulator = emulator_of(list(joints.values()), settings, body, [pty] * len(joints), clock)
                wire = SerialWire(pty.path, settings.baud, log, pty, emulator)
            gap_per_period = EMULATED_GAP_PER_PERIOD if is_emulated(wire.port) else GAP_PER_PERIOD
            port = Port(wire, max(MIN_GAP_S, gap_per_period * config.period_ns * 1e-9))
            servos_context = ServosContext(
                servos=[servo_of(joints[number], port, settings) for number in numbers],
                port=port,
                readings=readings,
                settings=settings,
                emulator=emulator,
                answer_s=answer_limit_s(config, settings.decimation),
                clock_ns=clock.now_ns,
            )
            return Servos(servos_context)

        ports = settings.ports
        if body is not None:
            ports = [NAME]
        return group_by_port(joints, settings, ports, open_servos)


def servo_of(joint: Joint, port: Port, settings: FeetechSettings) -> Servo:
    """Return a servo with the parameters of its joint, converted to its horn."""
    lower_rad, upper_rad = find_travel_rad(joint)
    return Servo(
        id=joint.id,
        name=joint.name,
        port=port,
        lower_rad=lower_rad,
        upper_rad=upper_rad,
        torque_nm=joint.limits.torque_nm / joint.drive.gear,
        stall_torque_nm=stall_torque_of(joint, settings),
        min_voltage_v=joint.limits.min_voltage_v,
        homing_offset=settings.homing_offsets.get(joint.name),
    )


def stall_torque_of(joint: Joint, settings: FeetechSettings) -> float:
    """Return the stall torque of a joint's servo. Without a setting, which only emulated servos may lack, the joint's.

    It is a little more than the joint demands, because the torque limit is rounded down.
    """
    return settings.stall_torque_nm or 1.01 * joint.limits.torque_nm / joint.drive.gear


def find_travel_rad(joint: Joint) -> tuple[float, float]:
    """Return the smallest and the largest angle of a joint's servo."""
    ratio = joint.drive.sign * joint.drive.gear  # rotation of the horn for one of the joint
    end_a_rad = joint.drive.zero_rad + ratio * joint.limits.lower_rad
    end_b_rad = joint.drive.zero_rad + ratio * joint.limits.upper_rad
    return min(end_a_rad, end_b_rad), max(end_a_rad, end_b_rad)


def check_real_servos(settings: FeetechSettings) -> None:
    """Raise ConfigError if the scenario does not state what real servos need."""
    if not settings.accept_no_watchdog:
        raise ConfigError(
            "`backends.feetech.accept_no_watchdog` = false: Feetech servos have no watchdog. If the host dies or the "
            "cable breaks, each servo holds its last angle with torque on, until its supply is cut. Put the supply "
            "behind a relay in an emergency stop circuit, keep its switch within reach, and set it to true "
            "(docs/hardware/feetech.md)",
            code="drive/no-watchdog",
        )
    if settings.stall_torque_nm is None:
        raise ConfigError(
            "`backends.feetech.stall_torque_nm` is missing, and servos limit their torque in parts of it: take the "
            "stall torque in N·m at your supply voltage from the data sheet, and measure it (docs/hardware/feetech.md)",
            code="drive/unsupported-setting",
        )


def check_joints(config: RunConfig, joints: Sequence[Joint]) -> None:
    """Raise ConfigError for joints that no servo can drive."""
    last_rad = math.pi - at.RAD
    for joint in joints:
        if joint.id > LAST_ID:
            raise ConfigError(
                f"{joint_label(config, joint)}: `id` = {joint.id}; ids of Feetech servos are 0 to {LAST_ID}",
                code="drive/unsupported-setting",
            )
        lower_rad, upper_rad = find_travel_rad(joint)
        if lower_rad < -math.pi or upper_rad > last_rad:
            raise ConfigError(
                f"{joint_label(config, joint)}: its servo travels from {lower_rad:.2f} to {upper_rad:.2f} rad, and its "
                f"position starts again at {math.pi:.2f} rad, where it would turn the long way round: all angles must "
                f"be within -{math.pi:.2f} and {last_rad:.2f} rad. Mount the horn, or set the homing offset, so that "
                "the middle of the travel is at position 2048, and correct `zero_rad`; or narrow the limits or `gear`",
                code="drive/unsupported-setting",
            )


def check_load(rate_hz: float, settings: FeetechSettings, joints: Sequence[Joint]) -> None:
    """Raise ConfigError when a port cannot carry its servos."""
    bus_of_joint = assign_ports(joints, settings.ports)
    fullest = max(bus_of_joint.count(bus) for bus in set(bus_of_joint))
    busy_s = cycle_s(fullest, settings.baud)
    if busy_s * rate_hz > MAX_LOAD:
        raise ConfigError(
            f"{fullest} servos at {rate_hz:g} Hz: a cycle of {cycle_bytes(fullest)} bytes takes "
            f"{busy_s * 1e3:.1f} ms at {settings.baud} baud, which is {busy_s * rate_hz:.0%} of a period; at "
            f"most {MAX_LOAD:.0%}: use rate_hz = {fits_hz(fullest, settings.baud)}, a higher "
            f"`backends.feetech.baud`, or more `backends.feetech.ports`",
            code="bus/overloaded",
        )


def emulator_on(
    config: RunConfig, settings: FeetechSettings, ptys: list[Pty], clock: DriverClock, pose: str | None
) -> EmulatedFeetech:
    """Make emulated servos for a whole robot.

    Args:
        config: configuration of the run, with the robot and the settings of its backend.
        settings: the scenario's section of this driver type.
        ptys: a pseudo terminal for each of its ports.
        clock: the time of the servos.
        pose: where motion capture sends poses, HOST:PORT; None: nowhere.
    """
    joints = config.robot.joint_table
    body = make_body(config, settings, NAME, pose)
    pty_of_joint = [ptys[bus] for bus in assign_ports(joints, settings.ports)]
    return emulator_of(joints, settings, body, pty_of_joint, clock)


def emulator_of(
    joints: Sequence[Joint], settings: FeetechSettings, body: EmulatedBody, ptys: Sequence[Pty], clock: DriverClock
) -> EmulatedFeetech:
    """Make emulated servos for joints. ptys: the pseudo terminal of every joint's servo."""
    stall_torques_nm = [stall_torque_of(joint, settings) for joint in joints]
    return EmulatedFeetech(body, ptys, stall_torques_nm, settings.baud, settings.speed_unit_counts_s, clock.now_ns)
