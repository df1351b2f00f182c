"""The key space, relative to the robot's Zenoh namespace. Keys are built and parsed only here."""

from dataclasses import dataclass

from snakesim_hal.wire import messages as m

JOINTS = "sensor/joints"
CONTACTS = "sensor/contacts"
IMU = "sensor/imu"
POSE = "sensor/pose"
POWER = "sensor/power"
DEPTH_ALL = "sensor/depth/*"
COLOR_ALL = "sensor/color/*"
RANGE_ALL = "sensor/range/*"
CUSTOM_ALL = "sensor/custom/*"
PREVIEW_DEPTH_ALL = "preview/depth/*"
PREVIEW_COLOR_ALL = "preview/color/*"
JOINT_COMMAND = "actuator/joints"
DESCRIPTION = "hal/description"
CONFIG = "hal/config"
STATUS = "hal/status"
CLOCK = "hal/clock"
APPLIED = "hal/applied"
LEASE = "hal/lease"
LIFECYCLE = "hal/lifecycle"
ESTOP = "hal/estop"
SIMULATOR = "hal/simulator"
FAULT_ALL = "fault/*"
DONE_ALL = "hal/done/*"
WORLD = "guidance/world"
TRAJECTORY = "navigation/trajectory"
CONTROL_STATE = "control/state"
PARAMETERS = "control/parameters"
PARAMETERS_IN_FORCE = "control/parameters_in_force"
INTENT = "operator/intent"
ALIVE_ALL = "alive/*"
HOST_ALL = "hal/host/*"
PROCESS_ALL = "process/*"
RECEIVED = "recorder/received"


@dataclass(frozen=True)
class KeyRow:
    """One line of the key space: the message at a key, who writes it, how and when."""

    key: str
    message: type[m.Message] | None
    writer: str
    kind: str  # stream, latched, query, liveliness
    when: str
    description: str


_TICK = "every tick"
_SENSOR = "at its `rate_hz` in `RobotDescription.sensors`"
_ASKED = "on request"
_TURN = "every `decimation` of its service"
_LIVES = "while connected"
_LOOKED_AT = "2 Hz, if there is a subscriber"

SPACE: tuple[KeyRow, ...] = (
    KeyRow(JOINTS, m.JointState, "HAL", "stream", _TICK, "angle, velocity, torque of every joint"),
    KeyRow(
        CONTACTS, m.Contacts, "HAL", "stream", _SENSOR, "every contact of a link with an obstacle"
    ),
    KeyRow(IMU, m.Imu, "HAL", "stream", _SENSOR, "angular velocity and acceleration of the links"),
    KeyRow(POSE, m.Pose, "HAL", "stream", _SENSOR, "base pose from motion capture"),
    KeyRow(
        POWER,
        m.Power,
        "HAL",
        "stream",
        _SENSOR,
        "supply, temperatures and leaks of the joint modules",
    ),
    KeyRow(DEPTH_ALL, m.DepthImage, "HAL", "stream", _SENSOR, "distances that a camera sees"),
    KeyRow(COLOR_ALL, m.ColorImage, "HAL", "stream", _SENSOR, "what a camera sees, in color"),
    KeyRow(
        RANGE_ALL,
        m.RangeScan,
        "HAL",
        "stream",
        _SENSOR,
        "distances along the beams of a lidar or a range finder",
    ),
    KeyRow(
        CUSTOM_ALL,
        m.CustomSample,
        "HAL",
        "stream",
        _SENSOR,
        "samples of a sensor with a custom message",
    ),
    KeyRow(
        PREVIEW_DEPTH_ALL,
        m.ImagePreview,
        "preview",
        "stream",
        _LOOKED_AT,
        "small PNG of a depth image, for remote viewers",
    ),
    KeyRow(
        PREVIEW_COLOR_ALL,
        m.ImagePreview,
        "preview",
        "stream",
        _LOOKED_AT,
        "small JPEG of a color image",
    ),
    KeyRow(
        JOINT_COMMAND,
        m.JointCommand,
        "lease holder",
        "stream",
        _TICK,
        "mode and setpoint of every joint",
    ),
    KeyRow(
        DESCRIPTION,
        m.RobotDescription,
        "HAL",
        "latched",
        "once",
        "joints, order, limits, geometry, sensors",
    ),
    KeyRow(
        CONFIG,
        m.RunConfiguration,
        "HAL",
        "latched",
        "once",
        "everything that the run was started with, as JSON",
    ),
    KeyRow(
        STATUS,
        m.RobotStatus,
        "HAL",
        "latched",
        "on a change, and 5 Hz",
        "lifecycle, reason, holder, faults, counters",
    ),
    KeyRow(
        CLOCK,
        m.Clock,
        "HAL",
        "stream",
        f"{_TICK}, last",
        "tick, time, and the newest sample at each key",
    ),
    KeyRow(
        APPLIED,
        m.AppliedCommand,
        "HAL",
        "stream",
        _TICK,
        "setpoints that the motors got, and limits applied",
    ),
    KeyRow(
        LEASE,
        m.LeaseRequest,
        "any",
        "query",
        _ASKED,
        "acquire, renew, release the right to command. Replies Answer",
    ),
    KeyRow(
        LIFECYCLE,
        m.LifecycleRequest,
        "any",
        "query",
        _ASKED,
        "arm, disarm, reset, finish. Replies Answer",
    ),
    KeyRow(
        ESTOP,
        m.EstopRequest,
        "any",
        "query",
        _ASKED,
        "stop now, needs no lease, latched. Replies Answer",
    ),
    KeyRow(
        SIMULATOR,
        m.SimulatorRequest,
        "any",
        "query",
        _ASKED,
        "pause, step, speed, reset a simulator. Replies Answer",
    ),
    KeyRow(
        FAULT_ALL,
        m.FaultRequest,
        "any",
        "query",
        _ASKED,
        "inject a fault, where allowed. Replies Answer",
    ),
    KeyRow(
        DONE_ALL,
        m.TickDone,
        "each service",
        "stream",
        _TURN,
        "lockstep: all output for a tick is published",
    ),
    KeyRow(
        WORLD,
        m.WorldModel,
        "guidance",
        "stream",
        _TURN,
        "body pose, contacts and obstacles in the world",
    ),
    KeyRow(
        TRAJECTORY, m.Trajectory, "navigation", "stream", _TURN, "path, speed, push-points ahead"
    ),
    KeyRow(
        CONTROL_STATE,
        m.ControlState,
        "control",
        "stream",
        "on a change, and 20 Hz",
        "state, reason, forces, torques",
    ),
    KeyRow(
        PARAMETERS,
        m.ParametersRequest,
        "any",
        "query",
        _ASKED,
        "other parameters for the running controller. Replies Answer",
    ),
    KeyRow(
        PARAMETERS_IN_FORCE,
        m.ControlParameters,
        "control",
        "latched",
        "on a change",
        "the controller's parameters now",
    ),
    KeyRow(
        INTENT,
        m.LocomotionIntent,
        "operator",
        "stream",
        "before the last expires",
        "the requested speed and direction",
    ),
    KeyRow(
        ALIVE_ALL,
        None,
        "each service",
        "liveliness",
        _LIVES,
        "present while the service's process is connected",
    ),
    KeyRow(
        PROCESS_ALL,
        m.ProcessInfo,
        "each process",
        "latched",
        "once",
        "its machine, version, settings, and its token",
    ),
    KeyRow(
        RECEIVED,
        m.TickDone,
        "HAL",
        "query",
        "once, at the end of a run in lockstep",
        "whether all messages of the run have arrived. Replies Answer",
    ),
    KeyRow(
        HOST_ALL,
        None,
        "HAL",
        "liveliness",
        _LIVES,
        "one for each HAL host process, and a robot must have only one",
    ),
)

