"""The control process: runs one controller, holds the command lease, sends setpoints, and publishes its state.

The controller gets only fresh inputs (`freshness`). If the joint state is too old, this process sends no command: the
lease expires, and the robot is stopped. The controller's output is checked (`guarded`): a controller that fails ends
this process at once.
"""

import time
from collections.abc import Sequence

from snakesim_gnc.control.service.freshness import AgeLimits
from snakesim_gnc.control.service.guarded import GuardedController
from snakesim_gnc.control.service.live_parameters import LiveParameters
from snakesim_gnc.control.service.state_reports import StateReports
from snakesim_gnc.control.service.update_times import UpdateTimes
from snakesim_hal.base.errors import ControllerError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.controller import Observation, SensorSamples, Task
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import Commander, HostClient, SampleFeed
from snakesim_hal.programs.preflight import find_missing_capability
from snakesim_hal.service import SILENCE_S, Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    ControlState,
    JointState,
    Message,
    Pose,
    RobotDescription,
    RobotStatus,
    Trajectory,
    WorldModel,
)

# Sensor samples that a controller may request.
SENSOR_MESSAGE_TYPES: dict[str, type[Message]] = {keys.POSE: Pose, keys.CONTACTS: Contacts}

KeyedMessages = list[tuple[str, Message]]  # messages to publish, with their keys


