"""The start pose and the mission of a run."""

from typing import Annotated, Literal

from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.geometry.outlines import Clearance, Heading, Point, Size


class StartPlacement(FileStruct, frozen=True, kw_only=True):
    """Start pose of the snake: along the scene's route, or straight at a pose."""

    on_route: bool = True
    """True: the snake lies along the scene's route. False: it lies straight at a pose."""

    tail_s_m: Annotated[float, Meta(ge=-100, le=1000, extra_json_schema={"unit": "m"})] = 0.0
    """Arc length of the tail end along the route. Used if `on_route` is true."""

    position_m: Point = (0.0, 0.0)
    """Position of the tail end in the world frame, as [x, y]. Used if `on_route` is false."""

    yaw_rad: Heading = 0.0
    """Direction from the tail to the head in the world frame. Used if `on_route` is false."""

    height_m: Clearance = 0.0
    """Height above the ground at which the snake starts, for scenes with a [fluid] that carries it. Elsewhere it falls
    before the run begins.
    """


class HeadingGoal(FileStruct, frozen=True, kw_only=True, tag="heading", tag_field="kind"):
    """Advance the whole body in one direction."""

    heading_rad: Heading = 0.0
    """Direction of the advance in the world frame. 0: along x."""

    distance_m: Size = 3.0
    """Distance of the goal from the start pose."""


class WaypointGoal(FileStruct, frozen=True, kw_only=True, tag="waypoints", tag_field="kind"):
    """Take the head from point to point."""

    points_m: Annotated[list[Point], Meta(min_length=1, max_length=1000)]
    """Points that the head visits in order, in the world frame, as [x, y]."""

    within_m: Size = 0.2
    """Distance at which a point counts as reached."""


class Mission(FileStruct, frozen=True, kw_only=True):
    """The goal of navigation: the end of the scene's route, or with `goal` a path that it plans itself."""

    speed_m_s: Annotated[float, Meta(ge=0, le=10, extra_json_schema={"unit": "m/s"})] = 0.2
    """Speed along the path that navigation asks for."""

    goal: HeadingGoal | WaypointGoal | None = None
    """Goal to which navigation plans a path, `kind` = "heading" or "waypoints". None: the end of the scene's route."""

    until_goal: bool = False
    """True: the run ends when the goal is reached, even before `duration_s`."""

    map: Literal["known", "perceived"] = "known"
    """`known`: navigation has the obstacles of the scene, as from a survey. `perceived`: only what the sensors measure.
    """

    map_error_m: Annotated[float, Meta(ge=0, le=0.1, extra_json_schema={"unit": "m"})] = 0.0
    """Standard deviation of each obstacle's position in a known map. The errors follow from the run's seed."""

    assumed_obstacle_friction: Annotated[
        float, Meta(ge=0, le=2, extra_json_schema={"unit": "1 (Coulomb coefficient)"})
    ] = 0.0
    """Friction of obstacles that navigation assumes when it plans, and the controller when it pushes."""

    max_climb_m: Annotated[float, Meta(ge=0, le=1, extra_json_schema={"unit": "m"})] = 0.1
    """Height of the highest `step` of a known map that a robot with pitch joints climbs."""

    localization: Literal["pose_sensor", "dead_reckoning"] = "pose_sensor"
    """`pose_sensor`: the pose comes from the pose sensor if there is one. `dead_reckoning`: from joints, IMU, contacts
    and the map alone.
    """

    def __post_init__(self) -> None:
        """Check that survey errors come with a known map, and `until_goal` with a goal. Raises ValueError."""
        if self.map_error_m > 0 and self.map == "perceived":
            raise ValueError('`map_error_m` is of a survey; with map = "perceived" there is none')
        if self.until_goal and self.goal is None:
            raise ValueError(
                "`until_goal`: this mission has no goal to reach; give it one in [mission.goal]"
            )
