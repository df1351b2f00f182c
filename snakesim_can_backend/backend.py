"""Joint modules on CAN behind the HAL. Thin: every job has its own module.

A tick: Sync goes out, every module answers with what it sampled at that instant, and enacts the set-point that it got
in the period before. So a command acts exactly one period after the state that it answers, whatever the load.
"""

import logging
import time
import uuid
from pathlib import Path

import msgspec

from snakesim_can_backend import commands
from snakesim_can_backend.bring_up import Bus, configure, find, objections
from snakesim_can_backend.bus_load import BIT_RATE, Reports, check_load, reports_of, shares, worst_bits
from snakesim_can_backend.log import LoggedWire, open_log
from snakesim_can_backend.mocap import MocapReceiver
from snakesim_can_backend.own_twins import TwinProcess, check_twins, twins_here
from snakesim_can_backend.parameters import check_ratings, parameters_of
from snakesim_can_backend.protocol import Action, Frame, LastStop, ModuleState
from snakesim_can_backend.reading import Reading
from snakesim_can_backend.sensors import Sensors, contacts_due, described
from snakesim_can_backend.settings import Settings
from snakesim_can_backend.watch import Watch
from snakesim_can_backend.wire import SocketCanWire, Trouble, VirtualWire, Wire, check_interface, wait
from snakesim_hal.backend import Samples, SetPoints
from snakesim_hal.errors import BackendError
from snakesim_hal.messages import Description, Fault, LifecycleState, Pace
from snakesim_hal.robot import describe
from snakesim_hal.scenario import RunConfig, config_hash

NAME = "can"
ANSWER_MARGIN = 1.25  # of the bus time that all answers take
ANSWER_SLACK_S = 0.002
LOCKSTEP_ANSWER_S = 2.0  # twins that are slow are waited for; those that are dead are not waited for again
FIRST_STATE_SYNCS = 20
FIRST_STATE_PAUSE_S = 0.02

_log = logging.getLogger("snakesim.can")


