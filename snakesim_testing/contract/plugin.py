"""The pytest plugin: options, fixtures and the table at the end. It does nothing until a contract test runs.

Its options are --snakesim-backend, -scenario, -set, -mute, -drives and -table. A repository with several benches
implements `pytest_snakesim_benches` in a conftest.py and imports the tests; see docs/hardware/contract-suite.md.
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

# Properties of a test's report; pytest-xdist sends them from its workers, too.
CLAUSE = "snakesim_clause"
BENCH = "snakesim_bench"
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
    "recovery",
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
    """Register the hook."""
    pluginmanager.add_hookspecs(Hooks)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the contract suite to pytest: the backend to test, its scenario, and its table of results."""
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
        help="CLASS(backend) has a backend's emulated drives: see EmulatedDrives in docs/hardware/contract-suite.md",
    )
    group.addoption("--snakesim-table", metavar="FILE.md", help="write the table of tests and benches as Markdown")


def pytest_configure(config: pytest.Config) -> None:
    """Prepare the storage of benches, and the collector of outcomes."""
    config.stash[_benches] = {}
    config.pluginmanager.register(Outcomes(), "snakesim-outcomes")


# --- benches ---------------------------------------------------------------------------------------------------


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every contract test on every bench. All tests of a bench run in a row, so that it is rarely opened again."""
    if "bench" not in metafunc.fixturenames or not metafunc.function.__module__.startswith(PACKAGE):
        return
    benches = _find_benches_in_options(metafunc.config)
    if not benches:
        benches = _find_benches_in_hook(metafunc)
    if not benches:
        raise pytest.UsageError(
            "contract tests need a backend: give --snakesim-backend NAME or --snakesim-backend ./file.py:Class"
        )
    metafunc.parametrize("bench", benches, ids=[bench.name for bench in benches], indirect=True, scope="session")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort contract tests into the order of `SUBJECTS`; all other tests keep their positions."""
    positions = [i for i, item in enumerate(items) if _find_test_module(item).startswith(PACKAGE)]
    contract_tests = [items[i] for i in positions]
    contract_tests.sort(key=lambda item: _sort_key(_find_test_module(item).removeprefix(PACKAGE)))
    for i, item in zip(positions, contract_tests, strict=True):
        items[i] = item


def _find_test_module(item: pytest.Item) -> str:
    """Return the module that defines a test; pytest may have collected the test from another file."""
    return getattr(getattr(item, "function", None), "__module__", "")


_benches = pytest.StashKey["dict[str, Bench]"]()
COMMAND_LINE = "--snakesim-backend"


def _find_benches_in_hook(metafunc: pytest.Metafunc) -> "list[Bench]":
    """Return the benches of conftest.py files. The hook is called for every test; tests share a bench by its name."""
    results: list[list[Bench] | None] = metafunc.definition.ihook.pytest_snakesim_benches(config=metafunc.config)
    known = metafunc.config.stash[_benches]
    benches: list[Bench] = []
    for result in results:
        for bench in result or ():
            benches.append(known.setdefault(bench.name, bench))
    return benches


def _find_benches_in_options(config: pytest.Config) -> "list[Bench]":
    """Return the bench that the options describe, made once; empty if they name no backend."""
    backend = config.getoption("--snakesim-backend")
    if not backend:
        return []
    known = config.stash[_benches]
    if COMMAND_LINE not in known:
        from snakesim_hal.base.errors import ConfigError

        try:
            known[COMMAND_LINE] = _make_bench_from_options(backend, config)
        except ConfigError as error:
            raise pytest.UsageError(str(error)) from error
    return [known[COMMAND_LINE]]


def _make_bench_from_options(backend: str, config: pytest.Config) -> "Bench":
    """Return the bench for a backend that the user has named on the command line.

    Args:
        backend: name of an installed backend, or ./file.py:Class.
        config: configuration of pytest, with the options of the suite.

    Raises:
        ConfigError: the backend or its scenario cannot be loaded.
    """
    from snakesim_hal.model.plugins import BACKENDS, find_plugin
    from snakesim_testing.contract.bench import SCENARIO, Bench

    sets: list[str] = config.getoption("--snakesim-set") or []
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
    assert bench.config  # loads it here, so that a wrong setting is reported once and not by every test
    return bench


