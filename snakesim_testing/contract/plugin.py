"""Adds the options, the fixtures and the table of results of the contract suite to pytest.

This plugin does nothing until a contract test runs.

A bench is the fixture around one backend under test: the backend with its settings, and a column of the table. A clause
is one contract test, and a row of the table. The clauses of one test module are a section of the table.

Its options are --snakesim-backend, -scenario, -set, -mute, -drives and -table. A repository with several benches
implements `pytest_snakesim_benches` in a conftest.py and imports the tests; see docs/hardware/contract-suite.md.
"""

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

# Nothing else of SnakeSIM is imported before it is used: every pytest run loads this module.
if TYPE_CHECKING:
    from snakesim_hal.wire.messages import JointMode
    from snakesim_testing.contract.bench import Bench, EmulatedDrives
    from snakesim_testing.contract.loopback import HostedBackend
    from snakesim_testing.contract.recordings import PushRecording
    from snakesim_testing.contract.rig import BackendRig, Floats, RigRecord

pytest.register_assert_rewrite(
    "snakesim_testing.contract.loopback", "snakesim_testing.contract.rig"
)

# Properties of a test's report; pytest-xdist sends them from its workers, too.
CLAUSE_PROPERTY = "snakesim_clause"
BENCH_PROPERTY = "snakesim_bench"
PACKAGE = "snakesim_testing.contract."
OUTCOMES_WORST_FIRST = ("error", "fail", "skip", "pass")
MIN_COLUMN_WIDTH = 5  # of the longest outcome, "error"
# Tests that share an opening of the backend are adjacent; those that need their own openings come last.
SECTION_ORDER = (
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


class ContractHooks:
    """The hooks that a conftest.py may implement."""

    @staticmethod
    def pytest_snakesim_benches(config: pytest.Config) -> "list[Bench] | None":  # pyright: ignore[reportReturnType]
        """Return the benches that the contract tests below this folder run on if --snakesim-backend is not given."""


def pytest_addhooks(pluginmanager: pytest.PytestPluginManager) -> None:
    """Register the hooks that a conftest.py may implement."""
    pluginmanager.add_hookspecs(ContractHooks)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the contract suite to pytest: the backend to test, its scenario, and its table of results."""
    group = parser.getgroup(
        "snakesim", "contract tests of SnakeSIM backends (--pyargs snakesim_testing.contract)"
    )
    group.addoption(
        "--snakesim-backend",
        metavar="NAME",
        help="backend to test: an installed one, or ./file.py:Class",
    )
    group.addoption(
        "--snakesim-scenario",
        metavar="FILE",
        help="scenario instead of the shipped bench; a name or a path",
    )
    group.addoption(
        "--snakesim-set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a value of the scenario",
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
    group.addoption(
        "--snakesim-table",
        metavar="FILE.md",
        help="write the table of tests and benches as Markdown",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Prepare the storage of benches, and the collector of outcomes."""
    config.stash[_bench_by_name] = {}
    config.pluginmanager.register(OutcomeTable(), "snakesim-outcomes")


# --- benches ---------------------------------------------------------------------------------------------------


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every contract test on every bench. All tests of a bench run in a row, so that it is rarely opened again."""
    if "bench" not in metafunc.fixturenames or not metafunc.function.__module__.startswith(PACKAGE):
        return
    benches = _get_bench_from_options(metafunc.config)
    if not benches:
        benches = _get_benches_from_hook(metafunc)
    if not benches:
        raise pytest.UsageError(
            "contract tests need a backend: give --snakesim-backend NAME or --snakesim-backend ./file.py:Class"
        )
    metafunc.parametrize(
        "bench", benches, ids=[bench.name for bench in benches], indirect=True, scope="session"
    )


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort contract tests into the order of `SECTION_ORDER`; all other tests keep their positions."""
    positions = [i for i, item in enumerate(items) if _find_test_module(item).startswith(PACKAGE)]
    contract_tests = [items[i] for i in positions]
    contract_tests.sort(
        key=lambda item: _compute_sort_position(_find_test_module(item).removeprefix(PACKAGE))
    )
    for i, item in zip(positions, contract_tests, strict=True):
        items[i] = item


def _find_test_module(item: pytest.Item) -> str:
    """Return the module that defines a test; pytest may have collected the test from another file."""
    return getattr(getattr(item, "function", None), "__module__", "")


_bench_by_name = pytest.StashKey["dict[str, Bench]"]()
COMMAND_LINE_BENCH = "--snakesim-backend"


def _get_benches_from_hook(metafunc: pytest.Metafunc) -> "list[Bench]":
    """Return the benches that conftest.py files offer for a test.

    The hook makes new benches for every test. Of those with the same name, the first one is used by all tests.
    """
    results: list[list[Bench] | None] = metafunc.definition.ihook.pytest_snakesim_benches(
        config=metafunc.config
    )
    known = metafunc.config.stash[_bench_by_name]
    benches: list[Bench] = []
    for result in results:
        for bench in result or ():
            benches.append(known.setdefault(bench.name, bench))
    return benches


def _get_bench_from_options(config: pytest.Config) -> "list[Bench]":
    """Return the bench that the command line describes, which all tests share; empty if it names no backend."""
    backend = config.getoption("--snakesim-backend")
    if not backend:
        return []
    known = config.stash[_bench_by_name]
    if COMMAND_LINE_BENCH not in known:
        from snakesim_hal.base.errors import ConfigError

        try:
            known[COMMAND_LINE_BENCH] = _make_bench_from_options(backend, config)
        except ConfigError as error:
            raise pytest.UsageError(str(error)) from error
    return [known[COMMAND_LINE_BENCH]]


def _make_bench_from_options(backend: str, config: pytest.Config) -> "Bench":
    """Make the bench for a backend that the user has named on the command line, and load its scenario.

    A bench is the fixture around one backend under test: the backend with its settings.

    Args:
        backend: Name of an installed backend, or ./file.py:Class.
        config: Configuration of pytest, with the options of the suite.

    Raises:
        ConfigError: The backend, its scenario or a plugin of the options cannot be loaded.
    """
    from snakesim_hal.model.plugins import BACKENDS, load_plugin
    from snakesim_testing.contract.bench import DEFAULT_SCENARIO, Bench

    overrides: list[str] = config.getoption("--snakesim-set") or []  # KEY=VALUE
    # Functions that silence one joint, and that find the emulated drives. They are looked up like backends: by the
    # name of an entry point, or as ./file.py:NAME.
    mute_plugin: str | None = config.getoption("--snakesim-mute")
    drives_plugin: str | None = config.getoption("--snakesim-drives")
    bench = Bench(
        name=backend.rpartition(":")[2],
        backend=backend,
        scenario=str(config.getoption("--snakesim-scenario") or DEFAULT_SCENARIO),
        overrides=tuple(overrides),
        mute_joint=load_plugin(BACKENDS, mute_plugin) if mute_plugin else None,
        make_emulated_drives=load_plugin(BACKENDS, drives_plugin) if drives_plugin else None,
    )
    bench.load_config()  # here, so that a wrong setting is reported once and not by every test
    return bench


@pytest.fixture(scope="session")
def bench(request: pytest.FixtureRequest) -> "Iterator[Bench]":
    """Provide the bench of the backend under test, which is not opened yet, and close it after its last test."""
    bench: Bench = request.param
    if bench.unavailable_reason is not None:
        pytest.skip(bench.unavailable_reason)
    yield bench
    bench.close()


@pytest.fixture
def rig(bench: "Bench", request: pytest.FixtureRequest) -> "Iterator[BackendRig]":
    """Provide the open backend at its start pose, at rest and disarmed. After a failed test, it is reopened."""
    rig = bench.get_shared_rig()
    rig.return_home()
    yield rig
    if rig.late_periods > 1:
        warning = (
            f"{bench.name}: this machine was up to {rig.late_periods:.1f} periods behind real time"
        )
        request.node.add_report_section("call", "clock_mode", warning)
        rig.late_periods = 0.0
    if request.node.stash.get(_failed, False):
        bench.reopen_for_next_test()


@pytest.fixture
def drives(bench: "Bench", rig: "BackendRig") -> "EmulatedDrives":
    """Return the emulated drives of the open backend."""
    drives = bench.find_emulated_drives(rig.backend)
    if drives is None:
        pytest.skip("this bench has no access to emulated drives; give --snakesim-drives")
    return drives


@pytest.fixture
def hosted(bench: "Bench", request: pytest.FixtureRequest) -> "Iterator[HostedBackend]":
    """Provide the backend behind a real host, with a controller. After a failed test both are reopened."""
    yield bench.get_shared_host()
    if request.node.stash.get(_failed, False):
        bench.reopen_for_next_test()


@pytest.fixture
def healthy(bench: "Bench", request: pytest.FixtureRequest) -> "RigRecord":
    """Return the record of 1 s of normal operation, in which every joint swings. It is recorded once for all tests."""
    from snakesim_testing.contract.recordings import record_sway

    return bench.record_once("healthy", lambda: record_sway(request.getfixturevalue("rig")))


@pytest.fixture
def pushing(bench: "Bench", request: pytest.FixtureRequest) -> "PushRecording":
    """Return the record of two joints that push against their end stops. It is recorded once for all tests."""
    from snakesim_testing.contract.recordings import record_push

    return bench.record_once("pushing", lambda: record_push(request.getfixturevalue("rig")))


@pytest.fixture
def switching(
    bench: "Bench", request: pytest.FixtureRequest
) -> "dict[tuple[JointMode, JointMode], Floats]":
    """Return the record of a joint in every change of mode. It is recorded once for all tests."""
    from snakesim_testing.contract.recordings import record_mode_switches

    return bench.record_once(
        "switching", lambda: record_mode_switches(request.getfixturevalue("rig"))
    )


# --- outcomes --------------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add clause and bench to the report of a contract test, and mark the item if the test failed."""
    report = yield
    module = _find_test_module(item)
    if (
        module.startswith(PACKAGE)
        and isinstance(item, pytest.Function)
        and hasattr(item, "callspec")
    ):
        clause = f"{module.removeprefix(PACKAGE)}::{item.originalname}"
        bench: Any = item.callspec.params["bench"]
        for name, value in ((CLAUSE_PROPERTY, clause), (BENCH_PROPERTY, bench.name)):
            if (name, value) not in report.user_properties:
                report.user_properties.append((name, value))
        if report.failed:
            item.stash[_failed] = True
    return report


class OutcomeTable:
    """Collects the outcome of every contract test on every bench, and prints them as one table."""

    def __init__(self) -> None:
        # By module and clause, then by name of the bench: outcomes, each with the reason of a skip.
        self._outcomes_by_clause: dict[tuple[str, str], dict[str, list[tuple[str, str]]]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store an outcome. With pytest-xdist this runs in the process that collects the reports."""
        properties = dict(report.user_properties)
        if CLAUSE_PROPERTY not in properties or (report.when != "call" and report.passed):
            return
        module, _, clause = str(properties[CLAUSE_PROPERTY]).partition("::")
        row = self._outcomes_by_clause.setdefault((module, clause), {})
        outcomes = row.setdefault(str(properties[BENCH_PROPERTY]), [])
        outcome = _get_outcome(report)
        if outcome not in outcomes:
            outcomes.append(outcome)

    def pytest_terminal_summary(
        self, terminalreporter: pytest.TerminalReporter, config: pytest.Config
    ) -> None:
        """Print the table of clauses with their outcome on each bench, and write it to the requested file.

        Args:
            terminalreporter: Prints lines at the end of a session.
            config: Configuration of pytest, with the options of the suite.
        """
        if not self._outcomes_by_clause:
            return
        clauses = sorted(
            self._outcomes_by_clause,
            key=lambda module_and_clause: _compute_sort_position(module_and_clause[0]),
        )
        bench_names = list(
            dict.fromkeys(
                name for by_bench in self._outcomes_by_clause.values() for name in by_bench
            )
        )
        rows: list[ClauseRow] = []
        skip_reasons: list[str] = []
        for module, clause in clauses:
            outcomes_by_bench = self._outcomes_by_clause[module, clause]
            clause_text = _describe_clause(clause)
            worst_outcomes = [
                _find_worst_outcome(outcomes_by_bench.get(name, [])) for name in bench_names
            ]
            rows.append(ClauseRow(module, clause_text, worst_outcomes))
            for bench_name, outcomes in outcomes_by_bench.items():
                skip_reasons += [
                    f"{clause_text}, on {bench_name}: {reason}" for _, reason in outcomes if reason
                ]
        skip_reasons = _merge_skip_reasons(skip_reasons)
        terminalreporter.section("contract")
        for line in format_plain_table(bench_names, rows):
            terminalreporter.write_line(line)
        for reason in skip_reasons:
            terminalreporter.write_line(f"skipped: {reason}")
        path = config.getoption("--snakesim-table")
        if path:
            from snakesim_hal.model.textfiles import write_text

            write_text(Path(path), format_markdown_table(bench_names, rows, skip_reasons))
            terminalreporter.write_line(f"written to {path}")


class ClauseRow(NamedTuple):
    """One row of the table of results: a clause, which is one contract test, with its outcomes."""

    module: str  # test module of the clause, such as `test_modes`
    clause: str  # the clause in words
    outcomes: list[str]  # worst outcome on each bench, in the order of the benches


def format_plain_table(bench_names: list[str], rows: list[ClauseRow]) -> list[str]:
    """Format the table of results for a terminal: one row for each contract test, grouped by test module.

    Args:
        bench_names: Names of the benches, which are the headings of the columns. A bench is a backend under test.
        rows: The results; rows of the same module are adjacent.

    Returns:
        The lines of the table.
    """
    clause_width = max(len(row.clause) for row in rows)
    column_widths = [max(len(name), MIN_COLUMN_WIDTH) for name in bench_names]
    heading = "".join(
        f"  {name:>{width}}" for name, width in zip(bench_names, column_widths, strict=True)
    )
    lines = [" " * clause_width + heading]
    previous_module = ""
    for row in rows:
        if row.module != previous_module:
            lines.append(_format_section_title(row.module).upper())
            previous_module = row.module
        cells = "".join(
            f"  {outcome:>{width}}"
            for outcome, width in zip(row.outcomes, column_widths, strict=True)
        )
        lines.append(f"{row.clause:<{clause_width}}{cells}")
    return lines


def format_markdown_table(
    bench_names: list[str], rows: list[ClauseRow], skip_reasons: list[str]
) -> str:
    """Format the table of results as Markdown, with the reasons of skipped clauses below.

    Args:
        bench_names: Names of the benches, which are the headings of the columns. A bench is a backend under test.
        rows: The results of the contract tests.
        skip_reasons: Sentences about clauses that were skipped.
    """
    table_rows = [["subject", "contract", *bench_names], ["---"] * (2 + len(bench_names))]
    for row in rows:
        table_rows.append([_format_section_title(row.module), row.clause, *row.outcomes])
    text = ""
    for table_row in table_rows:
        text += "| " + " | ".join(table_row) + " |\n"
    for reason in skip_reasons:
        text += f"\nSkipped: {reason}\n"
    return text


def _get_outcome(report: pytest.TestReport) -> tuple[str, str]:
    """Return the outcome of a test, and the reason if it was skipped."""
    if report.skipped:
        # A skip has a tuple of file, line and reason. An expected failure has another object.
        details: Any = report.longrepr
        if isinstance(details, tuple):
            return "skip", details[2].removeprefix("Skipped: ")
        return "skip", "expected to fail"
    if report.failed:
        return ("fail" if report.when == "call" else "error"), ""
    return "pass", ""


def _find_worst_outcome(outcomes: list[tuple[str, str]]) -> str:
    """Return the worst outcome, or a dash if there is none."""
    words = [word for word, _ in outcomes]
    return next((word for word in OUTCOMES_WORST_FIRST if word in words), "-")


def _merge_skip_reasons(reasons: list[str]) -> list[str]:
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


def _format_section_title(module: str) -> str:
    return module.removeprefix("test_")


def _describe_clause(clause: str) -> str:
    return clause.removeprefix("test_").replace("_", " ")


def _compute_sort_position(module: str) -> int:
    subject = _format_section_title(module)
    return SECTION_ORDER.index(subject) if subject in SECTION_ORDER else len(SECTION_ORDER)
