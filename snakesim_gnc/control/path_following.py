"""Path following: every joint in position mode, towards a body pose slightly further along the path.

The obstacles turn the change of shape into motion. The reference moves with the mission's speed, but never more than
`look_ahead_m` ahead of the measured body, so a blocked snake does not wind up.
"""

from typing import Annotated

from snakesim_gnc.control.bumpless import Blend, BumplessReference
from snakesim_gnc.control.climb import Climb
from snakesim_gnc.control.controller import Action, Report, View
from snakesim_gnc.control.progress import Progress, SpeedFilter
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import about, from_zero


class PathFollowing:
    """Shape control along a path; does not use obstacles."""

    class Settings(FileStruct, frozen=True, kw_only=True):
        """Too little look-ahead does not overcome the drag; too much wedges the body between tight obstacles."""

        look_ahead_m: Annotated[
            float,
            from_zero(1, "m"),
            about("how far ahead on its path the shape is at most"),
        ] = 0.03
        blend_s: Blend = 0.3
        speed_filter_s: SpeedFilter = 0.03

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._set = settings
        self._body, self._climb = PlanarBody(robot), Climb(robot)
        self._progress = Progress(self._body, speed_filter_s=settings.speed_filter_s)
        self._bumpless = BumplessReference(robot, settings.blend_s)
        self._ahead_s_m = 0.0

    def update(self, view: View) -> Action:
        """Angles of the body slightly further along the path."""
        located = self._progress.update(view)
        if isinstance(located, str):
            return self._bumpless.hold(view, located)
        tail_s_m = located.tail_s_m
        if located.restarted:
            self._ahead_s_m = tail_s_m
        advanced = self._ahead_s_m + located.trajectory.speed_m_s * view.period_s
        self._ahead_s_m = min(max(advanced, tail_s_m), tail_s_m + self._set.look_ahead_m)
        reference = self._body.all_angles(located.on_path.pose_at(self._ahead_s_m))
        reference = reference + self._climb.angles_rad(located.trajectory.rises, self._ahead_s_m)
        setpoints = self._bumpless.follow(view, reference, restarted=located.restarted)
        return Action(setpoints, Report(path_s_m=tail_s_m, reference_rad=reference.tolist()))
