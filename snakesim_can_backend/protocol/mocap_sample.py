"""The datagram by which a motion-capture system tells the base's pose; docs/can-protocol.md has it in full."""

import msgspec

from snakesim_hal.wire import quantities as q


class MocapSample(msgspec.Struct, frozen=True, kw_only=True):
    """One datagram: the base (tail end of link 0) in the world, and when it was there."""

    stamp_ns: q.Nanoseconds  # of the motion-capture system's own clock
    position_w: q.Vector
    orientation_wxyz: q.Quaternion
    velocity_w: q.VelocityVector | None = None
    angular_velocity_w: q.AngularVelocityVector | None = None
