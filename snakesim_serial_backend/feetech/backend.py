"""The backend `feetech`: checks, and the ports that it opens."""

import math
from collections.abc import Collection, Sequence
from typing import ClassVar

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import make_joint_label
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint, Measurement
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.emulator import EmulatedFeetech
from snakesim_serial_backend.feetech.load import PORT_LOAD
from snakesim_serial_backend.feetech.packets import LAST_ID
from snakesim_serial_backend.feetech.port import FeetechPort
from snakesim_serial_backend.feetech.probe import FeetechProbe
from snakesim_serial_backend.feetech.servo import FeetechServo
from snakesim_serial_backend.feetech.servos import FeetechContext, FeetechServos
from snakesim_serial_backend.feetech.settings import NAME, FeetechSettings
from snakesim_serial_backend.port_load import PortLoad
from snakesim_serial_backend.servo_backend import OpenedPort, ServoBackend, find_travel_rad
from snakesim_serial_backend.wire import PseudoTerminal, is_emulated


class FeetechBackend(ServoBackend[EmulatedFeetech]):
    """The backend on Feetech STS servos, real or emulated."""

    Settings = FeetechSettings
    name = NAME
    port_load: ClassVar[PortLoad] = PORT_LOAD
    # Servos have no other mode that the driver uses, even if the robot file lists one.
    supported_modes = ("position",)
    unmeasured: ClassVar[Collection[Measurement]] = ("torque",)
    has_watchdog: ClassVar[bool] = False

    @classmethod
    def open_probe(cls, config: RunConfig, settings: FeetechSettings) -> FeetechProbe:
        return FeetechProbe(config, settings)

    @classmethod
    def check_drives(
        cls, config: RunConfig, settings: FeetechSettings, joints: Sequence[Joint]
    ) -> None:
        if not all(is_emulated(port) for port in settings.ports):
            validate_real_servos(settings)
        validate_joints(config, joints)
        cls.validate_port_load(config, settings, joints)

    @classmethod
    def open_servos(cls, opened_port: OpenedPort[EmulatedFeetech]) -> FeetechServos:
        port = FeetechPort(opened_port.wire, opened_port.response_gap_s)
        context = FeetechContext(
            servos=[make_servo(joint, port, opened_port.settings) for joint in opened_port.joints],
            port=port,
            readings=opened_port.readings,
            settings=opened_port.settings,
            emulator=opened_port.emulator,
            response_timeout_s=opened_port.response_timeout_s,
            clock_ns=opened_port.clock_ns,
        )
        return FeetechServos(context)

    @classmethod
    def make_emulator(
        cls,
        joints: Sequence[Joint],
        settings: FeetechSettings,
        body: EmulatedBody,
        ptys: Sequence[PseudoTerminal],
        clock: DriverClock,
    ) -> EmulatedFeetech:
        stall_torques_nm = [get_stall_torque_nm(joint, settings) for joint in joints]
        return EmulatedFeetech(
            body, ptys, stall_torques_nm, settings.baud, settings.speed_unit_counts_s, clock.now_ns
        )


def make_servo(joint: Joint, port: FeetechPort, settings: FeetechSettings) -> FeetechServo:
    """Return a servo with the parameters of its joint, converted to its horn."""
    lower_rad, upper_rad = find_travel_rad(joint)
    return FeetechServo(
        id=joint.id,
        name=joint.name,
        port=port,
        lower_rad=lower_rad,
        upper_rad=upper_rad,
        torque_nm=joint.limits.torque_nm / joint.drive.gear,
        stall_torque_nm=get_stall_torque_nm(joint, settings),
        min_voltage_v=joint.limits.min_voltage_v,
        homing_offset=settings.homing_offsets.get(joint.name),
    )


def get_stall_torque_nm(joint: Joint, settings: FeetechSettings) -> float:
    """Return the stall torque of a joint's servo. Without a setting, which only emulated servos allow, the joint's.

    It is a little more than the joint demands, because the torque limit is rounded down.
    """
    return settings.stall_torque_nm or 1.01 * joint.limits.torque_nm / joint.drive.gear


def validate_real_servos(settings: FeetechSettings) -> None:
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


def validate_joints(config: RunConfig, joints: Sequence[Joint]) -> None:
    """Raise ConfigError for joints that no servo can drive."""
    last_rad = math.pi - registers.RAD
    for joint in joints:
        if joint.id > LAST_ID:
            raise ConfigError(
                f"{make_joint_label(config, joint)}: `id` = {joint.id}; ids of Feetech servos are 0 to {LAST_ID}",
                code="drive/unsupported-setting",
            )
        lower_rad, upper_rad = find_travel_rad(joint)
        if lower_rad < -math.pi or upper_rad > last_rad:
            raise ConfigError(
                f"{make_joint_label(config, joint)}: its servo travels from {lower_rad:.2f} to {upper_rad:.2f} rad, "
                f"and its position starts again at {math.pi:.2f} rad, where it would turn the long way round: all "
                f"angles must be within -{math.pi:.2f} and {last_rad:.2f} rad. Mount the horn, or set the homing "
                "offset, so that the middle of the travel is at position 2048, and correct `zero_rad`; or narrow the "
                "limits or `gear`",
                code="drive/unsupported-setting",
            )
