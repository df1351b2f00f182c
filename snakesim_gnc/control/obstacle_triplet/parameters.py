"""The parameters of the obstacle-triplet controller: the section `[controllers.obstacle_triplet]` of a scenario."""

from typing import Annotated

from snakesim_gnc.control.progress import SpeedFilter
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import about, above, bounded, from_zero


class TripletParameters(FileStruct, frozen=True, kw_only=True):
    """The defaults suit modules of about 0.1 m and some hundred grams. The speed is that of the mission."""

    # Propulsion. Its rate is limited because a body that starts and stops in jerks would shake the command.
    propulsion_n: Annotated[
        float,
        above(1e4, "N"),
        about("maximum propulsion force, f_s; it fades to zero as the snake reaches the mission's speed"),
    ] = 35.0
    propulsion_rate_n_s: Annotated[float, above(1e6, "N/s"), about("how fast the propulsion force changes")] = 700.0

    # Load compensation. A servo gives way under a load; with its target ahead by load / stiffness, the joint stays
    # where it was planned.
    load_ratio: Annotated[
        float, from_zero(1, "1"), about("ratio of its planned load by which a servo's target leads; 0: it gives way")
    ] = 0.0
    load_filter_s: Annotated[float, above(60, "s"), about("time constant of the filter of that load")] = 0.3

    # Push-points.
    gap_m: Annotated[
        float, from_zero(1, "m"), about("how far the skin may be from an obstacle that is to be pushed")
    ] = 0.06
    give_up_gap_m: Annotated[
        float, from_zero(1, "m"), about("how far it may get from an obstacle that is being pushed")
    ] = 0.12
    end_m: Annotated[float, from_zero(10, "m"), about("how near to a tip of the body a push-point may be")] = 0.03

    # The choice of a triplet.
    condition_max: Annotated[
        float,
        bounded(1, 1e9, "1"),
        about("triplets above this condition number are refused"),
    ] = 100.0
    authority_min: Annotated[
        float,
        from_zero(1, "1 (sine of the angle)"),
        about("joints whose lever is so nearly along the normal at o_3 are refused"),
    ] = 0.02
    switch_fraction: Annotated[
        float, from_zero(1, "1"), about("a triplet is left for one that needs less than this fraction of its torque")
    ] = 0.5

    # The change from one propulsion joint to the next. `hold_on_m` is larger than the noise of the arc length.
    blend_m: Annotated[float, above(10, "m"), about("travel over which one joint hands over to the next")] = 0.055
    blend_s: Annotated[
        float, above(10, "s"), about("time over which one joint hands over to the next when standing")
    ] = 0.3
    hold_on_m: Annotated[
        float, from_zero(0.1, "m"), about("the joint behind o_2 takes over when it is so far past it")
    ] = 0.003

    # The swing of the propulsion joint: it swings out until its contacts carry the load. Damping and a fading
    # propulsion keep it from racing.
    damping_nm_s_per_rad: Annotated[
        float, from_zero(1e4, "N·m·s/rad"), about("damping of the propulsion joint, which keeps it from racing")
    ] = 0.5
    angle_fade_rad: Annotated[
        float, above(3.2, "rad"), about("the propulsion fades from so far off the reference to twice as far")
    ] = 0.2
    angle_guard_rad: Annotated[
        float, above(3.2, "rad"), about("a propulsion joint further off its reference goes back to position mode")
    ] = 0.7
    guard_s: Annotated[float, from_zero(60, "s"), about("how long it stays in position mode then, at least")] = 0.5

    # A stall: less progress than `stall_m` within `stall_s`, while pushing with more than half of the propulsion.
    stall_m: Annotated[float, above(1, "m"), about("less progress than this while pushing is a stall")] = 0.005
    stall_s: Annotated[float, above(60, "s"), about("time over which that progress is measured")] = 1.0

    # The release of a triplet that stalls. It is released if its contacts are strained, if hardly any ground could hold
    # a sliding snake so well, or if its joint is at its torque limit or far off its reference. Then all joints go to
    # position mode for `release_s`, and the same triplet is not used until the body has moved.
    jam_force_n: Annotated[
        float,
        above(1e6, "N"),
        about("a triplet that stalls with a larger contact force, as a mean over 50 ms, is released"),
    ] = 60.0
    drag_ratio: Annotated[
        float,
        above(10, "1 (of the weight)"),
        about("a triplet that stalls with a propulsion above this ratio to the robot's weight is released"),
    ] = 0.5
    release_s: Annotated[float, from_zero(60, "s"), about("how long all joints go to position mode then")] = 0.5

    # The arc length that the joints in position mode follow. It has slack, so that noise does not shake the body
    # forward. Its speed is limited, so that these joints brake a body that moves too fast; but it is never further
    # behind the body than `brake_m`.
    slack_m: Annotated[
        float, from_zero(0.1, "m"), about("slack of the arc length that the joints in position mode follow")
    ] = 0.001
    overspeed_ratio: Annotated[
        float, bounded(1, 100, "1"), about("maximum speed of that arc length, as a ratio to the mission's")
    ] = 1.2
    brake_m: Annotated[float, from_zero(1, "m"), about("maximum distance of that arc length behind the body")] = 0.02

    speed_filter_s: SpeedFilter = 0.03
