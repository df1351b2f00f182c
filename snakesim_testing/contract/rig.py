"""An open backend on the bench, driven tick by tick as by the host, through the real authority and its limiter."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.arrays import Floats
from snakesim_hal.host.control_cycle import ControlCycle
from snakesim_hal.safety.authority import Authority
from snakesim_hal.wire.messages import (
    ClockMode,
    EstopRequest,
    Fault,
    JointCommand,
    JointState,
    LeaseRequest,
    LifecycleRequest,
    LifecycleState,
    Mode,
    make_arm_request,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_testing.contract import tolerances as t

JointTargets = Mapping[int, tuple[Mode, float]]  # joint index -> mode and target
HOLDER = "control"
REANCHOR_PERIODS = 10


def _no_sleep(_seconds: float) -> None:
    """In lockstep no drive's time is that of a clock."""


def unlimited(requested: RequestedSetpoints) -> SafeSetpoints:
    """Pass setpoints off as limited, for clauses about what a backend does at its joints' ends."""
    return SafeSetpoints(requested.mode, requested.target, requested.torque_limit_nm)


@dataclass
class Record:
    """Joint states and setpoints over some ticks. All arrays are (ticks, n_joints)."""

    samples: list[Samples]
    setpoints: list[SafeSetpoints]
    faults: list[Fault]  # reported by the backend in these ticks

    @property
    def joints(self) -> list[JointState]:
        """The joint states, oldest first."""
        return [sample.joints for sample in self.samples]

    @property
    def angle_rad(self) -> Floats:
        """Measured angles."""
        return np.array([joints.angle_rad for joints in self.joints])

    @property
    def velocity_rad_s(self) -> Floats:
        """Measured velocities."""
        return np.array([joints.velocity_rad_s for joints in self.joints])

    @property
    def torque_nm(self) -> Floats:
        """Measured torques."""
        return np.array([joints.torque_nm for joints in self.joints])


