"""A whole run in one process: backend, authority with its gate, guidance, navigation and a controller; no Zenoh.

The order of calls and the age of every message are those of the lockstep host (`snakesim_hal.host.host`): in a tick the
backend is sampled, services act on the ticks that are theirs, the controller answers with what counts at that tick,
and the authority decides what the motors get.
"""

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.advance import Advance
from snakesim_gnc.control.controller import Controller, Report, View
from snakesim_gnc.control.hold import Hold
from snakesim_gnc.control.obstacle_triplet import ObstacleTriplet
from snakesim_gnc.control.path_following import PathFollowing
from snakesim_gnc.control.states import locomotion_state
from snakesim_gnc.guidance.core import WorldModel
from snakesim_gnc.navigation.core import KnownPath
from snakesim_hal.backend import SetPoints
from snakesim_hal.model.plugins import CONTROLLERS, find_plugin, plugin_settings
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import Override, RunConfig, load, parse_set, place_all, start_of
from snakesim_hal.model.scenario import Service as Schedule
from snakesim_hal.model.scene import route_of
from snakesim_hal.safety.authority import Authority
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Contacts,
    Description,
    JointCommand,
    JointState,
    LeaseRequest,
    LifecycleRequest,
    Mode,
    Pose,
    Trajectory,
    World,
)
from snakesim_sim_backend.backend import SimBackend

Floats = NDArray[np.float64]

SHIPPED: dict[str, Any] = {  # also without an installed distribution
    "hold": Hold,
    "obstacle_triplet": ObstacleTriplet,
    "path_following": PathFollowing,
}


@dataclass
class Run:
    """What happened, one row a tick. Angles, torques and targets are (ticks, n_joints), tail to head."""

    config: RunConfig
    backend: SimBackend
    reports: list[Report]
    states: list[str]
    reasons: list[str]
    time_s: Floats
    base_w: Floats  # (ticks, 3): the tail end, as the pose sensor has it
    angle_rad: Floats
    torque_nm: Floats
    velocity_rad_s: Floats
    mode: NDArray[np.int64]
    target: Floats  # as applied, after the gate
    limited: list[dict[int, str]]
    update_us: Floats  # how long the controller took
    contact_n: Floats  # the strongest touch felt

    @property
    def path_s_m(self) -> Floats:
        """Arc length of the tail along the route, projected from the measured pose, (ticks,)."""
        route = route_of(self.config.scene)
        assert route is not None
        places: list[float] = []
        near: float | None = None
        for point in self.base_w[:, :2]:
            near = route.project(point, near)
            places.append(near)
        return np.array(places)

    @property
    def moved_m(self) -> float:
        """How far the tail came along the route."""
        return float(self.path_s_m[-1] - self.path_s_m[0])

    @property
    def turns(self) -> list[int | None]:
        """Propulsion joints in their order; None while nothing pushes."""
        found: list[int | None] = []
        for report in self.reports:
            if not found or found[-1] != report.propulsion_joint:
                found.append(report.propulsion_joint)
        return found


@dataclass
class _Output:
    """A service's outputs by tick."""

    schedule: Schedule
    by_tick: dict[int, Any] = field(default_factory=dict[int, Any])

    def at(self, tick: int) -> Any:
        return self.by_tick.get(self.schedule.counting_at(tick))


def configure(scenario: str, *sets: str, **robot_files: str) -> RunConfig:
    """A shipped scenario with `--set` texts."""
    overrides = [parse_set(text) for text in sets]
    overrides += [Override(key, value, f"--{key}") for key, value in robot_files.items()]
    return load(scenario, overrides).config


def run(
    config: RunConfig,
    *,
    duration_s: float | None = None,
    controller: Controller | None = None,
    intercept: Callable[[int, SetPoints], SetPoints] | None = None,
    each_tick: Callable[[int, SimBackend], None] | None = None,
    blind: Collection[int] = (),
    lost: Collection[int] = (),
) -> Run:
    """Run a configuration for its duration.

    intercept: changes the controller's set-points; each_tick: called before every period with the backend.
    blind, lost: ticks at which the controller gets no world model, and no trajectory.
    """
    settings = msgspec.convert(config.backends.get("sim", {}), SimBackend.Settings)
    backend = SimBackend(config, settings)
    try:
        runner = _Runner(config, backend, controller)
        runner.blind, runner.lost = blind, lost
        return runner.go(duration_s or config.duration_s, intercept, each_tick)
    finally:
        backend.close()


