"""Builds the compiled MuJoCo model of a robot in its scene.

The snake is a chain of capsules, tail to head. The free joint belongs to link 0, whose body frame is the base frame:
its origin is at the tail end, and x points forward. Every other body's frame is the link frame of
`model.kinematics`, with the origin at the link's rear joint. Bodies, hinges and motors are therefore in the order of
the robot description.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.links import Link
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig, place_obstacles
from snakesim_hal.model.scene_file.placement import PlacedObstacle
from snakesim_hal.model.scene_file.scene import compute_gravity_w, compute_normal_gravity_m_s2
from snakesim_hal.physics.motor import validate_position_gains
from snakesim_hal.wire.messages import Axis
from snakesim_hal.wire.quantities import Vector
from snakesim_sim_backend.actuators import add_motor
from snakesim_sim_backend.laws.chain import FREE_DOFS
from snakesim_sim_backend.laws.flat_ground import FOOT, GroundFeet, find_feet
from snakesim_sim_backend.laws.version import LawsVersion, add_laws, choose_laws
from snakesim_sim_backend.laws.yielding import validate_yielding_obstacles
from snakesim_sim_backend.model.fluid import add_fluid
from snakesim_sim_backend.model.friction import set_friction
from snakesim_sim_backend.model.ground import add_ground
from snakesim_sim_backend.model.imu import add_imus
from snakesim_sim_backend.model.obstacles import OBSTACLE, add_obstacle, make_geom_name
from snakesim_sim_backend.model.pipes import add_pipes
from snakesim_sim_backend.model.surface import ContactParameters, make_contact_parameters
from snakesim_sim_backend.model.tether import add_tether
from snakesim_sim_backend.settings import SimSettings

FREE_QPOS = 7  # coordinates of the base: position and quaternion
CLAMP_INERTIA = 1e6  # kg and kg·m²: more than the robot can move, in all six degrees of freedom
CLAMP_DAMPING = 1e6  # N·s/m and N·m·s/rad
# Links that are closer than this when the snake is straight would always touch.
MIN_GAP_RADII = 2.05
FOOT_GROUP = 3  # MuJoCo geom group of the feet, which are inside of the links' capsules
ORANGE = [0.87, 0.45, 0.12, 1.0]  # color of the robot
AXES: dict[Axis, list[float]] = {"yaw": [0.0, 0.0, 1.0], "pitch": [0.0, 1.0, 0.0]}


@dataclass(frozen=True)
class SimModel:
    """A compiled model, and the indices of the robot and the obstacles in MuJoCo's arrays."""

    model: mujoco.MjModel
    steps_per_tick: int
    first_link_body: int  # bodies of the links are consecutive
    obstacle_of_geom: list[str | None]  # (n_geoms,); None: link, ground or step
    feet: GroundFeet | None  # None: the ground is not flat, and MuJoCo finds the contacts with it
    link_geoms: list[int]  # (n_links,), tail to head
    suspended: bool  # the tail link is clamped
    # Obstacles that move when they are pushed; their bodies come after the robot's.
    yielding: list[PlacedObstacle]
    laws: LawsVersion  # which version of the laws the model is made for


@dataclass(frozen=True)
class ModelBlueprint:
    """The model of a run before it is compiled."""

    spec: mujoco.MjSpec
    steps_per_tick: int
    yielding: list[PlacedObstacle]  # obstacles that move when they are pushed
    laws: LawsVersion


def view_joint_states(data: mujoco.MjData, count: int) -> tuple[Floats, Floats]:
    """Return views of the joints' angles in rad and velocities in rad/s, (count,) each, tail to head."""
    angles_rad = data.qpos[FREE_QPOS : FREE_QPOS + count]
    velocities_rad_s = data.qvel[FREE_DOFS : FREE_DOFS + count]
    return angles_rad, velocities_rad_s


