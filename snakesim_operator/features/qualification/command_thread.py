"""Commands one joint through the host in a thread of its own, while the main thread waits for a person or a drive."""

import math
import threading
import time
from dataclasses import dataclass

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.network.commanding import CommandingClient
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, JointMode, JointState, RobotDescription
from snakesim_hal.wire.setpoints import RequestedSetpoints

CONNECT_TIMEOUT_S = 5.0
STOP_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class MotionPlan:
    """Where the joint is to be: `offset_rad` from its angle at the very start, plus a slow oscillation."""

    torque_limit_nm: float
    offset_rad: float = 0.0
    amplitude_rad: float = 0.0
    period_s: float = 2.0

    def compute_offset_rad(self, time_s: float) -> float:
        """Return the offset at a time since this plan began."""
        return self.offset_rad + self.amplitude_rad * math.sin(2 * math.pi * time_s / self.period_s)


@dataclass(frozen=True)
class MotionSample:
    """What the drive measured in one tick."""

    monotonic_ns: int
    is_armed: bool
    angle_rad: float
    velocity_rad_s: float
    torque_nm: float


class CommandThread:
    """Holds the lease of the robot from `start` to `stop`. The limiter of the host limits each command."""

    def __init__(
        self,
        connection: ConnectionSettings,
        robot: RobotDescription,
        plan: MotionPlan,
        center_rad: float | None,
    ) -> None:
        """Prepare to command a robot with one joint.

        Args:
            connection: How the host is reached.
            robot: Description of the robot.
            plan: First motion once the robot is armed.
            center_rad: Angle from which offsets count; None: the first angle that is measured.
        """
        self._connection = connection
        self._robot = robot
        self._thread = threading.Thread(target=self._run, name="qualification", daemon=True)
        self._stop_event = threading.Event()
        self._lock = threading.Lock()
        # Guarded by the lock.
        self._plan = plan
        self._center_rad = center_rad
        self._plan_start_s = time.monotonic()
        self._samples: list[MotionSample] = []
        self._failure: SnakesimError | None = None

    def start(self) -> None:
        """Start to command."""
        self._thread.start()

    def stop(self) -> None:
        """End the commands; the lease ends with them."""
        self._stop_event.set()
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT_S)

    @property
    def failure(self) -> SnakesimError | None:
        """Why no commands are sent any more; None while they are."""
        with self._lock:
            return self._failure

    @property
    def center_rad(self) -> float | None:
        """Angle from which offsets count; None before the first measurement."""
        with self._lock:
            return self._center_rad

    def set_plan(self, plan: MotionPlan) -> None:
        """Begin another motion."""
        with self._lock:
            self._plan = plan
            self._plan_start_s = time.monotonic()

    def list_samples(self, start_ns: int) -> list[MotionSample]:
        """Return what the drive has measured since an instant of the monotonic clock, oldest first."""
        with self._lock:
            return [sample for sample in self._samples if sample.monotonic_ns >= start_ns]

    def _run(self) -> None:
        try:
            with open_session(self._connection, CONNECT_TIMEOUT_S) as session:
                client = CommandingClient(session, self._robot, "realtime")
                while not self._stop_event.is_set():
                    self._command(client, client.wait_for_tick())
        except SnakesimError as error:
            with self._lock:
                self._failure = error

    def _command(self, client: CommandingClient, clock: Clock) -> None:
        """Command one tick: hold the measured angle until the robot is armed, then follow the plan."""
        joints = client.read(keys.JOINTS)
        if not isinstance(joints, JointState) or not joints.valid[0]:
            return
        angle_rad = joints.angle_rad[0]
        is_armed = clock.lifecycle == "armed"
        sample = MotionSample(
            time.monotonic_ns(), is_armed, angle_rad, joints.velocity_rad_s[0], joints.torque_nm[0]
        )
        with self._lock:
            if self._center_rad is None:
                self._center_rad = angle_rad
            center_rad = self._center_rad
            self._samples.append(sample)
            plan = self._plan
            time_s = time.monotonic() - self._plan_start_s
        if not client.holds_lease:
            return
        target_rad = angle_rad
        if is_armed:
            target_rad = center_rad + plan.compute_offset_rad(time_s)
        client.send_setpoints(
            RequestedSetpoints([JointMode.POSITION], [target_rad], [plan.torque_limit_nm])
        )
