"""What a router's log tells, from lines as Zenoh 1.10 writes them."""

import subprocess
import sys

import pytest

from snakesim_hal.network.router_log import (
    LINES_PER_INTERVAL,
    MAX_BURST_LINES,
    MAX_LINE_CHARACTERS,
    RouterLog,
)

ACL, TLS, LINK = (
    "zenoh::net::routing::interceptor::access_control",
    "zenoh_link_tls::unicast",
    "zenoh_transport::unicast::establishment::accept",
)
VIEWER, ZID = "viewer.planar13.laptop", "691724de333916becef94c117b3ba4b5"
SUBJECT = f"{ZID} on Interface(lo)+CertCommonName({VIEWER})+Transport(Tls)+{ZID}"
LISTED = ("Query", "Put", "Declare/Undeclare Queryable", "Declare Liveliness Subscriber")


def log_line(text: str, module: str = ACL, level: str = "TRACE", thread: int = 8) -> str:
    return (
        f"\x1b[2m2026-11-22T22:16:53.032731Z\x1b[0m \x1b[35m{level}\x1b[0m  rx-0 ThreadId({thread:02}) "
        f"\x1b[2m{module}\x1b[0m\x1b[2m:\x1b[0m {text}"
    )


def reported(*lines: str) -> list[str]:
    said: list[str] = []
    log = RouterLog(said.append)
    for one in lines:
        log.process_line(one)
    log.report_repetitions()
    return said


def comes(name: str = VIEWER, zid: str = ZID) -> list[str]:
    address = "10.78.0.4:53700"
    link = f"TransportLinkUnicast {{ link: Link {{ src: tls/10.78.0.1:7447, dst: tls/{address}, mtu: 49152 }} }}"
    return [
        log_line(
            f"Accepted TLS connection on 10.78.0.1:7447: {address}. Common Name: {name}.",
            TLS,
            "DEBUG",
        ),
        log_line(f"New transport link accepted from {zid} to 4344bd: {link}.", LINK, "DEBUG"),
    ]


def test_router_log_names_certificates_of_joins_and_refusals() -> None:
    put = log_line(f"{SUBJECT} is unauthorized to Put (ingress) on planar13/actuator/joints")
    cached = log_line(
        f"Using cached result: {ZID} is unauthorized to Declare Queryable (ingress) on planar13/hal/lease"
    )
    assert reported(*comes(), put, cached) == [
        f"let in: {VIEWER} from 10.78.0.4:53700",
        f"refused: {VIEWER}: Put (ingress) on planar13/actuator/joints",
        f"refused: {VIEWER}: Declare Queryable (ingress) on planar13/hal/lease",
    ]


def test_a_certificate_that_no_rule_names_is_told() -> None:
    certified, let_in = comes("gnc.planar13.laptop")
    nobody = log_line(
        f"{ZID} did not match any configured ACL subject. Default permission `Deny` will be applied",
        ACL,
    )
    assert reported(certified, nobody, let_in) == [
        "refused: gnc.planar13.laptop from 10.78.0.4:53700: everything, because no rule is for it"
    ]


def test_neither_what_passes_nor_what_nobody_asked_for_is_told() -> None:
    """Zenoh lists everything that is not allowed at a key; other threads go on meanwhile."""
    listed = [
        log_line(f"{SUBJECT} is unauthorized to {what} (ingress) on planar13/hal/lease")
        for what in LISTED
    ]
    passes = log_line(
        f"Using cached result: {ZID} is authorized to Put (egress) on planar13/sensor/joints"
    )
    other = log_line(
        f"{SUBJECT} is unauthorized to Delete (ingress) on planar13/hal/clock", thread=9
    )
    begins = log_line("ACL (ingress): caching permissions for `planar13/hal/lease` ...")
    after = log_line(f"{SUBJECT} is unauthorized to Query (ingress) on planar13/hal/lifecycle")
    assert reported(begins, *listed[:2], other, passes, *listed[2:], after) == [
        f"refused: {VIEWER}: Delete (ingress) on planar13/hal/clock",
        f"refused: {VIEWER}: Query (ingress) on planar13/hal/lifecycle",
    ]


def test_the_end_of_a_list_may_be_allowed() -> None:
    begins = log_line("ACL (egress): caching permissions for `planar13/alive/hal` ...")
    ends = log_line(
        f"{SUBJECT} is authorized to Declare Liveliness Subscriber (egress) on planar13/alive/hal"
    )
    after = log_line(f"{SUBJECT} is unauthorized to Query (ingress) on planar13/hal/lifecycle")
    assert len(reported(begins, ends, after)) == 1


def test_zenohs_own_warnings_are_told() -> None:
    assert reported(
        log_line("peer sent no certificates", TLS, "WARN"), log_line("Closing", LINK, "DEBUG")
    ) == [f"WARN {TLS}: peer sent no certificates"]


def test_what_comes_again_is_counted() -> None:
    put = f"{SUBJECT} is unauthorized to Put (ingress) on planar13/actuator/joints"
    first = f"refused: {VIEWER}: Put (ingress) on planar13/actuator/joints"
    assert reported(*[log_line(put)] * 1000) == [first, f"999 times more: {first}"]


@pytest.mark.slow
def test_a_flood_of_different_lines_is_bounded() -> None:
    said: list[str] = []
    log = RouterLog(said.append)
    for _ in range(3):
        for number in range(2 * MAX_BURST_LINES):
            log.process_line(
                log_line(f"{SUBJECT} is unauthorized to Put (ingress) on {number:09}{'x' * 5000}")
            )
        log.report_repetitions()
    assert len(said) <= MAX_BURST_LINES + 3 * LINES_PER_INTERVAL + 3
    assert max(map(len, said)) <= MAX_LINE_CHARACTERS
    assert "left out" in said[-1]


ROUTER = """
import os
from snakesim_hal.network.router_log import shortened_zenoh_log
with shortened_zenoh_log():
    print("ours", flush=True)
    for number in range(20_000):
        text = f"f1 is {what} to Put (egress) on {number}"
        os.write(1, f"2026Z TRACE rx-0 ThreadId(08) access_control: {text}\\n".encode())
    os.write(1, b"2026Z ERROR rx-0 ThreadId(08) zenoh: it failed\\n")
print("afterwards")
"""


def router(what: str) -> list[str]:
    return [sys.executable, "-c", f"what = {what!r}{ROUTER}"]


def test_only_what_zenoh_writes_is_made_short() -> None:
    done = subprocess.run(
        router("authorized"), capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "ours\nafterwards\n"
    assert [at.partition("Z ")[2] for at in done.stderr.splitlines()] == ["ERROR zenoh: it failed"]


def test_a_router_does_not_wait_for_whoever_reads_its_log() -> None:
    with subprocess.Popen(
        router("unauthorized"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            assert process.wait(60) == 0
            assert process.stdout.read() == "ours\nafterwards\n"
        finally:
            process.kill()
