"""Compares keys, tokens and attachments with the design document of rmw_zenoh and with Zenoh's own serializer."""

import zenoh
from zenoh import ext  # pyright: ignore[reportMissingModuleSource]

from snakesim_operator.features.ros2 import graph, messages
from snakesim_operator.features.ros2.graph import NodeName, RosTopic, make_token, make_topic_key

# From docs/design.md of ros2/rmw_zenoh.
LISTENER_TOKEN = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
TALKER_TOKEN = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
)
CHATTER = RosTopic("/chatter", messages.STRING, depth=7)


def test_ros_keys_and_tokens_equal_those_of_the_design_document() -> None:
    assert (
        make_token(2, "aac3178e146ba6f1fc6e6a4085e77f21", 0, graph.NODE, NodeName("listener"))
        == LISTENER_TOKEN
    )
    assert (
        make_token(
            2, "8b20917502ee955ac4476e0266340d5c", 10, graph.PUBLISHER, NodeName("talker"), CHATTER
        )
        == TALKER_TOKEN
    )
    assert (
        make_topic_key(2, CHATTER)
        == f"2/chatter/std_msgs::msg::dds_::String_/{messages.STRING.type_hash}"
    )


def test_ros_token_contains_namespace_and_quality_of_service() -> None:
    topic = RosTopic(
        "/lab/planar13/tf", messages.TRANSFORMS, depth=1, best_effort=True, latched=True
    )
    token = make_token(
        0, "abc", 3, graph.SUBSCRIPTION, NodeName("snakesim", "/lab/planar13"), topic
    )
    assert "/MS/%/%lab%planar13/snakesim/%lab%planar13%tf/" in token
    assert token.endswith("/2:1:,1:,:,:,,")
    assert make_topic_key(0, topic).startswith("0/lab/planar13/tf/")
    zenoh.KeyExpr(token)  # raises an error if the token is no valid key


def test_ros_attachment_equals_that_of_zenoh_serializer() -> None:
    gid = graph.compute_gid(TALKER_TOKEN)
    expected = ext.z_serialize((ext.Int64(7), ext.Int64(1_700_000_000_123_456_789), gid))
    assert graph.make_attachment(7, 1_700_000_000_123_456_789, gid) == bytes(expected)
    assert len(gid) == 16
    assert len(bytes(expected)) == 33
