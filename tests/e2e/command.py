"""Drives the real `snakesim` command, and reads what it leaves."""

from pathlib import Path

import msgspec

from snakesim_operator.results.record import SUMMARY
from snakesim_operator.results.summary import RunSummary
from tests.harness.command import LIMIT_S, SNAKESIM, Ended, Running, environment, running, snakesim
from tests.harness.endpoint import free_endpoint

TOO_SLOW = "this computer is too slow: "
__all__ = [
    "LIMIT_S",
    "SNAKESIM",
    "TOO_SLOW",
    "Ended",
    "Running",
    "environment",
    "run_to_summary",
    "running",
    "snakesim",
]


def run_to_summary(out: Path, *arguments: str, **more: str) -> tuple[Ended, RunSummary]:
    """`snakesim run ... --out out`, and the summary that it left."""
    network = [] if "--router" in arguments else ["--endpoint", free_endpoint()]
    ended = snakesim("run", *arguments, "--out", str(out), *network, cwd=out.parent, more=more)
    assert (out / SUMMARY).is_file(), ended.said
    return ended, msgspec.json.decode((out / SUMMARY).read_bytes(), type=RunSummary)