def build_sim_model(
    config: RunConfig,
    settings: SimSettings,
    *,
    motors: bool = True,
    laws: LawsVersion | None = None,
    stores_contacts_in_state: bool = False,
    measures_force: bool = False,
) -> SimModel:
    """Compile the MuJoCo model of a run: robot, obstacles, ground, motors, sensors and friction.

    Args:
        config: Configuration of the run, with its robot and its scene.
        settings: Parameters of the physics.
        motors: Whether the joints have motors. Otherwise they are hinges with the inertia and the friction of the
            motors' rotors, for torques that are applied from outside.
        laws: Version of the laws that computes ground and friction. None for the C version if it can be loaded.
        stores_contacts_in_state: Whether the C version writes the forces between links and obstacles into
            MuJoCo's state, for programs that see only the state.
        measures_force: Whether the simulation has a contact sensor, which `PhysicsStepper` reads.

    Returns:
        The model, with the indices by which other modules find links, feet and obstacles in it.

    Raises:
        ConfigError: The settings do not match the robot or the scene, or MuJoCo cannot build the model.
    """
    laws = laws or choose_laws()
    blueprint = assemble_model_blueprint(
        config,
        settings,
        motors=motors,
        laws=laws,
        keeps_touches=stores_contacts_in_state,
        measures_force=measures_force,
    )
    model = _compile(blueprint.spec, config.robot.name)
    link_count = config.robot.chain.modules + 1
    first_link_body = model.body("link_0").id
    feet = None
    if config.scene.ground.heightfield is None:
        feet = find_feet(model, first_link_body, link_count, config.robot.module.radius_m)
    return SimModel(
        model=model,
        steps_per_tick=blueprint.steps_per_tick,
        first_link_body=first_link_body,
        obstacle_of_geom=[_parse_obstacle_name(model.geom(i).name) for i in range(model.ngeom)],
        feet=feet,
        link_geoms=[model.geom(f"link_{i}").id for i in range(link_count)],
        suspended=settings.suspended,
        yielding=blueprint.yielding,
        laws=blueprint.laws,
    )


def assemble_model_blueprint(
    config: RunConfig,
    settings: SimSettings,
    *,
    motors: bool,
    laws: LawsVersion,
    keeps_touches: bool = False,
    measures_force: bool = False,
) -> ModelBlueprint:
    """Assemble the model of a run before it is compiled: bodies, geoms, motors, and the friction of each geom.

    Args:
        config: Configuration of the run, with its robot and its scene.
        settings: Parameters of the physics.
        motors: Whether the joints have motors.
        laws: Version of the laws that computes ground and friction.
        keeps_touches: Whether the laws write the forces between links and obstacles into MuJoCo's state.
        measures_force: Whether the simulation has a contact sensor, which `PhysicsStepper` reads.

    Returns:
        The model before it is compiled, with the number of physics steps in a control period and the obstacles that
        yield.

    Raises:
        ConfigError: The settings do not match the robot or the scene.
    """
    # The longest step that is at most `timestep_s`, and of which a control period is a multiple. A quotient of floats
    # may exceed its whole number by less than 1e-9.
    period_s = config.period_ns * 1e-9
    steps_per_tick = int(np.ceil(period_s / settings.timestep_s - 1e-9))
    step_s = period_s / steps_per_tick
    _check_contact_time(settings, step_s)
    placed = place_obstacles(config)
    yielding = [item for item in placed if item.can_move]
    validate_yielding_obstacles(yielding, config.scene.name, step_s, config.scene.ground.slope_rad)

    # The order decides the numbers of bodies: fixed obstacles, the robot, obstacles that yield.
    spec = mujoco.MjSpec()
    _set_options(spec, step_s, compute_gravity_w(config.scene))
    contact = make_contact_parameters(settings)
    rough_ground_geoms = add_ground(spec, config.scene.ground, contact)
    add_pipes(spec, config.scene.pipe, contact)
    fixed = [item for item in placed if not item.can_move]
    _add_obstacles(spec, fixed, config, contact, collide=bool(yielding), step_s=step_s)
    _add_snake(spec, config, settings, contact)
    _add_obstacles(spec, yielding, config, contact, collide=bool(yielding), step_s=step_s)
    _add_motors_and_sensors(spec, config.robot, settings, step_s, motors=motors)

    # Friction and the other laws.
    links = config.robot.chain.modules + 1
    add_fluid(spec, config.scene.fluid, links)
    set_friction(spec, config, placed, rough_ground_geoms, settings.self_friction)
    yielding_bodies = [make_geom_name(item) for item in yielding]
    add_laws(
        spec,
        laws,
        links,
        yielding_bodies,
        keeps_touches=keeps_touches,
        measures_force=measures_force,
    )
    return ModelBlueprint(spec, steps_per_tick, yielding, laws)


