"""The injected faults that the configuration of a run contains, and whether the run can carry them out."""

from collections.abc import Collection

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import (
    HAL,
    RUN,
    FaultInjection,
    parse_injection,
    validate_injection_targets,
)
from snakesim_hal.model.files import ConfigTable
from snakesim_hal.model.scenario import RunConfig

MAX_BUSES = 8


def parse_planned_faults(
    config: RunConfig, table: ConfigTable | None = None
) -> list[FaultInjection]:
    """Parse the injected faults that a run configuration plans.

    Args:
        config: Run configuration.
        table: Values as read with their origins, to name the file or flag in errors. None if they are not known.

    Raises:
        ConfigError: The text of a fault is not valid. The error has its index.
    """
    injections: list[FaultInjection] = []
    for i, text in enumerate(config.faults):
        try:
            injections.append(parse_injection(text))
        except ConfigError as error:
            raise ConfigError(
                f"{_describe_location(config, i, table)}: {error}", code=error.code
            ) from None
    return injections


def validate_faults_for_backend(
    config: RunConfig, *, supported_kinds: Collection[str], bus_count: int, reason: str
) -> None:
    """Raise ConfigError unless a backend can inject the planned faults of joints, buses and the simulator.

    The run must have all targets of the planned faults, too.

    Args:
        config: Run configuration.
        supported_kinds: Kinds of fault that the backend injects itself. The host injects some kinds for any backend.
        bus_count: Number of buses of the backend.
        reason: Why the backend injects no other kinds, for the error.

    Raises:
        ConfigError: The backend cannot inject a planned fault, or the run does not have its target.
    """
    for i, injection in enumerate(parse_and_validate_planned_faults(config, bus_count=bus_count)):
        is_backend_fault = injection.executing_part == HAL and injection.target_type not in (
            "process",
            "key",
        )
        can_host_inject = (
            "host" in injection.kind_info.executors or "samples" in injection.kind_info.executors
        )
        if is_backend_fault and not can_host_inject and injection.kind not in supported_kinds:
            raise ConfigError(
                f"{_describe_location(config, i, None)}: backend {config.backend!r} cannot do {injection.kind} to "
                f"{injection.target}: {reason}",
                code="injection/not-supported",
            )


def validate_faults_without_supervisor(config: RunConfig, table: ConfigTable | None = None) -> None:
    """Raise ConfigError if a planned fault needs `snakesim run`, which alone starts, kills and freezes processes.

    Raises:
        ConfigError: A planned fault needs it.
    """
    for i, injection in enumerate(parse_planned_faults(config, table)):
        if injection.executing_part == RUN:
            raise ConfigError(
                f"{_describe_location(config, i, table)} = {str(injection)!r}: only `snakesim run` does that; for a "
                "host by itself leave it out, such as by --set 'faults=[]'",
                code="injection/not-supported",
            )


def parse_and_validate_planned_faults(
    config: RunConfig, table: ConfigTable | None = None, bus_count: int = MAX_BUSES
) -> list[FaultInjection]:
    """Parse the injected faults that a run configuration plans, and check that the run has all their targets.

    Args:
        config: Run configuration.
        table: Values as read with their origins, to name the file or flag in errors. None if they are not known.
        bus_count: Number of buses of the backend, if it is known.

    Raises:
        ConfigError: A text is not valid, or the run has no such process, key, joint or bus.
    """
    injections = parse_planned_faults(config, table)
    for i, injection in enumerate(injections):
        try:
            validate_injection_targets(
                [injection],
                services=config.internal_services,
                joint_count=config.robot.chain.modules,
                bus_count=bus_count,
            )
            if injection.executing_part == RUN and injection.target in config.in_host_services:
                raise ConfigError(
                    f"fault {str(injection)!r}: {injection.target} has no process of its own; it runs in the host "
                    f'(services.{injection.target}.process = "host")',
                    code="injection/not-supported",
                )
        except ConfigError as error:
            raise ConfigError(
                f"{_describe_location(config, i, table)}: {error}", code=error.code
            ) from None
    return injections


def _describe_location(config: RunConfig, i: int, table: ConfigTable | None) -> str:
    """Return the place of the i-th planned fault for errors: its file or flag if known, otherwise the scenario."""
    origin = f"scenario {config.name!r}" if table is None else table.find_origin("faults")
    return f"{origin}: `faults[{i}]`"
