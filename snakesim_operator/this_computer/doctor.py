"""`snakesim doctor`: what this computer has, what it lacks, and the command that fixes each."""

from collections.abc import Callable, Iterator

import msgspec

from snakesim_hal.base.terminal import print_json, print_line
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.this_computer import computer
from snakesim_operator.this_computer.computer import Finding
from snakesim_operator.this_computer.kernel import kernel
from snakesim_operator.this_computer.network_findings import ports, routers

CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    computer.python,
    computer.packages,
    computer.opengl,
    computer.can,
    computer.kvm,
    computer.clock,
    computer.real_time,
    kernel,
    computer.disk,
)


def doctor(where: RobotSelection, *, as_json: bool) -> int:
    """Check everything. Returns 1 when something fails without which no run is possible, else 0."""
    found: list[Finding] = []
    for check in (*CHECKS, ports, lambda: routers(where)):
        for finding in check():
            found.append(finding)
            if not as_json:
                _print(finding)
    failed = [finding.what for finding in found if finding.state == "fail"]
    if as_json:
        print_json({"ok": not failed, "findings": msgspec.to_builtins(found)})
    else:
        warned = sum(finding.state == "warn" for finding in found)
        print_line(f"{len(found)} checked; fail: {', '.join(failed) or 'none'}; warnings: {warned}")
    return 1 if failed else 0


def _print(finding: Finding) -> None:
    print_line(f"{finding.state:<5}{finding.what:<21}{finding.detail}")
    for fix in finding.fix:
        print_line(f"     {'':<21}$ {fix}")
