"""The schema of a scenario's `[controllers.obstacle_triplet]` section."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import above, from_zero


class Settings(FileStruct, frozen=True, kw_only=True):
    """The defaults suit modules of about 0.1 m and some hundred grams. Speed comes from the mission."""

    # Greatest propulsion force (the paper's f_s). It fades to zero as the snake reaches the mission's speed.
    propulsion_n: Annotated[float, above(1e4, "N")] = 35.0
    # How fast the propulsion force changes; a body that starts and stops by jerks would shake the command.
    propulsion_rate_n_s: Annotated[float, above(1e6, "N/s")] = 700.0

    # Push-points: how far the skin may be from an obstacle that is to be pushed, how far it may get from one that is
    # being pushed, and how near to a tip the point may be.
    gap_m: Annotated[float, from_zero(1, "m")] = 0.06
    give_up_gap_m: Annotated[float, from_zero(1, "m")] = 0.12
    end_m: Annotated[float, from_zero(10, "m")] = 0.03

    # Triplets: those above this condition number are refused, and joints whose lever is nearly along o_3's normal.
    condition_max: Annotated[float, Meta(ge=1, le=1e9, extra_json_schema={"unit": "1"})] = 100.0
    authority_min: Annotated[float, Meta(ge=0, le=1, extra_json_schema={"unit": "1 (sine of the angle)"})] = 0.02
    # A triplet is left for one that needs less than this share of its torque.
    switch_share: Annotated[float, Meta(ge=0, le=1, extra_json_schema={"unit": "1"})] = 0.5

    # Hand-over from joint to joint: over this much travel, or this much time when standing.
    blend_m: Annotated[float, above(10, "m")] = 0.055
    blend_s: Annotated[float, above(10, "s")] = 0.3
    # The joint behind o_2 takes over when it is so far past it; more than the noise of the arc length.
    hold_on_m: Annotated[float, from_zero(0.1, "m")] = 0.003

    # The propulsion joint swings out until its contacts carry; damping and a fading propulsion keep it from racing. The
    # propulsion fades from this far off the reference to twice as far.
    damping_nm_s_per_rad: Annotated[float, from_zero(1e4, "N·m·s/rad")] = 0.5
    angle_fade_rad: Annotated[float, above(3.2, "rad")] = 0.2
    # A propulsion joint further than this from its reference goes back to position mode, for this long at least.
    angle_guard_rad: Annotated[float, above(3.2, "rad")] = 0.7
    guard_s: Annotated[float, from_zero(60, "s")] = 0.5

    # Standing still: less progress than this, in this time, while pushing with more than half of the propulsion.
    stall_m: Annotated[float, above(1, "m")] = 0.005
    stall_s: Annotated[float, above(60, "s")] = 1.0
    # A triplet that stands is let go of when a contact force exceeds this, or the propulsion this share of the robot's
    # weight (hardly any ground holds a sliding snake so well), or its joint is at its limit of torque or swings out.
    jam_force_n: Annotated[float, above(1e6, "N")] = 120.0
    drag_share: Annotated[float, above(10, "1 (of the weight)")] = 0.5
    # Then all joints go to position mode for this long, and the same triplet waits until the body has moved.
    release_s: Annotated[float, from_zero(60, "s")] = 0.5

    # The arc length that the joints in position mode follow: with slack, so that noise does not shake the body forward,
    # and no faster than this share of the mission's speed, so that they brake a body that runs away; but never further
    # behind the body than `brake_m`.
    slack_m: Annotated[float, from_zero(0.1, "m")] = 0.001
    overspeed_share: Annotated[float, Meta(ge=1, le=100, extra_json_schema={"unit": "1"})] = 1.2
    brake_m: Annotated[float, from_zero(1, "m")] = 0.02

    # Filter of the speed along the path.
    speed_filter_s: Annotated[float, from_zero(1, "s")] = 0.03
