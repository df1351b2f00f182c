"""The ROS services that the bridge answers: their definitions, the hashes of their types, and CDR both ways.

rosbags knows messages alone. A service is a type with a request, a response and an event (REP 2016), so it is
registered as messages of those names; a test compares the hashes with ones that ROS itself has printed.
"""

from dataclasses import dataclass
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg

from snakesim_operator.features.ros2.graph import RosType
from snakesim_operator.features.ros2.messages import STORE, made

_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
# ROS makes uint8 of char before it hashes a definition, and rosbags does not.
_EVENT_INFO_HASHED = "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number"
STORE.fielddefs[_EVENT_INFO] = get_types_from_msg(_EVENT_INFO_HASHED, _EVENT_INFO)[_EVENT_INFO]

EMPTY = "uint8 structure_needs_at_least_one_member"  # what ROS puts into a message without fields
_PARAMETER_VALUES = "rcl_interfaces/msg/ParameterValue[] values"


@dataclass(frozen=True)
class Service:
    """A type of service."""

    type: RosType

    def request(self, payload: bytes) -> Any | None:
        """What is asked for; None: it is no such request."""
        try:
            return STORE.deserialize_cdr(payload, f"{self.type.name}_Request")
        except SerdeError:
            return None

    def response(self, *fields: Any) -> bytes:
        """An answer, in CDR."""
        name = f"{self.type.name}_Response"
        return bytes(STORE.serialize_cdr(made(name, *fields), name))


def service(name: str, request: str, response: str) -> Service:
    """A service by its definition. name: such as std_srvs/srv/Trigger."""
    event = f"{_EVENT_INFO} info\n{name}_Request[<=1] request\n{name}_Response[<=1] response"
    whole = f"{name}_Request request_message\n{name}_Response response_message\n{name}_Event event_message"
    defined: dict[str, Any] = {}
    for text, suffix in ((request, "_Request"), (response, "_Response"), (event, "_Event"), (whole, "")):
        defined |= _as_services(get_types_from_msg(text, f"{name}{suffix}"))
    STORE.register(defined)
    return Service(RosType(name, STORE.hash_rihs01(name)))


def _as_services(part: Any) -> Any:
    """Undo rosbags' renaming of every type into a message."""
    if isinstance(part, str):
        return part.replace("/srv/msg/", "/srv/")
    if isinstance(part, dict):
        return {_as_services(key): _as_services(value) for key, value in part.items()}
    return type(part)(map(_as_services, part)) if isinstance(part, tuple | list) else part


def _of_parameters(name: str, request: str, response: str) -> Service:
    return service(f"rcl_interfaces/srv/{name}", request, response)


TRIGGER = service("std_srvs/srv/Trigger", EMPTY, "bool success\nstring message")
LIST_PARAMETERS = _of_parameters(
    "ListParameters",
    "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth",
    "rcl_interfaces/msg/ListParametersResult result",
)
GET_PARAMETERS = _of_parameters("GetParameters", "string[] names", _PARAMETER_VALUES)
GET_PARAMETER_TYPES = _of_parameters("GetParameterTypes", "string[] names", "uint8[] types")
DESCRIBE_PARAMETERS = _of_parameters(
    "DescribeParameters", "string[] names", "rcl_interfaces/msg/ParameterDescriptor[] descriptors"
)
SET_PARAMETERS = _of_parameters(
    "SetParameters",
    "rcl_interfaces/msg/Parameter[] parameters",
    "rcl_interfaces/msg/SetParametersResult[] results",
)
SET_PARAMETERS_ATOMICALLY = _of_parameters(
    "SetParametersAtomically",
    "rcl_interfaces/msg/Parameter[] parameters",
    "rcl_interfaces/msg/SetParametersResult result",
)
