"""The control process: runs one controller, holds the lease, sends the commands, and publishes its state.

A controller gets only fresh inputs (`freshness`). With stale joints no command is sent: the lease ends, and
the robot is stopped. Its output is checked (`guarded`): a controller that fails ends this process at once.
"""

import time
from collections.abc import Sequence

from snakesim_gnc.control.controller import Senses, Task, View
from snakesim_gnc.control.freshness import Limits
from snakesim_gnc.control.guarded import Guarded
from snakesim_gnc.control.live_settings import LiveSettings
from snakesim_gnc.control.state_reports import StateReports
from snakesim_gnc.control.update_times import UpdateTimes
from snakesim_hal.base.errors import ControllerError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import Client, Commander
from snakesim_hal.programs.preflight import what_it_lacks
from snakesim_hal.service import SILENCE_S, Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    ControlState,
    Description,
    JointState,
    Message,
    Pose,
    Status,
    Trajectory,
    World,
)

SENSED: dict[str, type[Message]] = {keys.POSE: Pose, keys.CONTACTS: Contacts}


class Control(Service):
    """Runs the scenario's controller."""

    name = "control"
    urgent = True

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Finds the controller and checks its settings."""
        self._config = config
        self._settings = LiveSettings(client, config)
        self._client = client
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._world = client.subscribe(keys.WORLD, World)
        self._trajectory = client.subscribe(keys.TRAJECTORY, Trajectory)
        asked = self._settings.asks_for_senses
        sensors = config.robot.sensors
        has = {keys.POSE: sensors.pose is not None, keys.CONTACTS: sensors.contacts is not None}
        self._feeds = {key: client.subscribe(key, SENSED[key]) for key in SENSED if asked and has[key]}
        self._sensed: dict[str, Message] = {}
        self._task = Task.of(config) if asked else None
        self._statuses = client.session.reader(keys.STATUS, Status)
        self._arm_session = -1
        self._armed_at_ns = 0
        self._noted: set[str] = set()  # streams that are too old, as the log has it
        self._last_clock: Clock | None = None

    def configure(self, robot: Description) -> None:
        """Get ready to command this robot."""
        if (lacks := what_it_lacks(robot.joints, self._settings.plugin, self._config.controller)) is not None:
            raise ControllerError(f"robot {robot.robot!r}: {lacks}")
        self._settings.configure(robot)
        self._commander = Commander(self._client, robot)
        self._limits = Limits.of(self._config, robot)
        self._reports = StateReports(self._config.controller, robot)
        self._times = UpdateTimes(robot)
        self._controller: Guarded | None = None
        self._sensed.clear()

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Command the robot: while armed by the controller, otherwise to hold its pose."""
        self._last_clock = clock
        self._statuses.drain()  # those found in a silence have come after the last clock
        if self._settings.turn(clock):
            self._controller = None
        joints = self._client.read(self._joints)
        if joints is None:
            return None
        armed = clock.lifecycle == "armed"
        mine = self._commander.holds(clock)
        if not (armed and mine):
            self._controller = None
        if not mine:
            why = f"no right to command: {self._commander.refusal or 'the lease is not ours'}"
            return _state_messages(self._reports.state(clock, armed=armed, missing=why))
        late = self._limits.against_joints(joints, clock.timestamp_ns)
        if late:
            self._note(clock, [late], "no commands")
            return _state_messages(self._reports.state(clock, armed=armed, missing=late))
        if not armed:
            self._note(clock)
            self._commander.send(clock, joints, self._commander.stay(joints))
            return _state_messages(self._reports.state(clock))
        return self._act(clock, joints)

    def pause(self, clock: Clock) -> None:
        """Settings may be changed; they are in force from the next tick on."""
        if self._settings.turn(clock):
            self._controller = None

    def silence(self) -> list[tuple[str, Message]]:
        """Time stands, or the HAL is silent altogether: PowerOff. The next tick decides about the controller."""
        clock = self._last_clock
        if clock is None:
            return []
        statuses = self._statuses.drain()
        if not statuses:
            silent = f"neither clock nor status from the HAL for {SILENCE_S:g} s, after tick {clock.tick}"
            return _state_messages(self._reports.state(clock, silent=silent))
        stands = statuses[-1].held_up or f"no tick for {SILENCE_S:g} s, after tick {clock.tick}"
        armed = statuses[-1].lifecycle == "armed"
        return _state_messages(self._reports.state(clock, armed=armed, stands=f"time stands: {stands}"))

    def _act(self, clock: Clock, joints: JointState) -> list[tuple[str, Message]]:
        """Call the controller, with world and trajectory as far as they are fresh."""
        world, trajectory, missing = self._outlook(clock)
        senses = self._senses(clock)
        try:
            controller = self._made_for(clock)
            view = View(
                tick=clock.tick,
                time_s=(clock.timestamp_ns - self._armed_at_ns) * 1e-9,
                period_s=clock.period_ns * 1e-9,
                joints=joints,
                world=world,
                trajectory=trajectory,
                senses=senses,
            )
            began_s = time.perf_counter()
            action = controller.update(view)
            self._note_time(clock, time.perf_counter() - began_s)
            self._commander.send(clock, joints, action.setpoints)
            rests = _why_it_rests(trajectory)
            try:
                state = self._reports.state(clock, action.report, armed=True, missing=missing, rests=rests)
            except ValueError as error:
                raise controller.wrong(str(error)) from None
        except ControllerError as error:
            self._client.put(keys.CONTROL_STATE, self._reports.failure(clock, str(error)))
            raise
        return _state_messages(state)

    def _outlook(self, clock: Clock) -> tuple[World | None, Trajectory | None, str]:
        """World and trajectory as far as they are available and fresh, and why they are not."""
        world, trajectory = self._client.read(self._world), self._client.read(self._trajectory)
        late: list[str] = []
        if world is not None and (why := self._limits.against_world(world, clock.timestamp_ns)):
            world, late = None, [why]
        if trajectory is not None and (why := self._limits.against_trajectory(trajectory, clock.timestamp_ns)):
            trajectory, late = None, [*late, why]
        self._note(clock, late, "the controller holds")
        if world is not None:
            self._reports.follow(world)
        return world, trajectory, "; ".join(late)

    def _senses(self, clock: Clock) -> Senses | None:
        """The newest samples, and which of them are too old; None for a controller that does not ask."""
        if self._task is None:
            return None
        for key, feed in self._feeds.items():
            if (sample := self._client.read(feed)) is not None:
                self._sensed[key] = sample
        stamps = {key: getattr(sample, "timestamp_ns", None) for key, sample in self._sensed.items()}
        return Senses(dict(self._sensed), self._limits.of_sensors(stamps, clock.timestamp_ns), self._task)

    def _made_for(self, clock: Clock) -> Guarded:
        """The controller of this arming, and of the settings in force."""
        if self._controller is None or clock.arm_session != self._arm_session:
            self._controller = self._settings.controller()
            if clock.arm_session != self._arm_session:
                self._arm_session, self._armed_at_ns = clock.arm_session, clock.timestamp_ns
        return self._controller

    def _note_time(self, clock: Clock, took_s: float) -> None:
        """Count an update, and write into the log when the controller has become too slow for real time."""
        before = self.too_slow
        self._times.add(took_s)
        self.too_slow = self._times.too_slow
        if (
            clock.clock_mode == "realtime"
        ):  # elsewhere there are no deadlines, and no message may depend on the wall clock
            self._reports.too_slow = self.too_slow
        if self.too_slow and not before:
            print_stderr(f"{clock.timestamp_ns * 1e-9:.3f} s: {self.too_slow}")

    def _note(self, clock: Clock, late: Sequence[str] = (), so: str = "") -> None:
        """Write into the log when other streams are too old than before, and when all is fresh again."""
        streams = {why.partition(" ")[0] for why in late}
        if streams != self._noted:
            text = f"{'; '.join(late)}: {so}" if late else "all inputs of control are fresh again"
            print_stderr(f"{clock.timestamp_ns * 1e-9:.3f} s: {text}")
        self._noted = streams


def _why_it_rests(trajectory: Trajectory | None) -> str:
    if trajectory is None:
        return "there is no trajectory yet"
    if trajectory.speed_m_s != 0.0:
        return ""
    return trajectory.reason or "the speed is zero"


def _state_messages(state: ControlState | None) -> list[tuple[str, Message]]:
    return [] if state is None else [(keys.CONTROL_STATE, state)]
