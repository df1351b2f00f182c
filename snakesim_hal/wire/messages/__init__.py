"""The wire contract: every message that crosses Zenoh, as a frozen Struct with bounds.

Vectors run over all joints, tail to head, in the order of the description. Frames are name suffixes: `_w` world,
`_l` the link's own frame (x forward along the link, origin at its rear joint). Quaternions are wxyz.
A new field gets a default; a change of meaning gets a new version in `VERSIONS`.

The meaning of a field is its `about`, because the published schemas are generated from it. Import messages from this
package; its modules hold them by topic:

`sensors`, `mounted_sensors`   what sensors measure          `description`   the robot, and the configuration
`actuators`                    setpoints of the joints       `status`        the state of host and processes
`locomotion`                   guidance, navigation, control  `requests`      requests to the host, and its answer
"""

from snakesim_hal.wire.messages.actuators import (
    AppliedCommand,
    JointCommand,
)
from snakesim_hal.wire.messages.base import (
    Axis,
    ClockMode,
    FaultScope,
    JointMode,
    LifecycleState,
    LocomotionState,
    Measurement,
    Message,
    Modes,
    StopMode,
)
from snakesim_hal.wire.messages.description import (
    MAX_CONFIG,
    JointDescription,
    LinkDescription,
    RobotDescription,
    RunConfiguration,
    SensorDescription,
)
from snakesim_hal.wire.messages.locomotion import (
    ControlParameters,
    ControlState,
    KnownObstacle,
    LocomotionIntent,
    ParametersRequest,
    PathRise,
    Trajectory,
    WorldContact,
    WorldModel,
)
from snakesim_hal.wire.messages.mounted_sensors import (
    CameraImage,
    ColorImage,
    CustomSample,
    DepthImage,
    ImagePreview,
    MountedSample,
    RangeScan,
)
from snakesim_hal.wire.messages.requests import (
    Answer,
    EstopRequest,
    FaultRequest,
    LeaseRequest,
    LifecycleRequest,
    SimulatorRequest,
    make_arm_request,
)
from snakesim_hal.wire.messages.sensors import (
    Contact,
    Contacts,
    Imu,
    JointState,
    Pose,
    Power,
)
from snakesim_hal.wire.messages.status import (
    TICK_TIMES,
    Clock,
    Fault,
    ProcessInfo,
    RobotStatus,
    TickDone,
    TimingStatistics,
)

__all__ = [
    "MAX_CONFIG",
    "TICK_TIMES",
    "VERSIONS",
    "Answer",
    "AppliedCommand",
    "Axis",
    "CameraImage",
    "Clock",
    "ClockMode",
    "ColorImage",
    "Contact",
    "Contacts",
    "ControlParameters",
    "ControlState",
    "CustomSample",
    "DepthImage",
    "EstopRequest",
    "Fault",
    "FaultRequest",
    "FaultScope",
    "ImagePreview",
    "Imu",
    "JointCommand",
    "JointDescription",
    "JointMode",
    "JointState",
    "KnownObstacle",
    "LeaseRequest",
    "LifecycleRequest",
    "LifecycleState",
    "LinkDescription",
    "LocomotionIntent",
    "LocomotionState",
    "Measurement",
    "Message",
    "Modes",
    "MountedSample",
    "ParametersRequest",
    "PathRise",
    "Pose",
    "Power",
    "ProcessInfo",
    "RangeScan",
    "RobotDescription",
    "RobotStatus",
    "RunConfiguration",
    "SensorDescription",
    "SimulatorRequest",
    "StopMode",
    "TickDone",
    "TimingStatistics",
    "Trajectory",
    "WorldContact",
    "WorldModel",
    "make_arm_request",
]

VERSIONS: dict[type[Message], int] = dict.fromkeys(
    (
        JointState,
        Contacts,
        Imu,
        Pose,
        Power,
        DepthImage,
        ColorImage,
        RangeScan,
        CustomSample,
        ImagePreview,
        JointCommand,
        AppliedCommand,
        Clock,
        RobotDescription,
        RunConfiguration,
        RobotStatus,
        LeaseRequest,
        LifecycleRequest,
        EstopRequest,
        SimulatorRequest,
        FaultRequest,
        Answer,
        TickDone,
        ProcessInfo,
        WorldModel,
        Trajectory,
        ControlState,
        ParametersRequest,
        ControlParameters,
        LocomotionIntent,
    ),
    1,
)
"""Every message that may be sent on its own, with its version."""
