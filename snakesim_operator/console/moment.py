"""What the console shows of one instant of a robot, live or recorded."""

from dataclasses import dataclass, field

from snakesim_hal.wire.messages import (
    AppliedCommand,
    ColourImage,
    Contacts,
    ControlSettings,
    ControlState,
    DepthImage,
    Description,
    JointState,
    Power,
    Status,
    Trajectory,
    World,
)
from snakesim_hal.wire.quantities import Quaternion, Vector


@dataclass(frozen=True)
class Stream:
    """One key: how many messages a second arrive, and how old its data is in robot time (None: it has no stamp)."""

    rate_hz: float
    age_s: float | None


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One instant. Whatever is None is not known."""

    robot: Description
    time_s: float | None = None  # robot time
    silent_s: float = 0.0  # since the host was heard
    status: Status | None = None
    joints: JointState | None = None  # the newest
    body: JointState | None = None  # of the instant of `base`
    base: tuple[Vector, Quaternion] | None = None  # position_w and orientation wxyz of the tail end
    world: World | None = None
    contacts: Contacts | None = None
    trajectory: Trajectory | None = None
    control: ControlState | None = None
    applied: AppliedCommand | None = None
    settings: ControlSettings | None = None
    power: Power | None = None
    images: dict[str, DepthImage | ColourImage] = field(default_factory=dict)  # by key
    streams: dict[str, Stream] = field(default_factory=dict)  # by key
    hosts: frozenset[str] = frozenset()  # ids of all that publish a status; more than one: an impostor
