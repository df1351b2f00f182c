"""A camera's images behind a lab's router, over the connection of their own."""

import json
import time

import msgspec

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.session_file import read_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import DepthImage
from snakesim_hal.wire.roles import Role
from snakesim_testing.hal.strategies import make_plain_example
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.lab.small_lab import OWN_ROBOT, RunningLab

KEY = keys.depth_key("head")
# The largest that a robot may have: it is sent in many pieces, each of which waits for the one before it.
SIZE = {"width": 1280, "height": 960, "depth": bytes(2 * 1280 * 960)}
IMAGE = msgspec.convert({**make_plain_example(DepthImage), **SIZE, "tick": 1}, DepthImage)


def link(lab: RunningLab, role: Role) -> ConnectionSettings:
    """As a rendered session file says; only the router that runs."""
    identity = lab.find_identity_by_role(role, OWN_ROBOT)
    path = lab.folder / f"{identity.common_name}.json5"
    path.write_text(json.dumps(lab.make_session_settings(identity, namespace=OWN_ROBOT)))
    return ConnectionSettings.from_session_file(read_session(path), OWN_ROBOT)


def test_the_largest_image_arrives_and_a_viewer_can_send_none(lab: RunningLab) -> None:
    viewer_link, robot_link = link(lab, Role.VIEWER), link(lab, Role.ROBOT)
    with open_session(viewer_link) as viewer, open_session(robot_link) as robot:
        reader, found = viewer.declare_reader(KEY, DepthImage), list[DepthImage]()
        robots, viewers = (
            robot.declare_publisher(KEY, DepthImage),
            viewer.declare_publisher(KEY, DepthImage),
        )
        wait_until(robots.has_subscriber, "the viewer subscribes")
        viewers.put(msgspec.structs.replace(IMAGE, tick=2))

        def arrived() -> bool:
            robots.put(IMAGE)  # one that a busy router drops is not sent again
            time.sleep(0.1)
            found.extend(reader.drain())
            return bool(found)

        wait_until(arrived, "the image")
        assert {image.tick for image in found} == {1}
        assert found[0].depth == IMAGE.depth
