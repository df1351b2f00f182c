"""`snakesim estop` where a robot is there and does not answer."""

from dataclasses import replace

from snakesim_hal.session import Link, open_session
from snakesim_operator import command
from tests.unit.hal.network import running
from tests.unit.hal.test_client_host import run_config


def test_a_robot_that_does_not_answer_a_stop_is_named() -> None:
    with running(run_config()) as run:
        everywhere, said = replace(run.link, namespace=None), list[str]()
        assert command.estop(everywhere, said.append) == 0
        assert said == [f"lab/worm: stopped: {run.status.why}"] and run.status.lifecycle == "estop"
        with open_session(Link(run.link.endpoint, "lab/deaf")) as deaf:
            deaf.declare_alive("hal")
            said.clear()
            assert command.estop(everywhere, said.append) == 1
            assert said[0].startswith("lab/worm: stopped") and said[1].startswith("lab/deaf: NO ANSWER")
            said.clear()
            assert command.estop(Link(run.link.endpoint, "lab/nobody"), said.append) == 1
            assert said == ["lab/nobody: NO ANSWER: use its own emergency stop"]
