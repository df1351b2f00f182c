"""A robot that runs, for scripts and notebooks: read the newest, wait for a tick, command, arm, stop, tune, record."""

import math
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from snakesim_gnc.control.controller import positions
from snakesim_hal.base.errors import ConfigError, NotConnectedError, RefusedError, StalledError, did_you_mean
from snakesim_hal.base.process import user_name
from snakesim_hal.network.commanding import READ, Commanding
from snakesim_hal.network.endpoint import check_endpoint, check_namespace
from snakesim_hal.network.robot_mismatch import mismatch
from snakesim_hal.network.session import Link, Reader, Session, open_session
from snakesim_hal.network.session_file import read_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    Description,
    JointState,
    LifecycleRequest,
    Message,
    Pose,
    Status,
    request_to_arm,
)
from snakesim_hal.wire.own_sample import message_of
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.base.targets import find_robots
from snakesim_operator.recording.process import record
from snakesim_operator.robot_commands.command import ask_meanwhile
from snakesim_operator.robot_commands.parameters import Parameter, change, in_force, parameters_of
from snakesim_operator.robot_commands.stop import estop

CONNECT_S, FIRST_S, SILENCE_S, READY_S, RECORDING_S = 5.0, 1.0, 2.0, 10.0, 10.0
LOOK_S = 0.0005


