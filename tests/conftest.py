"""Every test runs with a state folder of its own and tries the same examples each time. A failure is shown at once."""

import gc
import random

import pytest

import snakesim_testing.isolation  # noqa: F401 - first: it fixes the arithmetic before NumPy is imported
from snakesim_hal.base.process import make_collections_rare
from snakesim_native.compile import SHIPPED_FOLDER, compile_all
from snakesim_testing.hypothesis_profiles import load_profile

make_collections_rare()
pytest_plugins = ["snakesim_testing.contract.plugin", "snakesim_testing.messages"]
load_profile()


class FailuresAtOnce:
    """Print a failure when it happens; the whole text of all of them follows at the end."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        terminal = self._config.pluginmanager.get_plugin("terminalreporter")
        if not report.failed or terminal is None:
            return
        reasons = [line for line in report.longreprtext.splitlines() if line.startswith("E ")] or [
            ""
        ]
        terminal.write_line(f"\nFAILED {report.nodeid}: {reasons[0][1:].strip()}", red=True)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run the tests in a random order")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    seed = config.getoption("--shuffle")
    if seed is not None:
        random.Random(seed).shuffle(items)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Exclude the collected tests from garbage collection, which would visit all of them in every test."""
    gc.collect()
    gc.freeze()


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):  # a worker of pytest-xdist prints nothing
        config.pluginmanager.register(FailuresAtOnce(config), "failures-at-once")
        compile_all(SHIPPED_FOLDER)  # here, because a unit test may not start a compiler