class _Runner:
    def __init__(self, config: RunConfig, backend: SimBackend, controller: Controller | None) -> None:
        self.config, self.backend = config, backend
        self.robot: Description = backend.describe()
        self.authority = Authority(self.robot)
        known = [placed.obstacle for placed in place_all(config) if not placed.walkable]
        self.guidance = WorldModel(self.robot, known)
        self.planner = KnownPath(_route(config), known, speed_m_s=config.mission.speed_m_s)
        self.world = _Output(config.services["guidance"])
        self.trajectory = _Output(config.services["navigation"])
        self.controller = controller or _make_controller(config, self.robot)
        self.contacts: Contacts | None = None
        self.pose: Pose | None = None
        self.blind: Collection[int] = ()
        self.lost: Collection[int] = ()

    def go(
        self,
        duration_s: float,
        intercept: Callable[[int, SetPoints], SetPoints] | None,
        each_tick: Callable[[int, SimBackend], None] | None,
    ) -> Run:
        period_ns = self.config.period_ns
        rows: list[tuple[Any, ...]] = []
        for tick in range(round(duration_s * 1e9 / period_ns)):
            stamp_ns = tick * period_ns
            joints = self._sense(tick, stamp_ns)
            if tick == 0:
                self._arm(joints)
            view = View(
                tick=tick,
                time_s=stamp_ns * 1e-9,
                period_s=period_ns * 1e-9,
                joints=joints,
                world=None if tick in self.blind else self.world.at(tick),
                trajectory=None if tick in self.lost else self.trajectory.at(tick),
            )
            started = time.perf_counter_ns()
            action = self.controller.update(view)
            took_us = (time.perf_counter_ns() - started) / 1000
            set_points = action.set_points if intercept is None else intercept(tick, action.set_points)
            refusal = self.authority.offer(self._command(tick, set_points), now_ns=stamp_ns, tick=tick, age_ns=0)
            assert refusal is None, refusal
            self.authority.expire(stamp_ns, tick)
            decision = self.authority.decide(self.config.services["control"].counting_at(tick + 1))
            if each_tick is not None:
                each_tick(tick, self.backend)
            self.backend.enact(decision.set_points, self.authority.state)
            self.backend.advance()
            assert self.pose is not None
            rows.append((view, action.report, decision, took_us, self.pose.position_w, self._strongest_n()))
        return self._as_run(rows)

    def _sense(self, tick: int, stamp_ns: int) -> JointState:
        samples = self.backend.sample(tick, stamp_ns)
        self.authority.observe(samples.joints)
        contacts, pose = samples.others.get(keys.CONTACTS), samples.others.get(keys.POSE)
        if isinstance(contacts, Contacts):
            self.contacts = contacts
        if isinstance(pose, Pose):
            self.pose = pose
        if tick % self.world.schedule.every_ticks == 0 and self.pose is not None:
            world: World = self.guidance.update(tick, stamp_ns, samples.joints, self.contacts, self.pose)
            self.world.by_tick[tick] = world
        if tick % self.trajectory.schedule.every_ticks == 0:
            trajectory: Trajectory = self.planner.update(tick, stamp_ns, self.world.at(tick), None)
            self.trajectory.by_tick[tick] = trajectory
        return samples.joints

    def _arm(self, joints: JointState) -> None:
        answer = self.authority.on_lease(LeaseRequest(action="acquire", holder="control"), 0)
        assert answer.ok, answer.reason
        stay = SetPoints([Mode.POSITION] * len(self.robot.joints), list(joints.angle_rad), [])
        assert self.authority.offer(self._command(-1, stay), now_ns=0, tick=0, age_ns=0) is None
        request = LifecycleRequest(
            action="arm", robot=self.robot.robot, backend=self.robot.backend, config_hash=self.robot.config_hash
        )
        answer = self.authority.on_lifecycle(request, 0)
        assert answer.ok, answer.reason

    def _command(self, tick: int, set_points: SetPoints) -> JointCommand:
        return JointCommand(
            tick=max(tick, 0),
            sequence=tick + 1,
            lease_epoch=self.authority.lease.epoch,
            arming=self.authority.arming,
            layout=self.robot.layout,
            valid_for_ns=self.robot.lease_ns,
            mode=set_points.mode,
            target=set_points.target,
            torque_limit_nm=set_points.torque_limit_nm or None,
        )

    def _strongest_n(self) -> float:
        felt = [] if self.contacts is None else self.contacts.contacts
        return max((float(np.linalg.norm(contact.force_l)) for contact in felt), default=0.0)

    def _as_run(self, rows: Sequence[tuple[Any, ...]]) -> Run:
        views, reports, decisions, took_us, base, strongest = zip(*rows, strict=True)
        advance, told = Advance(), list[tuple[str, str]]()
        for view, report in zip(views, reports, strict=True):
            if view.world is not None:
                advance.put(view.world.stamp_ns * 1e-9, view.world.centre_w)
            moves = view.trajectory is not None and view.trajectory.speed_m_s != 0.0
            told.append(
                locomotion_state(
                    rests="" if moves else "no speed",
                    usable_push_points=report.usable_push_points,
                    obstacle=report.why,
                    advanced_m=advance.metres,
                )
            )
        return Run(
            config=self.config,
            backend=self.backend,
            reports=list(reports),
            states=[state for state, _ in told],
            reasons=[reason for _, reason in told],
            time_s=np.array([view.time_s for view in views]),
            base_w=np.array(base),
            angle_rad=np.array([view.joints.angle_rad for view in views]),
            torque_nm=np.array([view.joints.torque_nm for view in views]),
            velocity_rad_s=np.array([view.joints.velocity_rad_s for view in views]),
            mode=np.array([d.set_points.mode for d in decisions], dtype=np.int64),
            target=np.array([d.set_points.target for d in decisions]),
            limited=[d.limited for d in decisions],
            update_us=np.array(took_us),
            contact_n=np.array(strongest),
        )


def _route(config: RunConfig) -> Route:
    route = route_of(config.scene)
    if route is None:
        start = start_of(config)
        ahead = 100.0 * np.array([np.cos(start.yaw_rad), np.sin(start.yaw_rad)])
        route = Route(np.array([start.position_w, start.position_w + ahead]))
    return route


def _make_controller(config: RunConfig, robot: Description) -> Controller:
    plugin = SHIPPED.get(config.controller) or find_plugin(CONTROLLERS, config.controller)
    source = f"scenario {config.name!r}"
    return plugin(robot, plugin_settings(plugin, config.control_settings, source, config.control_section))
