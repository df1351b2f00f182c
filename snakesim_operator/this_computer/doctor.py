"""`snakesim doctor`: what this computer has, what is missing, and the command that fixes it."""

from collections.abc import Callable, Iterator

import msgspec

from snakesim_hal.base.terminal import print_json, print_line
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.this_computer import computer
from snakesim_operator.this_computer.computer import ComputerFinding
from snakesim_operator.this_computer.kernel import check_kernel
from snakesim_operator.this_computer.network_findings import check_ports, check_routers

CHECKS: tuple[Callable[[], Iterator[ComputerFinding]], ...] = (
    computer.check_python,
    computer.check_packages,
    computer.check_laws,
    computer.check_opengl,
    computer.check_can,
    computer.check_kvm,
    computer.check_clocks,
    computer.check_real_time,
    check_kernel,
    computer.check_disk,
)


def run_doctor(selection: RobotSelection, *, as_json: bool) -> int:
    """Check this computer and its network, and print a finding for each check.

    Args:
        selection: Selects the endpoints that are checked.
        as_json: Whether to print all findings as one JSON object instead of text.

    Returns:
        The exit code: 1 if a run is not possible, 0 otherwise.
    """
    findings: list[ComputerFinding] = []
    for check in (*CHECKS, check_ports, lambda: check_routers(selection)):
        for finding in check():
            findings.append(finding)
            if not as_json:
                _print_finding(finding)
    failed_checks = [finding.what for finding in findings if finding.state == "fail"]
    if as_json:
        print_json({"ok": not failed_checks, "findings": msgspec.to_builtins(findings)})
    else:
        warning_count = sum(finding.state == "warn" for finding in findings)
        print_line(
            f"{len(findings)} checked; fail: {', '.join(failed_checks) or 'none'}; warnings: {warning_count}"
        )
    return 1 if failed_checks else 0


def _print_finding(finding: ComputerFinding) -> None:
    print_line(f"{finding.state:<5}{finding.what:<21}{finding.detail}")
    for fix in finding.fix:
        print_line(f"     {'':<21}$ {fix}")
