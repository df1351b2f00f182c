"""An open backend, driven tick by tick as the host does it, through the real authority and its command limiter."""

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
    """Do not wait: in lockstep the time of drives does not pass by a clock."""


def unlimited(requested: RequestedSetpoints) -> SafeSetpoints:
    """Return setpoints as safe ones without limiting them, for clauses about the ends of joints."""
    return SafeSetpoints(requested.mode, requested.target, requested.torque_limit_nm)


@dataclass
class Record:
    """Joint states and setpoints of some ticks. All arrays are (ticks, n_joints)."""

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
    """An open backend with the real safety core. Every clause that needs no network is tested on it."""

    backend: Backend
    clock_mode: ClockMode
    period_ns: int
    spoiled: bool = False  # unusable for further tests: closed, or a joint is silent
    closed: bool = False
    tick: int = 0
    late_periods: float = 0.0  # how far this machine fell behind real time at worst
    _intermediate_rad: dict[int, float] = field(
        default_factory=dict[int, float]
    )  # by joint: last position of a joint without velocity mode, which follows a speed
    _faults_by_tick: list[tuple[int, Fault]] = field(default_factory=list[tuple[int, Fault]])

    def __post_init__(self) -> None:
        self.robot = self.backend.describe()
        self.count = len(self.robot.joints)
        self.full_torque_nm = [joint.torque_limit_nm for joint in self.robot.joints]
        self._cycle = ControlCycle(self.backend, Authority(self.robot))
        self._sequence = 0
        self._anchor_ns = time.monotonic_ns()
        self._samples: list[Samples] = []
        self._setpoints: list[SafeSetpoints] = []
        self.first_sample = self._sample()
        # On a bus the first joint states may take a few periods.
        for _ in range(t.ARMING_PERIODS):
            self.idle()
            if all(self.newest_joints.valid):
                break
        self.home_rad = list(self.newest_joints.angle_rad)
        self.faults_at_opening = self.faults

    @property
    def authority(self) -> Authority:
        """The safety core that drives the robot."""
        return self._cycle.safety

    # --- capabilities --------------------------------------------------------------------------------------

    def supports_mode(self, joint: int, mode: Mode) -> bool:
        """Return whether the description of a joint has a mode."""
        return self.robot.joints[joint].supports_mode(mode)

    def measures_torque(self, joint: int = 0) -> bool:
        """Return whether a joint measures its torque, by its description."""
        return "torque" in self.robot.joints[joint].measures

    @property
    def joints_without_watchdog(self) -> list[str]:
        """The joints whose drives do not stop by themselves, by the description."""
        return [joint.name for joint in self.robot.joints if not joint.watchdog]

    def skip_without(self, *modes: Mode, torque: bool = False) -> None:
        """Skip the clause if joint 0 or 1 does not have these modes, or does not measure its torque.

        Args:
            modes: modes that the clause uses.
            torque: whether the clause reads measured torque.
        """
        for joint in (0, 1):
            name = self.robot.joints[joint].name
            for mode in modes:
                if not self.supports_mode(joint, mode):
                    pytest.skip(f"{name} is described without {mode.name.lower()} mode")
            if torque and not self.measures_torque(joint):
                pytest.skip(f"{name} is described without measured torque")

    def _next_position_rad(self, joint: int, speed_rad_s: float) -> float:
        """Return where a joint is one period later at this speed."""
        position_rad = self._intermediate_rad.get(joint, self.newest_joints.angle_rad[joint])
        position_rad = position_rad + speed_rad_s * self.period_ns * 1e-9
        self._intermediate_rad[joint] = position_rad
        return position_rad

    # --- readings ------------------------------------------------------------------------------------------

    @property
    def faults(self) -> list[Fault]:
        """All faults that the backend reported since it was opened."""
        return [fault for _, fault in self._faults_by_tick]

    @property
    def newest_joints(self) -> JointState:
        """The newest joint state."""
        return self._samples[-1].joints

    def record_since(self, tick: int) -> Record:
        """Return the record of everything after a tick."""
        first = len(self._samples) - (self.tick - tick)
        faults = [fault for found_at, fault in self._faults_by_tick if found_at >= tick]
        return Record(self._samples[first:], self._setpoints[first - 1 :], faults)

    def count_periods(self, seconds: float) -> int:
        """Return the number of periods in a time, rounded up."""
        return int(np.ceil(seconds * 1e9 / self.period_ns))

    # --- one period ----------------------------------------------------------------------------------------

    def enact_without_limiter(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Give setpoints to the backend without the command limiter, and let a period pass."""
        self.backend.enact(setpoints, lifecycle)
        self.advance_period(setpoints)

    def advance_period(self, setpoints: SafeSetpoints | None = None) -> None:
        """Let a period pass and sample, as the host does. Faults go to the authority, as in the host."""
        self._setpoints.append(setpoints or self._setpoints[-1])
        for fault in self._cycle.advance():
            self._faults_by_tick.append((self.tick, fault))
        self.tick += 1
        if self.clock_mode == "realtime":
            self._wait_for_deadline()
        self._sample()

    def idle(self, periods: int = 1) -> Record:
        """Let periods pass without a new command: the last one stays active while its lease lasts."""
        first_tick = self.tick
        for _ in range(periods):
            decision = self._cycle.decide(self._now_ns, self.tick)
            self._cycle.enact(decision)
            self.advance_period(decision.setpoints)
        return self.record_since(first_tick)

    def drive(self, targets: JointTargets, periods: int = 1, *, torque_limit_nm: list[float] | None = None) -> Record:
        """Command some joints while the others hold the start pose, through lease, command limiter and lifecycle.

        Args:
            targets: mode and target by joint.
            periods: how often the command is sent.
            torque_limit_nm: of all joints; None: their full torque.

        Returns:
            The record of these periods.
        """
        first_tick = self.tick
        for _ in range(periods):
            self._send(self.make_setpoints(targets, torque_limit_nm))
            self.idle()
        return self.record_since(first_tick)

    def send_command(self, setpoints: RequestedSetpoints) -> Record:
        """Send one command, and return the record of the period after it."""
        first_tick = self.tick
        self._send(setpoints)
        self.idle()
        return self.record_since(first_tick)

    def press(self, targets: JointTargets, periods: int = 1, *, torque_limit_nm: list[float] | None = None) -> Record:
        """Command some joints without the command limiter, which does not drive a joint against its stop."""
        first_tick = self.tick
        for _ in range(periods):
            self._send(self.make_setpoints(dict.fromkeys(targets, (Mode.PASSIVE, 0.0))))
            self._cycle.decide(self._now_ns, self.tick)
            self.enact_without_limiter(unlimited(self.make_setpoints(targets, torque_limit_nm)), self.authority.state)
        return self.record_since(first_tick)

    def make_setpoints(self, targets: JointTargets, torque_limit_nm: list[float] | None = None) -> RequestedSetpoints:
        """Return setpoints of all joints; those without a command hold the start pose.

        A joint without velocity mode gets a position instead, which moves on at the speed with each call.
        """
        mode = [Mode.POSITION] * self.count
        target = list(self.home_rad)
        for joint in self._intermediate_rad.keys() - targets.keys():
            del self._intermediate_rad[joint]
        for joint, (joint_mode, joint_target) in targets.items():
            if joint_mode is Mode.VELOCITY and not self.supports_mode(joint, Mode.VELOCITY):
                joint_mode = Mode.POSITION
                joint_target = self._next_position_rad(joint, joint_target)
            mode[joint] = joint_mode
            target[joint] = joint_target
        return RequestedSetpoints(mode, target, torque_limit_nm or self.full_torque_nm)

    def freeze_host(self, seconds: float, freeze_driver: Callable[[float, Callable[[float], None]], None]) -> None:
        """Let time pass in which the host does nothing, as when its process is stopped and continued later.

        Args:
            seconds: how long.
            freeze_driver: freezes the driver for a time, with the given sleep; see `EmulatedDrives`.
        """
        freeze_driver(seconds, time.sleep if self.clock_mode == "realtime" else _no_sleep)
        self.tick += self.count_periods(seconds)

    # --- the lifecycle -------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Arm at the present pose, and wait until the joint modules are armed."""
        if self.authority.state == "armed":
            return
        if self.authority.state != "disarmed":
            self.disarm()
            self.idle(t.TRANSPORT_PERIODS)
        here = {i: (Mode.POSITION, angle) for i, angle in enumerate(self.newest_joints.angle_rad)}
        self._send(self.make_setpoints(here))
        answer = self.authority.on_lifecycle(make_arm_request(self.robot, "conformance"), self._now_ns)
        assert answer.ok, f"the robot cannot be armed: {answer.reason}"
        self.drive(here, t.ARMING_PERIODS)
        self.assert_armed()

    def assert_armed(self) -> None:
        """Fail with the reason if the robot is not armed any more."""
        assert self.authority.state == "armed", f"no longer armed: {self.authority.reason}"

    def disarm(self) -> None:
        """Disarm; or reset a stop."""
        if self.authority.state == "armed":
            self.authority.on_lifecycle(LifecycleRequest(action="disarm"), self._now_ns)
        else:
            self.reset()

    def reset(self) -> None:
        """Reset a stop, and end isolations."""
        self.authority.on_lifecycle(LifecycleRequest(action="reset"), self._now_ns)

    def estop(self) -> None:
        """Trigger an emergency stop."""
        self.authority.on_estop(EstopRequest(requester="bench"), self.tick)

    def fault(self) -> None:
        """Report a fault to the authority which the backend has not reported."""
        self.authority.fault(Fault(tick=self.tick, what="bench", cause="planted by the contract tests"))

    @contextlib.contextmanager
    def with_isolation_allowed(self) -> Iterator[None]:
        """Allow the isolation of one failed joint, whatever the robot file allows. Begins and ends disarmed."""
        usual_cycle = self._cycle
        tolerant = Authority(msgspec.structs.replace(self.robot, max_isolated_joints=1))
        self._cycle = ControlCycle(self.backend, tolerant)
        self.idle()
        yield
        self.disarm()
        self.idle()
        self._cycle = usual_cycle
        self.idle()

    def isolate_joint(self, joint: int) -> None:
        """Isolate a joint, as after a failure."""
        name = self.robot.joints[joint].name
        cause = f"the contract tests isolate {name}"
        self.authority.fault(Fault(tick=self.tick, what="bench", cause=cause, joint=name, reach="joint"))

    def cruise(self, joint: int = 0) -> Record:
        """Arm, and move one joint at constant speed."""
        self.arm()
        record = self.drive({joint: (Mode.VELOCITY, t.CRUISE_RAD_S)}, self.count_periods(t.CRUISE_S))
        self.assert_armed()
        moved = record.angle_rad[-1, joint] - record.angle_rad[0, joint]
        assert moved > t.STILL_RAD, f"joint {joint} does not move in velocity mode, so stopping cannot be tested"
        return record

    def go_home(self) -> None:
        """Bring every joint back to the start pose, at rest and disarmed."""
        is_home = self._is_home()
        if self.authority.state == "armed" or not is_home:
            if not is_home:
                self.arm()
                self.drive({}, self.count_periods(t.SETTLE_S))
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
        away = np.abs(np.array(self.newest_joints.angle_rad) - self.home_rad)
        return bool(away.max() < t.REACHED_RAD and np.abs(self.newest_joints.velocity_rad_s).max() < t.STILL_RAD_S)

    def _send(self, setpoints: RequestedSetpoints) -> None:
        """Send a command to the authority; the clause sees a rejection in the joint states."""
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
            mode=setpoints.mode,
            target=setpoints.target,
            torque_limit_nm=setpoints.torque_limit_nm,
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
