"""The backend `dynamixel`: checks, and the ports that it opens."""

from collections.abc import Collection, Sequence

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import answer_limit_s, assign_ports, joint_label, make_body
from snakesim_drivers.kit.drive_type import DriverTypeBackend, DriverTypeContext, group_by_port
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.emulator import MAX_CURRENT, MODEL, EmulatedDynamixel, EmulatedModel
from snakesim_serial_backend.dynamixel.load import MAX_LOAD, cycle_bytes, cycle_s, fits_hz
from snakesim_serial_backend.dynamixel.packets import LAST_ID
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.dynamixel.servo import REVOLUTION_RAD, SLACK_RAD, Servo
from snakesim_serial_backend.dynamixel.servos import Servos, ServosContext
from snakesim_serial_backend.dynamixel.settings import NAME, DynamixelSettings
from snakesim_serial_backend.wire import Pty, SerialWire, is_emulated, open_log

# A silence of this length ends an answer, whichever is longer.
MIN_GAP_S = 0.002
GAP_PER_PERIOD = 0.2
EMULATED_GAP_PER_PERIOD = 0.5  # of servos in another process, which a busy computer delays

UNKNOWN_CURRENT_UNIT_A = 0.00269  # of an emulated servo whose model the driver refuses


class DynamixelBackend(DriverTypeBackend):
    """The backend on Dynamixel X servos, real or emulated."""

    Settings = DynamixelSettings
    name = NAME
    supported_modes = ("position", "torque")  # servos have no other mode, even if the robot file lists one

    @classmethod
    def list_ports(cls, settings: DynamixelSettings) -> Sequence[str]:
        return settings.ports

    @classmethod
    def list_bus_faults(cls, settings: DynamixelSettings) -> Collection[str]:
        if settings.ports:
            return set()
        return {"cut"}

    @classmethod
    def check_drives(cls, config: RunConfig, settings: DynamixelSettings, joints: Sequence[Joint]) -> None:
        check_joints(config, settings, joints)
        check_load(config.rate_hz / settings.decimation, settings, joints)

    @classmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        config = context.config
        settings: DynamixelSettings = context.settings
        joints = context.joints
        clock = context.clock
        body = context.body
        gap_s = max(MIN_GAP_S, GAP_PER_PERIOD * config.period_ns * 1e-9)
        log = open_log(settings.log, "backends.dynamixel.log")

        def open_servos(port_name: str, numbers: Sequence[int], readings: DriveReadings) -> Servos:
            """Open a port with the servos of these joints; emulated servos are on a pseudo terminal."""
            emulator = None
            if body is None:
                wire = SerialWire(port_name, settings.baud, log)
            else:
                pty = Pty()
                emulator = emulator_of(list(joints.values()), settings, body, [pty] * len(joints), clock)
                wire = SerialWire(pty.path, settings.baud, log, pty, emulator)
            port_gap_s = gap_s
            if is_emulated(wire.port):
                port_gap_s = max(gap_s, EMULATED_GAP_PER_PERIOD * config.period_ns * 1e-9)
            port = Port(wire, port_gap_s)
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


def servo_of(joint: Joint, port: Port, settings: DynamixelSettings) -> Servo:
    """Return a servo with the parameters of its joint, converted to its horn."""
    drive = joint.drive
    limits = joint.limits
    ratio = drive.sign * drive.gear  # rotation of the horn for one of the joint
    end_a_rad = drive.zero_rad + ratio * limits.lower_rad
    end_b_rad = drive.zero_rad + ratio * limits.upper_rad
    return Servo(
        id=joint.id,
        name=joint.name,
        port=port,
        constant=constant_of(joint, emulated_model(settings)),
        stiffness=joint.motor.stiffness_nm_per_rad / drive.gear**2,
        damping=joint.motor.damping_nm_s_per_rad / drive.gear**2,
        lower_rad=min(end_a_rad, end_b_rad),
        upper_rad=max(end_a_rad, end_b_rad),
        torque_nm=limits.torque_nm / drive.gear,
        speed_rad_s=limits.speed_rad_s * drive.gear,
    )


