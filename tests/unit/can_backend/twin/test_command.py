"""`snakesim modules`: what it refuses, and that help names every fault."""

import pytest

from snakesim_can_backend.twin.command import main
from snakesim_can_backend.twin.faults import ABOUT


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["triplet", "--channel", "can0"], "--on-real-bus"),
        (["nowhere"], "nowhere"),
        (["triplet", "--pose", "7450"], "HOST:PORT"),
        (["triplet", "--set", "robot.chain.modules=70"], "70 joints"),
        (["triplet", "--channel", "vcan77"], "vcan77"),
    ],
)
def test_wrong_input_is_told_and_nothing_starts(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_wrong_faults_are_told_before_an_interface_is_touched(capsys):
    assert main(["triplet", "--channel", "vcan77", "--fault", "mute:joint_14@1"]) == 2
    assert "joint_13" in capsys.readouterr().err


def test_help_explains_every_fault(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out
    assert all(kind in shown for kind in ABOUT)
