"""The backend `dynamixel`: checks, and the ports that it opens."""

from collections.abc import Sequence
from typing import ClassVar

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import make_joint_label
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.emulator import (
    MAX_CURRENT,
    MODEL,
    EmulatedDynamixel,
    EmulatedModel,
)
from snakesim_serial_backend.dynamixel.load import PORT_LOAD
from snakesim_serial_backend.dynamixel.packets import LAST_ID
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.dynamixel.probe import DynamixelProbe
from snakesim_serial_backend.dynamixel.servo import REVOLUTION_RAD, SLACK_RAD, DynamixelServo
from snakesim_serial_backend.dynamixel.servos import DynamixelContext, DynamixelServos
from snakesim_serial_backend.dynamixel.settings import NAME, DynamixelSettings
from snakesim_serial_backend.port_load import PortLoad
from snakesim_serial_backend.servo_backend import OpenedPort, ServoBackend, find_travel_rad
from snakesim_serial_backend.wire import PseudoTerminal, is_emulated

UNKNOWN_CURRENT_UNIT_A = 0.00269  # of an emulated servo whose model the driver refuses


class DynamixelBackend(ServoBackend[EmulatedDynamixel]):
    """The backend on Dynamixel X servos, real or emulated."""

    Settings = DynamixelSettings
    name = NAME
    port_load: ClassVar[PortLoad] = PORT_LOAD
    # The bus watchdog counts every packet to the servo.
    polling_feeds_watchdog: ClassVar[bool] = True
    uses_torque_constant: ClassVar[bool] = True
    # Servos have no other mode, even if the robot file lists one.
    supported_modes = "position", "torque"

    @classmethod
    def open_probe(cls, config: RunConfig, settings: DynamixelSettings) -> DynamixelProbe:
        return DynamixelProbe(config, settings)

    @classmethod
    def check_drives(
        cls, config: RunConfig, settings: DynamixelSettings, joints: Sequence[Joint]
    ) -> None:
        validate_joints(config, settings, joints)
        cls.validate_port_load(config, settings, joints)

    @classmethod
    def open_servos(cls, opened_port: OpenedPort[EmulatedDynamixel]) -> DynamixelServos:
        port = DynamixelPort(opened_port.wire, opened_port.response_gap_s)
        context = DynamixelContext(
            servos=[make_servo(joint, port, opened_port.settings) for joint in opened_port.joints],
            port=port,
            readings=opened_port.readings,
            settings=opened_port.settings,
            emulator=opened_port.emulator,
            response_timeout_s=opened_port.response_timeout_s,
            clock_ns=opened_port.clock_ns,
        )
        return DynamixelServos(context)

    @classmethod
    def make_emulator(
        cls,
        joints: Sequence[Joint],
        settings: DynamixelSettings,
        body: EmulatedBody,
        ptys: Sequence[PseudoTerminal],
        clock: DriverClock,
    ) -> EmulatedDynamixel:
        model = select_emulated_model(settings)
        torque_constants_nm_per_a = [get_torque_constant(joint, model) for joint in joints]
        return EmulatedDynamixel(
            body, ptys, torque_constants_nm_per_a, settings.baud, clock.now_ns, model
        )


def make_servo(joint: Joint, port: DynamixelPort, settings: DynamixelSettings) -> DynamixelServo:
    """Return a servo with the parameters of its joint, converted to its horn."""
    drive = joint.drive
    limits = joint.limits
    lower_rad, upper_rad = find_travel_rad(joint)
    return DynamixelServo(
        id=joint.id,
        name=joint.name,
        port=port,
        torque_constant_nm_per_a=get_torque_constant(joint, select_emulated_model(settings)),
        stiffness=joint.motor.stiffness_nm_per_rad / drive.gear**2,
        damping=joint.motor.damping_nm_s_per_rad / drive.gear**2,
        lower_rad=lower_rad,
        upper_rad=upper_rad,
        torque_nm=limits.torque_nm / drive.gear,
        speed_rad_s=limits.speed_rad_s * drive.gear,
    )


def get_torque_constant(joint: Joint, model: EmulatedModel) -> float:
    """Return a joint's torque constant in N·m/A.

    Without one, which only emulated servos allow, it is such that half of the possible current gives full torque.
    """
    max_a = MAX_CURRENT * model.current_a / 2
    return joint.motor.torque_constant_nm_per_a or joint.limits.torque_nm / joint.drive.gear / max_a


def validate_joints(
    config: RunConfig, settings: DynamixelSettings, joints: Sequence[Joint]
) -> None:
    """Raise ConfigError for joints that no servo can drive."""
    has_real_servos = not all(is_emulated(port) for port in settings.ports)
    for joint in joints:
        travel_rad = (joint.limits.upper_rad - joint.limits.lower_rad) * joint.drive.gear
        if joint.id > LAST_ID:
            raise ConfigError(
                f"{make_joint_label(config, joint)}: `id` = {joint.id}; ids of protocol 2.0 are 0 to {LAST_ID}",
                code="drive/unsupported-setting",
            )
        if travel_rad + 2 * SLACK_RAD >= REVOLUTION_RAD:
            raise ConfigError(
                f"{make_joint_label(config, joint)}: its servo travels {travel_rad:.2f} rad, and loses the count of "
                "whole turns when it is off: its angle would be ambiguous afterwards. Narrow its limits (or `gear`) "
                f"to less than {REVOLUTION_RAD - 2 * SLACK_RAD:.2f} rad",
                code="drive/unsupported-setting",
            )
        if joint.motor.torque_constant_nm_per_a is None and has_real_servos:
            raise ConfigError(
                f"{make_joint_label(config, joint)}: `torque_constant_nm_per_a` is missing, and servos measure and "
                "limit amperes: take stall torque over stall current from the e-Manual, and measure it "
                "(docs/hardware/dynamixel.md)",
                code="drive/unsupported-setting",
            )


def select_emulated_model(settings: DynamixelSettings) -> EmulatedModel:
    """Return the model that servos are emulated as: that of the settings, if they name one that is known."""
    number = registers.find_model_number(settings.model)
    if number is None:
        number = MODEL
    current_a = settings.current_unit_a.get(str(number))
    if current_a is None and number in registers.MODELS:
        current_a = registers.MODELS[number].current_a
    if current_a is None:
        current_a = UNKNOWN_CURRENT_UNIT_A
    return EmulatedModel(number, current_a)
