"""The loop around a service: when it says that it is there, and what it waits for."""

from typing import Any

from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.service import Service, ServiceLoop
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    JointState,
    Message,
    ProcessInfo,
    RobotDescription,
    TickDone,
)
from snakesim_testing.hal.foreign_samples import CLOCK, ROBOT
from snakesim_testing.hal.small_robots import make_joint_state, make_run_config


class Undemanding(Service):
    """Answers whether it has joints or not."""

    name = "navigation"

    def __init__(self, client: Any, config: Any) -> None:
        self.client, self.joints = client, client.subscribe(keys.JOINTS, JointState)

    def configure(self, robot: RobotDescription) -> None: ...

    def outputs(self, clock: Clock) -> list[tuple[str, Message]]:
        self.client.read(self.joints)
        return []


def test_service_waits_for_the_joints_before_it_answers_ticks() -> None:
    network = LocalNetwork()
    hal = network.create_session()
    hal.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(ROBOT)
    clocks, felt = (
        hal.declare_publisher(keys.CLOCK, Clock),
        hal.declare_publisher(keys.JOINTS, JointState),
    )
    done = hal.declare_reader(keys.done_key("navigation"), TickDone)
    loop = ServiceLoop(
        Undemanding, make_run_config(clock_mode=CLOCK.clock_mode), network.create_session()
    )
    clocks.put(CLOCK)
    loop.connect()
    entries = hal.declare_latched_reader(keys.PROCESS_ALL, ProcessInfo)
    loop.step()
    assert done.drain() == []
    assert entries.drain()[-1].waits_for == [keys.JOINTS]
    felt.put(make_joint_state(ROBOT, 0.1, tick=CLOCK.tick))
    clocks.put(CLOCK)
    loop.step()
    assert [one.tick for one in done.drain()] == [CLOCK.tick]
    assert entries.drain()[-1].waits_for == []
    loop.close()