@dataclass
class Rig:
    """One opening of a backend. Every clause that needs no network is tested on it."""

    backend: Backend
    clock_mode: ClockMode
    period_ns: int
    spoiled: bool = False  # unusable for further tests: closed, or a joint is silent
    closed: bool = False
    tick: int = 0
    late_periods: float = 0.0  # how far this machine fell behind real time at worst
    _on_the_way: dict[int, float] = field(default_factory=dict[int, float])  # of joints led along by positions
    _found: list[tuple[int, Fault]] = field(default_factory=list[tuple[int, Fault]])

    def __post_init__(self) -> None:
        self.robot = self.backend.describe()
        self.count = len(self.robot.joints)
        self.full_torque_nm = [joint.torque_limit_nm for joint in self.robot.joints]
        self._cycle = ControlCycle(self.backend, Authority(self.robot))
        self._sequence = 0
        self._anchor_ns = time.monotonic_ns()
        self._samples: list[Samples] = []
        self._setpoints: list[SafeSetpoints] = []
        self.first = self._sample()
        # On a bus the first joint states may take a few periods.
        for _ in range(t.ARMING_PERIODS):
            self.idle()
            if all(self.now.valid):
                break
        self.home_rad = list(self.now.angle_rad)
        self.faults_at_opening = self.faults

    @property
    def authority(self) -> Authority:
        """The safety core that drives the robot."""
        return self._cycle.safety

    # --- capabilities --------------------------------------------------------------------------------------

    def has(self, joint: int, mode: Mode) -> bool:
        """Whether a joint is described to have a mode."""
        return self.robot.joints[joint].supports_mode(mode)

    def feels(self, joint: int = 0) -> bool:
        """Whether a joint is described to measure its torque."""
        return "torque" in self.robot.joints[joint].measures

    def needs(self, *modes: Mode, torque: bool = False) -> None:
        """Skip a clause about modes that joints 0 or 1 do not have, or about a torque that they do not measure."""
        for joint in (0, 1):
            name = self.robot.joints[joint].name
            for mode in modes:
                if not self.has(joint, mode):
                    pytest.skip(f"{name} is described without {mode.name.lower()} mode")
            if torque and not self.feels(joint):
                pytest.skip(f"{name} is described without measured torque")

    def _next_along(self, joint: int, speed_rad_s: float) -> float:
        """The position a period further."""
        at = self._on_the_way.get(joint, self.now.angle_rad[joint]) + speed_rad_s * self.period_ns * 1e-9
        self._on_the_way[joint] = at
        return at

    # --- readings ------------------------------------------------------------------------------------------

    @property
    def faults(self) -> list[Fault]:
        """All faults that the backend reported since it was opened."""
        return [fault for _, fault in self._found]

    @property
    def now(self) -> JointState:
        """The newest joint state."""
        return self._samples[-1].joints

    def since(self, tick: int) -> Record:
        """Everything after a tick."""
        first = len(self._samples) - (self.tick - tick)
        faults = [fault for found_at, fault in self._found if found_at >= tick]
        return Record(self._samples[first:], self._setpoints[first - 1 :], faults)

    def periods(self, seconds: float) -> int:
        """Number of periods in a time, rounded up."""
        return int(np.ceil(seconds * 1e9 / self.period_ns))

    # --- one period ----------------------------------------------------------------------------------------

    def hand(self, points: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Hand setpoints to the backend without the limiter, and let a period pass."""
        self.backend.enact(points, lifecycle)
        self.let_pass(points)

    def let_pass(self, setpoints: SafeSetpoints | None = None) -> None:
        """Let a period pass and sample, as the host does. Faults go to the authority, as in the host."""
        self._setpoints.append(setpoints or self._setpoints[-1])
        for fault in self._cycle.advance():
            self._found.append((self.tick, fault))
        self.tick += 1
        if self.clock_mode == "realtime":
            self._wait_for_deadline()
        self._sample()

    def idle(self, periods: int = 1) -> Record:
        """Periods without a new command: the last one stays active while its lease lasts."""
        began = self.tick
        for _ in range(periods):
            decision = self._cycle.decide(self._now_ns, self.tick)
            self._cycle.enact(decision)
            self.let_pass(decision.setpoints)
        return self.since(began)

    def drive(self, asked: JointTargets, periods: int = 1, *, torque_limit_nm: list[float] | None = None) -> Record:
        """Command some joints, while the others hold the start pose; through lease, limiter and lifecycle."""
        began = self.tick
        for _ in range(periods):
            self._offer(self.points(asked, torque_limit_nm))
            self.idle()
        return self.since(began)

    def offer(self, points: RequestedSetpoints) -> Record:
        """One command as it is, and the period after it."""
        began = self.tick
        self._offer(points)
        self.idle()
        return self.since(began)

    def press(self, asked: JointTargets, periods: int = 1, *, torque_limit_nm: list[float] | None = None) -> Record:
        """The same without the limiter, which would not drive a joint against its stop; the lifecycle still applies."""
        began = self.tick
        for _ in range(periods):
            self._offer(self.points(dict.fromkeys(asked, (Mode.PASSIVE, 0.0))))
            self._cycle.decide(self._now_ns, self.tick)
            self.hand(unlimited(self.points(asked, torque_limit_nm)), self.authority.state)
        return self.since(began)

    def points(self, asked: JointTargets, torque_limit_nm: list[float] | None = None) -> RequestedSetpoints:
        """RequestedSetpoints of all joints; those without a command hold the start pose.

        A joint without a velocity mode gets the positions that lead along at that speed, one each time.
        """
        mode, target = [Mode.POSITION] * self.count, list(self.home_rad)
        self._on_the_way = {joint: at for joint, at in self._on_the_way.items() if joint in asked}
        for joint, (wanted_mode, wanted) in asked.items():
            if wanted_mode is Mode.VELOCITY and not self.has(joint, Mode.VELOCITY):
                wanted_mode, wanted = Mode.POSITION, self._next_along(joint, wanted)
            mode[joint], target[joint] = wanted_mode, wanted
        return RequestedSetpoints(mode, target, torque_limit_nm or self.full_torque_nm)

    def freeze_host(self, seconds: float, freeze_driver: Callable[[float, Callable[[float], None]], None]) -> None:
        """Let time pass in which the host does nothing, as when its process is stopped and goes on later."""
        freeze_driver(seconds, time.sleep if self.clock_mode == "realtime" else _no_sleep)
        self.tick += self.periods(seconds)

    # --- the lifecycle -------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Arm at the present pose, and give the modules time to follow."""
        if self.authority.state == "armed":
            return
        if self.authority.state != "disarmed":
            self.disarm()
            self.idle(t.TRANSPORT_PERIODS)
        here = {i: (Mode.POSITION, angle) for i, angle in enumerate(self.now.angle_rad)}
        self._offer(self.points(here))
        answer = self.authority.on_lifecycle(make_arm_request(self.robot, "conformance"), self._now_ns)
        assert answer.ok, f"the robot cannot be armed: {answer.reason}"
        self.drive(here, t.ARMING_PERIODS)
        self.must_be_armed()

    def must_be_armed(self) -> None:
        """Fail with the reason when the robot has left `armed`."""
        assert self.authority.state == "armed", f"no longer armed: {self.authority.reason}"

    def disarm(self) -> None:
        """Disarm, or reset a stop."""
        if self.authority.state == "armed":
            self.authority.on_lifecycle(LifecycleRequest(action="disarm"), self._now_ns)
        else:
            self.reset()

    def reset(self) -> None:
        """Reset a stop, and end isolations."""
        self.authority.on_lifecycle(LifecycleRequest(action="reset"), self._now_ns)

    def estop(self) -> None:
        """Emergency stop."""
        self.authority.on_estop(EstopRequest(who="bench"), self.tick)

    def fault(self) -> None:
        """A fault that the backend has not reported."""
        self.authority.fault(Fault(tick=self.tick, what="bench", cause="planted by the contract tests"))

    @contextlib.contextmanager
    def may_lose_a_joint(self) -> Iterator[None]:
        """Context in which one failed joint is isolated, whatever the robot file allows. Begins and ends disarmed."""
        usual = self._cycle
        tolerant = Authority(msgspec.structs.replace(self.robot, max_isolated_joints=1))
        self._cycle = ControlCycle(self.backend, tolerant)
        self.idle()
        yield
        self.disarm()
        self.idle()
        self._cycle = usual
        self.idle()

    def lose(self, joint: int) -> None:
        """Isolate a joint, as after a failure."""
        name = self.robot.joints[joint].name
        cause = f"the contract tests isolate {name}"
        self.authority.fault(Fault(tick=self.tick, what="bench", cause=cause, joint=name, reach="joint"))

    def cruise(self, joint: int = 0) -> Record:
        """Arm, and move one joint at constant speed."""
        self.arm()
        record = self.drive({joint: (Mode.VELOCITY, t.CRUISE_RAD_S)}, self.periods(t.CRUISE_S))
        self.must_be_armed()
        moved = record.angle_rad[-1, joint] - record.angle_rad[0, joint]
        assert moved > t.STILL_RAD, f"joint {joint} does not move in velocity mode, so stopping cannot be tested"
        return record

    def go_home(self) -> None:
        """Bring every joint back to the start pose, at rest and disarmed; does nothing if it is there."""
        if self.authority.state == "armed" or not self._is_home():
            if not self._is_home():
                self.arm()
                self.drive({}, self.periods(t.SETTLE_S))
            self.disarm()
            self.idle(t.TRANSPORT_PERIODS)
        elif self.authority.state != "disarmed":
            self.disarm()
            self.idle()

    def close(self) -> None:
        """Close the backend; safe to call again."""
        self.spoiled = self.closed = True
        self.backend.close()

    # --- inside --------------------------------------------------------------------------------------------

    @property
    def _now_ns(self) -> int:
        return self.tick * self.period_ns

    def _is_home(self) -> bool:
        away = np.abs(np.array(self.now.angle_rad) - self.home_rad)
        return bool(away.max() < t.REACHED_RAD and np.abs(self.now.velocity_rad_s).max() < t.STILL_RAD_S)

    def _offer(self, points: RequestedSetpoints) -> None:
        """Send a command; a rejection shows in the joint states."""
        if self.authority.state == "disarmed" and not self.authority.lease.is_live(self._now_ns):
            self.authority.on_lease(LeaseRequest(action="acquire", holder=HOLDER), self._now_ns)
        self._sequence += 1
        command = JointCommand(
            tick=self.tick,
            sequence=self._sequence,
            lease_epoch=self.authority.lease.epoch,
            arm_session=self.authority.arm_session,
            layout=self.robot.layout,
            valid_for_ns=self.robot.lease_ns,
            mode=points.mode,
            target=points.target,
            torque_limit_nm=points.torque_limit_nm,
        )
        self.authority.offer_command(command, now_ns=self._now_ns, tick=self.tick, age_ns=0)

    def _sample(self) -> Samples:
        samples = self._cycle.sample(self.tick, self._now_ns)
        self._cycle.observe(samples, self._now_ns)
        self._samples.append(samples)
        return samples

    def _wait_for_deadline(self) -> None:
        left_ns = self._anchor_ns + self._now_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)
            return
        self.late_periods = max(self.late_periods, -left_ns / self.period_ns)
        if -left_ns > REANCHOR_PERIODS * self.period_ns:
            self._anchor_ns -= left_ns
