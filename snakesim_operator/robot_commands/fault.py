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
    """Explain every kind of fault, as text or as JSON. Returns the exit code."""
    if as_json:
        kinds = [
            {"kind": name, "target": target, "description": kind.description}
            for target, kinds_of_target in KINDS.items()
            for name, kind in kinds_of_target.items()
        ]
        print_json({"kinds": kinds})
        return 0
    for line in explain_kinds().splitlines():
        print_line(line)
    return 0


def inject_fault(order: FaultOrder, where: RobotSelection, report: PrintLine = print_line) -> int:
    """Inject a fault into a run, or end it.

    Args:
        order: the command's options.
        where: selects the robot.
        report: gets the answer of the process that did it.

    Returns:
        0, the exit code of the command.

    Raises:
        ConfigError: there is no such fault, or the options contradict each other.
        RefusedError: the run does not allow the fault.
        NotConnectedError: the process that can do it does not answer.
    """
    injection = _check_order(order)
    request = FaultRequest(
        kind=order.kind,
        target=order.target,
        for_s=order.for_s,
        amount=order.amount,  # without the default, which the process fills in itself
        end=order.end,
    )
    link = only_robot(where, f"fault inject {order.kind} {order.target}")
    with open_session(link, CONNECT_S) as session:
        try:
            answer = session.request(keys.fault_key(injection.part), request, ANSWER_S)
        except NotConnectedError:
            raise NotConnectedError(
                f"{injection.part} does not answer, and only it can {order.kind} {order.target}; `snakesim status` "
                f"shows which services are alive"
            ) from None
    if not answer.ok:
        raise RefusedError(f"not done: {answer.reason}")
    report(answer.reason)
    return 0


def _check_order(order: FaultOrder) -> Injection:
    """Return the injection that the options describe. Raises ConfigError for options that cannot be."""
    kinds = sorted({kind for kinds_of_target in KINDS.values() for kind in kinds_of_target})
    if order.kind not in kinds:
        suggestion = suggest_word(order.kind, kinds)
        raise ConfigError(
            f"fault inject {shorten(order.kind)}: there is no such kind; {suggestion}"
            "`snakesim fault list` explains all",
            code="injection/unknown-fault",
        )
    injection = check_injection(
        Injection(order.kind, order.target, amount=order.amount), f"{order.kind} {order.target}"
    )
    if order.for_s is not None and not 0.0 < order.for_s < inf:
        raise ConfigError(f"--duration {order.for_s:g}: give more than 0 s", code="injection/unknown-fault")
    if injection.about.once and (order.end or order.for_s is not None):
        raise ConfigError(
            f"{order.kind} happens once and has no end; omit --duration and --end", code="injection/unknown-fault"
        )
    return injection
