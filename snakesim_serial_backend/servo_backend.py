"""A backend on the servos of serial ports, for any protocol: its ports, their load, and servos emulated at their end.

A driver type derives from `ServoBackend`, and adds how its servos are operated and emulated.
"""

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from snakesim_drivers.emulation.drive_emulator import DriveEmulator
from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import (
    assign_port_indices,
    compute_response_timeout_s,
    make_emulated_body,
)
from snakesim_drivers.kit.drive_type import (
    DriverTypeBackend,
    DriverTypeContext,
    make_bus_specs_by_port,
)
from snakesim_drivers.kit.drives import Drives
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.port_load import PortLoad
from snakesim_serial_backend.wire import PseudoTerminal, SerialWire, is_emulated, open_log

# A silence of this length ends an answer, whichever is longer.
MIN_GAP_S = 0.002
GAP_PER_PERIOD = 0.2
EMULATED_GAP_PER_PERIOD = 0.5  # of servos in another process, which a busy computer delays


class ServoEmulator(DriveEmulator[PseudoTerminal]):
    """Emulated servos at the end of pseudo terminals."""

    @abstractmethod
    def __call__(self) -> None:
        """Handle what has arrived, and let time pass up to now."""


EmulatorT = TypeVar("EmulatorT", bound=ServoEmulator)


@dataclass(frozen=True)
class OpenedPort(Generic[EmulatorT]):
    """A serial port that is open, with all that the servos on it need."""

    wire: SerialWire
    response_gap_s: float  # silence that ends an answer
    joints: Sequence[Joint]  # those on this port, from tail to head
    settings: Any  # an instance of the driver type's own `Settings`
    readings: DriveReadings
    emulator: EmulatorT | None  # the servos, if they are emulated in this process
    response_timeout_s: float  # time that a reading waits for answers
    clock_ns: Callable[[], int]


class ServoBackend(DriverTypeBackend, Generic[EmulatorT]):
    """The backend on servos of one protocol, real or emulated.

    Its `Settings` have `ports`, `baud` and `log`.
    """

    port_load: ClassVar[PortLoad]

    @classmethod
    @abstractmethod
    def open_servos(cls, opened_port: OpenedPort[EmulatorT]) -> Drives:
        """Return the drives of a port. Nothing is sent yet."""

    @classmethod
    @abstractmethod
    def make_emulator(
        cls,
        joints: Sequence[Joint],
        settings: Any,
        body: EmulatedBody,
        ptys: Sequence[PseudoTerminal],
        clock: DriverClock,
    ) -> EmulatorT:
        """Make emulated servos for joints.

        Args:
            joints: The joints, from tail to head.
            settings: An instance of `Settings`.
            body: What the servos move.
            ptys: The pseudo terminal of every joint's servo.
            clock: The time of the servos.
        """

    @classmethod
    def make_robot_emulator(
        cls,
        config: RunConfig,
        settings: Any,
        ptys: list[PseudoTerminal],
        clock: DriverClock,
        pose_address: str | None,
    ) -> EmulatorT:
        """Make emulated servos for a whole robot.

        Args:
            config: Configuration of the run, with the robot and the settings of its backend.
            settings: The scenario's section of this driver type.
            ptys: A pseudo terminal for each of its ports.
            clock: The time of the servos.
            pose_address: HOST:PORT to which motion capture sends poses; None if it does not send.
        """
        joints = config.robot.joint_table
        body = make_emulated_body(config, settings, cls.name, pose_address)
        port_indices = assign_port_indices(joints, settings.ports)  # of each joint
        pty_by_joint = [ptys[port_index] for port_index in port_indices]
        return cls.make_emulator(joints, settings, body, pty_by_joint, clock)

    @classmethod
    def list_ports(cls, settings: Any) -> Sequence[str]:
        return settings.ports

    @classmethod
    def list_bus_faults(cls, settings: Any) -> Collection[str]:
        if settings.ports:
            return set()
        return {"cut"}

    @classmethod
    def validate_port_load(cls, config: RunConfig, settings: Any, joints: Sequence[Joint]) -> None:
        """Raise ConfigError when a port cannot carry its servos."""
        port_indices = assign_port_indices(joints, settings.ports)  # of each joint
        servo_count_by_port = Counter(port_indices)
        max_servo_count = max(servo_count_by_port.values())
        cls.port_load.check(
            max_servo_count,
            config.rate_hz / settings.decimation,
            settings.baud,
            f"backends.{cls.name}",
        )

    @classmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        config = context.config
        settings = context.settings
        joints = context.joints
        clock = context.clock
        body = context.body
        log = open_log(settings.log, f"backends.{cls.name}.log")

        def open_drives(
            port_name: str, joint_indices: Sequence[int], readings: DriveReadings
        ) -> Drives:
            """Open a port with the servos of some joints; emulated servos are on a pseudo terminal.

            Args:
                port_name: Name of the serial port; not used for emulated servos.
                joint_indices: Indices in the robot of the joints with servos on this port.
                readings: Object that stores the values that the servos report.
            """
            emulator = None
            if body is None:
                wire = SerialWire(port_name, settings.baud, log)
            else:
                pty = PseudoTerminal()
                emulator = cls.make_emulator(
                    list(joints.values()), settings, body, [pty] * len(joints), clock
                )
                wire = SerialWire(pty.path, settings.baud, log, pty, emulator)
            gap_per_period = EMULATED_GAP_PER_PERIOD if is_emulated(wire.port) else GAP_PER_PERIOD
            opened_port = OpenedPort(
                wire=wire,
                response_gap_s=max(MIN_GAP_S, gap_per_period * config.period_ns * 1e-9),
                joints=[joints[number] for number in joint_indices],
                settings=settings,
                readings=readings,
                emulator=emulator,
                response_timeout_s=compute_response_timeout_s(config, settings.decimation),
                clock_ns=clock.now_ns,
            )
            return cls.open_servos(opened_port)

        ports = settings.ports
        if body is not None:
            ports = [cls.name]
        return make_bus_specs_by_port(joints, settings, ports, open_drives)


def find_travel_rad(joint: Joint) -> tuple[float, float]:
    """Return the smallest and the largest angle of the horn of a joint's servo."""
    ratio = joint.drive.sign * joint.drive.gear  # rotation of the horn for one of the joint
    end_a_rad = joint.drive.zero_rad + ratio * joint.limits.lower_rad
    end_b_rad = joint.drive.zero_rad + ratio * joint.limits.upper_rad
    return min(end_a_rad, end_b_rad), max(end_a_rad, end_b_rad)
