"""A router reports who joined and what it refused; the tests give it log lines as Zenoh 1.10 writes them."""

import subprocess
import sys

import pytest

from snakesim_hal.network.router_log import (
    LINES_PER_INTERVAL,
    MAX_BURST_LINES,
    MAX_LINE_CHARACTERS,
    RouterLog,
)

# The modules of Zenoh that write the lines.
ACL = "zenoh::net::routing::interceptor::access_control"
TLS = "zenoh_link_tls::unicast"
LINK = "zenoh_transport::unicast::establishment::accept"

VIEWER = "viewer.planar13.laptop"  # the name in the client's certificate
ZENOH_ID = "691724de333916becef94c117b3ba4b5"
SUBJECT = f"{ZENOH_ID} on Interface(lo)+CertCommonName({VIEWER})+Transport(Tls)+{ZENOH_ID}"
ACTIONS = ("Query", "Put", "Declare/Undeclare Queryable", "Declare Liveliness Subscriber")


def make_log_line(text: str, module: str = ACL, level: str = "TRACE", thread: int = 8) -> str:
    """Format a line as Zenoh writes it to a terminal."""
    return (
        f"\x1b[2m2026-11-22T22:16:53.032731Z\x1b[0m \x1b[35m{level}\x1b[0m  rx-0 ThreadId({thread:02}) "
        f"\x1b[2m{module}\x1b[0m\x1b[2m:\x1b[0m {text}"
    )


def report_lines(*lines: str) -> list[str]:
    """Return what a router reports about these lines of its log."""
    reports: list[str] = []
    log = RouterLog(reports.append)
    for line in lines:
        log.process_line(line)
    log.report_repetitions()
    return reports


def make_join_lines(name: str = VIEWER, zenoh_id: str = ZENOH_ID) -> list[str]:
    """Make the two lines that Zenoh writes when a client with this certificate joins."""
    address = "10.78.0.4:53700"
    link = f"TransportLinkUnicast {{ link: Link {{ src: tls/10.78.0.1:7447, dst: tls/{address}, mtu: 49152 }} }}"
    return [
        make_log_line(
            f"Accepted TLS connection on 10.78.0.1:7447: {address}. Common Name: {name}.",
            TLS,
            "DEBUG",
        ),
        make_log_line(
            f"New transport link accepted from {zenoh_id} to 4344bd: {link}.", LINK, "DEBUG"
        ),
    ]


def test_router_log_names_certificates_of_joins_and_refusals() -> None:
    refused_put = make_log_line(
        f"{SUBJECT} is unauthorized to Put (ingress) on planar13/actuator/joints"
    )
    cached_refusal = make_log_line(
        f"Using cached result: {ZENOH_ID} is unauthorized to Declare Queryable (ingress) on planar13/hal/lease"
    )
    assert report_lines(*make_join_lines(), refused_put, cached_refusal) == [
        f"let in: {VIEWER} from 10.78.0.4:53700",
        f"refused: {VIEWER}: Put (ingress) on planar13/actuator/joints",
        f"refused: {VIEWER}: Declare Queryable (ingress) on planar13/hal/lease",
    ]


def test_router_log_certificate_without_rule_is_reported() -> None:
    certificate_line, accepted_line = make_join_lines("gnc.planar13.laptop")
    no_rule_line = make_log_line(
        f"{ZENOH_ID} did not match any configured ACL subject. Default permission `Deny` will be applied",
        ACL,
    )
    assert report_lines(certificate_line, no_rule_line, accepted_line) == [
        "refused: gnc.planar13.laptop from 10.78.0.4:53700: everything, because no rule is for it"
    ]


