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
    LifecycleState,
    LocomotionState,
    Measurement,
    Message,
    Mode,
    Modes,
    Reach,
    StopMode,
)
from snakesim_hal.wire.messages.description import (
    MAX_CONFIG,
    Configuration,
    Description,
    JointDescription,
    LinkDescription,
    SensorDescription,
)
from snakesim_hal.wire.messages.locomotion import (
    ControlParameters,
    ControlState,
    Intent,
    Obstacle,
    ParametersRequest,
    Rise,
    Trajectory,
    World,
    WorldContact,
)
from snakesim_hal.wire.messages.mounted_sensors import (
    CameraImage,
    ColorImage,
    CustomSample,
    DepthImage,
    MountedSample,
    Preview,
    Ranges,
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
    Done,
    Fault,
    Process,
    Status,
    Timing,
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
    "Configuration",
    "Contact",
    "Contacts",
    "ControlParameters",
    "ControlState",
    "CustomSample",
    "DepthImage",
    "Description",
    "Done",
    "EstopRequest",
    "Fault",
    "FaultRequest",
    "Imu",
    "Intent",
    "JointCommand",
    "JointDescription",
    "JointState",
    "LeaseRequest",
    "LifecycleRequest",
    "LifecycleState",
    "LinkDescription",
    "LocomotionState",
    "Measurement",
    "Message",
    "Mode",
    "Modes",
    "MountedSample",
    "Obstacle",
    "ParametersRequest",
    "Pose",
    "Power",
    "Preview",
    "Process",
    "Ranges",
    "Reach",
    "Rise",
    "SensorDescription",
    "SimulatorRequest",
    "Status",
    "StopMode",
    "Timing",
    "Trajectory",
    "World",
    "WorldContact",
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
        Ranges,
        CustomSample,
        Preview,
        JointCommand,
        AppliedCommand,
        Clock,
        Description,
        Configuration,
        Status,
        LeaseRequest,
        LifecycleRequest,
        EstopRequest,
        SimulatorRequest,
        FaultRequest,
        Answer,
        Done,
        Process,
        World,
        Trajectory,
        ControlState,
        ParametersRequest,
        ControlParameters,
        Intent,
    ),
    1,
)
"""Every message that may be sent on its own, with its version."""
