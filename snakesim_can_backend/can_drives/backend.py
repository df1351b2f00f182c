"""A backend over a driver type of drives on CAN: settings, checks, and the buses that it opens."""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from snakesim_can_backend.bus.adapter import check_channels, is_emulated, open_wire
from snakesim_can_backend.bus.bus import VirtualWire, Wire, make_virtual_channel
from snakesim_can_backend.bus.load import format_bit_rate, worst_frame_s
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.can_drives.drives import CanDrives
from snakesim_can_backend.can_drives.emulator import CanEmulator
from snakesim_can_backend.can_drives.traffic import Load, Traffic, load_of
from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.buses import Bus
from snakesim_drivers.kit.drive_backend import Clock
from snakesim_drivers.kit.drive_settings import DriveSettings, answer_limit_s, body_of, port_of, who
from snakesim_drivers.kit.drive_type import DriverTypeBackend, buses_of
from snakesim_drivers.kit.readings import Readings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import KINDS
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig


class CanDriveSettings(DriveSettings, frozen=True, kw_only=True):
    """Fields that the settings of every driver type on CAN have."""

    # Buses: SocketCAN interfaces such as can0, or INTERFACE:CHANNEL of python-can. Empty: emulated drives, here.
    channels: Annotated[list[Annotated[str, Meta(min_length=1, max_length=127)]], Meta(max_length=8)] = []
    bit_rate: Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})] = 1_000_000
    log: str = ""  # candump file of all frames; empty: none

    @property
    def fd_rate(self) -> int | None:
        """Bit rate of the data on CAN FD; None: classic CAN."""
        return None


class CanDriveBackend(DriverTypeBackend):
    """A backend for drives on CAN, real or emulated. A driver type adds what is declared here."""

    Settings: ClassVar[type[Any]]  # `CanDriveSettings`
    a_drive: ClassVar[str]  # what the driver type calls one, in the plural
    first_id: ClassVar[int] = 0
    last_id: ClassVar[int]
    reserved_ids: ClassVar[str]  # what the ids beyond these are, for a message
    traffic: ClassVar[Traffic]
    # (joints of the driver type, settings, joints of the bus, wire, readings, and the kit's arguments by name)
    drives: ClassVar[Callable[..., CanDrives]]
    emulator: ClassVar[Callable[..., CanEmulator]]  # (joints of the driver type, settings, body, wires, clock)
    says_every_s: ClassVar[float | None] = None  # how often a drive reports its state; None: when it is asked

    @classmethod
    def check_joint(cls, config: RunConfig, settings: Any, joint: Joint) -> None:
        """Raise ConfigError for a joint that no drive of this driver type can be."""

    @classmethod
    def ports(cls, settings: Any) -> Sequence[str]:
        """Its channels."""
        return settings.channels

    @classmethod
    def bus_faults(cls, settings: Any) -> Collection[str]:
        """A full queue is that of a kernel's interface."""
        return {*KINDS["bus"]} - {"slow", "full" if settings.channels else ""}

    @classmethod
    def check_drives(cls, config: RunConfig, settings: Any, joints: Sequence[Joint]) -> None:
        """Channels, ids, load, and what the driver type adds."""
        check_channels(settings.channels, fd=settings.fd_rate is not None)
        for joint in joints:
            if not cls.first_id <= joint.id <= cls.last_id:
                raise ConfigError(
                    f"{who(config, joint)}: `id` = {joint.id}, and {cls.a_drive} have ids of {cls.first_id} to "
                    f"{cls.last_id}: {cls.reserved_ids}. Give its drive another id, and say that as `id` of the joint"
                )
            cls.check_joint(config, settings, joint)
        rate_hz = config.rate_hz / settings.decimation
        cls.load(rate_hz, settings, joints).check(cls.name, rate_hz, cls.rates(settings))

    @staticmethod
    def real(settings: Any) -> bool:
        """Whether something on a bus may really move."""
        return not all(map(is_emulated, settings.channels))

    @classmethod
    def load(cls, rate_hz: float, settings: Any, joints: Sequence[Joint]) -> Load:
        """Of the fullest bus."""
        on = port_of(joints, settings.channels)
        return load_of(
            cls.traffic, on, rate_hz, lambda length: worst_frame_s(length, settings.bit_rate, settings.fd_rate)
        )

    @staticmethod
    def rates(settings: Any) -> str:
        """Bit rates, in words."""
        return format_bit_rate(settings.bit_rate) + (
            f" with data at {format_bit_rate(settings.fd_rate)}" if settings.fd_rate else ""
        )

    @classmethod
    def emulator_on(
        cls, config: RunConfig, settings: Any, wires: Sequence[Wire], clock: Clock, pose: str | None
    ) -> CanEmulator:
        """Emulated drives of a whole robot."""
        body, joints = body_of(config, settings, cls.name, pose), config.robot.joint_table
        return cls.emulator(
            joints, settings, body, [wires[bus] for bus in port_of(joints, settings.channels)], clock.ns
        )

    @classmethod
    def buses(
        cls, config: RunConfig, settings: Any, joints: Mapping[int, Joint], clock: Clock, body: EmulatedBody | None
    ) -> list[Bus]:
        """One for each channel, or one of emulated drives."""
        fd, everybody = settings.fd_rate is not None, list(joints.values())
        says_every_ns = config.period_ns * settings.decimation
        if cls.says_every_s is not None:
            says_every_ns = max(round(cls.says_every_s * 1e9), says_every_ns)
        log = open_log(Path(settings.log), cls.name) if settings.log else None

        def open_drives(channel: str, mine: Sequence[int], readings: Readings) -> CanDrives:
            emulator = None
            if body is not None:
                other_end = [VirtualWire(channel, fd=fd)] * len(everybody)
                emulator = cls.emulator(everybody, settings, body, other_end, clock.ns)
                wire: Wire = VirtualWire(channel, emulator, fd=fd)
            else:
                wire = open_wire(channel, None, settings.bit_rate, settings.fd_rate)
            return cls.drives(
                everybody,
                settings,
                [joints[j] for j in mine],
                wire if log is None else LoggedWire(wire, log, fd=fd),
                readings,
                emulator=emulator,
                emulated=body is not None or is_emulated(channel),
                answer_s=answer_limit_s(config, settings.decimation),
                bring_up_s=settings.bring_up_limit_s,
                says_every_ns=says_every_ns,
                clock_ns=clock.ns,
            )

        channels = [make_virtual_channel()] if body is not None else settings.channels
        return buses_of(joints, settings, channels, open_drives)
