"""Defines the ROS services that the bridge answers: definitions, type hashes, and CDR both ways.

rosbags knows only messages. A service is a type with a request, a response and an event (REP 2016), so it is
registered as messages of those names. A test compares the hashes with hashes that ROS itself has printed.
"""

from dataclasses import dataclass
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg

from snakesim_operator.features.ros2.graph import RosType
from snakesim_operator.features.ros2.messages import TYPE_STORE, make_message

# ROS turns char into uint8 before it hashes a definition, and rosbags does not. So the definition uses uint8.
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_EVENT_INFO_FIELDS = (
    "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number"
)
TYPE_STORE.fielddefs[_EVENT_INFO] = get_types_from_msg(_EVENT_INFO_FIELDS, _EVENT_INFO)[_EVENT_INFO]

# What ROS puts into a message without fields.
EMPTY_DEFINITION = "uint8 structure_needs_at_least_one_member"
_PARAMETER_VALUES = "rcl_interfaces/msg/ParameterValue[] values"


@dataclass(frozen=True)
class RosService:
    """A type of service: it decodes requests and encodes responses."""

    type: RosType

    def decode_request(self, payload: bytes) -> Any | None:
        """Return a request, or None if the payload is none of this type."""
        try:
            return TYPE_STORE.deserialize_cdr(payload, f"{self.type.name}_Request")
        except SerdeError:
            return None

    def encode_response(self, *fields: Any) -> bytes:
        """Return a response in CDR with these fields, in the order of their definition."""
        name = f"{self.type.name}_Response"
        response = make_message(name, *fields)
        return bytes(TYPE_STORE.serialize_cdr(response, name))


def define_service(name: str, request: str, response: str) -> RosService:
    """Register a ROS service type with its request, response and event, and return it with its type hash.

    Args:
        name: Name of the type, such as std_srvs/srv/Trigger.
        request: Definition of the request's fields.
        response: Definition of the response's fields.
    """
    event = f"{_EVENT_INFO} info\n{name}_Request[<=1] request\n{name}_Response[<=1] response"
    service = f"{name}_Request request_message\n{name}_Response response_message\n{name}_Event event_message"
    definitions = {
        f"{name}_Request": request,
        f"{name}_Response": response,
        f"{name}_Event": event,
        name: service,
    }
    types: dict[str, Any] = {}
    for type_name, fields in definitions.items():
        types |= _restore_service_names(get_types_from_msg(fields, type_name))
    TYPE_STORE.register(types)
    return RosService(RosType(name, TYPE_STORE.hash_rihs01(name)))


def _restore_service_names(definition: Any) -> Any:
    """Undo, in a nested definition, the renaming of service types into message types that rosbags does."""
    if isinstance(definition, str):
        return definition.replace("/srv/msg/", "/srv/")
    if isinstance(definition, dict):
        restored: dict[Any, Any] = {}
        for key, value in definition.items():
            restored[_restore_service_names(key)] = _restore_service_names(value)
        return restored
    if isinstance(definition, tuple | list):
        return type(definition)(map(_restore_service_names, definition))
    return definition


def _define_parameter_service(name: str, request: str, response: str) -> RosService:
    return define_service(f"rcl_interfaces/srv/{name}", request, response)


TRIGGER = define_service("std_srvs/srv/Trigger", EMPTY_DEFINITION, "bool success\nstring message")
LIST_PARAMETERS = _define_parameter_service(
    "ListParameters",
    "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth",
    "rcl_interfaces/msg/ListParametersResult result",
)
GET_PARAMETERS = _define_parameter_service("GetParameters", "string[] names", _PARAMETER_VALUES)
GET_PARAMETER_TYPES = _define_parameter_service(
    "GetParameterTypes", "string[] names", "uint8[] types"
)
DESCRIBE_PARAMETERS = _define_parameter_service(
    "DescribeParameters", "string[] names", "rcl_interfaces/msg/ParameterDescriptor[] descriptors"
)
SET_PARAMETERS = _define_parameter_service(
    "SetParameters",
    "rcl_interfaces/msg/Parameter[] parameters",
    "rcl_interfaces/msg/SetParametersResult[] results",
)
SET_PARAMETERS_ATOMICALLY = _define_parameter_service(
    "SetParametersAtomically",
    "rcl_interfaces/msg/Parameter[] parameters",
    "rcl_interfaces/msg/SetParametersResult result",
)
