"""A backend on the servos of serial ports, for any protocol: its ports, their load, and servos emulated at their end.

A driver type derives from `ServoBackend`, and adds how its servos are operated and emulated.
"""

from abc import abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from snakesim_drivers.emulation.drive_emulator import DriveEmulator
from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import answer_limit_s, assign_ports, make_body
from snakesim_drivers.kit.drive_type import DriverTypeBackend, DriverTypeContext, group_by_port
from snakesim_drivers.kit.drives import Drives
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.port_load import PortLoad
from snakesim_serial_backend.wire import Pty, SerialWire, is_emulated, open_log

# A silence of this length ends an answer, whichever is longer.
MIN_GAP_S = 0.002
GAP_PER_PERIOD = 0.2
EMULATED_GAP_PER_PERIOD = 0.5  # of servos in another process, which a busy computer delays


class ServoEmulator(DriveEmulator[Pty]):
    """Emulated servos at the end of pseudo terminals."""

    @abstractmethod
    def __call__(self) -> None:
        """Handle what has arrived, and let time pass up to now."""


EmulatorT = TypeVar("EmulatorT", bound=ServoEmulator)


@dataclass(frozen=True)
class OpenedPort(Generic[EmulatorT]):
    """A serial port that is open, with all that the servos on it need."""

    wire: SerialWire
    gap_s: float  # silence that ends an answer
    joints: Sequence[Joint]  # those on this port, from tail to head
    settings: Any  # an instance of the driver type's own `Settings`
    readings: DriveReadings
    emulator: EmulatorT | None  # the servos, if they are emulated in this process
    answer_s: float  # time that a reading waits for answers
    clock_ns: Callable[[], int]


class ServoBackend(DriverTypeBackend, Generic[EmulatorT]):
    """The backend on servos of one protocol, real or emulated.

    Its `Settings` have `ports`, `baud` and `log`.
    """

    port_load: ClassVar[PortLoad]

    @classmethod
    @abstractmethod
    def open_servos(cls, opened: OpenedPort[EmulatorT]) -> Drives:
        """Return the drives of a port. Nothing is sent yet."""

    @classmethod
    @abstractmethod
    def make_emulator(
        cls, joints: Sequence[Joint], settings: Any, body: EmulatedBody, ptys: Sequence[Pty], clock: DriverClock
    ) -> EmulatorT:
        """Make emulated servos for joints.

        Args:
            joints: the joints, from tail to head.
            settings: an instance of `Settings`.
            body: what the servos move.
            ptys: the pseudo terminal of every joint's servo.
            clock: the time of the servos.
        """

    @classmethod
    def make_robot_emulator(
        cls, config: RunConfig, settings: Any, ptys: list[Pty], clock: DriverClock, pose: str | None
    ) -> EmulatorT:
        """Make emulated servos for a whole robot.

        Args:
            config: configuration of the run, with the robot and the settings of its backend.
            settings: the scenario's section of this driver type.
            ptys: a pseudo terminal for each of its ports.
            clock: the time of the servos.
            pose: where motion capture sends poses, HOST:PORT; None: nowhere.
        """
        joints = config.robot.joint_table
        body = make_body(config, settings, cls.name, pose)
        pty_of_joint = [ptys[bus] for bus in assign_ports(joints, settings.ports)]
        return cls.make_emulator(joints, settings, body, pty_of_joint, clock)

    @classmethod
    def list_ports(cls, settings: Any) -> Sequence[str]:
        return settings.ports

    @classmethod
    def list_bus_faults(cls, settings: Any) -> Collection[str]:
        if settings.ports:
            return set()
        return {"cut"}

    @classmethod
    def check_port_load(cls, config: RunConfig, settings: Any, joints: Sequence[Joint]) -> None:
        """Raise ConfigError when a port cannot carry its servos."""
        bus_of_joint = assign_ports(joints, settings.ports)
        fullest = max(bus_of_joint.count(bus) for bus in set(bus_of_joint))
        cls.port_load.check(fullest, config.rate_hz / settings.decimation, settings.baud, f"backends.{cls.name}")

    @classmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        config = context.config
        settings = context.settings
        joints = context.joints
        clock = context.clock
        body = context.body
        log = open_log(settings.log, f"backends.{cls.name}.log")

        def open_drives(port_name: str, numbers: Sequence[int], readings: DriveReadings) -> Drives:
            """Open a port with the servos of these joints; emulated servos are on a pseudo terminal."""
            emulator = None
            if body is None:
                wire = SerialWire(port_name, settings.baud, log)
            else:
                pty = Pty()
                emulator = cls.make_emulator(list(joints.values()), settings, body, [pty] * len(joints), clock)
                wire = SerialWire(pty.path, settings.baud, log, pty, emulator)
            gap_per_period = EMULATED_GAP_PER_PERIOD if is_emulated(wire.port) else GAP_PER_PERIOD
            opened = OpenedPort(
                wire=wire,
                gap_s=max(MIN_GAP_S, gap_per_period * config.period_ns * 1e-9),
                joints=[joints[number] for number in numbers],
                settings=settings,
                readings=readings,
                emulator=emulator,
                answer_s=answer_limit_s(config, settings.decimation),
                clock_ns=clock.now_ns,
            )
            return cls.open_servos(opened)

        ports = settings.ports
        if body is not None:
            ports = [cls.name]
        return group_by_port(joints, settings, ports, open_drives)


def find_travel_rad(joint: Joint) -> tuple[float, float]:
    """Return the smallest and the largest angle of the horn of a joint's servo."""
    ratio = joint.drive.sign * joint.drive.gear  # rotation of the horn for one of the joint
    end_a_rad = joint.drive.zero_rad + ratio * joint.limits.lower_rad
    end_b_rad = joint.drive.zero_rad + ratio * joint.limits.upper_rad
    return min(end_a_rad, end_b_rad), max(end_a_rad, end_b_rad)