class CanBackend:
    """A `snakesim_hal.backend.Backend` on joint modules, real or emulated."""

    Settings = Settings

    @staticmethod
    def check(config: RunConfig, settings: Settings) -> tuple[Pace, ...]:
        """Real modules wait for nobody; twins that this backend starts can. Raises ConfigError."""
        check_load(config, settings)
        check_ratings(config.robot)
        check_twins(config, settings)
        for channel in settings.channels:
            check_interface(channel)
        return ("realtime",) if settings.twins_run == "none" else ("lockstep", "realtime")

    def __init__(self, config: RunConfig, settings: Settings) -> None:
        """Open the buses and find every module; nothing is enabled. Raises ConfigError and BackendError."""
        self.check(config, settings)
        self._config, self._settings = config, settings
        self._lockstep = config.pace == "lockstep"
        self._reports = reports_of(config, settings)
        joints = config.robot.chain.modules
        self._mocap: MocapReceiver | None = None
        self._twins: TwinProcess | None = None
        self._wires: list[Wire] = []
        self._open = True
        try:
            if pose_listen := settings.pose_listen or ("" if settings.twins_run == "none" else "127.0.0.1:0"):
                self._mocap = MocapReceiver(pose_listen)
            self._buses = self._open_buses(shares(config, settings))
            self._reading = Reading(joints)
            self._description = self._describe()
            names = [joint.name for joint in self._description.joints]
            self._wire_of = [bus.wire for bus in self._buses for _ in bus.nodes]
            channels = [wire.channel for wire in self._wire_of]
            self._watch = Watch(names, channels, config.period_ns * 1e-9, config.lease_ns * 1e-9)
            self._bring_up(names)
        except BaseException:
            self.close()
            raise
        self._sensors = Sensors(config, self._reports, self._reading, self._mocap)
        self._set_points = commands.SetPointWriter(joints)
        self._lifecycle: LifecycleState = "disarmed"
        self._unsent: list[str] = []
        self._answer_limit_s = LOCKSTEP_ANSWER_S if self._lockstep else _answer_time_s(self._buses, self._reports)
        self._tick = 0

    def describe(self) -> Description:
        """The robot as its file says, with the sensors that its modules have."""
        return self._description

    def sample(self, tick: int, stamp_ns: int) -> Samples:
        """Send Sync, and take what the modules sampled at it. Who is late is waited for only so long."""
        self._must_be_open()
        self._tick = tick
        self._sync(stamp_ns // 1000 if self._lockstep else time.monotonic_ns() // 1000)
        return self._sensors.sample(tick, stamp_ns)

    def enact(self, set_points: SetPoints, lifecycle: LifecycleState) -> None:
        """Armed: send the set-points. Otherwise none go out: the modules bring themselves to rest and stay passive."""
        if not self._open:
            return
        if lifecycle == self._lifecycle:
            self._remind(lifecycle)
        for frame in commands.on_change(self._lifecycle, lifecycle):
            self._broadcast(frame)
        if self._lifecycle in commands.LATCHED and lifecycle not in commands.LATCHED:
            self._cleared()
        self._lifecycle = lifecycle
        self._unsent = []
        if lifecycle != "armed":
            return
        for i, frame in enumerate(self._set_points.frames(set_points)):
            if self._wire_of[i].send(frame):
                self._set_points.sent(i)
            else:  # the queue is full or the interface down: the next set-point takes its place
                self._unsent.append(self._wire_of[i].channel)

    def advance(self) -> None:
        """The world goes on by itself: take in what has come meanwhile. Raises BackendError when it is closed."""
        self._must_be_open()
        self._receive()

    def faults(self) -> list[Fault]:
        """What the modules and the buses complain of, and what the driver sees wrong with them."""
        if not self._open:
            return []
        troubles: list[Trouble] = [trouble for wire in self._wires for trouble in wire.troubles()]
        names = self._description.joints
        return [
            Fault(
                tick=self._tick,
                what=finding.what,
                cause=finding.cause[:500],
                joint=None if finding.joint is None else names[finding.joint].name,
            )
            for finding in self._watch.look(self._reading, self._lifecycle, troubles, self._unsent)
        ]

    def close(self) -> None:
        """Motors off, buses closed, own twins ended."""
        if not self._open:
            return
        self._open = False
        for wire in self._wires:
            try:
                wire.send(commands.command(Action.DISARM))
            except BackendError as error:
                _log.warning("closing: %s", error)
            wire.idle()
            wire.close()
        if self._twins is not None:
            self._twins.stop()
        if self._mocap is not None:
            self._mocap.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _must_be_open(self) -> None:
        if not self._open:
            raise BackendError("the buses are closed; open a new backend")

    def _describe(self) -> Description:
        config = self._config
        plain = describe(
            config.robot,
            backend=NAME,
            period_ns=config.period_ns,
            lease_ns=config.lease_ns,
            config_hash=config_hash(config),
        )
        sensors = described(config, self._reports, pose=self._mocap is not None)
        return msgspec.structs.replace(plain, sensors=sensors)

    def _open_buses(self, joints_of: list[int]) -> list[Bus]:
        settings = self._settings
        pose = self._mocap.address if self._mocap is not None else None
        if settings.twins_run == "process":
            self._twins = TwinProcess(self._config, settings, pose, stepped=self._lockstep)
        names = settings.channels or [f"virtual-{uuid.uuid4().hex[:8]}"]
        for name in names:
            if settings.channels:
                self._wires.append(SocketCanWire(name))
            else:
                other_end = twins_here(self._config, settings, name, pose, stepped=self._lockstep)
                self._wires.append(VirtualWire(name, other_end))
        if settings.log:
            log = open_log(Path(settings.log))
            self._wires = [LoggedWire(wire, log) for wire in self._wires]
        buses, first = [], 1
        for wire, count in zip(self._wires, joints_of, strict=True):
            buses.append(Bus(wire, range(first, first + count)))
            first += count
        return buses

    def _bring_up(self, names: list[str]) -> None:
        limit_s = self._settings.bring_up_limit_s
        found = find(self._buses, limit_s, self._reading.take)
        wrong = objections(self._buses, found, names, lockstep=self._lockstep)
        if wrong:
            raise BackendError("the robot is not whole; nothing was enabled:\n  " + "\n  ".join(wrong))
        self._broadcast(commands.command(Action.DISARM))
        self._configure(range(1, len(names) + 1))
        self._await_first_states(names)
        self._forgive_old_faults()

    def _forgive_old_faults(self) -> None:
        """What a driver that was killed has left behind is cleared; heat, leaks and emergencies are not."""
        for module, wire in zip(self._reading.modules, self._wire_of, strict=True):
            if module.state == ModuleState.FAULT and module.last_stop in (LastStop.WATCHDOG, LastStop.STREAM):
                _log.warning("node %d: clearing a %s fault of before", module.node, module.last_stop.name.lower())
                wire.send(commands.command(Action.CLEAR, module.node))

    def _configure(self, nodes: range | set[int]) -> None:
        wanted = parameters_of(self._config.robot, self._settings, self._reports)
        in_force = configure(
            self._buses, {node: wanted[node] for node in nodes}, self._settings.bring_up_limit_s, self._reading.take
        )
        check_ratings(self._config.robot, in_force)

    def _await_first_states(self, names: list[str]) -> None:
        for _ in range(FIRST_STATE_SYNCS):
            self._answer_limit_s = FIRST_STATE_PAUSE_S if not self._lockstep else LOCKSTEP_ANSWER_S
            self._sync(0 if self._lockstep else time.monotonic_ns() // 1000)
            if all(module.sync >= 0 for module in self._reading.modules):
                self._reading.strangers.clear()
                return
        silent = [name for name, module in zip(names, self._reading.modules, strict=True) if module.sync < 0]
        raise BackendError(f"{', '.join(silent)} did not answer {FIRST_STATE_SYNCS} Syncs; nothing was enabled")

    def _sync(self, time_us: int) -> None:
        reading = self._reading
        self._receive()
        reading.begin(reading.sync + 1, contacts=contacts_due(self._reports, reading.sync + 1), tail=self._reports.tail)
        self._broadcast(commands.sync(reading.sync, time_us))
        end = time.monotonic() + self._answer_limit_s
        while not reading.complete and (left_s := end - time.monotonic()) > 0:
            if not wait(self._wires, left_s):
                break
            self._receive()

    def _receive(self) -> None:
        take = self._reading.take
        for wire in self._wires:
            for frame in wire.receive():
                take(frame)

    def _broadcast(self, frame: Frame) -> None:
        for wire in self._wires:
            wire.send(frame)

    def _remind(self, lifecycle: LifecycleState) -> None:
        for module, wire in zip(self._reading.modules, self._wire_of, strict=True):
            frame = commands.reminder(lifecycle, module.state, module.node)
            if frame is not None:
                wire.send(frame)

    def _cleared(self) -> None:
        """Somebody cleared the fault. Modules that restarted have lost their parameters, and get them again."""
        self._watch.forget(self._reading.sync)
        restarted, self._watch.restarted = self._watch.restarted, set()
        if restarted:
            try:
                self._configure({joint + 1 for joint in restarted})
            except BackendError as error:
                _log.warning("after a restart: %s", error)
                self._watch.restarted = restarted


def _answer_time_s(buses: list[Bus], reports: Reports) -> float:
    """How long all answers to a Sync may take on the fullest bus."""
    frames = max(len(bus.nodes) for bus in buses) * (1 + (reports.contact_every > 0)) + reports.tail
    bus_s = frames * worst_bits(8) / BIT_RATE
    return ANSWER_MARGIN * bus_s + ANSWER_SLACK_S
