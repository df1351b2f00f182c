"""`python -m snakesim_hal.host_process`: opens a backend and runs the host until the run is over."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from snakesim_hal.backend import BackendFactory
from snakesim_hal.errors import SnakesimError
from snakesim_hal.host import Ending, Host
from snakesim_hal.latch import EstopLatch
from snakesim_hal.messages import Fault
from snakesim_hal.plugins import BACKENDS, find_plugin, plugin_settings
from snakesim_hal.process import HOST_PRIORITY, hurry, on_stop_signal, settle_for_timing
from snakesim_hal.scenario import RunConfig
from snakesim_hal.serve import arguments, duty
from snakesim_hal.session import open_session

HOST_RECORD = "host.json"
BLACK_BOX = "blackbox.npz"
DESCRIPTION = "description.json"


class HostRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What the host leaves behind: its own numbers of the run."""

    ticks: int
    wall_s: float
    overruns: int
    answered_ticks: int
    armed_ticks: int
    command_digest: str
    state_to_command_us: dict[str, float | None]
    rejected_commands: dict[str, int]
    limited_commands: dict[str, int]
    faults: list[Fault]
    lifecycle: str
    why: str
    ended: Ending = "complete"
    injected: list[str] = []  # faults on request, as they began and ended
    isolated: list[str] = []  # joints that were set aside at the end


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code 0 when the run ended without a fault, 1 otherwise."""
    parser = arguments("Run a robot's HAL host.")
    parser.add_argument("--router", action="store_true", help="connect to a router instead of listening")
    parser.add_argument("--max-ticks", type=int, help="end this many ticks after the first arming")
    parser.add_argument("--end-after-fault", type=float, help="end so many seconds after a fault")
    parser.add_argument("--stay", action="store_true", help="count only armed ticks, record only what follows them")
    parsed_listen = "--router" not in (sys.argv[1:] if argv is None else argv)
    given = duty(parser, argv, listen=parsed_listen)
    try:
        factory = find_plugin(BACKENDS, given.config.backend)
        backend = factory(given.config, backend_settings(given.config, factory))
        try:
            hygiene = hurry(HOST_PRIORITY) if given.config.pace == "realtime" else []
            with open_session(given.link) as session:
                host = Host(
                    given.config,
                    backend,
                    session,
                    max_ticks=given.arguments.max_ticks,
                    end_after_fault_s=given.arguments.end_after_fault,
                    stay=given.arguments.stay,
                    latch=EstopLatch(given.out),
                    hygiene=hygiene,
                )
                on_stop_signal(host.stop)
                settle_for_timing()
                host.run()
                if given.out is not None:
                    leave_record(host, given.out)
        finally:
            backend.close()
    except SnakesimError as error:
        print(f"snakesim host: {error}", file=sys.stderr)
        return 1
    return 1 if any(fault.reach == "robot" for fault in host.authority.fault_log) else 0


def backend_settings(config: RunConfig, factory: BackendFactory) -> Any:
    """The scenario's [backends.<name>] section, checked by the backend's own Struct."""
    return plugin_settings(factory, config.backend_settings, f"scenario {config.name!r}", config.backend_section)


def leave_record(host: Host, out: Path) -> None:
    """Write the black box and the host's own numbers."""
    latencies = np.array(host.tally.state_to_command_us)
    record = HostRecord(
        ticks=host.black_box.ticks,
        wall_s=host.wall_s,
        overruns=host.tally.overruns,
        answered_ticks=host.tally.answered_ticks,
        armed_ticks=host.tally.ticks,
        command_digest=host.black_box.command_digest,
        state_to_command_us={
            "p50": float(np.percentile(latencies, 50)) if len(latencies) else None,
            "p99": float(np.percentile(latencies, 99)) if len(latencies) else None,
        },
        rejected_commands=dict(host.authority.rejected),
        limited_commands=dict(host.authority.limited),
        faults=host.authority.fault_log,
        lifecycle=host.authority.state,
        why=host.authority.why,
        ended=host.ended,
        injected=host.faults.noted,
        isolated=host.authority.isolated,
    )
    host.black_box.save(out / BLACK_BOX)
    (out / DESCRIPTION).write_bytes(msgspec.json.encode(host.description))
    partial = out / f"{HOST_RECORD}.partial"
    partial.write_bytes(msgspec.json.format(msgspec.json.encode(record)))
    partial.rename(out / HOST_RECORD)


if __name__ == "__main__":
    sys.exit(main())
