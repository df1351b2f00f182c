"""A backend over a driver type of drives on CAN: settings, checks, and the buses that it opens."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from snakesim_can_backend.bus.adapter import is_emulated, open_wire, validate_channels
from snakesim_can_backend.bus.bus import VirtualWire, Wire, make_virtual_channel
from snakesim_can_backend.bus.load import compute_max_frame_duration_s, format_bit_rate
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.can_drives.drives import CanDrives, CanDrivesContext
from snakesim_can_backend.can_drives.emulator import CanEmulator, CanEmulatorContext
from snakesim_can_backend.can_drives.traffic import BusLoad, CycleTraffic, compute_load
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import (
    DriveSettings,
    assign_port_indices,
    compute_response_timeout_s,
    make_emulated_body,
    make_joint_label,
)
from snakesim_drivers.kit.drive_type import (
    DriverTypeBackend,
    DriverTypeContext,
    make_bus_specs_by_port,
)
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import FAULT_KINDS
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig


class CanDriveSettings(DriveSettings, frozen=True, kw_only=True):
    """Settings that every driver type on CAN has."""

    channels: Annotated[
        list[Annotated[str, Meta(min_length=1, max_length=127)]], Meta(max_length=8)
    ] = []
    """CAN buses: SocketCAN interfaces such as can0, INTERFACE:CHANNEL of python-can, or local:FOLDER for emulated
    drives. Empty: emulated drives in this process.
    """

    bit_rate: Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})] = (
        1_000_000
    )
    """Bit rate of the buses, for which loads are computed and to which adapters are set."""

    log: str = ""
    """Candump file of all frames. Empty: no file is written."""

    @property
    def fd_rate(self) -> int | None:
        """Bit rate of the data on CAN FD; None for classic CAN."""
        return None


class CanDriveBackend(DriverTypeBackend):
    """A backend for drives on CAN, real or emulated.

    A driver type sets the class variables, with a subclass of `CanDriveSettings` as `Settings`, and may override
    `validate_joint`.
    """

    drives_class: ClassVar[Callable[[CanDrivesContext], CanDrives]]
    emulator_class: ClassVar[Callable[[CanEmulatorContext], CanEmulator]]
    plural_noun: ClassVar[str]  # what the driver type calls its drives in messages, such as "axes"
    first_id: ClassVar[int] = 0
    last_id: ClassVar[int]
    reserved_ids: ClassVar[str]  # what the ids beyond these are, for a message
    traffic: ClassVar[CycleTraffic]
    # Of a drive's state; None: a drive reports it when requested.
    report_period_s: ClassVar[float | None] = None

    @classmethod
    def validate_joint(cls, config: RunConfig, settings: Any, joint: Joint) -> None:
        """Check that a drive of this type suits a joint.

        Raises:
            ConfigError: A drive of this type does not suit the joint.
        """
        del config, settings, joint

    @classmethod
    def list_ports(cls, settings: Any) -> Sequence[str]:
        return settings.channels

    @classmethod
    def list_bus_faults(cls, settings: Any) -> Collection[str]:
        """Return the kinds of faults that can be injected into the buses.

        A full queue can be injected only into a virtual bus in this process: a real bus has the queue of the kernel.
        """
        impossible_kinds = {"slow"}
        if settings.channels:
            impossible_kinds.add("full")
        return {*FAULT_KINDS["bus"]} - impossible_kinds

    @classmethod
    def check_drives(cls, config: RunConfig, settings: Any, joints: Sequence[Joint]) -> None:
        """Check channels, ids, joints and bus load of the joints that have drives of this type.

        Args:
            config: Configuration of the run.
            settings: Settings of the driver type.
            joints: Joints with drives of this type.

        Raises:
            ConfigError: A channel, an id, a joint or the load of a bus does not suit this driver type.
        """
        validate_channels(settings.channels, needs_fd=settings.fd_rate is not None)
        for joint in joints:
            if not cls.first_id <= joint.id <= cls.last_id:
                raise ConfigError(
                    f"{make_joint_label(config, joint)}: `id` = {joint.id}, and {cls.plural_noun} have ids of "
                    f"{cls.first_id} to {cls.last_id}: {cls.reserved_ids}. Give its drive another id, and set it as "
                    f"`id` of the joint",
                    code="drive/unsupported-setting",
                )
            cls.validate_joint(config, settings, joint)
        rate_hz = config.rate_hz / settings.decimation
        cls.compute_load(rate_hz, settings, joints).check(
            cls.name, rate_hz, cls.describe_bit_rates(settings)
        )

    @staticmethod
    def has_real_bus(settings: Any) -> bool:
        """Return whether real motors may be on one of the buses."""
        return not all(map(is_emulated, settings.channels))

    @classmethod
    def compute_load(cls, rate_hz: float, settings: Any, joints: Sequence[Joint]) -> BusLoad:
        """Return the load of the bus with the most drives.

        Args:
            rate_hz: Rate of the control cycle on the bus.
            settings: Settings of the driver type, with channels and bit rates.
            joints: Joints with drives of this type.
        """

        def compute_frame_duration_s(length: int) -> float:
            return compute_max_frame_duration_s(length, settings.bit_rate, settings.fd_rate)

        return compute_load(
            cls.traffic,
            assign_port_indices(joints, settings.channels),
            rate_hz,
            compute_frame_duration_s,
        )

    @staticmethod
    def describe_bit_rates(settings: Any) -> str:
        """Return the bit rates in words."""
        rates = format_bit_rate(settings.bit_rate)
        if settings.fd_rate:
            rates += f" with data at {format_bit_rate(settings.fd_rate)}"
        return rates

    @classmethod
    def make_emulator(
        cls,
        config: RunConfig,
        settings: Any,
        wires: Sequence[Wire],
        clock: DriverClock,
        pose_address: str | None,
    ) -> CanEmulator:
        """Create the emulated drives of a whole robot, on buses that are already open.

        Args:
            config: Configuration of the run, with the robot and the settings of its backend.
            settings: Settings of the driver type, an instance of its class `Settings`.
            wires: Ends of the open buses, one for each of `settings.channels`.
            clock: Clock of the drives.
            pose_address: HOST:PORT to which emulated motion capture sends poses; None if it does not send.
        """
        body = make_emulated_body(config, settings, cls.name, pose_address)
        joints = config.robot.joint_table
        channel_indices = assign_port_indices(joints, settings.channels)  # of each joint
        wire_by_joint = [wires[channel_index] for channel_index in channel_indices]
        return cls.emulator_class(
            CanEmulatorContext(joints, settings, body, wire_by_joint, clock.now_ns)
        )

    @classmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        """Return the specification of one bus for each channel, or of one virtual bus with emulated drives.

        Args:
            context: Configuration, settings, joints, clock, and the body that emulated drives move; without a body the
                drives are on real buses.
        """
        config = context.config
        settings = context.settings
        joints = context.joints
        clock = context.clock
        body = context.body
        all_joints = list(joints.values())
        uses_fd = settings.fd_rate is not None
        report_period_ns = config.period_ns * settings.decimation
        if cls.report_period_s is not None:
            report_period_ns = max(round(cls.report_period_s * 1e9), report_period_ns)
        log = open_log(Path(settings.log), cls.name) if settings.log else None

        def open_drives(channel: str, indices: Sequence[int], readings: DriveReadings) -> CanDrives:
            """Open the bus of a channel, virtual if the drives are emulated, and return its drives; nothing is sent.

            Args:
                channel: Name of the channel.
                indices: Indices in the robot of the joints with drives on this bus.
                readings: Object that stores the values that the drives report.
            """
            emulator = None
            if body is not None:
                emulator_wire = VirtualWire(channel, fd=uses_fd)
                wires = [emulator_wire] * len(all_joints)
                emulator = cls.emulator_class(
                    CanEmulatorContext(all_joints, settings, body, wires, clock.now_ns)
                )
                wire: Wire = VirtualWire(channel, emulator, fd=uses_fd)
            else:
                wire = open_wire(channel, None, settings.bit_rate, settings.fd_rate)
            if log is not None:
                wire = LoggedWire(wire, log, fd=uses_fd)
            drives_context = CanDrivesContext(
                all_joints=all_joints,
                joints=[joints[index] for index in indices],
                settings=settings,
                wire=wire,
                readings=readings,
                emulator=emulator,
                emulated=body is not None or is_emulated(channel),
                response_timeout_s=compute_response_timeout_s(config, settings.decimation),
                bring_up_timeout_s=settings.bring_up_limit_s,
                cycle_ns=config.period_ns * settings.decimation,
                report_period_ns=report_period_ns,
                clock_ns=clock.now_ns,
            )
            return cls.drives_class(drives_context)

        channels = settings.channels if body is None else [make_virtual_channel()]
        return make_bus_specs_by_port(joints, settings, channels, open_drives)
