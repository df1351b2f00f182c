"""`snakesim fault`: explain the kinds of faults, inject one into a run that allows it, and end it."""

from dataclasses import dataclass
from math import inf

from snakesim_hal.base.errors import (
    ConfigError,
    NotConnectedError,
    RefusedError,
    shorten,
    suggest_word,
)
from snakesim_hal.base.terminal import PrintLine, print_json, print_line
from snakesim_hal.model.fault_kinds import (
    FAULT_KINDS,
    FaultInjection,
    describe_fault_kinds,
    validate_and_complete_injection,
)
from snakesim_hal.network.session import open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import FaultRequest
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, RobotSelection, find_single_robot
from snakesim_operator.robot_commands.command import ANSWER_TIMEOUT_S


@dataclass(frozen=True)
class FaultOrder:
    """The options of `snakesim fault inject`."""

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
            for target, kinds_of_target in FAULT_KINDS.items()
            for name, kind in kinds_of_target.items()
        ]
        print_json({"kinds": kinds})
        return 0
    for line in describe_fault_kinds().splitlines():
        print_line(line)
    return 0


def inject_fault(
    order: FaultOrder, selection: RobotSelection, print_text: PrintLine = print_line
) -> int:
    """Inject a fault into a run, or end an injected fault.

    Args:
        order: Options of the command.
        selection: Selects the robot.
        print_text: Prints the answer of the process that injects the fault.

    Returns:
        0, the exit code of the command.

    Raises:
        ConfigError: There is no such fault, or the options contradict each other.
        RefusedError: The run does not allow the fault.
        NotConnectedError: The process that can inject the fault does not answer.
    """
    injection = _validate_order(order)
    request = FaultRequest(
        kind=order.kind,
        target=order.target,
        for_s=order.for_s,
        amount=order.amount,  # without the default, which the process fills in itself
        end=order.end,
    )
    link = find_single_robot(selection, f"fault inject {order.kind} {order.target}")
    with open_session(link, CONNECT_TIMEOUT_S) as session:
        try:
            answer = session.send_request(
                keys.fault_key(injection.executing_part), request, ANSWER_TIMEOUT_S
            )
        except NotConnectedError:
            raise NotConnectedError(
                f"{injection.executing_part} does not answer, and only it can {order.kind} {order.target}; "
                "`snakesim status` shows which services are alive"
            ) from None
    if not answer.ok:
        raise RefusedError(f"not done: {answer.reason}")
    print_text(answer.reason)
    return 0


def _validate_order(order: FaultOrder) -> FaultInjection:
    """Validate the options of `snakesim fault inject`, and return the injection that they describe.

    Raises:
        ConfigError: The kind, the target, the amount or the duration is not possible.
    """
    kinds = sorted({kind for kinds_of_target in FAULT_KINDS.values() for kind in kinds_of_target})
    if order.kind not in kinds:
        suggestion = suggest_word(order.kind, kinds)
        raise ConfigError(
            f"fault inject {shorten(order.kind)}: there is no such kind; {suggestion}"
            "`snakesim fault list` explains all",
            code="injection/unknown-fault",
        )
    injection = validate_and_complete_injection(
        FaultInjection(order.kind, order.target, amount=order.amount),
        f"{order.kind} {order.target}",
    )
    if order.for_s is not None and not 0.0 < order.for_s < inf:
        raise ConfigError(
            f"--duration {order.for_s:g}: give more than 0 s", code="injection/unknown-fault"
        )
    if injection.kind_info.is_instantaneous and (order.end or order.for_s is not None):
        raise ConfigError(
            f"{order.kind} happens once and has no end; omit --duration and --end",
            code="injection/unknown-fault",
        )
    return injection
