"""The schema of the physics settings: a scenario's `[backends.sim]` section, and a physics_model's settings."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import MAX_JOINTS, bounded, from_zero


class TetherSettings(FileStruct, frozen=True, kw_only=True):
    """A rope from a point of the snake to an anchor far away on the ground's plane.

    It can only pull towards `direction_w`: the point cannot move against that direction, and moves almost freely
    across it and along it. With `reel_in_m_s` above 0 a winch at the anchor tows the snake at that speed instead.
    """

    link: Annotated[int, Meta(ge=0, le=MAX_JOINTS)] = 0
    """Number of the link that the rope is fixed to, from 0 at the tail."""

    point_m: Annotated[float, bounded(-10, 10, "m")] = 0.0
    """Distance of that point from the link's rear joint."""

    direction_w: tuple[float, float]
    """Direction of the pull in the world frame, as [x, y] of any length but 0."""

    reel_in_m_s: Annotated[float, from_zero(10, "m/s")] = 0.0
    """Speed at which a winch tows the snake. 0: the rope only holds it."""


class SimSettings(FileStruct, frozen=True, kw_only=True):
    """Parameters of the physics. The defaults suit robots of centimeters to decimeters and of a few kilograms."""

    timestep_s: Annotated[float, bounded(1e-5, 0.01, "s")] = 0.002
    """Longest physics step. It is shortened so that a control period is a multiple of it."""

    contact_time_s: Annotated[float, bounded(1e-4, 0.1, "s")] = 0.005
    """Time constant with which a penetration is pushed out, at least two physics steps. Longer: softer contacts, which
    tolerate long steps.
    """

    self_friction: Annotated[float, from_zero(5, "1 (Coulomb coefficient)")] = 0.3
    """Coulomb friction between links of the snake."""

    mass_scale: Annotated[float, bounded(0.1, 10, "1")] = 1.0
    """Mass of every simulated link, divided by that in the robot file, which all other programs use."""

    motor_gain_scale: Annotated[float, bounded(0.1, 10, "1")] = 1.0
    """Gains of every simulated motor, divided by those in the robot file."""

    settle_s: Annotated[float, from_zero(60, "s")] = 3.0
    """Longest time that the snake may take to come to rest before the run begins."""

    suspended: bool = False
    """True: the snake hangs from a clamp by its tail link, head down and clear of the ground.

    `snakesim robot identify` needs it.
    """

    tether: TetherSettings | None = None
    """Rope to an anchor. None: there is no rope."""


class PhysicsModelSettings(SimSettings, frozen=True, kw_only=True):
    """The same for the physics under emulated joint modules, whose firmware sets the clock mode: one step at a time."""

    timestep_s: Annotated[float, bounded(1e-5, 0.01, "s")] = 0.001
    """Longest physics step. It is shortened so that a control period is a multiple of it."""

    def __post_init__(self) -> None:
        """Reject a gain scale: the motors belong to the firmware."""
        if self.motor_gain_scale != 1.0:
            raise ValueError(
                "`motor_gain_scale` is of motors in the simulator; those of emulated modules are firmware"
            )