def constant_of(joint: Joint, model: EmulatedModel) -> float:
    """Return a joint's torque constant in N·m/A.

    Without one, which only emulated servos may lack, it is such that half of the possible current gives full torque.
    """
    max_a = MAX_CURRENT * model.current_a / 2
    return joint.motor.torque_constant_nm_per_a or joint.limits.torque_nm / joint.drive.gear / max_a


def check_joints(config: RunConfig, settings: DynamixelSettings, joints: Sequence[Joint]) -> None:
    """Raise ConfigError for joints that no servo can drive."""
    has_real_servos = not all(is_emulated(port) for port in settings.ports)
    for joint in joints:
        travel_rad = (joint.limits.upper_rad - joint.limits.lower_rad) * joint.drive.gear
        if joint.id > LAST_ID:
            raise ConfigError(
                f"{joint_label(config, joint)}: `id` = {joint.id}; ids of protocol 2.0 are 0 to {LAST_ID}",
                code="drive/unsupported-setting",
            )
        if travel_rad + 2 * SLACK_RAD >= REVOLUTION_RAD:
            raise ConfigError(
                f"{joint_label(config, joint)}: its servo travels {travel_rad:.2f} rad, and loses the count of whole "
                f"turns when it is off: its angle would be ambiguous afterwards. Narrow its limits (or `gear`) to "
                f"less than {REVOLUTION_RAD - 2 * SLACK_RAD:.2f} rad",
                code="drive/unsupported-setting",
            )
        if joint.motor.torque_constant_nm_per_a is None and has_real_servos:
            raise ConfigError(
                f"{joint_label(config, joint)}: `torque_constant_nm_per_a` is missing, and servos measure and limit "
                "amperes: take stall torque over stall current from the e-Manual, and measure it "
                "(docs/hardware/dynamixel.md)",
                code="drive/unsupported-setting",
            )


def check_load(rate_hz: float, settings: DynamixelSettings, joints: Sequence[Joint]) -> None:
    """Raise ConfigError when a port cannot carry its servos."""
    bus_of_joint = assign_ports(joints, settings.ports)
    fullest = max(bus_of_joint.count(bus) for bus in set(bus_of_joint))
    busy_s = cycle_s(fullest, settings.baud)
    if busy_s * rate_hz > MAX_LOAD:
        raise ConfigError(
            f"{fullest} servos at {rate_hz:g} Hz: a cycle of {cycle_bytes(fullest)} bytes takes "
            f"{busy_s * 1e3:.1f} ms at {settings.baud} baud, which is {busy_s * rate_hz:.0%} of a period; at "
            f"most {MAX_LOAD:.0%}: use rate_hz = {fits_hz(fullest, settings.baud)}, a higher "
            f"`backends.dynamixel.baud`, or more `backends.dynamixel.ports`",
            code="bus/overloaded",
        )


def emulator_on(
    config: RunConfig, settings: DynamixelSettings, ptys: list[Pty], clock: DriverClock, pose: str | None
) -> EmulatedDynamixel:
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
    joints: Sequence[Joint], settings: DynamixelSettings, body: EmulatedBody, ptys: Sequence[Pty], clock: DriverClock
) -> EmulatedDynamixel:
    """Make emulated servos for joints. ptys: the pseudo terminal of every joint's servo."""
    model = emulated_model(settings)
    constants = [constant_of(joint, model) for joint in joints]
    return EmulatedDynamixel(body, ptys, constants, settings.baud, clock.now_ns, model)


def emulated_model(settings: DynamixelSettings) -> EmulatedModel:
    """Return the model that servos are emulated as: that of the settings, if they name one that is known."""
    number = at.model_number(settings.model)
    if number is None:
        number = MODEL
    current_a = settings.current_unit_a.get(str(number))
    if current_a is None and number in at.MODELS:
        current_a = at.MODELS[number].current_a
    if current_a is None:
        current_a = UNKNOWN_CURRENT_UNIT_A
    return EmulatedModel(number, current_a)
