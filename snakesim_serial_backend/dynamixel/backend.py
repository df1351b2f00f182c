"""The backend `dynamixel`: checks, and the ports that it opens."""

from pathlib import Path
from typing import TextIO

from snakesim_hal.drivers.drive_backend import Clock, DriveBackend
from snakesim_hal.drivers.drive_settings import answer_limit_s, body_of, check_settings, port_of, who
from snakesim_hal.drivers.mocap import receiver
from snakesim_hal.drivers.readings import Readings
from snakesim_hal.errors import BackendError, ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import Pace
from snakesim_serial_backend.dynamixel.load import MAX_LOAD, cycle_bytes, cycle_s, fits_hz
from snakesim_serial_backend.dynamixel.packets import LAST_ID
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.dynamixel.servo import SLACK_RAD, TURN, Servo
from snakesim_serial_backend.dynamixel.servos import Servos
from snakesim_serial_backend.dynamixel.settings import NAME, DynamixelSettings
from snakesim_serial_backend.dynamixel.twin import CURRENT_A, MOST_CURRENT, DynamixelTwin
from snakesim_serial_backend.wire import Pty, SerialWire, is_emulated

GAP_S, GAP_SHARE = 0.002, 0.2  # of silence, or of a period, after which no answer is expected


class DynamixelBackend(DriveBackend):
    """A `snakesim_hal.backend.Backend` on Dynamixel X servos, real or emulated."""

    Settings = DynamixelSettings
    MODES = ("position", "torque")  # what else a robot file says its joints have, they do not have here

    @staticmethod
    def check(config: RunConfig, settings: DynamixelSettings) -> tuple[Pace, ...]:
        """Servos on a port support real time only; emulated ones in this process lockstep, too. Raises ConfigError."""
        check_gains(config.robot)
        here = not settings.ports
        check_settings(config, settings, settings.ports, twins=here, bus_faults={"cut"} if here else set())
        check_joints(config, settings)
        check_load(config, settings)
        return ("lockstep", "realtime") if here else ("realtime",)

    def __init__(self, config: RunConfig, settings: DynamixelSettings) -> None:
        """Open the ports and find every servo; nothing is enabled. Raises ConfigError and BackendError."""
        self.check(config, settings)
        clock, here = Clock(config), not settings.ports
        mocap = receiver(config, settings.pose_listen, twins=here, clock=lambda _stamp_ns: clock.ns())
        gap_s = max(GAP_S, GAP_SHARE * config.period_ns * 1e-9)

        def make_servos(readings: Readings) -> Servos:
            log = _log(settings.log)
            twin, wires = None, list[SerialWire]()
            try:
                if here:
                    pty = Pty()
                    twin = twin_on(config, settings, [pty], clock, mocap.address if mocap is not None else None)
                    wires.append(SerialWire(pty.path, settings.baud, log, pty, twin))
                for port in settings.ports:
                    wires.append(SerialWire(port, settings.baud, log))
            except BaseException:
                for wire in wires:
                    wire.close()
                raise
            ports = [Port(wire, gap_s) for wire in wires]
            servos = [
                servo_of(joint, ports[bus])
                for joint, bus in zip(config.robot.joint_table, port_of(config, settings.ports), strict=True)
            ]
            return Servos(servos, readings, settings, clock.ns, answer_limit_s(config), twin)

        super().__init__(config, NAME, "+".join(settings.ports), clock, mocap, make_servos)


def servo_of(joint: Joint, port: Port) -> Servo:
    """A servo with the numbers of its joint, at its horn."""
    drive, motor, limits = joint.drive, joint.motor, joint.limits
    turns = drive.sign * drive.gear
    ends = drive.zero_rad + turns * limits.least_rad, drive.zero_rad + turns * limits.most_rad
    return Servo(
        id=joint.id,
        name=joint.name,
        port=port,
        constant=constant_of(joint),
        stiffness=motor.stiffness_nm_per_rad / drive.gear**2,
        damping=motor.damping_nm_s_per_rad / drive.gear**2,
        least_rad=min(ends),
        most_rad=max(ends),
        torque_nm=limits.torque_nm / drive.gear,
        speed_rad_s=limits.speed_rad_s * drive.gear,
    )


def constant_of(joint: Joint) -> float:
    """Its torque constant, N·m/A; without one, of a twin whose current limit is twice what its joint may ask for."""
    most_a = MOST_CURRENT * CURRENT_A / 2
    return joint.motor.torque_constant_nm_per_a or joint.limits.torque_nm / joint.drive.gear / most_a


def check_joints(config: RunConfig, settings: DynamixelSettings) -> None:
    """Raise ConfigError for joints that no servo can be."""
    real = not all(map(is_emulated, settings.ports))
    for joint in config.robot.joint_table:
        travel_rad = (joint.limits.most_rad - joint.limits.least_rad) * joint.drive.gear
        if joint.id > LAST_ID:
            raise ConfigError(f"{who(config, joint)}: `id` = {joint.id}; ids of protocol 2.0 are 0 to {LAST_ID}")
        if travel_rad + 2 * SLACK_RAD >= TURN:
            raise ConfigError(
                f"{who(config, joint)}: its servo travels {travel_rad:.2f} rad, and forgets whole turns when it is "
                f"off: where it woke up would be ambiguous. Narrow its limits (or `gear`) to "
                f"{TURN - 2 * SLACK_RAD:.2f} rad"
            )
        if joint.motor.torque_constant_nm_per_a is None and real:
            raise ConfigError(
                f"{who(config, joint)}: `torque_constant_nm_per_a` is not given, and servos measure and limit amperes: "
                f"take stall torque over stall current from the e-Manual, and measure it (docs/dynamixel.md)"
            )


def check_load(config: RunConfig, settings: DynamixelSettings) -> None:
    """Raise ConfigError when a port cannot carry its servos."""
    on = port_of(config, settings.ports)
    fullest = max(on.count(bus) for bus in set(on))
    busy_s = cycle_s(fullest, settings.baud)
    if busy_s * config.rate_hz > MAX_LOAD:
        raise ConfigError(
            f"{fullest} servos at {config.rate_hz:g} Hz: a cycle of {cycle_bytes(fullest)} bytes takes "
            f"{busy_s * 1e3:.1f} ms at {settings.baud} baud, which is {busy_s * config.rate_hz:.0%} of a period; at "
            f"most {MAX_LOAD:.0%}: use rate_hz = {fits_hz(fullest, settings.baud)}, a higher "
            f"`backends.dynamixel.baud`, or more `backends.dynamixel.ports`"
        )


def twin_on(
    config: RunConfig, settings: DynamixelSettings, ptys: list[Pty], clock: Clock, pose: str | None
) -> DynamixelTwin:
    """Emulated servos of a whole robot."""
    body = body_of(config, settings, NAME, pose)
    each = [ptys[bus] for bus in port_of(config, settings.ports)]
    constants = [constant_of(joint) for joint in config.robot.joint_table]
    return DynamixelTwin(body, each, constants, settings.baud, clock.ns)


def _log(path: str) -> TextIO | None:
    try:
        return Path(path).open("w", encoding="utf-8") if path else None
    except OSError as error:
        raise BackendError(f"`backends.dynamixel.log` = {path!r}: {error.strerror}") from error
