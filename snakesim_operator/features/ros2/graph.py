"""rmw_zenoh's graph: keys of topics, liveliness tokens of nodes and endpoints, and the attachment of each sample.

Source: docs/design.md, liveliness_utils.cpp and attachment_helpers.cpp of ros2/rmw_zenoh. The formats are those of
Kilted and Rolling, and of Jazzy from rmw_zenoh_cpp 0.2.4 on; earlier versions used another attachment.
"""

import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

from snakesim_hal.network.foreign_network import (
    ForeignNetwork,
    RawPublisher,
    RawQueryable,
    RawReader,
)

# Kinds of entities in liveliness tokens.
NODE = "NN"
PUBLISHER = "MP"
SUBSCRIPTION = "MS"
SERVER = "SS"

# Quality of service as rmw_qos_profile_t numbers it; defaults are left out of a token.
BEST_EFFORT = 2
TRANSIENT_LOCAL = 1

NODE_ID = 0  # a process of this bridge has a single node
GID_BYTES = 16
# Sequence, sender's wall clock in ns, length of the GID, sender's GID.
ATTACHMENT = struct.Struct("<qqB16s")


@dataclass(frozen=True)
class RosType:
    """A ROS message type, and the hash of its definition (REP 2016)."""

    name: str  # such as std_msgs/msg/String
    type_hash: str  # as rmw_zenoh writes it: RIHS01_ and 64 digits

    @property
    def dds_name(self) -> str:
        """Return the name as rmw_zenoh writes it, such as `std_msgs::msg::dds_::String_`."""
        package, kind, name = self.name.split("/")
        return f"{package}::{kind}::dds_::{name}_"


@dataclass(frozen=True)
class RosTopic:
    """A topic, or a service, and its quality of service."""

    name: str  # with its namespace, such as /planar13/joint_states
    type: RosType
    depth: int = 10
    best_effort: bool = False
    latched: bool = False  # ROS: transient local
    images: bool = False  # large, and less urgent than everything else

    @property
    def qos(self) -> str:
        """Return reliability, durability, history and depth as a token has them; the rest is the default."""
        reliability = ""
        if self.best_effort:
            reliability = str(BEST_EFFORT)
        durability = ""
        if self.latched:
            durability = str(TRANSIENT_LOCAL)
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


@dataclass(frozen=True)
class NodeName:
    """A ROS node: its name, and its namespace with a leading slash."""

    name: str
    namespace: str = "/"


def make_topic_key(domain: int, topic: RosTopic) -> str:
    """Return the Zenoh key of a topic's samples."""
    return f"{domain}/{topic.name.strip('/')}/{topic.type.dds_name}/{topic.type.type_hash}"


def make_token(
    domain: int,
    zenoh_id: str,
    entity: int,
    kind: str,
    node: NodeName,
    topic: RosTopic | None = None,
) -> str:
    """Return the liveliness token of a node (without a topic) or of one of its endpoints."""
    security_enclave = _escape_slashes("/")
    node_names = f"{security_enclave}/{_escape_slashes(node.namespace)}/{node.name}"
    token = f"@ros2_lv/{domain}/{zenoh_id}/{NODE_ID}/{entity}/{kind}/{node_names}"
    if topic is None:
        return token
    return f"{token}/{_escape_slashes(topic.name)}/{topic.type.dds_name}/{topic.type.type_hash}/{topic.qos}"


def _escape_slashes(name: str) -> str:
    return name.replace("/", "%")


def make_attachment(sequence: int, timestamp_ns: int, gid: bytes) -> bytes:
    """Return the attachment of one sample.

    Args:
        sequence: Number of the sample at its publisher.
        timestamp_ns: Wall clock of the sender.
        gid: Identity of the publisher, GID_BYTES long.
    """
    return ATTACHMENT.pack(sequence, timestamp_ns, GID_BYTES, gid)


def make_reply_attachment(request: bytes) -> bytes | None:
    """Return the attachment of the reply to a request: same sequence and sender, and the present time.

    Args:
        request: The attachment of the request.

    Returns:
        The attachment of the reply, or None if that of the request is malformed.
    """
    if len(request) != ATTACHMENT.size:
        return None
    sequence, _, gid_bytes, gid = ATTACHMENT.unpack(request)
    if gid_bytes != GID_BYTES or sequence < 0:
        return None
    return make_attachment(sequence, time.time_ns(), gid)


def compute_gid(token: str) -> bytes:
    """Return the identity of an endpoint: the 128 bits of XXH3 over its liveliness token, low half first."""
    import xxhash  # here, because it comes with the extra `ros2`

    return xxhash.xxh3_128(token).intdigest().to_bytes(GID_BYTES, "little")


class RosPublisher:
    """Publishes messages on one topic, each with the attachment that ROS subscribers expect."""

    def __init__(self, publisher: RawPublisher, token: str) -> None:
        self._publisher = publisher
        self._gid = compute_gid(token)
        self._sequence = count(1)
        self.has_subscribers = publisher.has_subscriber

    def publish(self, message: bytes) -> None:
        """Send a message in CDR."""
        attachment = make_attachment(next(self._sequence), time.time_ns(), self._gid)
        self._publisher.send(message, attachment)


class RosNode:
    """A node in the ROS graph, present for as long as its session is open."""

    def __init__(self, foreign_network: ForeignNetwork, domain: int, name: NodeName) -> None:
        self._network = foreign_network
        self._domain = domain
        self._name = name
        self._entities: Iterator[int] = count(NODE_ID)  # numbers of the node and its endpoints
        foreign_network.declare_token(self._make_next_token(NODE))

    def declare_publisher(self, topic: RosTopic) -> RosPublisher:
        """Declare a publisher, which `ros2 topic info` then shows."""
        key = make_topic_key(self._domain, topic)
        publisher = self._network.declare_publisher(
            key, latched=topic.latched, background=topic.images
        )
        token = self._make_next_token(PUBLISHER, topic)
        self._network.declare_token(token)
        return RosPublisher(publisher, token)

    def declare_subscription(self, topic: RosTopic) -> RawReader:
        """Subscribe to a topic.

        Returns:
            A reader that keeps the newest messages in CDR with their attachments, as many as the topic's depth.
        """
        reader = self._network.declare_reader(make_topic_key(self._domain, topic), topic.depth)
        self._network.declare_token(self._make_next_token(SUBSCRIPTION, topic))
        return reader

    def declare_service(self, service: RosTopic) -> RawQueryable:
        """Offer a service, which `ros2 service list` then shows, and return the queue of its requests in CDR."""
        queryable = self._network.declare_queryable(make_topic_key(self._domain, service))
        self._network.declare_token(self._make_next_token(SERVER, service))
        return queryable

    def _make_next_token(self, kind: str, topic: RosTopic | None = None) -> str:
        """Return the liveliness token of the next entity of this node."""
        return make_token(
            self._domain, self._network.id, next(self._entities), kind, self._name, topic
        )
