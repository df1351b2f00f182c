"""The parameters of the obstacle-triplet controller: the section `[controllers.obstacle_triplet]` of a scenario."""

from typing import Annotated

from snakesim_gnc.control.progress import SpeedFilter
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import above, bounded, from_zero


class TripletParameters(FileStruct, frozen=True, kw_only=True):
    """The defaults suit modules of about 0.1 m and some hundred grams. The speed is that of the mission."""

    # Propulsion. Its rate is limited because a body that starts and stops in jerks would shake the command.
    propulsion_n: Annotated[float, above(1e4, "N")] = 35.0
    """Maximum propulsion force f_s. It fades to zero as the snake reaches the mission's speed."""

    propulsion_rate_n_s: Annotated[float, above(1e6, "N/s")] = 700.0
    """Maximum rate at which the propulsion force changes."""

    # Load compensation. A servo gives way under a load; with its target ahead by load / stiffness, the joint stays
    # where it was planned.
    load_ratio: Annotated[float, from_zero(1, "1")] = 0.0
    """Fraction of its planned load / stiffness by which a servo's target leads. 0: the servo gives way under the load.
    """

    load_filter_s: Annotated[float, above(60, "s")] = 0.3
    """Time constant of the filter of that load."""

    # Push-points.
    gap_m: Annotated[float, from_zero(1, "m")] = 0.06
    """Maximum gap between the skin and an obstacle that is chosen as a push-point."""

    give_up_gap_m: Annotated[float, from_zero(1, "m")] = 0.12
    """Maximum gap between the skin and an obstacle that is being pushed."""

    end_m: Annotated[float, from_zero(10, "m")] = 0.03
    """Minimum distance of a push-point from a tip of the body."""

    # The choice of a triplet.
    condition_max: Annotated[float, bounded(1, 1e9, "1")] = 100.0
    """Condition number above which a triplet is refused."""

    authority_min: Annotated[float, from_zero(1, "1 (sine of the angle)")] = 0.02
    """Sine of the angle between a joint's lever and the normal at o_3 below which the joint is refused."""

    switch_fraction: Annotated[float, from_zero(1, "1")] = 0.5
    """A triplet is left for one that needs less than this fraction of its torque."""

    # The change from one propulsion joint to the next. `hold_on_m` is larger than the noise of the arc length.
    blend_m: Annotated[float, above(10, "m")] = 0.055
    """Travel over which one propulsion joint hands over to the next."""

    blend_s: Annotated[float, above(10, "s")] = 0.3
    """Time over which one propulsion joint hands over to the next while the body is stationary."""

    hold_on_m: Annotated[float, from_zero(0.1, "m")] = 0.003
    """Distance past o_2 at which the joint behind takes over. It exceeds the noise of the arc length."""

    # The swing of the propulsion joint: it swings out until its contacts carry the load. Damping and a fading
    # propulsion keep it from racing.
    damping_nm_s_per_rad: Annotated[float, from_zero(1e4, "N·m·s/rad")] = 0.5
    """Damping of the propulsion joint, which limits its speed."""

    angle_fade_rad: Annotated[float, above(3.2, "rad")] = 0.2
    """Angle off its reference from which the propulsion fades. At twice this angle it is zero."""

    angle_guard_rad: Annotated[float, above(3.2, "rad")] = 0.7
    """Angle off its reference at which a propulsion joint returns to position mode."""

    guard_s: Annotated[float, from_zero(60, "s")] = 0.5
    """Minimum time for which such a joint stays in position mode."""

    # A stall: less progress than `stall_m` within `stall_s`, while pushing with more than half of the propulsion.
    stall_m: Annotated[float, above(1, "m")] = 0.005
    """Progress below which a body that pushes has stalled."""

    stall_s: Annotated[float, above(60, "s")] = 1.0
    """Time over which that progress is measured."""

    # The release of a triplet that stalls. It is released if its contacts are strained, if hardly any ground could hold
    # a sliding snake so well, or if its joint is at its torque limit or far off its reference. Then all joints go to
    # position mode for `release_s`, and the same triplet is not used until the body has moved.
    jam_force_n: Annotated[float, above(1e6, "N")] = 60.0
    """Contact force, as a mean over 50 ms, above which a triplet that stalls is released."""

    drag_ratio: Annotated[float, above(10, "1 (of the weight)")] = 0.5
    """Ratio of the propulsion to the robot's weight above which a triplet that stalls is released."""

    release_s: Annotated[float, from_zero(60, "s")] = 0.5
    """Time for which all joints stay in position mode after a release."""

    # The arc length that the joints in position mode follow. It has slack, so that noise does not shake the body
    # forward. Its speed is limited, so that these joints brake a body that moves too fast; but it is never further
    # behind the body than `brake_m`.
    slack_m: Annotated[float, from_zero(0.1, "m")] = 0.001
    """Slack of the arc length that the joints in position mode follow."""

    overspeed_ratio: Annotated[float, bounded(1, 100, "1")] = 1.2
    """Maximum speed of that arc length, as a ratio to the mission's speed."""

    brake_m: Annotated[float, from_zero(1, "m")] = 0.02
    """Maximum distance of that arc length behind the body."""

    speed_filter_s: SpeedFilter = 0.03
    """Time constant of the filter of the speed along the path. 0: no filter."""
