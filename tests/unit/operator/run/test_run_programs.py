"""The processes of a run, each as a program of its own."""

from collections.abc import Callable, Sequence

import pytest

from snakesim_hal.programs import host_program as host_process
from snakesim_hal.programs import router_program as router_process
from snakesim_hal.programs import service_program as serve
from snakesim_operator.recording import recorder_process as recorder


@pytest.mark.parametrize(
    ("main", "given"),
    [
        (host_process.main, ()),
        (router_process.main, ()),
        (recorder.main, ()),
        (serve.main, ("control",)),
    ],
)
def test_a_scenario_that_is_not_there_is_wrong_input(
    main: Callable[[Sequence[str]], int], given: Sequence[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*given, "nowhere.toml"]) == 2
    assert "nowhere.toml" in capsys.readouterr().err
