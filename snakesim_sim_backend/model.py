"""Robot file + scene -> compiled MuJoCo model.

The snake is a chain of capsules, tail to head. The free joint sits on link 0, whose body frame is the base: origin at
the tail end, x forward. Every other body's frame is the link frame of `model.kinematics`: origin at the rear joint.
Bodies, hinges and motors are therefore in the order of the robot description.
"""

import math
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.links import Link
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig, place_all
from snakesim_hal.model.scene import Placed
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import Axis
from snakesim_sim_backend.actuators import add_motor
from snakesim_sim_backend.chain import FREE_DOFS
from snakesim_sim_backend.contact_friction import numbers_kept
from snakesim_sim_backend.flat_ground import KEPT, Soles, soles_of
from snakesim_sim_backend.ground import add_ground
from snakesim_sim_backend.imu import add_imus
from snakesim_sim_backend.obstacles import OBSTACLE, add_obstacle, geom_name
from snakesim_sim_backend.settings import SimSettings
from snakesim_sim_backend.surface import Skin, skin
from snakesim_sim_backend.tether import add_tether
from snakesim_sim_backend.yielding import FREEDOMS, check_yielding

FREE_QPOS = 7  # of the base: position and quaternion
CLAMP_KG = 1e6  # as rotor inertia and as damping, of all six degrees of freedom
FOOT_GROUP = 3  # MuJoCo geom group of the feet, which are inside of the links' capsules
ORANGE = [0.87, 0.45, 0.12, 1.0]  # color of the robot
AXES: dict[Axis, list[float]] = {"yaw": [0.0, 0.0, 1.0], "pitch": [0.0, 1.0, 0.0]}


@dataclass(frozen=True)
class SimModel:
    """A compiled model, and the indices of the robot and the obstacles in MuJoCo's arrays."""

    model: mujoco.MjModel
    steps_per_tick: int
    first_link_body: int  # bodies of the links are consecutive
    obstacle_of_geom: list[str | None]  # (ngeom,); None: link, ground or step
    soles: Soles | None  # None: MuJoCo finds the contacts with the ground, which is not flat
    link_geoms: list[int]
    friction: Floats  # (ngeom,) of what a link touches
    suspended: bool  # its tail link is clamped
    yielding: list[Placed]  # obstacles that move when they are pushed; their bodies come after the robot's


def of_joints(data: mujoco.MjData, count: int) -> tuple[Floats, Floats]:
    """Angles and velocities of a robot's joints, (count,) each, tail to head; views."""
    return data.qpos[FREE_QPOS : FREE_QPOS + count], data.qvel[FREE_DOFS : FREE_DOFS + count]


def build(config: RunConfig, settings: SimSettings, *, motors: bool = True) -> SimModel:
    """Compile the model of a run. Raises ConfigError when settings and robot do not match.

    Without motors the joints are only hinges with a rotor's inertia and friction, for external torques.
    """
    steps = int(np.ceil(config.period_ns * 1e-9 / settings.timestep_s - 1e-9))
    step_s = config.period_ns * 1e-9 / steps
    if settings.contact_time_s < 2 * step_s:
        raise ConfigError(
            f"`contact_time_s` = {settings.contact_time_s} s must be at least two physics steps, here "
            f"{2 * step_s:g} s; raise it or lower `timestep_s`"
        )
    spec = mujoco.MjSpec()
    _set_options(spec, step_s)
    placed = place_all(config)
    yielding = [item for item in placed if item.yields]
    check_yielding(yielding, config.scene.name, step_s)
    ground, links, hard = config.scene.ground, config.robot.chain.modules + 1, skin(settings)
    add = partial(
        add_obstacle,
        spec,
        skin=hard,
        body_radius_m=config.robot.module.radius_m,
        hills_m=ground.heightfield.height_m if ground.heightfield else 0.0,
        strike=bool(yielding),
    )
    rough = dict.fromkeys(add_ground(spec, ground, hard), ground.friction)
    rough |= {geom_name(item): item.friction for item in placed}
    for item in placed:
        if not item.yields:
            add(item)
    _add_snake(spec, config.robot, settings, hard)
    for item in yielding:
        add(item)
    spec.nuserdata = KEPT * (links + 1) + numbers_kept(links) + FREEDOMS * len(yielding)
    if motors:
        check_gains(config.robot)
        for joint in config.robot.joint_table:
            add_motor(spec, joint, config.robot.module, step_s)
    if config.robot.sensors.imu is not None:
        add_imus(spec, config.robot.link_lengths_m)
    if settings.tether is not None:
        add_tether(spec, settings.tether, config.robot, settings.contact_time_s)
    try:
        model = spec.compile()
    except ValueError as error:
        raise ConfigError(f"MuJoCo cannot build robot {config.robot.name!r} in this scene: {error}") from error
    first_link_body, soles = model.body("link_0").id, None
    if ground.heightfield is None:
        soles = soles_of(model, first_link_body, links, config.robot.module.radius_m, ground.friction)
    names = [model.geom(i).name for i in range(model.ngeom)]
    rough |= dict.fromkeys((f"link_{i}" for i in range(links)), settings.self_friction)
    obstacles = [name.removeprefix(OBSTACLE) if name.startswith(OBSTACLE) else None for name in names]
    return SimModel(
        model=model,
        steps_per_tick=steps,
        first_link_body=first_link_body,
        obstacle_of_geom=obstacles,
        soles=soles,
        link_geoms=[model.geom(f"link_{i}").id for i in range(links)],
        friction=np.array([rough.get(name, 0.0) for name in names]),
        suspended=settings.suspended,
        yielding=yielding,
    )


