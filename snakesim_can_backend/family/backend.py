"""A backend over a family of drives on CAN: settings, checks, and the buses that it opens."""

import uuid
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from snakesim_can_backend.bus.adapter import check_channel, is_emulated, open_wire
from snakesim_can_backend.bus.bus import VirtualWire, Wire
from snakesim_can_backend.bus.load import mbit, worst_s
from snakesim_can_backend.bus.log import logged
from snakesim_can_backend.family.drives import CanDrives
from snakesim_can_backend.family.traffic import Load, Traffic, load_of
from snakesim_can_backend.family.twin import CanTwin
from snakesim_hal.drivers.drive_backend import Clock, DriveBackend
from snakesim_hal.drivers.drive_settings import DriveSettings, answer_limit_s, body_of, check_settings, port_of, who
from snakesim_hal.drivers.mocap import receiver
from snakesim_hal.drivers.readings import Readings
from snakesim_hal.errors import ConfigError
from snakesim_hal.injection import KINDS
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import Pace


class CanDriveSettings(DriveSettings, frozen=True, kw_only=True):
    """Fields that the settings of every family on CAN have."""

    # Buses: SocketCAN interfaces such as can0, or INTERFACE:CHANNEL of python-can. Empty: emulated drives, here.
    channels: Annotated[list[Annotated[str, Meta(min_length=1, max_length=127)]], Meta(max_length=8)] = []
    bit_rate: Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})] = 1_000_000
    log: str = ""  # candump file of all frames; empty: none

    @property
    def fd_rate(self) -> int | None:
        """Bit rate of the data on CAN FD; None: classic CAN."""
        return None


class CanDriveBackend(DriveBackend):
    """A `snakesim_hal.backend.Backend` on drives on CAN, real or emulated. A family gives what is declared here."""

    Settings: ClassVar[type[CanDriveSettings]]
    name: ClassVar[str]  # of the backend
    a_drive: ClassVar[str]  # what the family calls one, in the plural
    last_id: ClassVar[int]
    traffic: ClassVar[Traffic]
    drives: ClassVar[
        Callable[..., CanDrives]
    ]  # (config, settings, joints, wires, readings, and the kit's arguments by name)
    twin: ClassVar[Callable[..., CanTwin]]  # (config, settings, body, wires, clock)
    says_every_s: ClassVar[float | None] = None  # how often a drive reports its state; None: each period

    @classmethod
    def check_joint(cls, joint: Joint, where: str, config: RunConfig, settings: Any, *, real: bool) -> None:
        """Raise ConfigError for a joint that no drive of this family can be. where: the joint, for the message."""

    @classmethod
    def check(cls, config: RunConfig, settings: Any) -> tuple[Pace, ...]:
        """Drives on a bus support real time only; emulated ones in this process lockstep, too. Raises ConfigError."""
        check_gains(config.robot)
        here = not settings.channels
        bus_faults = {*KINDS["bus"]} - (set() if here else {"full"})
        check_settings(config, settings, settings.channels, twins=here, bus_faults=bus_faults)
        for channel in settings.channels:
            check_channel(channel, fd=settings.fd_rate is not None)
        real = not all(map(is_emulated, settings.channels))
        for joint in config.robot.joint_table:
            if joint.id > cls.last_id:
                raise ConfigError(
                    f"{who(config, joint)}: `id` = {joint.id}; {cls.a_drive} have ids of 0 to {cls.last_id}"
                )
            cls.check_joint(joint, who(config, joint), config, settings, real=real)
        cls.load(config, settings).check(cls.name, config.rate_hz, cls.rates(settings))
        return ("lockstep", "realtime") if here else ("realtime",)

    @classmethod
    def load(cls, config: RunConfig, settings: Any) -> Load:
        """Of the fullest bus."""
        on = port_of(config, settings.channels)
        return load_of(
            cls.traffic, on, config.rate_hz, lambda length: worst_s(length, settings.bit_rate, settings.fd_rate)
        )

    @staticmethod
    def rates(settings: Any) -> str:
        """Bit rates, in words."""
        return mbit(settings.bit_rate) + (f" with data at {mbit(settings.fd_rate)}" if settings.fd_rate else "")

    @staticmethod
    def open(settings: Any) -> list[Wire]:
        """Every bus. Raises ConfigError and BackendError."""
        rates = settings.bit_rate, settings.fd_rate
        return [open_wire(channel, None, *rates) for channel in settings.channels]

    @classmethod
    def twin_on(
        cls, config: RunConfig, settings: Any, wires: Sequence[Wire], clock: Clock, pose: str | None
    ) -> CanTwin:
        """Emulated drives of a whole robot."""
        body = body_of(config, settings, cls.name, pose)
        return cls.twin(config, settings, body, [wires[bus] for bus in port_of(config, settings.channels)], clock.ns)

    def __init__(self, config: RunConfig, settings: Any) -> None:
        """Open the buses and find every drive; nothing is enabled. Raises ConfigError and BackendError."""
        self.check(config, settings)
        clock, own, fd = Clock(config), not settings.channels, settings.fd_rate is not None
        mocap = receiver(config, settings.pose_listen, twins=own, clock=lambda _stamp_ns: clock.ns())

        def make_drives(readings: Readings) -> CanDrives:
            twin = None
            if own:
                name, pose = f"virtual-{uuid.uuid4().hex[:8]}", mocap.address if mocap is not None else None
                twin = self.twin_on(config, settings, [VirtualWire(name, fd=fd)], clock, pose)
                wires: list[Wire] = [VirtualWire(name, twin, fd=fd)]
            else:
                wires = self.open(settings)
            wires = logged(wires, settings.log, self.name, fd=fd)
            says_every_ns = config.period_ns if self.says_every_s is None else round(self.says_every_s * 1e9)
            return type(self).drives(
                config,
                settings,
                config.robot.joint_table,
                [wires[bus] for bus in port_of(config, settings.channels)],
                readings,
                twin=twin,
                emulated=all(map(is_emulated, settings.channels)),
                answer_s=answer_limit_s(config),
                bring_up_s=settings.bring_up_limit_s,
                says_every_ns=says_every_ns,
                clock_ns=clock.ns,
            )

        super().__init__(config, self.name, "+".join(settings.channels), clock, mocap, make_drives)
