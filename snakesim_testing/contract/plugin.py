"""The pytest plugin: options, fixtures and the table at the end. It does nothing until a contract test runs.

Options of its own: --snakesim-backend, -scenario, -set, -mute, -drives, -table. A repository with several benches
implements `pytest_snakesim_benches` in a conftest.py and imports the tests; see docs/backends.md.
"""

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:  # nothing else of SnakeSIM is imported before it is used: every pytest run loads this module
    from snakesim_hal.wire.messages import Mode
    from snakesim_testing.contract.bench import Bench, EmulatedDrives
    from snakesim_testing.contract.loopback import Hosted
    from snakesim_testing.contract.recordings import Pushing
    from snakesim_testing.contract.rig import Floats, Record, Rig

pytest.register_assert_rewrite("snakesim_testing.contract.loopback", "snakesim_testing.contract.rig")

CLAUSE, BENCH = "snakesim_clause", "snakesim_bench"  # properties that a test's report carries, also between workers
PACKAGE = "snakesim_testing.contract."
WORST_FIRST = ("error", "fail", "skip", "pass")
# Tests that share an opening of the backend are adjacent; those that need their own openings come last.
SUBJECTS = (
    "description",
    "samples",
    "modes",
    "limits",
    "switching",
    "lifecycle",
    "faults",
    "drives",
    "host",
    "closing",
)
_failed = pytest.StashKey[bool]()


class Hooks:
    """What a conftest.py may implement."""

    @staticmethod
    def pytest_snakesim_benches(config: pytest.Config) -> "list[Bench] | None":  # pyright: ignore[reportReturnType]
        """Benches that the contract tests below this folder run on, when no --snakesim-backend is given."""


def pytest_addhooks(pluginmanager: pytest.PytestPluginManager) -> None:
    """Make the hook known."""
    pluginmanager.add_hookspecs(Hooks)


def pytest_addoption(parser: pytest.Parser) -> None:
    """The options."""
    group = parser.getgroup("snakesim", "contract tests of SnakeSIM backends (--pyargs snakesim_testing.contract)")
    group.addoption("--snakesim-backend", metavar="NAME", help="backend to test: an installed one, or ./file.py:Class")
    group.addoption(
        "--snakesim-scenario", metavar="FILE", help="scenario instead of the shipped bench; a name or a path"
    )
    group.addoption(
        "--snakesim-set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the scenario"
    )
    group.addoption(
        "--snakesim-mute",
        metavar="./FILE.py:FUNCTION",
        help="function(backend, joint) that silences a joint's module",
    )
    group.addoption(
        "--snakesim-drives",
        metavar="./FILE.py:CLASS",
        help="CLASS(backend) is the emulated drives of an open backend: see EmulatedDrives in docs/backends.md",
    )
    group.addoption("--snakesim-table", metavar="FILE.md", help="write the table of tests and benches as Markdown")


def pytest_configure(config: pytest.Config) -> None:
    """Storage for the benches, and a collector of the outcomes."""
    config.stash[_benches] = {}
    config.pluginmanager.register(Outcomes(), "snakesim-outcomes")


# --- benches ---------------------------------------------------------------------------------------------------


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every contract test on every bench; all tests of a bench in a row, so that it is opened seldom."""
    if "bench" not in metafunc.fixturenames or not metafunc.function.__module__.startswith(PACKAGE):
        return
    benches = _from_options(metafunc.config)
    if not benches:
        benches = _from_hook(metafunc)
    if not benches:
        raise pytest.UsageError(
            "contract tests need a backend: give --snakesim-backend NAME or --snakesim-backend ./file.py:Class"
        )
    metafunc.parametrize("bench", benches, ids=[bench.name for bench in benches], indirect=True, scope="session")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put contract tests into the order of `SUBJECTS`; all other tests stay where they are."""
    ours = [i for i, item in enumerate(items) if _module_of(item).startswith(PACKAGE)]
    ordered = sorted((items[i] for i in ours), key=lambda item: _place(_module_of(item).removeprefix(PACKAGE)))
    for i, item in zip(ours, ordered, strict=True):
        items[i] = item


def _module_of(item: pytest.Item) -> str:
    """The module that defines a test, which is not always the file that it is collected from."""
    return getattr(getattr(item, "function", None), "__module__", "")


_benches = pytest.StashKey["dict[str, Bench]"]()
COMMAND_LINE = "--snakesim-backend"


