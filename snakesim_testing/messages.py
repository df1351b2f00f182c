"""Compares the texts of messages with tests/messages.json, which contains the messages of each test.

A test asserts what is stable about an error: its class, its code, and the field and value that the message names. The
text is compared with the file. After a sentence was corrected, `pytest --update-messages TESTS` writes the file again,
and no test has to be changed.
"""

import json
import re
import sys
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest

ErrorT = TypeVar("ErrorT", bound=BaseException)
FILE = "tests/messages.json"
OPTION = "--update-messages"
PROPERTY = "snakesim_messages"  # of a test's report, which workers send to the process that writes the file
VARYING = (  # parts of texts that differ from run to run
    (re.compile(r"127\.0\.0\.1:\d+"), "127.0.0.1:PORT"),
    (re.compile(r"\[::1\]:\d+"), "[::1]:PORT"),
    (re.compile(r"\b([Pp]rocess|pid) \d+"), r"\1 PID"),
    (re.compile(r"0x[0-9a-f]{7,}"), "0xADDRESS"),
    (re.compile(r"\b(virtual-)?([0-9a-f]{32}|(?<=virtual-)[0-9a-f]{8})\b"), r"\1ID"),
    (re.compile(r"\((\w+\.py) line \d+\)"), r"(\1 line N)"),
    (re.compile(r"/dev/pts/\d+"), "/dev/pts/N"),
    # What Python's parsers report differs from version to version.
    (re.compile(r"(not valid (?:TOML|JSON|XML): )(?!nested).*?(?=; give| \[[a-z]+/|$)"), r"\1..."),
    (
        re.compile(r"ValueError: source code string cannot contain null bytes"),
        "SyntaxError: ...",
    ),  # before Python 3.11.4
    (re.compile(r"(SyntaxError: ).*?(?= \[[a-z]+/|$)"), r"\1..."),
    (re.compile(r"\(choose from [^)]*\)"), "(choose from ...)"),
)


class StoredMessages:
    """The messages of one test. Each is compared with the stored one, in order."""

    def __init__(self, item: pytest.Item, stored: Sequence[str], *, updating: bool) -> None:
        """Start to compare the messages of a test.

        Args:
            item: The test.
            stored: Its messages in the file.
            updating: True: nothing is compared, because the file will be written.
        """
        self._item = item
        self._stored = list(stored)
        self._updating = updating
        self.checked: list[str] = []

    def check(self, text: str, mask: str | None = None) -> None:
        """Compare a text with the stored one.

        Args:
            text: What the program printed, or the text of an error.
            mask: Regular expression of parts that differ from run to run; each is stored as `...`.
        """
        __tracebackhide__ = True
        text = self._replace_varying_parts(text if mask is None else re.sub(mask, "...", text))
        number = len(self.checked)
        self.checked.append(text)
        if self._updating:
            return
        hint = f"if this message is right, run `pytest {OPTION} {self._item.nodeid.partition('::')[0]}`"
        assert number < len(self._stored), (
            f"{FILE} does not hold message {number} of this test: {text}\n{hint}"
        )
        assert text == self._stored[number], hint

    def check_count(self) -> None:
        """Raise AssertionError if the file holds more messages than the test compared."""
        extra = len(self._stored) - len(self.checked)
        assert self._updating or extra <= 0, (
            f"{FILE} holds {extra} messages more than this test has; run with {OPTION}"
        )

    def _replace_varying_parts(self, text: str) -> str:
        if isinstance(self._item, pytest.Function) and "tmp_path" in self._item.funcargs:
            text = text.replace(str(self._item.funcargs["tmp_path"]), "TMP")
        text = re.sub(
            r"/[^\s:'\"`]*/pytest-of-[^/\s]+/pytest-\d+/(popen-gw\d+/)?[^/\s:'\"`]*", "TMP", text
        )
        text = text.replace(sys.executable, "PYTHON").replace(
            str(self._item.config.rootpath), "REPOSITORY"
        )
        for pattern, name in VARYING:
            text = pattern.sub(name, text)
        return text