def test_router_log_omits_permitted_actions_and_permission_lists() -> None:
    """Zenoh lists every forbidden action of a new key, while its other threads write lines in between."""
    permission_list = [
        make_log_line(f"{SUBJECT} is unauthorized to {action} (ingress) on planar13/hal/lease")
        for action in ACTIONS
    ]
    permitted = make_log_line(
        f"Using cached result: {ZENOH_ID} is authorized to Put (egress) on planar13/sensor/joints"
    )
    refused_in_other_thread = make_log_line(
        f"{SUBJECT} is unauthorized to Delete (ingress) on planar13/hal/clock", thread=9
    )
    list_start = make_log_line("ACL (ingress): caching permissions for `planar13/hal/lease` ...")
    refused_after_list = make_log_line(
        f"{SUBJECT} is unauthorized to Query (ingress) on planar13/hal/lifecycle"
    )
    lines = [
        list_start,
        *permission_list[:2],
        refused_in_other_thread,
        permitted,
        *permission_list[2:],
        refused_after_list,
    ]
    assert report_lines(*lines) == [
        f"refused: {VIEWER}: Delete (ingress) on planar13/hal/clock",
        f"refused: {VIEWER}: Query (ingress) on planar13/hal/lifecycle",
    ]


def test_router_log_permission_list_may_end_with_permitted_action() -> None:
    list_start = make_log_line("ACL (egress): caching permissions for `planar13/alive/hal` ...")
    list_end = make_log_line(
        f"{SUBJECT} is authorized to Declare Liveliness Subscriber (egress) on planar13/alive/hal"
    )
    refused_after_list = make_log_line(
        f"{SUBJECT} is unauthorized to Query (ingress) on planar13/hal/lifecycle"
    )
    assert len(report_lines(list_start, list_end, refused_after_list)) == 1


def test_router_log_reports_warnings_of_zenoh() -> None:
    warning = make_log_line("peer sent no certificates", TLS, "WARN")
    debug_line = make_log_line("Closing", LINK, "DEBUG")
    assert report_lines(warning, debug_line) == [f"WARN {TLS}: peer sent no certificates"]


def test_router_log_repeated_line_is_reported_once_and_counted() -> None:
    line = make_log_line(f"{SUBJECT} is unauthorized to Put (ingress) on planar13/actuator/joints")
    report = f"refused: {VIEWER}: Put (ingress) on planar13/actuator/joints"
    assert report_lines(*[line] * 1000) == [report, f"999 times more: {report}"]


@pytest.mark.slow
def test_router_log_flood_of_different_lines_is_limited() -> None:
    reports: list[str] = []
    log = RouterLog(reports.append)
    for _ in range(3):
        for number in range(2 * MAX_BURST_LINES):
            log.process_line(
                make_log_line(
                    f"{SUBJECT} is unauthorized to Put (ingress) on {number:09}{'x' * 5000}"
                )
            )
        log.report_repetitions()
    assert len(reports) <= MAX_BURST_LINES + 3 * LINES_PER_INTERVAL + 3
    assert max(map(len, reports)) <= MAX_LINE_CHARACTERS
    assert "left out" in reports[-1]


ROUTER_CODE = """
import os
from snakesim_hal.network.router_log import shortened_zenoh_log
with shortened_zenoh_log():
    print("ours", flush=True)
    for number in range(20_000):
        text = f"f1 is {permission} to Put (egress) on {number}"
        os.write(1, f"2026Z TRACE rx-0 ThreadId(08) access_control: {text}\\n".encode())
    os.write(1, b"2026Z ERROR rx-0 ThreadId(08) zenoh: it failed\\n")
print("afterwards")
"""


def make_router_command(permission: str) -> list[str]:
    """Make the command of a program that logs as a router does, with this word for the permission."""
    return [sys.executable, "-c", f"permission = {permission!r}{ROUTER_CODE}"]


def test_shortened_zenoh_log_leaves_other_output_unchanged() -> None:
    result = subprocess.run(
        make_router_command("authorized"), capture_output=True, text=True, timeout=60, check=True
    )
    assert result.stdout == "ours\nafterwards\n"
    texts = [line.partition("Z ")[2] for line in result.stderr.splitlines()]
    assert texts == ["ERROR zenoh: it failed"]


def test_router_whose_log_is_not_read_does_not_block() -> None:
    with subprocess.Popen(
        make_router_command("unauthorized"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        try:
            assert process.wait(60) == 0
            assert process.stdout.read() == "ours\nafterwards\n"
        finally:
            process.kill()
