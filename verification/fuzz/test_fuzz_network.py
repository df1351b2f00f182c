"""Sends a few thousand payloads of `python -m verification.fuzz --network` to a running robot."""

from pathlib import Path

import pytest

from verification.fuzz.network import FuzzRequest, fuzz_network
from verification.fuzz.network_verdict import format_verdict

pytestmark = pytest.mark.e2e

# As low as a control rate may be, so that the lease is long: a busy machine must not fail this test.
ROBOT_HZ = 20.0


@pytest.mark.slow
def test_fuzz_payloads_do_not_affect_running_robot(tmp_path: Path) -> None:
    request = FuzzRequest(payload_count=6000, rate_hz=2000.0, quiet_s=3.0, robot_hz=ROBOT_HZ)
    verdict = fuzz_network(tmp_path / "run", request)
    assert verdict.violations == [], format_verdict(verdict)
    assert sum(verdict.client_report.queries_by_key.values()) > 1000
    assert verdict.client_report.answers["no"] > 500
    assert verdict.host_record.rejected_commands["malformed"] > 500