class MessagesPlugin:
    """Provides the stored messages of each test, and writes the file at the end if the option requests it."""

    def __init__(self, config: pytest.Config) -> None:
        self._path = config.rootpath / FILE
        self._updating = bool(config.getoption(OPTION))
        self._is_worker = hasattr(config, "workerinput")  # of pytest-xdist
        self._is_partial = bool(config.getoption("keyword")) or any(
            "::" in argument for argument in config.args
        )
        self._stored: dict[str, list[str]] | None = None
        self._new: dict[str, list[str]] = {}
        self.current: StoredMessages | None = None

    def read_stored(self) -> dict[str, list[str]]:
        """Return the content of the file, which is read once."""
        if self._stored is not None:
            return self._stored
        stored: dict[str, list[str]] = {}
        if self._path.exists():
            stored = json.loads(self._path.read_text(encoding="utf-8"))
        self._stored = stored
        return stored

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Begin with the messages of a test."""
        # A test with Hypothesis has a text for each of its many examples.
        if item.get_closest_marker("hypothesis") is not None:
            return
        stored = self.read_stored().get(make_key(item.nodeid), [])
        self.current = StoredMessages(item, stored, updating=self._updating)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None]:
        """Check that a test has compared all of its messages."""
        yield
        if self.current is None:
            return
        self.current.check_count()
        if self._updating:
            item.user_properties.append((PROPERTY, [make_key(item.nodeid), self.current.checked]))

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_teardown(self) -> None:
        """End with the messages of a test."""
        self.current = None

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Collect the messages of the tests that passed."""
        if report.when == "call" and report.passed:
            properties: list[tuple[str, Any]] = report.user_properties
            self._new |= {value[0]: value[1] for name, value in properties if name == PROPERTY}

    def pytest_sessionfinish(self) -> None:
        """Write the file with the messages of all tests that passed, if the option requests it."""
        if not self._updating or self._is_worker:
            return
        stored = self.read_stored()
        functions = {key.partition("[")[0] for key in self._new}
        kept = {
            key: texts
            for key, texts in stored.items()
            if self._is_partial or key.partition("[")[0] not in functions
        }
        merged = {key: texts for key, texts in sorted({**kept, **self._new}.items()) if texts}
        self._path.write_text(
            json.dumps(merged, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )


def make_key(nodeid: str) -> str:
    """Return the key of a test in the file. It has no folder, so that test files may be moved."""
    path, _, name = nodeid.partition("::")
    return f"{Path(path).name}::{name}"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes the messages into the file."""
    parser.addoption(
        OPTION, action="store_true", help=f"write the messages of the tests that run into {FILE}"
    )


_plugins: list[MessagesPlugin] = []  # of the pytest sessions of this process, the inner one last


def pytest_configure(config: pytest.Config) -> None:
    """Make the plugin of this session."""
    plugin = MessagesPlugin(config)
    config.pluginmanager.register(plugin, "snakesim_messages")
    _plugins.append(plugin)


def pytest_unconfigure() -> None:
    """Discard the plugin of this session."""
    _plugins.pop()


def find_messages() -> StoredMessages | None:
    """Return the messages of the test that runs, if this plugin is loaded."""
    return _plugins[-1].current if _plugins else None


@pytest.fixture
def messages() -> StoredMessages:
    """The messages of this test: `messages.check(text)` compares a text with the stored one."""
    found = find_messages()
    assert found is not None
    return found


@contextmanager
def raises_error(
    error_type: type[ErrorT] | tuple[type[ErrorT], ...],
    *,
    code: str | tuple[str, ...] | None = None,
    field: str | tuple[str, ...] = (),
    value: object = None,
    mask: str | None = None,
    stored: bool = True,
) -> Iterator[pytest.ExceptionInfo[ErrorT]]:
    """Assert that an error is raised, with this code, and with the stored text.

    Args:
        error_type: Its class, or several.
        code: Its code, or the possible ones.
        field: What the message must name: a key, an option, a file, a joint. Several are possible.
        value: The value that the message must name.
        mask: As for `StoredMessages.check`.
        stored: False: the text is not compared, because it differs too much from run to run.

    Yields:
        The error, as `pytest.raises` does.
    """
    __tracebackhide__ = True
    from snakesim_hal.base.errors import SnakesimError

    with pytest.raises(error_type) as caught:
        yield caught
    error = caught.value
    text = str(error)
    if code is not None:
        assert isinstance(error, SnakesimError)
        codes = (code,) if isinstance(code, str) else code
        assert error.code in codes, f"{error.code}: {text}"
    names = [field] if isinstance(field, str) else list(field)
    if value is not None:
        names.append(str(value))
    for name in names:
        assert re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text), (
            f"{name!r} is not named in: {text}"
        )
    messages = find_messages()
    if stored and messages is not None:
        shown = f"{text} [{error.code}]" if isinstance(error, SnakesimError) else text
        messages.check(shown, mask)