def _set_options(spec: mujoco.MjSpec, step_s: float) -> None:
    spec.compiler.degree = False
    option = spec.option
    option.timestep = step_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # damping of the joints is taken implicitly
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # faster for a snake than the sparse one
    # A diverged run is reported, not silently restarted. One snake is one constraint island.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_ISLAND


def _add_snake(spec: mujoco.MjSpec, robot: RobotFile, settings: SimSettings, hard: Skin) -> None:
    """Capsules. Flat ground carries them at their feet: spheres at joints and ends, where capsules would have two."""
    lengths, masses, joints = robot.link_lengths_m, robot.link_masses_kg, robot.joint_table
    body = spec.worldbody
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        rear = [0.0, 0.0, robot.module.radius_m] if i == 0 else [lengths[i - 1], 0.0, 0.0]
        body = body.add_body(name=f"link_{i}", pos=rear)
        if i == 0:
            # A clamp is more inertia and damping than the robot can move.
            clamp = {"armature": CLAMP_KG, "damping": CLAMP_KG} if settings.suspended else {}
            body.add_joint(name="base", type=mujoco.mjtJoint.mjJNT_FREE, **clamp)
        else:
            _add_joint(body, joints[i - 1])
        if robot.links and robot.links[i].has_inertia:
            _set_inertia(body, robot.links[i], robot.module.radius_m, settings.mass_scale)
        body.add_geom(
            name=f"link_{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[robot.module.radius_m, 0.0, 0.0],
            fromto=[0.0, 0.0, 0.0, length, 0.0, 0.0],
            mass=mass * settings.mass_scale,
            rgba=ORANGE,
            **hard,
        )
        _add_foot(body, f"foot_{i}", 0.0, robot)
    _add_foot(body, f"foot_{len(lengths)}", lengths[-1], robot)
    for i in range(len(lengths)):
        for j in range(i + 2, len(lengths)):
            apart_m = math.fsum(lengths[i + 1 : j])
            if apart_m < 2.05 * robot.module.radius_m:  # they would touch when the snake is straight
                spec.add_exclude(bodyname1=f"link_{i}", bodyname2=f"link_{j}")


def _set_inertia(body: mujoco.MjsBody, link: Link, radius_m: float, scale: float) -> None:
    """The robot file's, in place of the capsule's."""
    body.explicitinertial = True
    body.mass = scale * link.mass_kg
    body.ipos = list(link.center)
    body.fullinertia = [scale * value for value in link.inertia(radius_m)]


def _add_foot(body: mujoco.MjsBody, name: str, along_m: float, robot: RobotFile) -> None:
    """A massless sphere of the body's radius, at a joint or an end."""
    ball = mujoco.mjtGeom.mjGEOM_SPHERE
    size = [robot.module.radius_m, 0.0, 0.0]
    body.add_geom(
        name=name, type=ball, size=size, pos=[along_m, 0.0, 0.0], mass=0.0, contype=0, conaffinity=0, group=FOOT_GROUP
    )


def _add_joint(body: mujoco.MjsBody, joint: Joint) -> None:
    motor = joint.motor
    body.add_joint(
        name=joint.name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=AXES[joint.axis],
        limited=True,
        range=[joint.limits.lower_rad, joint.limits.upper_rad],
        armature=motor.armature_kg_m2,
        damping=motor.viscous_nm_s_per_rad,
        frictionloss=motor.friction_nm,
    )
