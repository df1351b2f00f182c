"""The page on open networks has a row for each key by which a client can move, stop or change a robot."""

import re
from pathlib import Path

import pytest

from snakesim_hal.wire import keys
from snakesim_hal.wire.roles import ACCESS_RULES, AccessRule

PAGE = (Path(__file__).parents[4] / "docs" / "concepts" / "open-network.md").read_text(
    encoding="utf-8"
)
CLIENT_SECTION = PAGE.partition("## What an unauthenticated client can do")[2].partition("\n## ")[0]
REQUEST_KEYS = {keys.FAULT_ALL, keys.INTENT} | {
    rule.key for rule in ACCESS_RULES if rule.kind == "query"
}


@pytest.mark.parametrize(
    "rule", [rule for rule in ACCESS_RULES if rule.key in REQUEST_KEYS], ids=lambda rule: rule.key
)
def test_open_network_page_has_every_key_with_requests(rule: AccessRule) -> None:
    rows = [row for row in CLIENT_SECTION.splitlines() if row.startswith("| ")]
    assert any(re.search(rf"`{re.escape(rule.key)}`", row.split("|")[1]) for row in rows), rule.key
