"""`snakesim drive emulate can --firmware` runs the reference firmware in a process that a scan and a driver find."""

import contextlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_can_backend.emulator.command import main
from snakesim_testing.harness.command import make_environment, snakesim
from snakesim_testing.harness.wait import wait_until

COMMAND = "snakesim_can_backend.emulator.command"


@contextlib.contextmanager
def emulate_modules(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Run the modules of a robot in another process; yield their channel and a list that gets their output."""
    channel = f"local:{folder}/bus"
    printed: list[str] = []
    modules = subprocess.Popen(
        [sys.executable, "-m", COMMAND, "triplet", "--firmware", "--channel", channel],
        env=make_environment(folder),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until(lambda: any(Path(folder).glob("bus/*.can")), "the bus of the modules")
        yield channel, printed
    finally:
        modules.terminate()
        output, _ = modules.communicate(timeout=10)
        printed.extend(output.splitlines())


@pytest.mark.heavy
@pytest.mark.e2e
def test_scan_lists_every_module_of_reference_firmware(tmp_path: Path) -> None:
    with emulate_modules(tmp_path) as (channel, printed):
        scan = snakesim("drive", "scan", "can", channel, cwd=tmp_path)
        assert len(re.findall(r"\bdisarmed\b", scan.out)) == 13, scan.printed
    assert printed == [f"modules ready: 13 on {channel}"]


@pytest.mark.e2e
@pytest.mark.quiet
def test_run_drives_reference_firmware_of_another_process(tmp_path: Path) -> None:
    with emulate_modules(tmp_path) as (channel, printed):
        run = snakesim(
            "run", "triplet", "--controller", "hold", "--backend", "can", "--duration", "2", "--out", "run",
            "--set", f'backend.channels=["{channel}"]', cwd=tmp_path,
        )  # fmt: skip
        assert run.code == 0, run.printed
    switches = [line.split(maxsplit=1)[1] for line in printed[1:]]
    assert switches.count("joint_13 torque on") == 1
    assert switches.count("joint_13 torque off") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--firmware"], "--channel local:FOLDER"),
        (["--firmware", "--channel", "vcan0"], "--channel local:FOLDER"),
        (["--firmware", "--channel", "local:a", "--fault", "mute:joint_1@1"], "planned faults"),
        (
            [
                "--firmware",
                "--channel",
                "local:a",
                "--set",
                "backend.mounted.joint_1.connected=false",
            ],
            "joint_1",
        ),
    ],
)
def test_emulate_firmware_with_invalid_input_is_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["triplet", *arguments]) == 2
    assert message in capsys.readouterr().err