ROW_AT: dict[str, KeyRow] = {row.key: row for row in SPACE if row.message is not None}


def depth_key(camera: str) -> str:
    """Return the key of the depth images of a camera."""
    return f"sensor/depth/{camera}"


def color_key(camera: str) -> str:
    """Return the key of the color images of a camera."""
    return f"sensor/color/{camera}"


def ranges_key(sensor: str) -> str:
    """Return the key of a lidar or a range finder."""
    return f"sensor/range/{sensor}"


def custom_key(sensor: str) -> str:
    """Return the key of a custom sensor."""
    return f"sensor/custom/{sensor}"


def preview_key(image_key: str) -> str:
    """Return the key of the preview of an image: `sensor/depth/head` -> `preview/depth/head`."""
    return f"preview/{image_key.partition('/')[2]}"


def done_key(service: str) -> str:
    """Return the key on which `service` reports a lockstep tick as done."""
    return f"hal/done/{service}"


def fault_key(part: str) -> str:
    """Return the key on which a part of a run receives requests for fault injection."""
    return f"fault/{part}"


def alive_key(service: str) -> str:
    """Return the liveliness key of `service`."""
    return f"alive/{service}"


def host_key(host_id: str) -> str:
    """Return the liveliness key of one host process."""
    return f"hal/host/{host_id}"


def process_key(name: str, process_id: str) -> str:
    """Return the key of one process, and of its liveliness token."""
    return f"process/{name}-{process_id}"


def parse_service(key: str) -> str:
    """Return the service that a done or alive key names."""
    return key.rpartition("/")[2]


def find_row(key: str) -> KeyRow | None:
    """Return the line of the key space that a key with a message belongs to; None for other keys."""
    row = ROW_AT.get(key)
    if row is not None:
        return row
    start, _, name = key.rpartition("/")
    if not name:
        return None
    return ROW_AT.get(f"{start}/*")


def find_row_key(key: str) -> str:
    """Return the key or pattern of the line of the key space that a key belongs to; empty for other keys."""
    row = find_row(key)
    return "" if row is None else row.key


def find_message(key: str) -> type[m.Message] | None:
    """Return the message at `key`, or None when the key space has no such key."""
    row = find_row(key)
    return None if row is None else row.message


def split_namespace(full_key: str) -> tuple[str, str] | None:
    """Split a key seen from outside a namespace: `lab/planar13/sensor/joints` -> (`lab/planar13`, `sensor/joints`)."""
    parts = full_key.split("/")
    for cut in range(1, len(parts)):
        relative = "/".join(parts[cut:])
        is_token = parts[cut:-1] in (["alive"], ["hal", "host"])
        if is_token or find_message(relative) is not None:
            return "/".join(parts[:cut]), relative
    return None