def _from_hook(metafunc: pytest.Metafunc) -> "list[Bench]":
    """Benches of conftest.py files. The hook is called for every test; tests share the first bench of a name."""
    found: list[list[Bench] | None] = metafunc.definition.ihook.pytest_snakesim_benches(config=metafunc.config)
    known = metafunc.config.stash[_benches]
    return [known.setdefault(bench.name, bench) for some in found if some for bench in some]


def _from_options(config: pytest.Config) -> "list[Bench]":
    backend = config.getoption("--snakesim-backend")
    if not backend:
        return []
    known = config.stash[_benches]
    if COMMAND_LINE not in known:
        from snakesim_hal.base.errors import ConfigError
        from snakesim_hal.model.plugins import BACKENDS, find_plugin
        from snakesim_testing.contract.bench import SCENARIO, Bench

        sets: list[str] = config.getoption("--snakesim-set") or []
        try:
            mute: Any = config.getoption("--snakesim-mute")
            drives: Any = config.getoption("--snakesim-drives")
            bench = Bench(
                backend.rpartition(":")[2],
                backend,
                scenario=str(config.getoption("--snakesim-scenario") or SCENARIO),
                sets=tuple(sets),
                mute=find_plugin(BACKENDS, mute) if mute else None,
                drives=find_plugin(BACKENDS, drives) if drives else None,
            )
            assert bench.config  # a wrong setting is reported once, not by every test
        except ConfigError as error:
            raise pytest.UsageError(str(error)) from error
        known[COMMAND_LINE] = bench
    return [known[COMMAND_LINE]]


@pytest.fixture(scope="session")
def bench(request: pytest.FixtureRequest) -> "Iterator[Bench]":
    """A backend under test, not opened yet."""
    bench: Bench = request.param
    if bench.unavailable is not None:
        pytest.skip(bench.unavailable)
    yield bench
    bench.close()


@pytest.fixture
def rig(bench: "Bench", request: pytest.FixtureRequest) -> "Iterator[Rig]":
    """The backend, opened, at its start pose, at rest and disarmed. After a failed test it is reopened."""
    rig = bench.rig()
    rig.go_home()
    yield rig
    if rig.late_periods > 1:
        what = f"{bench.name}: this machine fell {rig.late_periods:.1f} periods behind real time"
        request.node.add_report_section("call", "clock_mode", what)
        rig.late_periods = 0.0
    if request.node.stash.get(_failed, False):
        bench.spoil()


@pytest.fixture
def drives(bench: "Bench", rig: "Rig") -> "EmulatedDrives":
    """The emulated drives of the open backend."""
    if bench.drives is None:
        pytest.skip("this bench has no emulated drives to look at; give --snakesim-drives")
    return bench.drives(rig.backend)


@pytest.fixture
def hosted(bench: "Bench", request: pytest.FixtureRequest) -> "Iterator[Hosted]":
    """The backend behind a real host, with a controller. After a failed test both are reopened."""
    yield bench.hosted()
    if request.node.stash.get(_failed, False):
        bench.spoil()


@pytest.fixture
def healthy(bench: "Bench", request: pytest.FixtureRequest) -> "Record":
    """A second of normal operation: every joint sways. Recorded once for all tests that read it."""
    from snakesim_testing.contract.recordings import sway

    return bench.keep("healthy", lambda: sway(request.getfixturevalue("rig")))


@pytest.fixture
def pushing(bench: "Bench", request: pytest.FixtureRequest) -> "Pushing":
    """Two joints pushing against their stops. Recorded once."""
    from snakesim_testing.contract.recordings import push

    return bench.keep("pushing", lambda: push(request.getfixturevalue("rig")))


@pytest.fixture
def switching(bench: "Bench", request: pytest.FixtureRequest) -> "dict[tuple[Mode, Mode], Floats]":
    """One joint through every change of mode. Recorded once."""
    from snakesim_testing.contract.recordings import switch

    return bench.keep("switching", lambda: switch(request.getfixturevalue("rig")))


# --- outcomes --------------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note the clause on the report, and on the item whether it failed."""
    report = yield
    module = _module_of(item)
    if module.startswith(PACKAGE) and isinstance(item, pytest.Function) and hasattr(item, "callspec"):
        clause = f"{module.removeprefix(PACKAGE)}::{item.originalname}"
        bench: Any = item.callspec.params["bench"]
        for name, value in ((CLAUSE, clause), (BENCH, bench.name)):
            if (name, value) not in report.user_properties:
                report.user_properties.append((name, value))
        if report.failed:
            item.stash[_failed] = True
    return report


