"""The injected faults that the configuration of a run contains, and whether the run can carry them out."""

from collections.abc import Collection

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import HAL, RUN, Injection, check_targets, parse_injection
from snakesim_hal.model.files import Table
from snakesim_hal.model.scenario import RunConfig

MAX_BUSES = 8


def parse_planned(config: RunConfig, table: Table | None = None) -> list[Injection]:
    """Return the injected faults of a configuration.

    Args:
        config: of the run.
        table: the values as read, to name the file or flag in errors.

    Raises:
        ConfigError: A text is not valid. The error has its number.
    """
    injections: list[Injection] = []
    for i, text in enumerate(config.faults):
        try:
            injections.append(parse_injection(text))
        except ConfigError as error:
            raise ConfigError(f"{_place(config, i, table)}: {error}", code=error.code) from None
    return injections


def check_backend_can(config: RunConfig, *, does: Collection[str], buses: int, because: str) -> None:
    """Check that a backend can inject the planned faults of joints, buses and the simulator.

    Args:
        config: of the run.
        does: kinds of fault that the backend injects itself; the host injects some for any backend.
        buses: number of buses of the backend.
        because: why the backend injects no other kinds, for the error.

    Raises:
        ConfigError: The backend cannot inject a planned fault.
    """
    for i, injection in enumerate(check_planned(config, buses=buses)):
        concerns_backend = injection.part == HAL and injection.target_type not in ("process", "key")
        host_can = "host" in injection.about.by or "samples" in injection.about.by
        if concerns_backend and not host_can and injection.kind not in does:
            raise ConfigError(
                f"{_place(config, i, None)}: backend {config.backend!r} cannot do {injection.kind} to "
                f"{injection.target}: {because}",
                code="injection/not-supported",
            )


def check_without_run(config: RunConfig, table: Table | None = None) -> None:
    """Check that no planned fault needs `snakesim run`, which alone starts, kills and freezes processes.

    Raises:
        ConfigError: A planned fault needs it.
    """
    for i, injection in enumerate(parse_planned(config, table)):
        if injection.part == RUN:
            raise ConfigError(
                f"{_place(config, i, table)} = {str(injection)!r}: only `snakesim run` does that; for a host by itself "
                "leave it out, such as by --set 'faults=[]'",
                code="injection/not-supported",
            )


def check_planned(config: RunConfig, table: Table | None = None, buses: int = MAX_BUSES) -> list[Injection]:
    """Return the injected faults of a configuration, after a check that the run has all their targets.

    Raises:
        ConfigError: A text is not valid, or the run has no such process, key, joint or bus.
    """
    injections = parse_planned(config, table)
    for i, injection in enumerate(injections):
        try:
            check_targets([injection], services=config.own_services, joints=config.robot.chain.modules, buses=buses)
            if injection.part == RUN and injection.target in config.in_host_services:
                raise ConfigError(
                    f"fault {str(injection)!r}: {injection.target} has no process of its own; it runs in the host "
                    f'(services.{injection.target}.process = "host")',
                    code="injection/not-supported",
                )
        except ConfigError as error:
            raise ConfigError(f"{_place(config, i, table)}: {error}", code=error.code) from None
    return injections


def _place(config: RunConfig, i: int, table: Table | None) -> str:
    """Return where the fault number i stands, for errors: file or flag if they are known, else the scenario."""
    origin = f"scenario {config.name!r}" if table is None else table.origin_of("faults")
    return f"{origin}: `faults[{i}]`"