class Robot:
    """A connection to one robot. The first command takes the lease; the end of a `with` disarms what it has armed.

        with snakesim.Robot.connect() as robot:
            robot.arm()
            began = robot.wait()
            while (passed_s := robot.wait() - began) < 3:
                robot.command([0.2 * math.sin(passed_s)] * len(robot.names))

    There is no thread: an armed robot needs a command in every tick, or its lease ends, and it stops in a fault.
    """

    def __init__(self, link: Link) -> None:
        """As `connect`."""
        self._link, self._opened = link, ExitStack()
        self._session: Session = self._opened.enter_context(open_session(link, CONNECT_S))
        self._readers: dict[str, Reader[Any]] = {}
        self._newest: dict[str, Any] = {}
        self._control: Commanding | None = None
        self._armed = False  # by this
        try:
            self.description: Description = self._present(keys.DESCRIPTION, Description)
            self._present(keys.STATUS, Status)
            self._taken(keys.CLOCK, Clock, 0.0)  # in lockstep none comes while somebody thinks
        except NotConnectedError:
            self._opened.close()
            raise

    @staticmethod
    def connect(
        endpoint: str | None = None, *, name: str | None = None, session: str | os.PathLike[str] | None = None
    ) -> "Robot":
        """Meet a robot. name: its namespace, needed where there are several; session: Zenoh session file of a lab.

        endpoint: None is the only robot that runs on this computer. Raises NotConnectedError, RefusedError when there
        are several, ConfigError.
        """
        if endpoint is not None:
            check_endpoint(endpoint, "endpoint")
        if name is not None:
            check_namespace(name, "name")
        where = RobotSelection(endpoint, name)
        if session is not None:
            if endpoint is not None:
                raise ConfigError("endpoint and session: the session file names the endpoint; leave one out")
            file = read_session(Path(session))
            where = RobotSelection(file.endpoints[0], file.namespace_for(name), file)
        deadline = time.monotonic() + CONNECT_S  # a robot may be starting
        while not (found := find_robots(where)) and time.monotonic() < deadline:
            time.sleep(LOOK_S)
        if not found:
            named = "" if where.namespace is None else f" named {where.namespace}"
            raise NotConnectedError(f"no robot{named} on {', '.join(where.endpoints())}; is its HAL host running?")
        if len(found) > 1:
            choices = [f"  endpoint={link.endpoint!r}, name={link.namespace!r}" for link in found]
            raise RefusedError("several robots found; choose one:", *choices)
        return Robot(found[0])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disarm what this has armed, and leave."""
        try:
            if self._armed:
                self.disarm()
        finally:
            self._opened.close()

    @property
    def names(self) -> list[str]:
        """Of the joints, tail to head."""
        return [joint.name for joint in self.description.joints]

    @property
    def status(self) -> Status:
        """The newest one: lifecycle, why, faults, counters."""
        return self._present(keys.STATUS, Status)

    @property
    def joints(self) -> JointState | None:
        """The newest state of all joints; None when there is none yet, as for all readings."""
        return self.read(keys.JOINTS)

    @property
    def pose(self) -> Pose | None:
        """The newest pose of the base, of a robot that has a sensor for it."""
        return self.read(keys.POSE)

    @property
    def contacts(self) -> Contacts | None:
        """The newest contacts."""
        return self.read(keys.CONTACTS)

    @property
    def time_s(self) -> float:
        """Robot time of the tick at hand, or of the newest one."""
        return self._clock.timestamp_ns * 1e-9

    def age_s(self, message: Any) -> float:
        """How old a reading is, in robot time."""
        return self.time_s - message.timestamp_ns * 1e-9

    def read(self, key: str) -> Any:
        """The newest message at a key, such as "sensor/imu"; None when there is none.

        From the first command on, joints, pose and contacts are those of the tick at hand.
        """
        if self._control is not None and key in READ:
            return self._control.read(key)
        message = keys.message_at(key)
        if message is None or "*" in key:
            known = [row.key for row in keys.SPACE if row.kind in ("stream", "latched")]
            raise ConfigError(f"no key {key!r} in the key space; {did_you_mean(key, known)}see schemas/keys.md")
        message = message_of(key, self.description) or message
        first = key not in self._readers and self._control is None
        return self._taken(key, message, FIRST_S if first else 0.0)

    def wait(self) -> float:
        """The next tick; its robot time in s. Raises StalledError; RefusedError when what was armed is not any more."""
        if self._control is None:
            return self._wait_for_clock()
        clock = self._control.wait()
        if self._armed and clock.lifecycle != "armed":
            self._armed = False
            raise RefusedError(f"{self._link.namespace} is no longer armed, but {clock.lifecycle}: {self.status.why}")
        return clock.timestamp_ns * 1e-9

    def command(self, angles_rad: Sequence[float] | RequestedSetpoints) -> None:
        """Command every joint, tail to head, in this tick: by angles, or by `RequestedSetpoints` with modes and limits.

        Raises ConfigError for what is no such command, RefusedError without the right to command.
        """
        points = (
            angles_rad if isinstance(angles_rad, RequestedSetpoints) else positions(self.description, list(angles_rad))
        )
        count = len(self.names)
        for what, values in (("target", points.target), ("torque_limit_nm", points.torque_limit_nm)):
            wanted = f"{what} is {values!r:.80}, must be {count} finite numbers, tail to head"
            if len(values) != count:
                raise ConfigError(f"{wanted}; got {len(values)}")
            if not all(math.isfinite(value) for value in values):
                raise ConfigError(wanted)
        self._commanding().send(points)

    def arm(self, *, unchecked: bool = False) -> None:
        """Take the lease, and have the robot hold its pose until the first command. Raises RefusedError.

        unchecked: also a robot whose joints nobody has checked as they are now; see docs/commissioning.md.
        """
        control = self._commanding()
        control.turn_until(lambda: self.status.ready_to_arm, READY_S, lambda: f"not armed: {self.status.why}")
        before = self._clock.arm_session
        self._ask(request_to_arm(self.description, user_name(), unchecked=unchecked), "armed")
        control.turn_until(lambda: self._clock.arm_session > before, READY_S, lambda: f"not armed: {self.status.why}")
        if self._clock.lifecycle != "armed":
            raise RefusedError(f"not armed any more, but {self._clock.lifecycle}: {self.status.why}")
        self._armed = True

    def disarm(self) -> None:
        """Make the joints passive."""
        self._ask(LifecycleRequest(action="disarm", who=user_name()), "disarmed")
        self._armed = False

    def clear(self) -> None:
        """Clear a fault or an emergency stop; the robot is disarmed then."""
        self._ask(LifecycleRequest(action="clear", who=user_name()), "cleared")

    def estop(self) -> None:
        """Emergency stop, over the stop port and over the network. Raises RefusedError unless it is confirmed."""
        said: list[str] = []
        self._armed = False
        if estop(RobotSelection(self._link.endpoint, self._link.namespace, self._link.session), said.append):
            raise RefusedError(*said)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Parameters of the running controller by name: value, unit, range, meaning."""
        return {f"control.{one.name}": one for one in parameters_of(in_force(self._session))}

    def set(self, changes: Mapping[str, Any]) -> None:
        """Change parameters of the running controller, all or none.

        Raises:
            ConfigError: There is no such parameter.
            RefusedError: Control refuses a value.
            ControllerError: Control has accepted the values and has ended, for the controller cannot go on with them.
        """
        change(self._session, changes, user_name())

    @contextmanager
    def record(self, path: str | os.PathLike[str]) -> Iterator[Path]:
        """Record everything that the robot publishes into an MCAP file. Raises ConfigError for one that exists."""
        ended, heard = threading.Event(), threading.Event()
        link = replace(self._link, max_bytes=MAX_IMAGE_BYTES)
        with ThreadPoolExecutor(1) as beside:
            recording = beside.submit(record, link, Path(path), lambda: not ended.is_set(), lambda *_: heard.set())
            try:
                deadline = time.monotonic() + RECORDING_S
                while not heard.is_set() and not recording.done() and time.monotonic() < deadline:
                    self._pass()
                yield Path(path)
            finally:
                ended.set()
                while not recording.done():
                    self._pass()
                recording.result()

    def _commanding(self) -> Commanding:
        if self._control is None:
            self._control = Commanding(self._session, self.description, self.status.clock_mode)
        return self._control

    def _ask(self, request: LifecycleRequest, done: str) -> None:
        ask_meanwhile(self._session, request, done, self._link, self._pass)

    def _pass(self) -> None:
        """Let some time pass."""
        if self._control is None:
            time.sleep(LOOK_S)
        else:
            self._control.turn()

    @property
    def _clock(self) -> Clock:
        if self._control is not None and self._control.clock is not None:
            return self._control.clock
        return self._present(keys.CLOCK, Clock)

    def _wait_for_clock(self) -> float:
        before, deadline = self._clock.tick, time.monotonic() + SILENCE_S
        while (clock := self._clock).tick == before:
            if time.monotonic() > deadline:
                raise StalledError(f"no tick of {self._link.namespace} for {SILENCE_S:g} s")
            time.sleep(LOOK_S)
        return clock.timestamp_ns * 1e-9

    def _present(self, key: str, message: type[Message]) -> Any:
        """The newest message of a key that every robot writes. Raises NotConnectedError."""
        found = self._taken(key, message, CONNECT_S)
        if found is None:
            raise NotConnectedError(f"{self._link.namespace} publishes nothing on {key}; is its HAL host running?")
        return found

    def _taken(self, key: str, message: type[Message], first_s: float) -> Any:
        """The newest message; the first one is waited for, at most so long."""
        row = keys.row_at(key)
        reader = self._readers.get(key)
        if reader is None:
            latched = row is not None and row.kind == "latched"
            reader = (self._session.latched_reader if latched else self._session.reader)(key, message)
            self._readers[key] = reader
        deadline = time.monotonic() + (0.0 if key in self._newest else first_s)
        while (found := reader.newest(self._fits)) is None and time.monotonic() < deadline:
            time.sleep(LOOK_S)
        if found is not None:
            self._newest[key] = found
        return self._newest.get(key)

    def _fits(self, message: Message) -> bool:
        """Whether it is of this robot, as far as that is known."""
        robot = self._newest.get(keys.DESCRIPTION)
        return robot is None or mismatch(message, robot) is None
