"""The loop of a service publishes what it waits for, and answers ticks when it has all inputs."""

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


class UndemandingService(Service):
    """A service that reads joint states, but does not need them."""

    name = "navigation"

    def __init__(self, client: Any, config: Any) -> None:
        self.client = client
        self.joints = client.subscribe(keys.JOINTS, JointState)

    def configure(self, robot: RobotDescription) -> None: ...

    def outputs(self, clock: Clock) -> list[tuple[str, Message]]:
        self.client.read(self.joints)
        return []


def test_service_waits_for_joint_states_before_it_answers_ticks() -> None:
    network = LocalNetwork()
    hal = network.create_session()
    hal.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(ROBOT)
    clock_publisher = hal.declare_publisher(keys.CLOCK, Clock)
    joint_publisher = hal.declare_publisher(keys.JOINTS, JointState)
    done_reader = hal.declare_reader(keys.done_key("navigation"), TickDone)
    loop = ServiceLoop(
        UndemandingService, make_run_config(clock_mode=CLOCK.clock_mode), network.create_session()
    )
    clock_publisher.put(CLOCK)
    loop.connect()
    process_reader = hal.declare_latched_reader(keys.PROCESS_ALL, ProcessInfo)
    loop.step()
    assert done_reader.drain() == []
    assert process_reader.drain()[-1].waits_for == [keys.JOINTS]
    joint_publisher.put(make_joint_state(ROBOT, 0.1, tick=CLOCK.tick))
    clock_publisher.put(CLOCK)
    loop.step()
    assert [answer.tick for answer in done_reader.drain()] == [CLOCK.tick]
    assert process_reader.drain()[-1].waits_for == []
    loop.close()
