"""Sends joint commands from ROS to the robot, as the robot's control service.

It is a client with a lease, like any other controller, and runs in a thread. Without the lease it sends nothing.
However the bridge ends, the lease expires within 50 to 100 ms, and an armed robot enters its stop mode.
"""

import contextlib
import threading
import time

from snakesim_hal.base.errors import NotConnectedError, RefusedError, SnakesimError
from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.base.workers import start_restarting_thread
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.network.commanding import CommandingClient
from snakesim_hal.network.foreign_network import RawReader
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, JointState, RobotDescription, RobotStatus
from snakesim_operator.features.ros2.joint_commands import RosJointTargets
from snakesim_operator.features.ros2.message_age import SenderClocks

RETRY_S = 2.0  # after a lost connection
DESCRIPTION_TIMEOUT_S = 5.0  # within which a robot that is running describes itself
THREAD_END_TIMEOUT_S = 5.0  # for the thread


class JointCommander:
    """Commands every joint in every tick from the messages of one topic; reconnects after a loss of the robot."""

    def __init__(
        self, session: Session, messages: RawReader, print_text: PrintLine, *, wall_time: bool
    ) -> None:
        """Start the thread that commands a robot from the joint targets on a ROS topic.

        Args:
            session: Session on the robot's network.
            messages: Messages of the ROS topic.
            print_text: Reports changes to the user.
            wall_time: Whether timestamps in ROS are wall-clock time instead of robot time.

        Raises:
            RefusedError: The robot has a controller.
        """
        if session.list_tokens(keys.alive_key(CONTROL)):
            raise RefusedError(
                "--joint-commands: the robot has a controller already, which holds the lease; run it without one: "
                "--set services.control.external=true",
                code="robot/has-controller",
            )
        self._session = session
        self._message_reader = messages
        self._print_text = print_text
        self._wall_time = wall_time
        self._sender_clocks = SenderClocks()
        self._last_report = ""
        self._stop_event = threading.Event()
        self._thread = start_restarting_thread(
            "driving", self._command_until_closed, should_stop=self._stop_event.is_set
        )

    def close(self) -> None:
        """End the thread, and with it the lease."""
        self._stop_event.set()
        self._thread.join(THREAD_END_TIMEOUT_S)

    def _command_until_closed(self) -> None:
        """Command the robot until `close`; after an error, wait and connect again."""
        while not self._stop_event.is_set():
            try:
                with contextlib.closing(self._session.create_subsession()) as part:
                    self._command_robot(part)
            except SnakesimError as error:
                self._report_change(f"nothing is commanded from ROS: {error}")
                self._stop_event.wait(RETRY_S)

    def _command_robot(self, session: Session) -> None:
        """Send setpoints from ROS in every tick in which this process holds the lease, until `close`.

        Args:
            session: Session on the robot's network, for this connection alone.

        Raises:
            NotConnectedError: The robot is lost, or its host has restarted.
        """
        robot = session.wait_for_latched(keys.DESCRIPTION, RobotDescription, DESCRIPTION_TIMEOUT_S)
        status = session.wait_for_latched(keys.STATUS, RobotStatus, DESCRIPTION_TIMEOUT_S)
        if robot is None or status is None:
            raise NotConnectedError(
                "the robot does not describe itself; is its HAL host running?",
                code="network/no-robot",
            )
        command_client = CommandingClient(session, robot, status.clock_mode)
        targets = RosJointTargets(robot)
        self._report_change(f"joint commands from ROS move {robot.robot} once it is armed")
        while not self._stop_event.is_set():
            clock = command_client.wait_for_tick()
            if command_client.has_host_changed():
                raise NotConnectedError("the robot's host has restarted", code="network/no-robot")
            self._read_messages(targets, clock)
            joint_state = command_client.read(keys.JOINTS)
            if not isinstance(joint_state, JointState):
                continue
            if command_client.holds_lease or clock.lifecycle != "armed":
                # Without the lease too: a robot that is not armed makes the targets forget the last arm session.
                setpoints = targets.make_setpoints(clock, joint_state)
                if command_client.holds_lease:
                    command_client.send_setpoints(setpoints)

    def _read_messages(self, targets: RosJointTargets, clock: Clock) -> None:
        """Accept the joint targets of all messages that have arrived since the last tick, and report refused ones."""
        for message in self._message_reader.drain():
            wall_ns = time.time_ns()
            age_ns = self._sender_clocks.estimate_age_ns(message, wall_ns, time.monotonic_ns())
            ros_now_ns = clock.timestamp_ns
            if self._wall_time:
                ros_now_ns = wall_ns
            if not targets.accept_message(message.payload, clock.timestamp_ns, ros_now_ns, age_ns):
                self._report_change(
                    f"a message on joint_commands {targets.reason}; it is dropped, with all that are alike"
                )

    def _report_change(self, text: str) -> None:
        """Show a text to the user, unless it is the same as the last one."""
        if text != self._last_report:
            self._last_report = text
            self._print_text(text)
