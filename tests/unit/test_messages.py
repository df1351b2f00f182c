"""Messages are compared with tests/messages.json, and an option writes the file again."""

import json
import re
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_testing.messages import FILE, StoredMessages, raises_error

REPOSITORY = Path(__file__).parents[2]


def test_every_stored_message_is_of_a_test() -> None:
    functions: set[str] = set()
    for path in (REPOSITORY / "tests").rglob("test_*.py"):
        names = re.findall(r"^def (test_\w+)\(", path.read_text(encoding="utf-8"), re.MULTILINE)
        functions |= {f"{path.name}::{name}" for name in names}
    stored = json.loads((REPOSITORY / FILE).read_text(encoding="utf-8"))
    assert {key.partition("[")[0] for key in stored} <= functions, f"remove the others from {FILE}"
    assert list(stored) == sorted(stored)


def test_a_changed_or_additional_message_is_an_error(
    request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    messages = StoredMessages(request.node, ["TMP/a.toml: one"], updating=False)
    messages.check(f"{tmp_path}/a.toml: one")
    with pytest.raises(AssertionError, match="--update-messages"):
        messages.check("two")
    with pytest.raises(AssertionError, match="--update-messages"):
        StoredMessages(request.node, ["one"], updating=False).check("another one")
    with pytest.raises(AssertionError, match="--update-messages"):
        StoredMessages(request.node, ["one"], updating=False).check_count()


def test_an_error_has_its_code_and_names_its_field() -> None:
    def fail() -> None:
        raise ConfigError("a.toml: `rate_hz` = 5 Hz is not allowed", code="config/out-of-range")

    with raises_error(
        ConfigError, code="config/out-of-range", field=("a.toml", "rate_hz"), value=5, stored=False
    ):
        fail()
    for wrong in ({"code": "config/conflict"}, {"field": "rate"}, {"value": 50}):
        with (
            pytest.raises(AssertionError),
            raises_error(ConfigError, stored=False, **wrong),  # pyright: ignore[reportArgumentType]
        ):
            fail()
