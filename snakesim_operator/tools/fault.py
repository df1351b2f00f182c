"""`snakesim fault`: let something go wrong in a run that allows it, and end it again."""

from dataclasses import dataclass
from math import inf

from snakesim_hal.errors import ConfigError, NotConnectedError, RefusedError
from snakesim_hal.model.injection import Injection, checked, explain
from snakesim_hal.network.session import open_session
from snakesim_hal.terminal import Say, say
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import FaultRequest
from snakesim_operator.tools.command import ANSWER_S
from snakesim_operator.tools.targets import CONNECT_S, Where, the_one

LIST = "list"


@dataclass(frozen=True)
class FaultOrder:
    """What the command line asks for."""

    kind: str
    target: str | None = None
    for_s: float | None = None
    amount: float | None = None
    end: bool = False


def fault(order: FaultOrder, where: Where, say: Say = say) -> int:
    """Ask the part that can do it. Raises RefusedError when it says no, NotConnectedError when nobody answers."""
    if order.kind == LIST and order.target is None:
        for line in explain().splitlines():
            say(line)
        return 0
    if order.target is None:
        raise ConfigError(f"fault {order.kind}: name what it happens to, such as joint_3; `snakesim fault list` helps")
    injection = checked(Injection(order.kind, order.target, amount=order.amount), f"{order.kind} {order.target}")
    if order.for_s is not None and not 0.0 < order.for_s < inf:
        raise ConfigError(f"--for {order.for_s:g}: give more than 0 s")
    if injection.about.once and (order.end or order.for_s is not None):
        raise ConfigError(f"{order.kind} happens once and has no end; leave out --for and --end")
    request = FaultRequest(kind=order.kind, target=order.target, for_s=order.for_s, amount=order.amount, end=order.end)
    with open_session(the_one(where, f"fault {order.kind} {order.target}"), CONNECT_S) as session:
        try:
            answer = session.ask(keys.fault(injection.part), request, ANSWER_S)
        except NotConnectedError:
            raise NotConnectedError(
                f"{injection.part} does not answer, and only it can {order.kind} {order.target}; `snakesim status` "
                f"shows who is alive"
            ) from None
    if not answer.ok:
        raise RefusedError(f"not done: {answer.reason}")
    say(answer.reason)
    return 0
