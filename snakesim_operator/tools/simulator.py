"""`snakesim sim`: pause, step, speed and reset of a simulator. A robot that moves something real refuses."""

from snakesim_hal.network.session import open_session
from snakesim_hal.process import user_name
from snakesim_hal.terminal import Say, say
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import SimulatorRequest
from snakesim_operator.tools.command import ask_host
from snakesim_operator.tools.simulator_order import SimulatorOrder
from snakesim_operator.tools.targets import CONNECT_S, RobotSelection, only_robot

DONE = {"pause": "paused", "resume": "resumed", "step": "stepped", "speed": "changed", "reset": "reset"}


def simulator(order: SimulatorOrder, where: RobotSelection, say: Say = say) -> int:
    """Ask for it. Raises RefusedError with the reason, NotConnectedError without an answer."""
    link = only_robot(where, f"sim {order}")
    request = SimulatorRequest(action=order.action, who=order.who or user_name(), ticks=order.ticks, speed=order.speed)
    with open_session(link, CONNECT_S) as session:
        return ask_host(session, keys.SIMULATOR, request, DONE[order.action], link, say)
