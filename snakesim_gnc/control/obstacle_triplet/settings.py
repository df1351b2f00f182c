"""The schema of a scenario's `[controllers.obstacle_triplet]` section."""

from typing import Annotated

from snakesim_gnc.control.progress import SpeedFilter
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import about, above, bounded, from_zero


class TripletSettings(FileStruct, frozen=True, kw_only=True):
    """The defaults suit modules of about 0.1 m and some hundred grams. Speed comes from the mission."""

    propulsion_n: Annotated[
        float,
        above(1e4, "N"),
        about("greatest propulsion force, f_s; it fades to zero as the snake reaches the mission's speed"),
    ] = 35.0
    # A body that starts and stops by jerks would shake the command.
    propulsion_rate_n_s: Annotated[float, above(1e6, "N/s"), about("how fast the propulsion force changes")] = 700.0

    # A servo gives way under a load; with its target ahead by load / stiffness the joint stays where it was planned.
    load_ratio: Annotated[
        float, from_zero(1, "1"), about("share of its planned load by which a servo's target leads; 0: it gives way")
    ] = 0.0
    load_filter_s: Annotated[float, above(60, "s"), about("time constant of the filter of that load")] = 0.3

    gap_m: Annotated[
        float, from_zero(1, "m"), about("how far the skin may be from an obstacle that is to be pushed")
    ] = 0.06
    give_up_gap_m: Annotated[
        float, from_zero(1, "m"), about("how far it may get from an obstacle that is being pushed")
    ] = 0.12
    end_m: Annotated[float, from_zero(10, "m"), about("how near to a tip of the body a push-point may be")] = 0.03

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
        float, from_zero(1, "1"), about("a triplet is left for one that needs less than this share of its torque")
    ] = 0.5

    blend_m: Annotated[float, above(10, "m"), about("travel over which one joint hands over to the next")] = 0.055
    blend_s: Annotated[
        float, above(10, "s"), about("time over which one joint hands over to the next when standing")
    ] = 0.3
    # More than the noise of the arc length.
    hold_on_m: Annotated[
        float, from_zero(0.1, "m"), about("the joint behind o_2 takes over when it is so far past it")
    ] = 0.003

    # The propulsion joint swings out until its contacts carry; damping and a fading propulsion keep it from racing.
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

    # Standing still: less progress than this, in this time, while pushing with more than half of the propulsion.
    stall_m: Annotated[float, above(1, "m"), about("less progress than this while pushing is standing still")] = 0.005
    stall_s: Annotated[float, above(60, "s"), about("time over which that progress is measured")] = 1.0
    jam_force_n: Annotated[
        float,
        above(1e6, "N"),
        about("a triplet that stands with a larger contact force, as a mean over 50 ms, is let go of"),
    ] = 60.0
    # Hardly any ground holds a sliding snake so well. A joint at its torque limit, or far out, ends it, too.
    drag_ratio: Annotated[
        float,
        above(10, "1 (of the weight)"),
        about("a triplet that stands with a propulsion above this share of the robot's weight is let go of"),
    ] = 0.5
    # Then all joints go to position mode for this long, and the same triplet waits until the body has moved.
    release_s: Annotated[float, from_zero(60, "s"), about("how long all joints go to position mode then")] = 0.5

    # The arc length that the joints in position mode follow: with slack, so that noise does not shake the body forward,
    # and no faster than this share of the mission's speed, so that they brake a body that runs away; but never further
    # behind the body than `brake_m`.
    slack_m: Annotated[
        float, from_zero(0.1, "m"), about("slack of the arc length that the joints in position mode follow")
    ] = 0.001
    overspeed_ratio: Annotated[
        float, bounded(1, 100, "1"), about("the largest speed of that arc length, as a share of the mission's")
    ] = 1.2
    brake_m: Annotated[float, from_zero(1, "m"), about("how far that arc length stays behind the body at most")] = 0.02

    speed_filter_s: SpeedFilter = 0.03
