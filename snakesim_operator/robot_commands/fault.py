"""`snakesim fault`: explain the kinds of faults, inject one into a run that allows it, and end it."""

from dataclasses import dataclass
from math import inf

from snakesim_hal.base.errors import ConfigError, NotConnectedError, RefusedError, shorten, suggest_word
from snakesim_hal.base.terminal import PrintLine, print_json, print_line
from snakesim_hal.model.fault_kinds import KINDS, Injection, check_injection, explain_kinds
from snakesim_hal.network.session import open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import FaultRequest
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.robot_commands.command import ANSWER_S


@dataclass(frozen=True)
class FaultOrder:
    """The command's options."""

    kind: str
    target: str
    for_s: float | None = None
    amount: float | None = None
    end: bool = False


def list_faults(*, as_json: bool) -> int:
    """Explain every kind of fault."""
    if as_json:
        kinds = [
            {"kind": name, "target": target, "about": kind.about}
            for target, kinds_of_target in KINDS.items()
            for name, kind in kinds_of_target.items()
        ]
        print_json({"kinds": kinds})
        return 0
    for line in explain_kinds().splitlines():
        print_line(line)
    return 0


def inject_fault(order: FaultOrder, where: RobotSelection, print_line: PrintLine = print_line) -> int:
    """Send the request to the responsible part. Raises RefusedError if it refuses, NotConnectedError without answer."""
    kinds = sorted({kind for of_target in KINDS.values() for kind in of_target})
    if order.kind not in kinds:
        meant = suggest_word(order.kind, kinds)
        raise ConfigError(
            f"fault inject {shorten(order.kind)}: there is no such kind; {meant}`snakesim fault list` explains all"
        )
    injection = check_injection(
        Injection(order.kind, order.target, amount=order.amount), f"{order.kind} {order.target}"
    )
    if order.for_s is not None and not 0.0 < order.for_s < inf:
        raise ConfigError(f"--duration {order.for_s:g}: give more than 0 s")
    if injection.about.once and (order.end or order.for_s is not None):
        raise ConfigError(f"{order.kind} happens once and has no end; omit --duration and --end")
    request = FaultRequest(kind=order.kind, target=order.target, for_s=order.for_s, amount=order.amount, end=order.end)
    with open_session(only_robot(where, f"fault inject {order.kind} {order.target}"), CONNECT_S) as session:
        try:
            answer = session.request(keys.fault_key(injection.part), request, ANSWER_S)
        except NotConnectedError:
            raise NotConnectedError(
                f"{injection.part} does not answer, and only it can {order.kind} {order.target}; `snakesim status` "
                f"shows which services are alive"
            ) from None
    if not answer.ok:
        raise RefusedError(f"not done: {answer.reason}")
    print_line(answer.reason)
    return 0