def _check_contact_time(settings: SimSettings, step_s: float) -> None:
    """Raise ConfigError if contacts would be too stiff for the physics step."""
    if settings.contact_time_s < 2 * step_s:
        raise ConfigError(
            f"`contact_time_s` = {settings.contact_time_s} s must be at least two physics steps, here "
            f"{2 * step_s:g} s; raise it or lower `timestep_s`",
            code="config/out-of-range",
        )


def _set_options(spec: mujoco.MjSpec, step_s: float, gravity_w: Vector) -> None:
    spec.compiler.degree = False
    option = spec.option
    option.timestep = step_s
    option.gravity = list(gravity_w)
    # Damping of the joints is integrated implicitly.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # faster for a snake than the sparse one
    # A diverged run is reported, not silently restarted. One snake is one constraint island.
    option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_ISLAND
    )


def _add_obstacles(
    spec: mujoco.MjSpec,
    placed: list[PlacedObstacle],
    config: RunConfig,
    contact: ContactParameters,
    *,
    collide: bool,
    step_s: float,
) -> None:
    """Add obstacles to the model. On hills they reach further down, so that no gap is left below them.

    Args:
        spec: Model, which is changed.
        placed: Obstacles with their places.
        config: Configuration of the run, for the robot's radius and the heights of the ground.
        contact: Parameters of MuJoCo's contacts.
        collide: Whether obstacles also collide with each other, because some of them move.
        step_s: Duration of a physics step in s.
    """
    ground_relief_m = 0.0  # height of the highest ground above the lowest
    if config.scene.ground.heightfield is not None:
        ground_relief_m = config.scene.ground.heightfield.height_m
    for item in placed:
        add_obstacle(
            spec,
            item,
            contact,
            body_radius_m=config.robot.module.radius_m,
            ground_relief_m=ground_relief_m,
            collide=collide,
            step_s=step_s,
            normal_gravity_m_s2=compute_normal_gravity_m_s2(config.scene),
        )


def _add_motors_and_sensors(
    spec: mujoco.MjSpec, robot: RobotFile, settings: SimSettings, step_s: float, *, motors: bool
) -> None:
    """Add motors, IMUs and the tether to a model whose links are complete."""
    if motors:
        validate_position_gains(robot)
        for joint in robot.joint_table:
            add_motor(spec, joint, robot.module, step_s)
    if robot.sensors.imu is not None:
        add_imus(spec, robot.link_lengths_m)
    if settings.tether is not None:
        add_tether(spec, settings.tether, robot, settings.contact_time_s)


def _compile(spec: mujoco.MjSpec, robot_name: str) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise ConfigError(
            f"MuJoCo cannot build robot {robot_name!r} in this scene: {error}",
            code="simulator/cannot-build",
        ) from error


def _parse_obstacle_name(name: str) -> str | None:
    """Return the scene's name of the obstacle with this geom; None for geoms of other things."""
    if name.startswith(OBSTACLE):
        return name.removeprefix(OBSTACLE)
    return None


