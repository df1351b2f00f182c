"""The injected faults that a run has planned, and whether the run supports them."""

from collections.abc import Collection

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import HAL, RUN, Injection, check_targets, parse
from snakesim_hal.model.files import Table
from snakesim_hal.model.scenario import RunConfig

MAX_BUSES = 8


def planned(config: RunConfig, table: Table | None = None) -> list[Injection]:
    """Parse them from their texts. Raises ConfigError with the number of the wrong one."""
    found: list[Injection] = []
    for i, text in enumerate(config.faults):
        try:
            found.append(parse(text))
        except ConfigError as error:
            raise ConfigError(f"{_place(config, i, table)}: {error}") from None
    return found


def check_backend_can(config: RunConfig, *, does: Collection[str], buses: int, because: str) -> None:
    """Check that a backend supports the planned faults of joints, buses and the simulator. Raises ConfigError.

    does: kinds of these that it knows by itself; because: why it knows no more. The host does some for any backend.
    """
    for i, injection in enumerate(check_planned(config, buses=buses)):
        own = injection.part == HAL and injection.target_type not in ("process", "key")
        if own and not {"host", "samples"} & {*injection.about.by} and injection.kind not in does:
            raise ConfigError(
                f"{_place(config, i, None)}: backend {config.backend!r} cannot do {injection.kind} to "
                f"{injection.target}: {because}"
            )


def check_without_run(config: RunConfig, table: Table | None = None) -> None:
    """Check that none needs `snakesim run`, which alone starts, kills and freezes processes. Raises ConfigError."""
    for i, injection in enumerate(planned(config, table)):
        if injection.part == RUN:
            raise ConfigError(
                f"{_place(config, i, table)} = {str(injection)!r}: only `snakesim run` does that; for a host by itself "
                "leave it out, such as by --set 'faults=[]'"
            )


def check_planned(config: RunConfig, table: Table | None = None, buses: int = MAX_BUSES) -> list[Injection]:
    """The planned faults; every target exists: process, key, joint or bus. Raises ConfigError."""
    found = planned(config, table)
    for i, injection in enumerate(found):
        try:
            check_targets([injection], services=config.own_services, joints=config.robot.chain.modules, buses=buses)
            if injection.part == RUN and injection.target in config.beside:
                raise ConfigError(
                    f"fault {str(injection)!r}: {injection.target} is no process of its own; it is beside the driver "
                    f'(services.{injection.target}.place = "host")'
                )
        except ConfigError as error:
            raise ConfigError(f"{_place(config, i, table)}: {error}") from None
    return found


def _place(config: RunConfig, i: int, table: Table | None) -> str:
    origin = f"scenario {config.name!r}" if table is None else table.origin_of("faults")
    return f"{origin}: `faults[{i}]`"
