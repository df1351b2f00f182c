"""What guidance perceives is drawn about where it believes it to be, beside the truth."""

from snakesim_hal.wire.messages import Obstacle, World
from snakesim_operator.console.drawing import draw
from snakesim_operator.console.port import open_port
from snakesim_operator.console.server import page_server
from snakesim_operator.console.snapshot import RobotSnapshot
from snakesim_operator.console.stage import Stage
from tests.unit.hal.rig import description
from tests.unit.operator.console.test_drawing import joints


def test_every_shape_that_is_perceived_is_drawn_and_goes_when_it_is_forgotten():
    found = [
        Obstacle(name="a", shape="sphere", position_w=(1.0, 0.0, 0.0), radius_m=0.1, felt=True),
        Obstacle(name="b", shape="cylinder", position_w=(2.0, 0.0, 0.0), radius_m=0.1, height_m=0.2, felt=True),
        Obstacle(name="c", shape="box", position_w=(3.0, 0.0, 0.0), half_size_m=(0.1, 0.2, 0.3), felt=True),
    ]
    with page_server(open_port(None)) as (server, _):
        stage = Stage(server.scene, description(), None)
        for obstacles in (found, []):
            world = World(
                tick=1, stamp_ns=1, base_position_w=(0.0, 0.0, 0.0), base_orientation_wxyz=(1.0, 0.0, 0.0, 0.0),
                base_confidence=1.0, contacts=[], obstacles=obstacles,
            )  # fmt: skip
            drawing = draw(RobotSnapshot(robot=description(), body=joints(), world=world), None)
            assert drawing is not None
            stage.show(drawing)
            shown = [batch for name, batch in stage._shapes.items() if name.startswith("perceived")]
            assert [batch.visible for batch in shown] == [bool(obstacles)] * 3
            assert sorted(float(batch.batched_positions[0, 0]) for batch in shown) == [1.0, 2.0, 3.0]
