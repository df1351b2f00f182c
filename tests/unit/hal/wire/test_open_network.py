"""The page on open networks has a row for each key by which a client can move, stop or change a robot."""

import re
from pathlib import Path

import pytest

from snakesim_hal.wire import keys
from snakesim_hal.wire.roles import ACCESS_RULES, AccessRule

PAGE = (Path(__file__).parents[4] / "docs" / "concepts" / "open-network.md").read_text(
    encoding="utf-8"
)
SECTION = PAGE.partition("## What an unauthenticated client can do")[2].partition("\n## ")[0]
REQUESTED = {keys.FAULT_ALL, keys.INTENT} | {
    line.key for line in ACCESS_RULES if line.kind == "query"
}


@pytest.mark.parametrize(
    "line", [line for line in ACCESS_RULES if line.key in REQUESTED], ids=lambda line: line.key
)
def test_every_key_that_takes_requests_has_a_row(line: AccessRule) -> None:
    rows = [row for row in SECTION.splitlines() if row.startswith("| ")]
    assert any(re.search(rf"`{re.escape(line.key)}`", row.split("|")[1]) for row in rows), line.key
