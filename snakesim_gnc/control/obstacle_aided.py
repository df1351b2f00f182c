"""Obstacle-aided propulsion with all joints: forces on the obstacles, and the shape slightly further along the path.

A body that obstacles hold on its path has one freedom, its arc length s. It is pushed along it by forces on the
obstacles that are near (`push.py`), under a bounded PI law of the speed.

Where these can balance a push, joints are in torque mode: they get the torques of those forces, and a shape so soft
that obstacles decide it, with no stiffness along the path. So the forces come true.

Elsewhere, and where drives have no torque mode, joints hold the shape in position mode. The torques then only close
gaps, and the shape itself pushes, at s plus a small look-ahead l: tau_i = k (theta_i(s + l) - theta_i(s)), hence by
virtual work a force F = l k sum theta_i'^2.

A negative speed backs the body out along its own path. A body that does not come on moves by a wave until it lies where
it can push (`contact_search.py`). See `docs/poal.md`.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from snakesim_gnc.control.bumpless import Blend, BumplessReference
from snakesim_gnc.control.carried import FeltContacts
from snakesim_gnc.control.climb import Climb
from snakesim_gnc.control.contact_search import ContactSearch
from snakesim_gnc.control.controller import Action, Report, View
from snakesim_gnc.control.progress import Located, Progress, SpeedFilter
from snakesim_gnc.control.push import Push, PushFilter, Touches, find_touches, push_forward
from snakesim_gnc.control.push_report import push_points, why_it_stands
from snakesim_gnc.control.undulation import LateralUndulation
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Description, Mode, World
from snakesim_hal.wire.quantities import about, above, from_zero

ANOTHER_SHAPE_RAD = 0.1
SLOPE_M = 0.02  # over which theta' is taken
SIGNS = np.random.default_rng(1).choice((-1.0, 1.0), 4096)
LARGEST_REST = 0.3  # of a push: what is not in balance turns the body a little, until it meets other obstacles
STRAIGHT_PER_M2 = 20.0  # sum of theta'^2 below which a shape hardly tells where on its path it is
FELT_N = 0.5  # a contact that is felt so hard is as dear as the others, but for a third
ACTS_AFTER_S = 0.03  # command and motor are on their way for so long
SOFT_REST, SOFT_AFTER_S = 0.03, 0.1  # what may be out of balance of a push with a soft shape, and for how long before
CREEPS_M_S, SETS_OFF = 0.05, 2.0  # slower than this, the push on obstacles grows so many times as fast
STANDS_M_S, STANDS_S = 0.01, 0.5  # slower than this for so long counts as standing still


@dataclass(frozen=True)
class PushSnapshot:
    """What the body could push off when it was last looked at."""

    world: World
    touches: Touches
    push: Push


class ObstacleAided:
    """Speed along the path, with every joint."""

    class Settings(FileStruct, frozen=True, kw_only=True):
        """Look-ahead l = speed_kp_s (v_wanted - v) + integral; its bound limits how hard the body is pushed."""

        speed_kp_s: Annotated[
            float, from_zero(5, "s"), about("look-ahead of the shape for each m/s that the speed is too low")
        ] = 0.2
        integral_per_s: Annotated[
            float, from_zero(50, "1/s"), about("how fast the look-ahead grows while the speed stays too low")
        ] = 0.4
        max_look_ahead_m: Annotated[
            float, from_zero(1, "m"), about("bound of the look-ahead: how far ahead on its path the shape is at most")
        ] = 0.05
        fresh_look_ahead_m: Annotated[
            float, from_zero(1, "m"), about("look-ahead with which it begins on a new path")
        ] = 0.01
        push_scale: Annotated[
            float, Meta(ge=-1, le=1), about("factor of both pushing terms, for control experiments; below 0: backward")
        ] = 1.0
        push_sign_s: Annotated[
            float,
            from_zero(100, "s"),
            about("for control experiments: after each such time the sign of the push is drawn at random; 0: never"),
        ] = 0.0
        speed_kp_n_s_per_m: Annotated[
            float, from_zero(1000, "N*s/m"), about("push on obstacles for each m/s that the speed is too low")
        ] = 25.0
        lag_kp_n_per_m: Annotated[
            float, from_zero(1000, "N/m"), about("push on obstacles for each metre that the body has fallen behind")
        ] = 60.0
        max_push_n: Annotated[float, from_zero(1000, "N"), about("bound of the push along the path")] = 60.0
        max_torque_nm: Annotated[
            float,
            from_zero(1000, "N*m"),
            about("bound of a joint's torque for pushing"),
        ] = 5.0
        max_contact_n: Annotated[float, above(1000, "N"), about("bound of the force that is asked of one contact")] = (
            60.0
        )
        reach_m: Annotated[float, above(1, "m"), about("an obstacle so near to the body is pushed")] = 0.03
        contact_gap_scale_m: Annotated[
            float, above(1, "m"), about("gap to an obstacle at which a contact counts half")
        ] = 0.005
        push_filter_s: Annotated[
            float, above(5, "s"), about("time constant of the filter of how the push is shared among contacts")
        ] = 0.05
        torque_filter_s: Annotated[
            float, above(5, "s"), about("time constant of the filter of the pushing torques")
        ] = 0.03
        search_after_s: Annotated[
            float,
            from_zero(1000, "s"),
            about("in which the body comes no 2 cm on, until it moves by a wave in search of contacts; 0: never"),
        ] = 1.2
        search_s: Annotated[float, above(1000, "s"), about("how long it does so, and then tries its path again")] = 30.0
        blend_s: Blend = 0.3
        speed_filter_s: SpeedFilter = 0.05
        no_contact_cost: Annotated[
            float,
            from_zero(1000, "1"),
            about("how many times dearer the force on an obstacle is that is not felt; 0: as dear as on others"),
        ] = 10.0
        shape_nm_per_rad: Annotated[
            float,
            from_zero(1000, "N*m/rad"),
            about("stiffness of the shape in torque mode; 0: always position mode, as stiff as the drives are"),
        ] = 1.5
        shape_nm_s_per_rad: Annotated[
            float, from_zero(1000, "N*m*s/rad"), about("damping of the shape in torque mode")
        ] = 0.1

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._robot = robot
        self._set = settings
        self._body, self._climb = PlanarBody(robot), Climb(robot)
        self._progress = Progress(self._body, speed_filter_s=settings.speed_filter_s)
        self._felt, self._filter = FeltContacts(), PushFilter(settings.push_filter_s)
        self._bumpless = BumplessReference(robot, settings.blend_s)
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._integral_m = 0.0
        self._push_n = 0.0
        self._bends = self._body.bends
        self._soft = settings.shape_nm_per_rad > 0.0 and all(robot.joints[i].has(Mode.TORQUE) for i in self._bends)
        self._unbalanced_s = 0.0  # when contacts could last not balance a push
        self._torques_nm = np.zeros(len(robot.joints))
        self._unit_nm = np.zeros(len(robot.joints))
        self._last_push: PushSnapshot | None = None
        self._max_force_n = self._force_n = 0.0  # what contacts and torques allow, and what is commanded of it
        self._moved_at_s = 0.0
        self._waits = False
        self._search = ContactSearch(robot, after_s=settings.search_after_s, for_s=settings.search_s)

    def update(self, view: View) -> Action:
        """Torques, or angles of the body further along the path, as far as the wanted speed needs it."""
        located = self._progress.update(view)
        if isinstance(located, str):
            self._waits = True
            return self._bumpless.hold(view, located)
        self._felt.take(located.world)
        if located.trajectory.speed_m_s == 0.0:  # whatever path is planned meanwhile
            return self._rest(view)
        lifted = self._climb.angles_rad(located.trajectory.rises, located.tail_s_m)
        middle_w, wanted_m_s = located.nodes_w.mean(axis=1), located.trajectory.speed_m_s
        near = self._last_push is not None and len(self._last_push.touches) > 0
        if (wave := self._search.decide(view, middle_w, wanted_m_s=wanted_m_s, near=near)) is not None:
            return self._undulate(view, wave, lifted)
        scale = self._set.push_scale * self._sign(view.time_s)
        ahead_m = self._look_ahead_m(located, view.period_s)
        ahead_m = scale * (ahead_m if scale >= 0 else abs(ahead_m))
        at = located.on_path.pose_at
        here = self._body.all_angles(at(located.tail_s_m))
        turns_per_m = (self._body.all_angles(at(located.tail_s_m + SLOPE_M)) - here) / SLOPE_M
        torques = scale * self._push_nm(view, located, turns_per_m)
        if self._soft and self._balanced(view.time_s) and not lifted.any():
            return self._press(view, located, here, turns_per_m, torques)
        reference = self._body.all_angles(at(located.tail_s_m + ahead_m)) + torques / self._stiffness + lifted
        restarted, before = located.restarted or self._waits or self._search.changed, self._bumpless.reference_rad
        if restarted and before is not None and np.abs(reference - before).max() > ANOTHER_SHAPE_RAD:
            self._integral_m = min(self._integral_m, self._set.fresh_look_ahead_m)
        setpoints, self._waits = self._bumpless.to(view, reference, restarted=restarted), False
        force_n = ahead_m * float(self._stiffness @ turns_per_m**2)
        return Action(setpoints, self._report(view, located, force_n, reference))

    def _balanced(self, time_s: float) -> bool:
        """Whether the obstacles beside the body have been able to hold a push for a while."""
        if self._last_push is None or self._last_push.push.rest > SOFT_REST:
            self._unbalanced_s = time_s
        return time_s - self._unbalanced_s > SOFT_AFTER_S

    def _press(
        self, view: View, located: Located, reference: Floats, turns_per_m: Floats, torques_nm: Floats
    ) -> Action:
        """Torques of the wanted forces, and a soft shape, less all that it would do along the path."""
        joints, bends, config = view.joints, self._bends, self._set
        off_rad = reference - np.array(joints.angle_rad)
        slower_rad_s = turns_per_m * located.speed_m_s - np.array(joints.velocity_rad_s)
        holding_nm = config.shape_nm_per_rad * off_rad + config.shape_nm_s_per_rad * slower_rad_s
        along = turns_per_m[bends]
        holding_nm = holding_nm - turns_per_m * float(along @ holding_nm[bends]) / (along @ along + STRAIGHT_PER_M2)
        setpoints = self._bumpless.to(view, reference)
        self._bumpless.let_go()
        self._integral_m, self._waits = min(self._integral_m, config.fresh_look_ahead_m), False
        for i in bends:
            limit_nm = setpoints.torque_limit_nm[i]
            setpoints.mode[i] = Mode.TORQUE
            setpoints.target[i] = min(max(float(holding_nm[i] + torques_nm[i]), -limit_nm), limit_nm)
        return Action(setpoints, self._report(view, located, 0.0, reference))

    def _undulate(self, view: View, wave: LateralUndulation, lifted: Floats) -> Action:
        """In search of something to push off."""
        self._torques_nm[:] = self._push_n = self._force_n = 0.0
        reference = wave.reference_rad(view, view.period_s) + lifted
        setpoints = self._bumpless.to(view, reference, restarted=self._search.changed)
        why = "it does not come on: it moves by a wave, in search of contacts"
        return Action(setpoints, Report(why=why, reference_rad=reference.tolist()))

    def _sign(self, time_s: float) -> float:
        """The same for every run, so that runs can be repeated."""
        if self._set.push_sign_s == 0.0:
            return 1.0
        return float(SIGNS[int(time_s / self._set.push_sign_s) % len(SIGNS)])

    def _report(self, view: View, located: Located, look_ahead_n: float, reference: Floats) -> Report:
        if abs(located.speed_m_s) > STANDS_M_S:
            self._moved_at_s = view.time_s
        stands, found, force_n = view.time_s - self._moved_at_s > STANDS_S, self._last_push, self._force_n
        points, jammed, standing = [], False, "standing still: backing out along its own path"
        if found is not None:
            points = push_points(self._body, found.world, found.touches, found.push, force_n)
            names = [point.obstacle for point in points if point.obstacle is not None]
            carried = self._felt.along((located.nodes_w[:, -1] - located.nodes_w[:, 0]).tolist())
            jammed, standing = why_it_stands(found.touches, found.push, force_n, self._max_force_n, carried, names)
        why = standing if stands and found is not None else ""
        return Report(
            why=why,
            why_if_still=standing if view.time_s > STANDS_S else "",
            path_s_m=located.tail_s_m,
            propulsion_n=look_ahead_n + force_n,
            push_points=points,
            desired_force_n=[float(np.hypot(*contact.force_w[:2])) for contact in points],
            bending_torque_nm=self._torques_nm.tolist(),
            reference_rad=reference.tolist(),
            torque_headroom_nm=self._set.max_torque_nm - float(np.abs(self._torques_nm).max()),
            saturated=0.0 < self._max_force_n <= force_n,
            jammed=bool(why) and jammed,
        )

    def _look_ahead_m(self, located: Located, period_s: float) -> float:
        max_m = self._set.max_look_ahead_m
        wanted_m_s = located.trajectory.speed_m_s
        error_m_s = wanted_m_s - located.speed_m_s
        self._integral_m += self._set.integral_per_s * error_m_s * period_s
        self._integral_m = min(max(self._integral_m, -max_m), max_m)
        return min(max(self._integral_m + self._set.speed_kp_s * error_m_s, -max_m), max_m)

    def _push_nm(self, view: View, located: Located, turns_per_m: Floats) -> Floats:
        """Torques of the wanted force along the path, by the contacts that the body has, (n_joints,)."""
        config, wanted_m_s, period_s = self._set, located.trajectory.speed_m_s, view.period_s
        if wanted_m_s <= 0.0 or config.max_push_n == 0.0:
            self._push_n = self._force_n = 0.0
            self._last_push = None
            return np.zeros(len(self._robot.joints))
        error = wanted_m_s - located.speed_m_s
        sooner = SETS_OFF if abs(located.speed_m_s) < CREEPS_M_S else 1.0
        self._push_n += sooner * config.lag_kp_n_per_m * error * period_s
        self._push_n = min(max(self._push_n, 0.0), config.max_push_n)
        force_n = min(max(self._push_n + config.speed_kp_n_s_per_m * error, 0.0), config.max_push_n)
        self._look(view.time_s, located, turns_per_m)
        self._push_n = min(self._push_n, self._max_force_n)  # who cannot push stores no force up for later
        self._force_n = force_n = min(force_n, self._max_force_n)
        keep = np.exp(-period_s / config.torque_filter_s)
        self._torques_nm = keep * self._torques_nm + (1 - keep) * force_n * self._unit_nm
        bound = config.max_torque_nm
        return np.clip(self._torques_nm, -bound, bound)

    def _look(self, time_s: float, located: Located, turns_per_m: Floats) -> None:
        """What the body could push off by the newest world model, and how hard."""
        if not located.fresh:
            return
        config = self._set
        outlines, friction = Outlines.of(located.world.obstacles), located.trajectory.peg_friction
        at, then_s_m = located.on_path.pose_at, located.tail_s_m + ACTS_AFTER_S * located.speed_m_s
        nodes_w = located.nodes_w + at(then_s_m).nodes_w - at(located.measured_s_m).nodes_w
        touches = find_touches(nodes_w, self._body.radius_m, outlines, reach_m=config.reach_m, friction=friction)
        names = [located.world.obstacles[k].name for k in touches.obstacle.tolist()]
        felt = self._felt.forces_w(names)
        measured_w = np.array(felt).reshape(-1, 2)  # none without a sensor
        dearer = config.no_contact_cost * np.exp(-np.hypot(*measured_w.T) / FELT_N) if felt else 0.0
        turns_per_m = turns_per_m[self._bends]
        push = push_forward(
            nodes_w, touches, turns_per_m, contact_gap_scale_m=config.contact_gap_scale_m, dearer=dearer
        )
        push = self._filter.take(time_s, push, names)
        self._last_push = PushSnapshot(located.world, touches, push)
        self._unit_nm, self._max_force_n = np.zeros(len(self._robot.joints)), 0.0
        largest = float(push.lambdas.max(initial=0.0))
        if push.rest < LARGEST_REST and largest > 0.0:  # a body bent into a U has hardly any drag, and needs no push
            self._unit_nm[self._bends] = push.torques_nm
            max_nm = float(np.abs(push.torques_nm).max(initial=0.0)) + 1e-9
            self._max_force_n = min(config.max_torque_nm / max_nm, config.max_contact_n / largest)

    def _rest(self, view: View) -> Action:
        """At speed 0 every joint stays where it is, and nothing pushes."""
        self._integral_m = self._push_n = self._force_n = 0.0
        self._torques_nm[:] = 0.0
        self._moved_at_s = view.time_s
        self._search.stop()
        if self._waits or self._bumpless.reference_rad is None:
            action = self._bumpless.hold(view, "")
        else:
            reference = np.array(view.joints.angle_rad)
            setpoints = self._bumpless.to(view, reference, restarted=True)
            action = Action(setpoints, Report(reference_rad=reference.tolist()))
        self._waits = True
        return action
