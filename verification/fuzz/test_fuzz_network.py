"""A few thousand payloads of `python -m verification.fuzz --network` on the network of a running robot."""

from pathlib import Path

import pytest

from verification.fuzz import network

pytestmark = pytest.mark.e2e


@pytest.mark.slow
def test_a_running_robot_takes_no_harm_from_bad_payloads(tmp_path: Path) -> None:
    # As slow as a robot may be, so that its lease is long: this is about what arrives, not about a busy machine.
    request = network.FuzzRequest(payloads=6000, rate=2000.0, quiet_s=3.0, robot_hz=20.0)
    verdict = network.fuzz(tmp_path / "run", request)
    assert verdict.violations == [], network.table(verdict)
    assert sum(verdict.sent.queries.values()) > 1000 and verdict.sent.answers["no"] > 500
    assert verdict.record.rejected_commands["malformed"] > 500
