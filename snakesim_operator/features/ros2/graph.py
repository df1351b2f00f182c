"""rmw_zenoh's graph: keys of topics, liveliness tokens of nodes and endpoints, and the attachment of each sample.

Source: docs/design.md, liveliness_utils.cpp and attachment_helpers.cpp of ros2/rmw_zenoh. As in Kilted and Rolling, and
in Jazzy from rmw_zenoh_cpp 0.2.4 on; earlier ones had another attachment.
"""

import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

from snakesim_hal.network.foreign_network import ForeignNetwork, RawPublisher, RawQueryable, RawReader

NODE, PUBLISHER, SUBSCRIPTION, SERVER = "NN", "MP", "MS", "SS"
NODE_ID = 0
BEST_EFFORT, TRANSIENT_LOCAL = 2, 1  # as rmw_qos_profile_t numbers them; the defaults are left out
GID_BYTES = 16
ATTACHED = struct.Struct("<qqB16s")  # sequence, wall clock of the sender, length of what follows, the sender


@dataclass(frozen=True)
class RosType:
    """A ROS message type, and the hash of its definition (REP 2016)."""

    name: str  # such as std_msgs/msg/String
    type_hash: str  # as rmw_zenoh writes it: RIHS01_ and 64 digits

    @property
    def dds_name(self) -> str:
        """As rmw_zenoh writes it, such as `std_msgs::msg::dds_::String_`."""
        package, kind, name = self.name.split("/")
        return f"{package}::{kind}::dds_::{name}_"


@dataclass(frozen=True)
class Topic:
    """A topic, or a service, and its quality of service."""

    name: str  # with its namespace, such as /planar13/joint_states
    type: RosType
    depth: int = 10
    best_effort: bool = False
    latched: bool = False  # ROS: transient local
    images: bool = False  # large, and less urgent than everything else

    @property
    def qos(self) -> str:
        """Reliability, durability, history and depth; the rest is the default."""
        reliability = str(BEST_EFFORT) if self.best_effort else ""
        durability = str(TRANSIENT_LOCAL) if self.latched else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


def topic_key(domain: int, topic: Topic) -> str:
    """Zenoh key of a topic's samples."""
    return f"{domain}/{topic.name.strip('/')}/{topic.type.dds_name}/{topic.type.type_hash}"


def token_key(domain: int, zenoh_id: str, entity: int, kind: str, node: "NodeName", topic: Topic | None = None) -> str:
    """Liveliness token of a node (topic is None) or of one of its endpoints."""
    names = f"{_flat('/')}/{_flat(node.namespace)}/{node.name}"  # the first is the security enclave
    ends = "" if topic is None else f"/{_flat(topic.name)}/{topic.type.dds_name}/{topic.type.type_hash}/{topic.qos}"
    return f"@ros2_lv/{domain}/{zenoh_id}/{NODE_ID}/{entity}/{kind}/{names}{ends}"


def _flat(name: str) -> str:
    return name.replace("/", "%")


@dataclass(frozen=True)
class NodeName:
    """A ROS node: its name, and its namespace with a leading slash."""

    name: str
    namespace: str = "/"


def attachment(sequence: int, timestamp_ns: int, gid: bytes) -> bytes:
    """Of one sample. timestamp_ns: wall clock of the sender; gid: of the publisher, GID_BYTES long."""
    return ATTACHED.pack(sequence, timestamp_ns, GID_BYTES, gid)


def answering(request: bytes) -> bytes | None:
    """Attachment of the reply to a request with this one: the same sequence and sender; None: it has none to read."""
    if len(request) != ATTACHED.size:
        return None
    sequence, _, length, gid = ATTACHED.unpack(request)
    return None if length != GID_BYTES or sequence < 0 else attachment(sequence, time.time_ns(), gid)


def gid_of(token: str) -> bytes:
    """Identity of an endpoint: the 128 bits of XXH3 over its liveliness token, low half first."""
    import xxhash  # here, because it comes with the extra `ros2`

    return xxhash.xxh3_128(token).intdigest().to_bytes(GID_BYTES, "little")


class RosPublisher:
    """Publishes on one topic."""

    def __init__(self, publisher: RawPublisher, token: str) -> None:
        self._publisher = publisher
        self._gid = gid_of(token)
        self._sequence = count(1)
        self.heard = publisher.heard

    def put(self, message: bytes) -> None:
        """Send a message, in CDR."""
        self._publisher.put(message, attachment(next(self._sequence), time.time_ns(), self._gid))


class Node:
    """A node in the ROS graph, present as long as the session."""

    def __init__(self, foreign_network: ForeignNetwork, domain: int, name: NodeName) -> None:
        self._network, self._domain, self._name = foreign_network, domain, name
        self._entities: Iterator[int] = count(NODE_ID)
        foreign_network.declare_token(self._token(NODE))

    def publisher(self, topic: Topic) -> RosPublisher:
        """A publisher that `ros2 topic info` shows."""
        key = topic_key(self._domain, topic)
        publisher = self._network.publisher(key, latched=topic.latched, background=topic.images)
        token = self._token(PUBLISHER, topic)
        self._network.declare_token(token)
        return RosPublisher(publisher, token)

    def subscription(self, topic: Topic) -> RawReader:
        """The newest messages of a topic, in CDR and with what is attached, as many as its depth."""
        reader = self._network.reader(topic_key(self._domain, topic), topic.depth)
        self._network.declare_token(self._token(SUBSCRIPTION, topic))
        return reader

    def server(self, service: Topic) -> RawQueryable:
        """A service that `ros2 service list` shows: its requests, in CDR."""
        queryable = self._network.queryable(topic_key(self._domain, service))
        self._network.declare_token(self._token(SERVER, service))
        return queryable

    def _token(self, kind: str, topic: Topic | None = None) -> str:
        return token_key(self._domain, self._network.id, next(self._entities), kind, self._name, topic)