@pytest.fixture(scope="session")
def bench(request: pytest.FixtureRequest) -> "Iterator[Bench]":
    """Provide a backend under test, which is not opened yet."""
    bench: Bench = request.param
    if bench.unavailable is not None:
        pytest.skip(bench.unavailable)
    yield bench
    bench.close()


@pytest.fixture
def rig(bench: "Bench", request: pytest.FixtureRequest) -> "Iterator[Rig]":
    """Provide the open backend at its start pose, at rest and disarmed. After a failed test it is reopened."""
    rig = bench.shared_rig()
    rig.go_home()
    yield rig
    if rig.late_periods > 1:
        warning = f"{bench.name}: this machine fell {rig.late_periods:.1f} periods behind real time"
        request.node.add_report_section("call", "clock_mode", warning)
        rig.late_periods = 0.0
    if request.node.stash.get(_failed, False):
        bench.reopen_for_next_test()


@pytest.fixture
def drives(bench: "Bench", rig: "Rig") -> "EmulatedDrives":
    """Return the emulated drives of the open backend."""
    drives = bench.look_at_drives(rig.backend)
    if drives is None:
        pytest.skip("this bench has no emulated drives to look at; give --snakesim-drives")
    return drives


@pytest.fixture
def hosted(bench: "Bench", request: pytest.FixtureRequest) -> "Iterator[Hosted]":
    """Provide the backend behind a real host, with a controller. After a failed test both are reopened."""
    yield bench.shared_host()
    if request.node.stash.get(_failed, False):
        bench.reopen_for_next_test()


@pytest.fixture
def healthy(bench: "Bench", request: pytest.FixtureRequest) -> "Record":
    """Return a second of normal operation, in which every joint sways; recorded once for all tests."""
    from snakesim_testing.contract.recordings import record_sway

    return bench.record_once("healthy", lambda: record_sway(request.getfixturevalue("rig")))


@pytest.fixture
def pushing(bench: "Bench", request: pytest.FixtureRequest) -> "Pushing":
    """Return two joints that push against their stops; recorded once for all tests."""
    from snakesim_testing.contract.recordings import record_push

    return bench.record_once("pushing", lambda: record_push(request.getfixturevalue("rig")))


@pytest.fixture
def switching(bench: "Bench", request: pytest.FixtureRequest) -> "dict[tuple[Mode, Mode], Floats]":
    """Return one joint through every change of mode; recorded once for all tests."""
    from snakesim_testing.contract.recordings import record_switching

    return bench.record_once("switching", lambda: record_switching(request.getfixturevalue("rig")))


