"""Settings that every driver type has in the scenario, and checks of them before a start."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any

from msgspec import Meta

from snakesim_drivers.emulation.emulated_body import FAULTS, EmulatedBody
from snakesim_drivers.emulation.mounted import MountedDrive, validate_mounting_overrides
from snakesim_drivers.emulation.shared_physics import SharedPhysics, make_physics_model
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_drivers.motion_capture.mocap import validate_pose_settings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_plan import validate_faults_for_backend
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig

# Control periods that a bus waits for responses: the rest is for the controller.
RESPONSE_TIMEOUT_PERIODS = 0.5
# Robot time does not pass while the driver waits, so a busy computer changes nothing.
LOCKSTEP_RESPONSE_TIMEOUT_S = 2.0
# Watchdog timeout in setpoint periods: one lost setpoint must not stop a drive.
MIN_WATCHDOG_PERIODS = 2.2
# Duration of a lease in readings of a bus: joint states have to be younger than a lease.
MIN_LEASE_ROUNDS = 1.5


class BodySettings(FileStruct, frozen=True, kw_only=True):
    """Settings that concern a robot as a whole, whatever its drives."""

    pose_listen: Annotated[str, Meta(pattern="^[^:]*:[0-9]{1,5}$")] | None = None
    """UDP address HOST:PORT at which the pose from motion capture arrives. None: there is no motion capture."""

    physics_model: str = "mujoco"
    """Body that emulated drives move: `mujoco`, `inertia`, or another installed physics model."""

    physics_model_settings: dict[str, Any] = {}
    """Settings of the physics model, which checks them."""

    mounted: Mapping[str, MountedDrive] = {}
    """For joints of emulated drives, how each is really mounted, to see what a wrong robot file does."""


class DriveSettings(BodySettings, frozen=True, kw_only=True):
    """Settings that every driver type has. A driver type adds its ports."""

    watchdog_s: Annotated[float, Meta(ge=0.02, le=1, extra_json_schema={"unit": "s"})] = 0.1
    """Time without a setpoint after which a drive stops by itself."""

    bring_up_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    """Time limit for finding and configuring all drives at the start."""

    decimation: Annotated[int, Meta(ge=1, le=100)] = 1
    """Control cycles from one reading of a bus to the next."""


def make_emulated_body(
    config: RunConfig, settings: BodySettings, backend: str, pose_address: str | None
) -> EmulatedBody:
    """Create the emulated body of a whole robot, through which all of its emulated drives share one physics model.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: Settings of the backend.
        backend: Name of the backend.
        pose_address: HOST:PORT to which emulated motion capture sends poses; None if it does not send.

    Returns:
        The body, with all joints of the robot.

    Raises:
        ConfigError: The physics model is unknown, or the address is malformed.
    """
    physics_model = make_physics_model(config, settings, backend)
    pose_sender = PoseSender(pose_address) if pose_address else None
    physics = SharedPhysics(config, physics_model, settings.mounted, pose_sender)
    return EmulatedBody(physics, range(config.robot.chain.modules))


def validate_body_settings(
    config: RunConfig,
    settings: BodySettings,
    *,
    are_emulated: bool,
    bus_count: int,
    bus_fault_kinds: Collection[str] = (),
) -> None:
    """Check the settings that all driver types share: motion capture, mounting and injected faults.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: Settings of the backend.
        are_emulated: Whether this process emulates the drives.
        bus_count: Number of buses that the settings name; 0 if the drives are emulated in this process.
        bus_fault_kinds: Kinds of faults that can be injected into these buses, such as "cut".

    Raises:
        ConfigError: A setting or an injected fault does not suit the robot.
    """
    validate_pose_settings(config, settings.pose_listen)
    validate_mounting_overrides(
        config.robot, config.backend_section, settings.mounted, are_emulated=are_emulated
    )
    possible_fault_kinds = {*bus_fault_kinds}
    if are_emulated:
        possible_fault_kinds |= {*FAULTS}
        reason = f"its emulated drives know {', '.join(FAULTS)}"
    else:
        reason = "its drives are not emulated in its process"
    if config.clock_mode == "lockstep" and are_emulated:
        reason += "; and in lockstep no bus is slow"
    else:
        possible_fault_kinds.add("slow")
    validate_faults_for_backend(
        config, supported_kinds=possible_fault_kinds, bus_count=max(bus_count, 1), reason=reason
    )


def validate_bus_settings(
    config: RunConfig,
    settings: DriveSettings,
    section: str,
    joints: Sequence[Joint],
    ports: Collection[str],
) -> None:
    """Check the ports of the joints, and the watchdog timeout and decimation of a driver type.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: Settings of the driver type.
        section: Dotted name of the settings section in the scenario, used in error messages.
        joints: The joints that drives of this type move.
        ports: Valid values of `drive.port` of a joint.

    Raises:
        ConfigError: A joint names a port that does not exist, the watchdog timeout is too short for the control
            period, or the decimation makes joint states older than a lease.
    """
    for joint in joints:
        if joint.drive.port and joint.drive.port not in ports:
            raise ConfigError(
                f"{make_joint_label(config, joint)}: `port` = {joint.drive.port!r} is not among those of "
                f"`{section}`: {', '.join(ports) or 'none'}",
                code="bus/invalid-channel",
            )
    _validate_watchdog(config, settings, section)
    _validate_decimation(config, settings.decimation, section)


def _validate_watchdog(config: RunConfig, settings: DriveSettings, section: str) -> None:
    """Raise ConfigError if a single lost setpoint would let the watchdogs of drives expire."""
    decimation = settings.decimation
    min_watchdog_s = MIN_WATCHDOG_PERIODS * decimation / config.rate_hz
    if settings.watchdog_s >= min_watchdog_s:
        return
    decimation_text = f" and `decimation` = {decimation}" if decimation > 1 else ""
    raise ConfigError(
        f"`{section}.watchdog_s` = {settings.watchdog_s:g} s at `rate_hz` = {config.rate_hz:g}{decimation_text}: "
        f"one lost setpoint would stop the drives; give them {min_watchdog_s:.3g} s or more",
        code="drive/watchdog-too-short",
    )


def _validate_decimation(config: RunConfig, decimation: int, section: str) -> None:
    """Raise ConfigError if joint states would be older than a lease because a bus is read too rarely."""
    max_decimation = int(config.lease_ns / (MIN_LEASE_ROUNDS * config.period_ns))
    if decimation <= max_decimation:
        return
    joint_state_age_ms = 1000 * decimation / config.rate_hz
    raise ConfigError(
        f"`{section}.decimation` = {decimation} at `rate_hz` = {config.rate_hz:g}: its joint states would be "
        f"{joint_state_age_ms:.0f} ms old, and a lease is {config.lease_ns * 1e-6:.0f} ms; at most {max_decimation}",
        code="drive/watchdog-too-short",
    )


def compute_response_timeout_s(config: RunConfig, decimation: int = 1) -> float:
    """Return how long a bus may wait for the responses of its drives, in s.

    Args:
        config: Configuration of the run, with clock mode and control period.
        decimation: Control cycles from one reading of the bus to the next.
    """
    if config.clock_mode == "lockstep":
        return LOCKSTEP_RESPONSE_TIMEOUT_S
    return RESPONSE_TIMEOUT_PERIODS * decimation * config.period_ns * 1e-9


def assign_port_indices(joints: Sequence[Joint], ports: Collection[str]) -> list[int]:
    """Return the index of the port of every joint.

    Joints that name no `port` are distributed evenly, from the tail on. Without any ports all joints get index 0.

    Args:
        joints: Joints from tail to head.
        ports: Names of the ports.
    """
    index_by_port = {port: i for i, port in enumerate(ports)}
    joints_per_port = math.ceil(len(joints) / max(len(ports), 1))
    return [
        index_by_port.get(joint.drive.port, i // joints_per_port) for i, joint in enumerate(joints)
    ]


def make_joint_label(config: RunConfig, joint: Joint) -> str:
    """Return the name of a joint with that of its robot, for error messages."""
    return f"robot {config.robot.name!r}, {joint.name}"
