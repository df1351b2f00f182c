"""The obstacle-triplet controller: one joint pushes with a torque, all others keep the body on its path.

For each new world model it finds the push-points of the body, solves every triplet on alternating sides
among them, and chooses one; its propulsion joint is the first joint ahead of o_2. As the body moves forward, o_2 passes
joint after joint towards the tail, and with it the propulsion joint, until the triplet's last obstacle is lost.

The propulsion force is `propulsion_n (1 - speed / mission speed)`, never below zero. A force below the drag moves
nothing: positions follow the path at the measured arc length, without a look-ahead that would push by itself. They
follow it no faster than the mission's speed, which brakes a body that is too fast.

Between push-points the propulsion joint swings freely until its contacts carry load. It is damped, the force is reduced
as it swings out, and a joint that has left its reference too far returns to position mode. A body that stands still
while it pushes is reported with the cause; where that strains joint or contacts, the triplet is released for a while
and others are tried.

Nothing jumps at a hand-over. In the tick of a change of mode, a position target is within `fade` times the joint's
angle from its reference, and a torque target within `fade` times (measured torque - propulsion torque), of the target
with which the motor keeps its torque; `fade = period / blend_s + |speed| period / blend_m`, 0.07 with the defaults at
100 Hz and 0.2 m/s. The limiter of the HAL limits it once more: `speed_limit * period` and `torque_rate_limit * period`.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_gnc.control.bumpless import HandOver
from snakesim_gnc.control.climb import Climb
from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_gnc.control.obstacle_triplet.contacts import PlannedContact, PushPoint, plan_contact, push_points
from snakesim_gnc.control.obstacle_triplet.selection import Choice, Names, Triplets, choose
from snakesim_gnc.control.obstacle_triplet.settings import TripletSettings
from snakesim_gnc.control.obstacle_triplet.stall import Stall, StallWatch, explain
from snakesim_gnc.control.obstacle_triplet.telemetry import bending_nm, planned_contacts
from snakesim_gnc.control.progress import Located, Progress
from snakesim_gnc.geometry.body_on_path import BodyPose
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.backend import Setpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Description, Mode, Obstacle

PLAN_WINDOW_M = 1.0  # beyond the body's ends: where the path may pass an obstacle that is near the body


@dataclass(frozen=True)
class Push:
    """Demand of the propulsion joint, and its reasons."""

    turn: int  # index of the joint
    wanted_n: float  # propulsion force from the speed alone
    force_n: float  # after fading, and within the joint's torque
    torque_nm: float
    saturated: bool  # the torque limit has reduced the force
    swung: bool  # the joint is so far from its reference that the force is reduced


class ObstacleTriplet:
    """Obstacle-aided locomotion after the paper's section IV."""

    MODES = (Mode.POSITION, Mode.TORQUE)
    MEASURES = ("torque",)
    Settings = TripletSettings

    def __init__(self, robot: Description, settings: TripletSettings) -> None:
        self._robot = robot
        self._set = settings
        self._body, self._climb = PlanarBody(robot), Climb(robot)
        self._progress = Progress(self._body, speed_filter_s=settings.speed_filter_s)
        self._hand_over = HandOver(robot)
        self._triplets = Triplets(
            condition_max=settings.condition_max,
            authority_min=settings.authority_min,
            hold_on_m=settings.hold_on_m,
        )
        self._felt = MeasuredContacts()
        self._stall_watch = StallWatch(
            stall_m=settings.stall_m, stall_s=settings.stall_s, propulsion_n=settings.propulsion_n
        )
        self._body_pose: BodyPose | None = None  # of the body that the joints in position mode follow
        self._reference = np.empty(0)  # the same as angles of all joints
        self._planned: dict[str, tuple[Obstacle, PlannedContact]] = {}
        self._points: list[PushPoint] = []
        self._asked_n = self._force_n = 0.0  # propulsion force of the tick before, wanted and as limited
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._held_nm = np.zeros(len(robot.joints))  # of the planned forces, by the joints in position mode
        self._choice: Choice | None = None
        self._refused: list[str] = []
        self._banned: dict[Names, float] = {}  # -> arc length at which it stood still
        self._barred: tuple[int, float] | None = None  # joint among those that bend, time until which
        self._position_until_s = 0.0
        self._stall: tuple[Stall, float] | None = None  # and the arc length at which it began

    def update(self, view: View) -> Action:
        """Setpoints for the next period."""
        located = self._progress.update(view)
        if isinstance(located, str):
            return self._wait(view, located)
        self._felt.add_world(located.world)
        body_pose, before = self._follow(view, located), self._choice
        if located.trajectory.speed_m_s <= 0:
            self._choice = None
            self._stall_watch.forget()
        if located.fresh or located.restarted:
            self._look(located, body_pose)
            self._choose(view, located, body_pose)
        self._guard(view, body_pose)
        choice, set_ = self._choice, self._set
        turn = None if choice is None else self._body.bends[choice.joint]
        anew = choice is not None and before is not None and choice.triplet.names != before.triplet.names
        reference = self._reference + self._held_rad(view, body_pose)
        self._hand_over.pass_to(turn, view.joints, reference, anew=anew)
        self._hand_over.fade(view.period_s / set_.blend_s + abs(located.speed_m_s) * view.period_s / set_.blend_m)
        targets: list[float] = self._hand_over.positions_rad(reference).tolist()
        mode = [Mode.POSITION] * len(targets)
        limits_nm = self._body.torque_limit_nm
        if choice is None or turn is None:
            self._asked_n = self._force_n = 0.0
            return Action(Setpoints(mode, targets, limits_nm), self._report_rest(located))
        push = self._push(view, located, choice, turn)
        self._force_n = push.force_n
        mode[turn], targets[turn] = Mode.TORQUE, push.torque_nm
        self._watch_progress(view, located, choice, push)
        return Action(Setpoints(mode, targets, limits_nm), self._report_push(located, body_pose, choice, push))

    def _follow(self, view: View, located: Located) -> BodyPose:
        """Reference of the joints in position mode; starts, and continues from another place, without a jump."""
        set_, s, before = self._set, located.tail_s_m, self._body_pose
        if before is None or located.restarted:
            body_pose = located.on_path.at(s)
        else:
            max_advance_m = max(located.trajectory.speed_m_s, 0.0) * set_.overspeed_ratio * view.period_s
            followed = min(max(before.tail_s_m, s - set_.slack_m), s + set_.slack_m, before.tail_s_m + max_advance_m)
            body_pose = located.on_path.at(max(followed, s - set_.brake_m))
        lifted = self._climb.angles_rad(located.trajectory.rises, body_pose.tail_s_m)
        reference = self._body.all_angles(body_pose) + lifted
        if not len(self._reference):
            self._hand_over.start(view.joints, reference)
        elif located.restarted:
            self._hand_over.shift(reference - self._reference)
        self._body_pose, self._reference = body_pose, reference
        return body_pose

    def _held_rad(self, view: View, body_pose: BodyPose) -> Floats:
        """How far targets are beyond the path's angles, so that its joints hold the planned forces on the path."""
        share, choice = self._set.load_ratio, self._choice
        if share == 0.0:
            return np.zeros(len(self._held_nm))
        wanted = np.zeros(len(self._held_nm))
        if choice is not None and self._force_n > 0.0:
            wanted = share * bending_nm(self._body, body_pose, choice, self._force_n)
        keep = np.exp(-view.period_s / self._set.load_filter_s)
        self._held_nm = keep * self._held_nm + (1.0 - keep) * wanted
        return self._held_nm / self._stiffness

    def _push(self, view: View, located: Located, choice: Choice, turn: int) -> Push:
        """The propulsion: reduced with the speed of the body, and with the swing of the joint."""
        set_, limit_nm = self._set, self._body.torque_limit_nm[turn]
        slow = 1.0 - located.speed_m_s / located.trajectory.speed_m_s
        off_rad = view.joints.angle_rad[turn] - float(self._reference[turn])
        swung_rad = off_rad if choice.torque_per_n > 0 else -off_rad
        near = 2.0 - swung_rad / set_.angle_fade_rad
        wanted_n = set_.propulsion_n * min(max(slow, 0.0), 1.0)
        asked_n = wanted_n * min(max(near, 0.0), 1.0)
        step_n = set_.propulsion_rate_n_s * view.period_s
        asked_n = self._asked_n = min(max(asked_n, self._asked_n - step_n), self._asked_n + step_n)
        force_n = min(asked_n, limit_nm / max(abs(choice.torque_per_n), 1e-12))
        torque_nm = force_n * choice.torque_per_n - set_.damping_nm_s_per_rad * view.joints.velocity_rad_s[turn]
        torque_nm = min(max(self._hand_over.torque_nm(torque_nm), -limit_nm), limit_nm)
        return Push(turn, wanted_n, force_n, torque_nm, saturated=force_n < asked_n, swung=near < 1.0)

    # --- push-points -----------------------------------------------------------------------------------------

    def _look(self, located: Located, body_pose: BodyPose) -> None:
        """Plan the contacts with the obstacles near the body, and find those that the body is at."""
        world = located.world
        if located.restarted:
            self._planned.clear()
        near = {obstacle.name: obstacle for obstacle in world.obstacles}
        for name in [name for name in self._planned if name not in near]:
            del self._planned[name]
        for name, obstacle in near.items():
            known = self._planned.get(name)
            if known is None or known[0] != obstacle:
                self._planned[name] = (obstacle, self._plan(located, obstacle))
        kept = [contact.obstacle for contact in world.contacts if contact.obstacle is not None]
        if self._choice is not None:
            kept += self._choice.triplet.names
        self._points = push_points(
            [contact for _, contact in self._planned.values()],
            kept,
            body_pose,
            located.nodes_w,
            self._body.node_s_m,
            gap_m=self._set.gap_m,
            give_up_gap_m=self._set.give_up_gap_m,
            end_m=self._set.end_m,
        )

    def _plan(self, located: Located, obstacle: Obstacle) -> PlannedContact:
        half_m = self._body.length_m / 2
        near_s_m, window_m = located.tail_s_m + half_m, half_m + PLAN_WINDOW_M
        return plan_contact(located.on_path.route, obstacle, self._body.radius_m, near_s_m=near_s_m, window_m=window_m)

    def _choose(self, view: View, located: Located, body_pose: BodyPose) -> None:
        """Choose a triplet, or none."""
        s, blend_m, share = located.tail_s_m, self._set.blend_m, self._set.switch_fraction
        self._banned = {names: at for names, at in self._banned.items() if abs(s - at) < blend_m}
        if self._stall is not None and abs(s - self._stall[1]) > blend_m:
            self._stall = None
        if self._barred is not None and view.time_s >= self._barred[1]:
            self._barred = None
        barred = None if self._barred is None else self._barred[0]
        choices, self._refused = self._triplets.choices(
            self._points, body_pose.nodes_w, self._body.node_s_m, self._choice, barred
        )
        if located.trajectory.speed_m_s <= 0 or view.time_s < self._position_until_s:
            self._choice = None
            return
        present = None if self._choice is None else self._choice.triplet
        self._choice = choose(choices, present, switch_fraction=share, banned=self._banned) or choose(
            choices, present, switch_fraction=share
        )

    # --- supervision -----------------------------------------------------------------------------------------

    def _guard(self, view: View, body_pose: BodyPose) -> None:
        """End the turn of a propulsion joint that has left its reference too far."""
        if self._choice is None:
            return
        joint, guard_s = self._choice.joint, self._set.guard_s
        turn = self._body.bends[joint]
        off_rad = view.joints.angle_rad[turn] - float(body_pose.angles_rad[joint])
        if abs(off_rad) > self._set.angle_guard_rad:
            self._barred = (joint, view.time_s + guard_s)
            name = self._body.names[turn]
            self._refused = [f"{name} left its reference by {off_rad:+.2f} rad; in position mode for {guard_s} s"]
            self._choice = None

    def _watch_progress(self, view: View, located: Located, choice: Choice, push: Push) -> None:
        """Detect standing still; let go of a triplet that strains and does not move."""
        if not self._stall_watch.stands(view.time_s, located.tail_s_m, push.wanted_n):
            return
        self._stall_watch.forget()
        name = self._body.names[push.turn]
        stall = explain(
            wanted_n=push.wanted_n,
            force_n=push.force_n,
            carried=self._felt.resolve_along(choice.triplet.contacts[0].tangent_w),
            push_points=choice.triplet.names,
            weight_n=self._body.weight_n,
            saturated=name if push.saturated else None,
            swung=name if push.swung else None,
            jam_force_n=self._set.jam_force_n,
            drag_ratio=self._set.drag_ratio,
        )
        self._stall = (stall, located.tail_s_m)
        if stall.lets_go:
            self._banned[choice.triplet.names] = located.tail_s_m
            self._position_until_s = view.time_s + self._set.release_s

    # --- reports ---------------------------------------------------------------------------------------------

    def _wait(self, view: View, why: str) -> Action:
        """Without a known body pose nothing pushes: every joint goes to its reference, and stays there."""
        self._choice, self._asked_n, self._force_n = None, 0.0, 0.0
        self._stall_watch.forget()
        if not len(self._reference):
            self._reference = np.array(view.joints.angle_rad)
            self._hand_over.start(view.joints, self._reference)
        self._hand_over.shift(-self._held_nm / self._stiffness)  # the load fades with all else
        self._held_nm = np.zeros(len(self._held_nm))
        self._hand_over.pass_to(None, view.joints, self._reference)
        self._hand_over.fade(view.period_s / self._set.blend_s)  # what the joint pushed with, too
        targets = self._hand_over.positions_rad(self._reference).tolist()
        return Action(positions(self._robot, targets), Report(why=why, reference_rad=self._reference.tolist()))

    def _report_rest(self, located: Located) -> Report:
        """Why nothing pushes."""
        speed_m_s = located.trajectory.speed_m_s
        if self._stall is not None:
            why = self._stall[0].why
        elif speed_m_s > 0:
            why = "; ".join(self._refused) or "no three push-points on alternating sides"
        else:
            why = "" if speed_m_s == 0 else "cannot go backward"
        return Report(
            why=why[:400],
            usable_push_points=len(self._points),
            path_s_m=located.tail_s_m,
            reference_rad=self._reference.tolist(),
            jammed=self._stall is not None and self._stall[0].jammed,
        )

    def _report_push(self, located: Located, body_pose: BodyPose, choice: Choice, push: Push) -> Report:
        """What pushes, and how hard."""
        forces_n: list[float] = (push.force_n * choice.triplet.unit.forces).tolist()
        full_nm = abs(self._set.propulsion_n * choice.torque_per_n)
        return Report(
            why="" if self._stall is None else self._stall[0].why,
            usable_push_points=len(self._points),
            path_s_m=located.tail_s_m,
            propulsion_joint=push.turn,
            propulsion_n=push.force_n,
            push_points=planned_contacts(self._body, located.world, choice, forces_n),
            desired_force_n=forces_n,
            propulsion_torque_nm=push.torque_nm,
            bending_torque_nm=bending_nm(self._body, body_pose, choice, push.force_n).tolist(),
            reference_rad=self._reference.tolist(),
            condition=choice.triplet.unit.condition,
            torque_headroom_nm=self._body.torque_limit_nm[push.turn] - full_nm,
            saturated=push.saturated,
            jammed=self._stall is not None and self._stall[0].jammed,
        )
