"""Simulates `planar13` on wheels that are bodies, in plain MuJoCo with its own friction, without SnakeSIM's laws."""

import mujoco
import numpy as np

from snakesim_testing.sim.simulator_rig import G, make_config
from snakesim_testing.sim.waves import (
    PERIODS,
    SERVO_NM_PER_RAD,
    SERVO_NM_S_PER_RAD,
    BodyTrack,
    JointWave,
)

TIRE_FRICTION = 0.6
WHEEL_RADIUS_M = 0.03
BEARING_RADIUS_M = 0.003
BEARING_FRICTION = 0.1
ROLLING_FRICTION = BEARING_FRICTION * BEARING_RADIUS_M / WHEEL_RADIUS_M
TRACK_M = 0.03  # distance of a wheel from the axis of its link
WHEEL_MASS_KG = 1e-3
STEP_S = 0.001
WHEELS = {
    "radius_m": WHEEL_RADIUS_M,
    "bearing_radius_m": BEARING_RADIUS_M,
    "bearing_friction": BEARING_FRICTION,
    "tire_friction": TIRE_FRICTION,
}


class WheeledSnake:
    """A snake with a pair of wheels in the middle of each link. A wheel is a sphere that rotates about its axle only.

    The bearings brake with a constant torque, which is computed from the weight at rest.
    """

    def __init__(self) -> None:
        robot = make_config().robot
        self.lengths_m = robot.link_lengths_m
        self.masses_kg = robot.link_masses_kg
        self.mass_kg = sum(self.masses_kg)
        spec = mujoco.MjSpec()
        spec.option.timestep = STEP_S
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 20.0
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=[TIRE_FRICTION, 0, 0]
        )
        body = spec.worldbody
        armature = robot.motor.armature_kg_m2
        for i, (length_m, mass_kg) in enumerate(zip(self.lengths_m, self.masses_kg, strict=True)):
            if i == 0:
                body = body.add_body(name="link_0", pos=[0, 0, WHEEL_RADIUS_M])
                body.add_freejoint()
            else:
                body = body.add_body(name=f"link_{i}", pos=[self.lengths_m[i - 1], 0, 0])
                body.add_joint(
                    name=f"joint_{i}", axis=[0, 0, 1], armature=armature, damping=SERVO_NM_S_PER_RAD
                )
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=[robot.module.radius_m, 0, 0],
                fromto=[0, 0, 0, length_m, 0, 0],
                mass=mass_kg - 2 * WHEEL_MASS_KG,
                contype=0,
                conaffinity=0,
            )
            self._add_wheels(body, i, length_m, mass_kg)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        hinges = [self.model.joint(f"joint_{i}") for i in range(1, len(self.lengths_m))]
        self._angles = [int(hinge.qposadr[0]) for hinge in hinges]
        self._velocities = [int(hinge.dofadr[0]) for hinge in hinges]

    def _add_wheels(
        self, body: mujoco.MjsBody, link_index: int, length_m: float, mass_kg: float
    ) -> None:
        """Add a pair of wheels to the body of a link."""
        bearing_nm = BEARING_FRICTION * BEARING_RADIUS_M * G * mass_kg / 2
        for side, name in ((1, "left"), (-1, "right")):
            wheel = body.add_body(
                name=f"{name}_{link_index}", pos=[length_m / 2, side * TRACK_M, 0]
            )
            wheel.add_joint(name=f"{name}_{link_index}", axis=[0, 1, 0], frictionloss=bearing_nm)
            wheel.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[WHEEL_RADIUS_M, 0, 0],
                mass=WHEEL_MASS_KG,
                condim=3,
                friction=[TIRE_FRICTION, 0, 0],
                solref=[2 * STEP_S, 1.0],
                contype=1,
                conaffinity=0,
            )

    def swim(self, wave: JointWave) -> BodyTrack:
        """Simulate a snake whose joints follow a wave, and return the track of its body."""
        data = self.data
        mujoco.mj_resetData(self.model, data)
        count = len(self._angles)
        data.qpos[self._angles] = wave.at(0.0, count)
        steps = int(PERIODS * wave.period_s / STEP_S) + 1
        center_w_m = np.empty((steps, 2))
        axis_w_m = np.empty((steps, 2))
        tail = self.model.body("link_0").id
        head = self.model.body(f"link_{count}").id
        for k in range(steps):
            end_s = (k + 1) * STEP_S
            stiffness_nm = SERVO_NM_PER_RAD * (wave.at(end_s, count) - data.qpos[self._angles])
            # The joints of the model damp their whole velocity, so the rate of the wave is added.
            damping_nm = SERVO_NM_S_PER_RAD * wave.rates_at(end_s, count)
            data.qfrc_applied[self._velocities] = stiffness_nm + damping_nm
            mujoco.mj_step(self.model, data)
            head_w = data.xpos[head] + self.lengths_m[-1] * data.xmat[head].reshape(3, 3)[:, 0]
            center_w_m[k] = data.subtree_com[tail, :2]
            axis_w_m[k] = (head_w - data.xpos[tail])[:2]
        return BodyTrack(center_w_m, axis_w_m, STEP_S, wave.period_s)

    def coast(self, speed_m_s: float, time_s: float) -> float:
        """Return the mean deceleration of the straight snake that rolls forward, in m/s²."""
        data = self._straighten()
        data.qvel[0] = speed_m_s
        for wheel in self._find_wheel_dofs():
            data.qvel[wheel] = speed_m_s / WHEEL_RADIUS_M
        self._simulate(0.1)
        before = float(data.qvel[0])
        self._simulate(time_s)
        return (before - float(data.qvel[0])) / time_s

    def push_sideways(self, force_per_weight: float, time_s: float) -> float:
        """Return the mean speed of the straight snake under a force to its left, in mm/s."""
        data = self._straighten()
        self._simulate(0.2)
        for i, mass_kg in enumerate(self.masses_kg):
            data.xfrc_applied[self.model.body(f"link_{i}").id, 1] = force_per_weight * G * mass_kg
        self._simulate(0.3)
        before = float(data.qpos[1])
        self._simulate(time_s)
        return (float(data.qpos[1]) - before) / time_s * 1e3

    def _straighten(self) -> mujoco.MjData:
        """Reset the snake to a straight body at rest, and return its data."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.xfrc_applied[:] = 0.0
        return self.data

    def _simulate(self, time_s: float) -> None:
        """Simulate with stiff joints."""
        for _ in range(round(time_s / STEP_S)):
            self.data.qfrc_applied[self._velocities] = (
                -SERVO_NM_PER_RAD * self.data.qpos[self._angles]
            )
            mujoco.mj_step(self.model, self.data)

    def _find_wheel_dofs(self) -> list[int]:
        """Return the indices of the velocities of all wheels."""
        links = range(len(self.lengths_m))
        return [
            int(self.model.joint(f"{name}_{i}").dofadr[0])
            for i in links
            for name in ("left", "right")
        ]
