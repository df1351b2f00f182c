"""Joint commands from ROS, as the robot's control service: a client with a lease, like any other, in a thread.

Without the lease nothing is sent. Whatever ends the bridge ends the lease within 50 to 100 ms, and an armed robot goes
into its stop mode.
"""

import contextlib
import threading
import time

from snakesim_hal.base.errors import NotConnectedError, RefusedError, SnakesimError
from snakesim_hal.base.terminal import Say
from snakesim_hal.base.workers import start_worker
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.network.commanding import Commanding
from snakesim_hal.network.foreign_network import RawReader
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, JointState, Status
from snakesim_operator.features.ros2.joint_commands import JointTargets
from snakesim_operator.features.ros2.message_age import SenderClocks

RETRY_S, PRESENT_S, END_S = 2.0, 5.0, 5.0


class Driving:
    """Commands every joint in every tick, from the messages of one topic; again after each loss of the robot."""

    def __init__(self, session: Session, messages: RawReader, say: Say, *, wall_time: bool) -> None:
        """Take the lease. Raises RefusedError for a robot that has a controller.

        wall_time: whether stamps in ROS are wall-clock time, else robot time.
        """
        if session.present(keys.alive(CONTROL)):
            raise RefusedError(
                "--joint-commands: the robot has a controller already, which holds the lease; run it without one: "
                "--set services.control.external=true"
            )
        self._session, self._messages, self._say = session, messages, say
        self._wall_time = wall_time
        self._senders = SenderClocks()
        self._ended = threading.Event()
        self._said = ""
        self._thread = start_worker("driving", self._run, is_over=self._ended.is_set)

    def close(self) -> None:
        """End it, and with it the lease."""
        self._ended.set()
        self._thread.join(END_S)

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                with contextlib.closing(self._session.part()) as part:
                    self._drive(part)
            except SnakesimError as error:
                self._tell(f"nothing is commanded from ROS: {error}")
                self._ended.wait(RETRY_S)

    def _drive(self, session: Session) -> None:
        robot = session.latest(keys.DESCRIPTION, Description, PRESENT_S)
        status = session.latest(keys.STATUS, Status, PRESENT_S)
        if robot is None or status is None:
            raise NotConnectedError("the robot does not describe itself; is its HAL host running?")
        commanding, targets = Commanding(session, robot, status.clock_mode), JointTargets(robot)
        self._tell(f"joint commands from ROS move {robot.robot} once it is armed")
        while not self._ended.is_set():
            clock = commanding.wait()
            if commanding.host_changed():
                raise NotConnectedError("the robot's host has restarted")
            for message in self._messages.drain():
                wall_ns = time.time_ns()
                age_ns = self._senders.age_ns(message, wall_ns, time.monotonic_ns())
                ros_now_ns = wall_ns if self._wall_time else clock.timestamp_ns
                if not targets.take(message.payload, clock.timestamp_ns, ros_now_ns, age_ns):
                    self._tell(f"a message on joint_commands {targets.why}; it is dropped, with all that are alike")
            joints = commanding.read(keys.JOINTS)
            if isinstance(joints, JointState) and (commanding.mine or clock.lifecycle != "armed"):
                points = targets.setpoints(clock, joints)
                if commanding.mine:
                    commanding.send(points)

    def _tell(self, text: str) -> None:
        """Once, until there is something else to tell."""
        if text != self._said:
            self._said = text
            self._say(text)