class Outcomes:
    """Collects the outcome of every contract test on every bench, and prints them as one table."""

    def __init__(self) -> None:
        self._rows: dict[tuple[str, str], dict[str, list[tuple[str, str]]]] = {}  # clause -> bench -> (word, why)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store an outcome; with pytest-xdist this runs in the controller process."""
        properties = dict(report.user_properties)
        if CLAUSE not in properties or (report.when != "call" and report.passed):
            return
        module, _, clause = str(properties[CLAUSE]).partition("::")
        cell = self._rows.setdefault((module, clause), {}).setdefault(str(properties[BENCH]), [])
        if (outcome := _outcome(report)) not in cell:
            cell.append(outcome)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
        """Print the table, and write it to the requested file."""
        if not self._rows:
            return
        rows = dict(sorted(self._rows.items(), key=lambda row: _place(row[0][0])))
        benches = list(dict.fromkeys(bench for row in rows.values() for bench in row))
        lines = [
            [module, _sentence(clause), *(_worst(row.get(bench, [])) for bench in benches)]
            for (module, clause), row in rows.items()
        ]
        reasons = [
            f"{_sentence(clause)}, on {bench}: {why}"
            for (_, clause), row in rows.items()
            for bench, cell in row.items()
            for _, why in cell
            if why
        ]
        reasons = _without_repetition(reasons)
        terminalreporter.section("contract")
        for line in plain(benches, lines):
            terminalreporter.write_line(line)
        for reason in reasons:
            terminalreporter.write_line(f"skipped: {reason}")
        if path := config.getoption("--snakesim-table"):
            from snakesim_hal.model.textfiles import write_text

            write_text(Path(path), markdown(benches, lines, reasons))
            terminalreporter.write_line(f"written to {path}")


def plain(benches: list[str], lines: list[list[str]]) -> list[str]:
    """The table for a terminal: one line a clause, grouped by subject."""
    width = max(len(line[1]) for line in lines)
    columns = [max(len(bench), 5) for bench in benches]
    text = [" " * width + "".join(f"  {bench:>{column}}" for bench, column in zip(benches, columns, strict=True))]
    subject = ""
    for module, clause, *words in lines:
        if module != subject:
            subject = module
            text.append(_subject(module).upper())
        text.append(f"{clause:<{width}}" + "".join(f"  {w:>{c}}" for w, c in zip(words, columns, strict=True)))
    return text


def markdown(benches: list[str], lines: list[list[str]], reasons: list[str]) -> str:
    """The table as Markdown."""
    table = [["subject", "contract", *benches], ["---"] * (2 + len(benches))]
    table += [[_subject(module), *rest] for module, *rest in lines]
    text = "\n".join("| " + " | ".join(line) + " |" for line in table) + "\n"
    return text + "".join(f"\nSkipped: {reason}\n" for reason in reasons)


def _outcome(report: pytest.TestReport) -> tuple[str, str]:
    if report.skipped:
        where: Any = report.longrepr  # (file, line, reason) of a skip; something else of an expected failure
        return "skip", where[2].removeprefix("Skipped: ") if isinstance(where, tuple) else "expected to fail"
    if report.failed:
        return ("fail" if report.when == "call" else "error"), ""
    return "pass", ""


def _worst(outcomes: list[tuple[str, str]]) -> str:
    words = [word for word, _ in outcomes]
    return next((word for word in WORST_FIRST if word in words), "-")


def _without_repetition(reasons: list[str]) -> list[str]:
    """An unavailable bench is reported once, not for every clause."""
    seen: dict[str, list[str]] = {}
    for reason in reasons:
        seen.setdefault(reason.partition(", on ")[2], []).append(reason)
    return [same[0] if len(same) == 1 else f"{len(same)} clauses, on {why}" for why, same in seen.items()]


def _subject(module: str) -> str:
    return module.removeprefix("test_")


def _sentence(clause: str) -> str:
    return clause.removeprefix("test_").replace("_", " ")


def _place(module: str) -> int:
    return SUBJECTS.index(_subject(module)) if _subject(module) in SUBJECTS else len(SUBJECTS)
