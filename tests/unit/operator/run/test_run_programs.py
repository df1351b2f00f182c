"""The processes of a run, each of which is also a separate program."""

from collections.abc import Callable, Sequence

import pytest

from snakesim_hal.programs import host_program, router_program, service_program
from snakesim_operator.recording import recorder_process


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (host_program.main, ()),
        (router_program.main, ()),
        (recorder_process.main, ()),
        (service_program.main, ("control",)),
    ],
)
def test_run_program_with_missing_scenario_fails_and_names_it(
    main: Callable[[Sequence[str]], int],
    arguments: Sequence[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([*arguments, "nowhere.toml"]) == 2
    assert "nowhere.toml" in capsys.readouterr().err