# --- outcomes --------------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add clause and bench to the report of a contract test, and mark the item if the test failed."""
    report = yield
    module = _find_test_module(item)
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
        # (module, clause) -> bench -> outcomes with the reason of a skip
        self._rows: dict[tuple[str, str], dict[str, list[tuple[str, str]]]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store an outcome. With pytest-xdist this runs in the process that collects the reports."""
        properties = dict(report.user_properties)
        if CLAUSE not in properties or (report.when != "call" and report.passed):
            return
        module, _, clause = str(properties[CLAUSE]).partition("::")
        row = self._rows.setdefault((module, clause), {})
        outcomes = row.setdefault(str(properties[BENCH]), [])
        outcome = _get_outcome(report)
        if outcome not in outcomes:
            outcomes.append(outcome)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
        """Print the table of clauses with their outcome on each bench, and write it to the requested file.

        Args:
            terminalreporter: prints lines at the end of a session.
            config: configuration of pytest, with the options of the suite.
        """
        if not self._rows:
            return
        benches = list(dict.fromkeys(bench for row in self._rows.values() for bench in row))
        lines: list[list[str]] = []  # module, clause, and the worst outcome on each bench
        skip_reasons: list[str] = []
        for (module, clause), row in sorted(self._rows.items(), key=lambda item: _sort_key(item[0][0])):
            clause_text = _describe_clause(clause)
            lines.append([module, clause_text, *(_find_worst_outcome(row.get(bench, [])) for bench in benches)])
            for bench, outcomes in row.items():
                skip_reasons += [f"{clause_text}, on {bench}: {reason}" for _, reason in outcomes if reason]
        skip_reasons = _merge_reasons(skip_reasons)
        terminalreporter.section("contract")
        for line in format_plain_table(benches, lines):
            terminalreporter.write_line(line)
        for reason in skip_reasons:
            terminalreporter.write_line(f"skipped: {reason}")
        path = config.getoption("--snakesim-table")
        if path:
            from snakesim_hal.model.textfiles import write_text

            write_text(Path(path), format_markdown_table(benches, lines, skip_reasons))
            terminalreporter.write_line(f"written to {path}")


def format_plain_table(benches: list[str], lines: list[list[str]]) -> list[str]:
    """Return the table for a terminal: one line a clause, below the name of its subject.

    Args:
        benches: names of the columns.
        lines: module, clause, and the outcome on each bench.
    """
    clause_width = max(len(line[1]) for line in lines)
    widths = [max(len(bench), 5) for bench in benches]
    heading = "".join(f"  {bench:>{width}}" for bench, width in zip(benches, widths, strict=True))
    table = [" " * clause_width + heading]
    previous_module = ""
    for module, clause, *outcomes in lines:
        if module != previous_module:
            table.append(_name_subject(module).upper())
            previous_module = module
        cells = "".join(f"  {outcome:>{width}}" for outcome, width in zip(outcomes, widths, strict=True))
        table.append(f"{clause:<{clause_width}}{cells}")
    return table


def format_markdown_table(benches: list[str], lines: list[list[str]], skip_reasons: list[str]) -> str:
    """Return the table as Markdown, with the reasons of skipped clauses below."""
    rows = [["subject", "contract", *benches], ["---"] * (2 + len(benches))]
    for module, *cells in lines:
        rows.append([_name_subject(module), *cells])
    text = ""
    for row in rows:
        text += "| " + " | ".join(row) + " |\n"
    for reason in skip_reasons:
        text += f"\nSkipped: {reason}\n"
    return text


def _get_outcome(report: pytest.TestReport) -> tuple[str, str]:
    """Return the outcome of a test, and the reason if it was skipped."""
    if report.skipped:
        details: Any = report.longrepr  # (file, line, reason) of a skip; something else of an expected failure
        if isinstance(details, tuple):
            return "skip", details[2].removeprefix("Skipped: ")
        return "skip", "expected to fail"
    if report.failed:
        return ("fail" if report.when == "call" else "error"), ""
    return "pass", ""


def _find_worst_outcome(outcomes: list[tuple[str, str]]) -> str:
    """Return the worst of some outcomes; a dash if there is none."""
    words = [word for word, _ in outcomes]
    return next((word for word in WORST_FIRST if word in words), "-")


def _merge_reasons(reasons: list[str]) -> list[str]:
    """Merge clauses that were skipped for the same reason on the same bench, as on an unavailable one."""
    reasons_by_cause: dict[str, list[str]] = {}  # "BENCH: REASON" -> the full reasons
    for reason in reasons:
        cause = reason.partition(", on ")[2]
        reasons_by_cause.setdefault(cause, []).append(reason)
    merged: list[str] = []
    for cause, same_cause in reasons_by_cause.items():
        if len(same_cause) == 1:
            merged.append(same_cause[0])
        else:
            merged.append(f"{len(same_cause)} clauses, on {cause}")
    return merged


def _name_subject(module: str) -> str:
    return module.removeprefix("test_")


def _describe_clause(clause: str) -> str:
    return clause.removeprefix("test_").replace("_", " ")


def _sort_key(module: str) -> int:
    subject = _name_subject(module)
    return SUBJECTS.index(subject) if subject in SUBJECTS else len(SUBJECTS)
