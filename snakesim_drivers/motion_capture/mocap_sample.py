"""The datagram with the base's pose from a motion-capture system; specified in docs/hardware/motion-capture.md."""

import msgspec

from snakesim_hal.wire import quantities as q


class MocapSample(msgspec.Struct, frozen=True, kw_only=True):
    """One datagram: pose of the base (tail end of link 0) in the world, and its capture time."""

    timestamp_ns: q.Nanoseconds  # of the motion-capture system's own clock
    position_w: q.Vector  # m
    orientation_wxyz: q.Quaternion
    velocity_w: q.VelocityVector | None = None  # m/s; None: the receiver derives it
    # Rad/s; None: the receiver derives it.
    angular_velocity_w: q.AngularVelocityVector | None = None
