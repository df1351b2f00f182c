"""The key space, relative to the robot's Zenoh namespace. Keys are built and parsed here and nowhere else."""

from dataclasses import dataclass

from snakesim_hal import messages as m

JOINTS = "sensor/joints"
CONTACTS = "sensor/contacts"
IMU = "sensor/imu"
POSE = "sensor/pose"
POWER = "sensor/power"
JOINT_COMMAND = "actuator/joints"
DESCRIPTION = "hal/description"
STATUS = "hal/status"
CLOCK = "hal/clock"
APPLIED = "hal/applied"
LEASE = "hal/lease"
LIFECYCLE = "hal/lifecycle"
ESTOP = "hal/estop"
FAULT_ALL = "fault/*"
DONE_ALL = "hal/done/*"
WORLD = "guidance/world"
TRAJECTORY = "navigation/trajectory"
CONTROL_STATE = "control/state"
INTENT = "operator/intent"
ALIVE_ALL = "alive/*"


@dataclass(frozen=True)
class Row:
    """One line of the key space: what stands at a key, who writes it, and how."""

    key: str
    message: type[m.Message] | None
    writer: str
    kind: str  # stream, latched, query, liveliness
    about: str


SPACE: tuple[Row, ...] = (
    Row(JOINTS, m.JointState, "HAL", "stream", "angle, velocity, torque of every joint"),
    Row(CONTACTS, m.Contacts, "HAL", "stream", "every touch of a link by an obstacle"),
    Row(IMU, m.Imu, "HAL", "stream", "angular velocity and acceleration of the links"),
    Row(POSE, m.Pose, "HAL", "stream", "base pose as a motion-capture system gives it"),
    Row(POWER, m.Power, "HAL", "stream", "supply, temperatures and leaks of the joint modules"),
    Row(JOINT_COMMAND, m.JointCommand, "lease holder", "stream", "mode and set-point of every joint"),
    Row(DESCRIPTION, m.Description, "HAL", "latched", "joints, order, limits, geometry, sensors"),
    Row(STATUS, m.Status, "HAL", "latched", "lifecycle and why, lease holder, faults, counters"),
    Row(CLOCK, m.Clock, "HAL", "stream", "tick, time, and what is newest at each key"),
    Row(APPLIED, m.AppliedCommand, "HAL", "stream", "what went to the motors, and what was limited"),
    Row(LEASE, m.LeaseRequest, "any", "query", "acquire, renew, release the right to command; replies Answer"),
    Row(LIFECYCLE, m.LifecycleRequest, "any", "query", "arm, disarm, clear, finish; replies Answer"),
    Row(ESTOP, m.EstopRequest, "any", "query", "stop now, needs no lease, latched; replies Answer"),
    Row(FAULT_ALL, m.FaultRequest, "any", "query", "let something go wrong, where that is allowed; replies Answer"),
    Row(DONE_ALL, m.Done, "each service", "stream", "lockstep: all that is owed for a tick is published"),
    Row(WORLD, m.World, "guidance", "stream", "body pose, contacts and obstacles in the world"),
    Row(TRAJECTORY, m.Trajectory, "navigation", "stream", "path, speed, push-points ahead"),
    Row(CONTROL_STATE, m.ControlState, "control", "stream", "state, push-points, forces, torques, and why"),
    Row(INTENT, m.Intent, "operator", "stream", "what a person or a mission wants"),
    Row(ALIVE_ALL, None, "each service", "liveliness", "present while the service's process is connected"),
)

MESSAGE_AT: dict[str, type[m.Message]] = {row.key: row.message for row in SPACE if row.message is not None}


def done(service: str) -> str:
    """Key on which `service` reports a lockstep tick as done."""
    return f"hal/done/{service}"


def fault(part: str) -> str:
    """Key on which a part of a run takes requests for faults."""
    return f"fault/{part}"


def alive(service: str) -> str:
    """Liveliness key of `service`."""
    return f"alive/{service}"


def service_of(key: str) -> str:
    """The service that a done or alive key names."""
    return key.rpartition("/")[2]


def message_at(key: str) -> type[m.Message] | None:
    """The message that stands at `key`, or None when the key space has no such key."""
    if key in MESSAGE_AT:
        return MESSAGE_AT[key]
    if key.startswith("hal/done/") and key.count("/") == 2:
        return m.Done
    if key.startswith("fault/") and key.count("/") == 1:
        return m.FaultRequest
    return None


def split_namespace(full_key: str) -> tuple[str, str] | None:
    """Split a key seen from outside a namespace: `lab/planar13/sensor/joints` -> (`lab/planar13`, `sensor/joints`)."""
    parts = full_key.split("/")
    for cut in range(1, len(parts)):
        relative = "/".join(parts[cut:])
        if message_at(relative) is not None or (parts[cut] == "alive" and len(parts) == cut + 2):
            return "/".join(parts[:cut]), relative
    return None