class ControlService(Service):
    """Runs the scenario's controller."""

    name = "control"
    urgent = True

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Create the service that runs one controller: it reads the robot's state in every tick, and sends setpoints.

        Args:
            client: Connection to the robot, on which inputs are subscribed.
            config: Configuration of the run, with the controller and its parameters.

        Raises:
            ConfigError: There is no such controller, or its parameters are invalid.
        """
        self._client = client
        self._config = config
        self._parameters = LiveParameters(client, config)

        # Inputs of every controller.
        self._joint_feed = client.subscribe(keys.JOINTS, JointState)
        self._world_feed = client.subscribe(keys.WORLD, WorldModel)
        self._trajectory_feed = client.subscribe(keys.TRAJECTORY, Trajectory)
        self._status_reader = client.session.declare_reader(keys.STATUS, RobotStatus)
        self._last_clock: Clock | None = None

        # Inputs of a controller that requests sensor samples.
        self._task: Task | None = None  # None if the controller requests no samples
        self._sensor_feeds: dict[str, SampleFeed[Message]] = {}
        self._sensor_samples: dict[str, Message] = {}  # the newest of each key
        if self._parameters.uses_sensors:
            self._task = Task.from_config(config)
            self._subscribe_to_sensors()

        # The arm session of the current controller.
        self._arm_session = -1
        self._arming_time_ns = 0

        # Streams that the log already reports as too old.
        self._logged_late_streams: set[str] = set()

    def _subscribe_to_sensors(self) -> None:
        """Subscribe to those sensors in SENSED that the robot has."""
        sensors = self._config.robot.sensors
        is_mounted = {
            keys.POSE: sensors.pose is not None,
            keys.CONTACTS: sensors.contacts is not None,
        }
        for key, message_type in SENSOR_MESSAGE_TYPES.items():
            if is_mounted[key]:
                self._sensor_feeds[key] = self._client.subscribe(key, message_type)

    def configure(self, robot: RobotDescription) -> None:
        """Prepare to command this robot. Raises ControllerError if the robot cannot do what the controller needs."""
        missing = find_missing_capability(
            robot.joints, self._parameters.controller_class, self._config.controller
        )
        if missing is not None:
            raise ControllerError(f"robot {robot.robot!r}: {missing}")
        self._parameters.configure(robot)
        self._commander = Commander(self._client, robot)
        self._age_limits = AgeLimits.from_config(self._config, robot)
        self._state_reports = StateReports(self._config.controller, robot)
        self._update_times = UpdateTimes(robot)
        self._controller: GuardedController | None = None
        self._sensor_samples.clear()

    def outputs(self, clock: Clock) -> KeyedMessages | None:
        """Command the robot in one tick, and return the message about the state of control.

        Args:
            clock: The current tick, with the lifecycle state of the robot.

        Returns:
            The state of control with its key, or an empty list if no message is due; None if there is no joint state
            for this tick.

        Raises:
            ControllerError: The controller has failed; its last state has been published.
        """
        self._last_clock = clock
        # Discard the statuses from before this clock: if clocks stop, `silence` must find only newer ones.
        self._status_reader.drain()
        self._apply_new_parameters(clock)
        joints = self._client.read(self._joint_feed)
        if joints is None:
            return None
        return _list_state_messages(self._command_robot(clock, joints))

    def _command_robot(self, clock: Clock, joints: JointState) -> ControlState | None:
        """Command the robot: by the controller while the robot is armed, otherwise to hold its pose.

        The order of the checks matters. Without the command lease nothing is sent, whatever the inputs are. With joint
        states that are too old nothing is sent either, not even the command to hold the pose.

        Args:
            clock: The current tick, with the lifecycle state of the robot.
            joints: The newest joint state.

        Returns:
            The state of control, or None if no message about it is due.

        Raises:
            ControllerError: The controller has failed; its last state has been published.
        """
        is_armed = clock.lifecycle == "armed"
        has_lease = self._commander.ensure_lease(clock)
        if not (is_armed and has_lease):
            self._controller = None
        if not has_lease:
            lease_reason = (
                f"no right to command: {self._commander.lease_refusal or 'the lease is not ours'}"
            )
            return self._state_reports.make_state(
                clock, is_armed=is_armed, missing_inputs=lease_reason
            )
        late_reason = self._age_limits.check_joints(joints, clock.timestamp_ns)
        if late_reason:
            self._log_late_streams(clock, [late_reason], "no commands")
            return self._state_reports.make_state(
                clock, is_armed=is_armed, missing_inputs=late_reason
            )
        if not is_armed:
            self._log_late_streams(clock)
            self._commander.send_command(clock, joints, self._commander.make_hold_setpoints(joints))
            return self._state_reports.make_state(clock)
        return self._run_controller(clock, joints)

    def pause(self, clock: Clock) -> None:
        """Answer requests to change parameters while robot time is paused; changes take effect in the next tick."""
        self._apply_new_parameters(clock)

    def silence(self) -> KeyedMessages:
        """Report why no clock arrives: time is paused, or the HAL is silent altogether, which is PowerOff.

        The controller stays. The next tick decides whether it continues.
        """
        clock = self._last_clock
        if clock is None:
            return []
        statuses = self._status_reader.drain()
        if not statuses:
            silence_reason = f"neither clock nor status from the HAL for {SILENCE_S:g} s, after tick {clock.tick}"
            return _list_state_messages(
                self._state_reports.make_state(clock, silence_reason=silence_reason)
            )
        status = statuses[-1]
        pause_reason = status.held_up or f"no tick for {SILENCE_S:g} s, after tick {clock.tick}"
        is_armed = status.lifecycle == "armed"
        reason = f"robot time is paused: {pause_reason}"
        return _list_state_messages(
            self._state_reports.make_state(clock, is_armed=is_armed, pause_reason=reason)
        )

    def _apply_new_parameters(self, clock: Clock) -> None:
        """Answer requests to change parameters. After a change, discard the controller, so that it is made again."""
        if self._parameters.answer_requests(clock):
            self._controller = None

    def _run_controller(self, clock: Clock, joints: JointState) -> ControlState | None:
        """Call the controller with its fresh inputs, and send its setpoints.

        Args:
            clock: The current tick, in which the robot is armed and this service has the command lease.
            joints: The joint state of this tick.

        Returns:
            The state of control, or None if no message about it is due.

        Raises:
            ControllerError: The controller has failed; its last state has been published.
        """
        world, trajectory, missing_inputs = self._read_fresh_plan(clock)
        sensor_samples = self._read_sensor_samples(clock)
        try:
            controller = self._prepare_controller(clock)
            observation = Observation(
                tick=clock.tick,
                time_s=(clock.timestamp_ns - self._arming_time_ns) * 1e-9,
                period_s=clock.period_ns * 1e-9,
                joints=joints,
                world=world,
                trajectory=trajectory,
                sensor_samples=sensor_samples,
            )
            start_time_s = time.perf_counter()
            command = controller.update(observation)
            duration_s = time.perf_counter() - start_time_s
            self._count_update(clock, duration_s)
            self._commander.send_command(clock, joints, command.setpoints)
            rest_reason = _explain_no_motion(trajectory)
            try:
                return self._state_reports.make_state(
                    clock,
                    command.telemetry,
                    is_armed=True,
                    missing_inputs=missing_inputs,
                    rest_reason=rest_reason,
                )
            except ValueError as error:
                raise controller.make_error(str(error)) from None
        except ControllerError as error:
            self._client.publish(
                keys.CONTROL_STATE, self._state_reports.make_failure_state(clock, str(error))
            )
            raise

    def _read_fresh_plan(self, clock: Clock) -> tuple[WorldModel | None, Trajectory | None, str]:
        """Read the newest world model and trajectory, and replace those that are too old by None.

        Args:
            clock: The current tick.

        Returns:
            The world model and the trajectory, each None if it is missing or too old, and the reason why inputs are too
            old, which is empty if all are fresh.
        """
        world = self._client.read(self._world_feed)
        trajectory = self._client.read(self._trajectory_feed)
        late_reasons: list[str] = []
        if world is not None:
            late_reason = self._age_limits.check_world(world, clock.timestamp_ns)
            if late_reason:
                late_reasons.append(late_reason)
                world = None
        if trajectory is not None:
            late_reason = self._age_limits.check_trajectory(trajectory, clock.timestamp_ns)
            if late_reason:
                late_reasons.append(late_reason)
                trajectory = None
        self._log_late_streams(clock, late_reasons, "the controller holds")
        if world is not None:
            self._state_reports.add_world(world)
        return world, trajectory, "; ".join(late_reasons)

    def _read_sensor_samples(self, clock: Clock) -> SensorSamples | None:
        """Return the newest sensor samples, with a reason for each that is too old.

        Returns:
            The samples, or None if the controller does not request sensor samples.
        """
        if self._task is None:
            return None
        for key, feed in self._sensor_feeds.items():
            sample = self._client.read(feed)
            if sample is not None:
                self._sensor_samples[key] = sample
        timestamps_ns = {
            key: getattr(sample, "timestamp_ns", None)
            for key, sample in self._sensor_samples.items()
        }
        late_reasons_by_key = self._age_limits.check_sensors(timestamps_ns, clock.timestamp_ns)
        return SensorSamples(dict(self._sensor_samples), late_reasons_by_key, self._task)

    def _prepare_controller(self, clock: Clock) -> GuardedController:
        """Return the controller of this arm session. Construct it after each arming and each change of parameters."""
        is_new_session = clock.arm_session != self._arm_session
        if self._controller is None or is_new_session:
            self._controller = self._parameters.construct_controller()
            if is_new_session:
                self._arm_session = clock.arm_session
                self._arming_time_ns = clock.timestamp_ns
        return self._controller

    def _count_update(self, clock: Clock, duration_s: float) -> None:
        """Record the duration of an update, and log once when the controller has become too slow for real time.

        Args:
            clock: The current tick.
            duration_s: Wall time that the controller needed for this update.
        """
        was_too_slow = bool(self.too_slow)
        self._update_times.add_duration(duration_s)
        self.too_slow = self._update_times.too_slow_reason
        # Other clock modes have no deadlines, and there no message may depend on the wall clock.
        if clock.clock_mode == "realtime":
            self._state_reports.too_slow_reason = self.too_slow
        if self.too_slow and not was_too_slow:
            print_stderr(f"{clock.timestamp_ns * 1e-9:.3f} s: {self.too_slow}")

    def _log_late_streams(
        self, clock: Clock, late_reasons: Sequence[str] = (), consequence: str = ""
    ) -> None:
        """Log if the set of input streams that are too old has changed since the last tick.

        Args:
            clock: The current tick.
            late_reasons: Why inputs are too old. Each text begins with the key of its stream. Empty if all are fresh.
            consequence: What control does without these inputs, for the log.
        """
        streams = {reason.partition(" ")[0] for reason in late_reasons}
        if streams != self._logged_late_streams:
            text = "all inputs of control are fresh again"
            if late_reasons:
                text = f"{'; '.join(late_reasons)}: {consequence}"
            print_stderr(f"{clock.timestamp_ns * 1e-9:.3f} s: {text}")
        self._logged_late_streams = streams


def _explain_no_motion(trajectory: Trajectory | None) -> str:
    """Return why no motion is requested by the trajectory; an empty text if motion is requested."""
    if trajectory is None:
        return "there is no trajectory yet"
    if trajectory.speed_m_s != 0.0:
        return ""
    return trajectory.reason or "the speed is zero"


def _list_state_messages(state: ControlState | None) -> KeyedMessages:
    """Return a state of control with its key, as `Service.outputs` returns messages; an empty list for None."""
    if state is None:
        return []
    return [(keys.CONTROL_STATE, state)]