def _add_snake(
    spec: mujoco.MjSpec, config: RunConfig, settings: SimSettings, contact: ContactParameters
) -> None:
    """Add the links, joints and feet of the robot to the model.

    Links are capsules. Flat ground carries them at their feet, which are spheres at joints and ends: at a joint, two
    capsules would make two contacts.

    Args:
        spec: Model, which is changed.
        config: Configuration of the run, with the robot and the ground.
        settings: Parameters of the physics, with a factor on all masses.
        contact: Parameters of MuJoCo's contacts.
    """
    robot = config.robot
    is_flat = config.scene.ground.heightfield is None
    lengths_m = robot.link_lengths_m
    radius_m = robot.module.radius_m
    body = spec.worldbody
    for i, (length_m, mass_kg) in enumerate(zip(lengths_m, robot.link_masses_kg, strict=True)):
        if i == 0:
            body = body.add_body(name="link_0", pos=[0.0, 0.0, radius_m])
            _add_free_joint(body, suspended=settings.suspended)
        else:
            body = body.add_body(name=f"link_{i}", pos=[lengths_m[i - 1], 0.0, 0.0])
            _add_joint(body, robot.joint_table[i - 1])
        if robot.links and robot.links[i].has_inertia:
            _set_inertia(body, robot.links[i], radius_m, settings.mass_scale)
        body.add_geom(
            name=f"link_{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[radius_m, 0.0, 0.0],
            fromto=[0.0, 0.0, 0.0, length_m, 0.0, 0.0],
            mass=mass_kg * settings.mass_scale,
            rgba=ORANGE,
            **contact,
        )
        _add_foot(body, f"foot_{i}", 0.0, radius_m, is_on_flat_ground=is_flat)
    _add_foot(body, f"foot_{len(lengths_m)}", lengths_m[-1], radius_m, is_on_flat_ground=is_flat)
    _exclude_near_links(spec, robot)


def _add_free_joint(body: mujoco.MjsBody, *, suspended: bool) -> None:
    """Add the joint of the base. A suspended robot is clamped there, by inertia and damping."""
    if suspended:
        body.add_joint(
            name="base",
            type=mujoco.mjtJoint.mjJNT_FREE,
            armature=CLAMP_INERTIA,
            damping=CLAMP_DAMPING,
        )
    else:
        body.add_joint(name="base", type=mujoco.mjtJoint.mjJNT_FREE)


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


def _set_inertia(body: mujoco.MjsBody, link: Link, radius_m: float, scale: float) -> None:
    """Give a link the mass and inertia of the robot file, in place of the capsule's."""
    body.explicitinertial = True
    body.mass = scale * link.mass_kg
    body.ipos = list(link.center)
    body.fullinertia = [scale * value for value in link.inertia(radius_m)]


def _add_foot(
    body: mujoco.MjsBody, name: str, along_m: float, radius_m: float, *, is_on_flat_ground: bool
) -> None:
    """Add a massless sphere at a joint or an end of the robot, on which flat ground carries the body.

    MuJoCo itself finds no contacts of the sphere. The law of flat ground computes them.

    Args:
        body: Body of the link.
        name: Name of the geom.
        along_m: Distance in m from the link's rear joint.
        radius_m: Radius of the robot's body in m.
        is_on_flat_ground: Whether the ground is flat and carries the foot.
    """
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[radius_m, 0.0, 0.0],
        pos=[along_m, 0.0, 0.0],
        mass=0.0,
        contype=0,
        conaffinity=0,
        group=FOOT_GROUP,
        userdata=[FOOT if is_on_flat_ground else 0.0],  # `set_friction` appends the coefficients
    )


def _exclude_near_links(spec: mujoco.MjSpec, robot: RobotFile) -> None:
    """Exclude contacts between links that have only short links between them and would touch in a straight snake."""
    lengths_m = robot.link_lengths_m
    for i in range(len(lengths_m)):
        for j in range(i + 2, len(lengths_m)):
            gap_m = math.fsum(lengths_m[i + 1 : j])
            if gap_m < MIN_GAP_RADII * robot.module.radius_m:
                spec.add_exclude(bodyname1=f"link_{i}", bodyname2=f"link_{j}")
