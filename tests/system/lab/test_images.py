"""A lab's router forwards camera images from a robot to a viewer, over their own connection."""

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
# The largest image that a robot may send. Zenoh sends it in many fragments, one after the other.
MAX_SIZE = {"width": 1280, "height": 960, "depth": bytes(2 * 1280 * 960)}
IMAGE = msgspec.convert({**make_plain_example(DepthImage), **MAX_SIZE, "tick": 1}, DepthImage)


def make_connection_settings(lab: RunningLab, role: Role) -> ConnectionSettings:
    """Return the connection settings of a role's session file, with only the router that is running."""
    identity = lab.find_identity_by_role(role, OWN_ROBOT)
    path = lab.folder / f"{identity.common_name}.json5"
    path.write_text(json.dumps(lab.make_session_settings(identity, namespace=OWN_ROBOT)))
    return ConnectionSettings.from_session_file(read_session(path), OWN_ROBOT)


def test_largest_image_reaches_viewer_and_viewer_image_is_dropped(lab: RunningLab) -> None:
    viewer_settings = make_connection_settings(lab, Role.VIEWER)
    robot_settings = make_connection_settings(lab, Role.ROBOT)
    with open_session(viewer_settings) as viewer, open_session(robot_settings) as robot:
        reader = viewer.declare_reader(KEY, DepthImage)
        received = list[DepthImage]()
        robot_publisher = robot.declare_publisher(KEY, DepthImage)
        viewer_publisher = viewer.declare_publisher(KEY, DepthImage)
        wait_until(robot_publisher.has_subscriber, "the viewer subscribes")
        viewer_publisher.put(msgspec.structs.replace(IMAGE, tick=2))

        def send_and_receive() -> bool:
            robot_publisher.put(IMAGE)  # Zenoh does not repeat an image that a busy router drops.
            time.sleep(0.1)
            received.extend(reader.drain())
            return bool(received)

        wait_until(send_and_receive, "the image")
        assert {image.tick for image in received} == {1}
        assert received[0].depth == IMAGE.depth
