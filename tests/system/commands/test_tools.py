"""Commands handle closed outputs and interrupts, watch a running robot, and run controllers of other packages."""

import json
import os
import pty
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.processes import assert_no_process_left
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.command import (
    SNAKESIM_COMMAND,
    RunningCommand,
    make_environment,
    run_program,
    running_armed_snakesim,
    snakesim,
)

pytestmark = pytest.mark.e2e

DELAY_STEP_S = 0.12  # between the times at which a starting command is interrupted
TUTORIAL = Path("docs/tutorials/write-a-controller.md").resolve()


def echo_messages(run: RunningCommand, key: str, count: int, *options: str) -> list[dict[str, Any]]:
    """Return the lines that `snakesim topic echo` prints, decoded from JSON."""
    completed = command.run_command_for_robot(
        run, "topic", "echo", key, "--count", str(count), *options
    )
    assert completed.code == 0, completed.err
    assert completed.err == ""
    lines = [json.loads(line) for line in completed.out.splitlines()]
    assert len(lines) == count
    assert all(set(line) in ({"key", "message"}, {"key", "error"}) for line in lines)
    return lines


@pytest.mark.heavy
def test_command_with_unwritable_output_prints_one_line(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        completed = subprocess.run(
            [*SNAKESIM_COMMAND, "scenario", "list"],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert completed.returncode == 1
    assert completed.stderr.startswith("snakesim: ")
    assert completed.stderr.count("\n") == 1
    piped = run_program(
        ["sh", "-c", f"{' '.join(SNAKESIM_COMMAND)} config triplet | head -1"], tmp_path
    )
    assert piped.err == ""
    assert piped.out.count("\n") == 1


@pytest.mark.slow
def test_run_with_unread_output_completes(tmp_path: Path) -> None:
    run = f"{' '.join(SNAKESIM_COMMAND)} run triplet --in-process --duration 1 --no-record --out"
    for number, redirection in enumerate(("| head -0", ">&-", "> /dev/full 2>&1")):
        completed = run_program(
            ["bash", "-c", f"set -o pipefail; {run} {number} {redirection}"], tmp_path
        )
        assert (completed.code, completed.err) == (0, ""), f"{redirection}: {completed.err}"
        assert (tmp_path / str(number) / "summary.json").exists(), redirection


@pytest.mark.heavy
def test_run_with_closed_terminal_ends_in_order(tmp_path: Path) -> None:
    test_end, command_end = pty.openpty()
    endpoint = find_free_endpoint()
    run = ["run", "triplet", "--clock-mode", "realtime", "--out", "run", "--endpoint", endpoint]
    process = subprocess.Popen(
        ["env", "--default-signal=HUP", "setsid", "--ctty", *SNAKESIM_COMMAND, *run],
        cwd=tmp_path,
        env=make_environment(tmp_path),
        stdin=command_end,
        stdout=command_end,
        stderr=command_end,
    )
    os.close(command_end)
    output = b""
    while b" of 10 s" not in output:
        output += os.read(test_end, 4096)
    os.close(test_end)
    assert process.wait(30) == 130
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["command_digest"]
    assert_no_process_left(tmp_path / "run")


INTERRUPTED_COMMANDS = (
    ["config", "triplet"],
    ["scenario", "list"],
    ["drive", "load", "can", "triplet"],
    ["schema", "--out", "schemas"],
    ["topic", "echo", "hal/clock"],
    ["status"],
    ["robot", "arm", "planar13", "sim"],
    ["drive", "emulate", "can", "triplet"],
    ["run", "triplet", "--clock-mode", "realtime", "--out", "run"],
)


@pytest.mark.heavy
@pytest.mark.parametrize(
    "arguments",
    [
        arguments if arguments[0] == "run" else pytest.param(arguments, marks=pytest.mark.slow)
        for arguments in INTERRUPTED_COMMANDS
    ],
    ids=lambda arguments: arguments[0],
)
def test_command_interrupted_while_starting_prints_no_traceback(
    arguments: list[str], tmp_path: Path
) -> None:
    """The command handles Ctrl-C from its first line on; before it, the Python interpreter is starting."""
    on_network = arguments[0] in ("topic", "status", "robot", "run")
    endpoint = ["--endpoint", find_free_endpoint()] if on_network else []
    for delay_step in range(7):
        process = subprocess.Popen(
            [*SNAKESIM_COMMAND, *arguments, *endpoint],
            cwd=tmp_path,
            env=make_environment(tmp_path),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        wait_until(lambda pid=process.pid: has_run_first_line(pid), "the first line of the command")
        time.sleep(DELAY_STEP_S * delay_step)
        os.killpg(process.pid, signal.SIGINT)  # A terminal also signals the whole group.
        output, _ = process.communicate(timeout=60)
        assert "Traceback" not in output, output
        assert "KeyboardInterrupt" not in output, output
        assert "Exception ignored" not in output, output
    assert_no_process_left(tmp_path / "run")


def has_run_first_line(pid: int) -> bool:
    """Return whether a process has replaced Python's handler of SIGINT and loads its modules, or has ended."""
    fields = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    maps = Path(f"/proc/{pid}/maps").read_text()
    catches_sigint = int(fields.get("SigCgt", "0"), 16) >> (signal.SIGINT - 1) & 1
    is_zombie = fields["State"].strip().startswith("Z")
    loads_modules = "lib-dynload" in maps or "site-packages" in maps
    return is_zombie or (not catches_sigint and loads_modules)


@pytest.mark.heavy
def test_topic_and_status_commands_show_a_running_robot(tmp_path: Path) -> None:
    arguments = ["triplet", "--controller", "hold", "--duration", "600", "--clock-mode", "realtime"]
    with running_armed_snakesim(tmp_path / "run", *arguments) as run:
        rate = command.run_command_for_robot(run, "topic", "rate", "sensor/joints", "--count", "2")
        rates_hz = re.findall(r"planar13/sensor/joints: ([\d.]+) Hz", rate.out)
        assert rates_hz, rate.out + rate.err
        assert float(rates_hz[-1]) == pytest.approx(100, rel=0.1), rate.out + rate.err
        (description,) = echo_messages(run, "hal/description", 1)
        assert description["key"] == "planar13/hal/description"
        assert description["message"]["joints"][12]["name"] == "joint_13"
        samples = echo_messages(run, "sensor/**", 40)
        assert {"planar13/sensor/joints", "planar13/sensor/imu"} <= {
            line["key"] for line in samples
        }
        assert all("tick" in line["message"] for line in samples)
        all_keys = {line["key"] for line in echo_messages(run, "**", 200)}
        assert {
            "planar13/hal/description",
            "planar13/hal/clock",
            "planar13/hal/done/guidance",
        } <= all_keys
        of_robot = echo_messages(run, "*/joints", 3, "--namespace", "planar13")
        assert {line["key"] for line in of_robot} <= {"sensor/joints", "actuator/joints"}
        unknown = command.run_command_for_robot(run, "topic", "echo", "sensor/smell")
        assert unknown.code == 2
        assert "sensor/contacts" in unknown.err
        invalid = command.run_command_for_robot(run, "topic", "echo", "sensor/***")
        assert invalid.code == 2
        assert "is not a key" in invalid.err
        assert invalid.err.count("\n") == 1
        status = command.run_command_for_robot(run, "status")
        assert status.code == 0
        assert "planar13: armed" in status.out
        assert "control, guidance, navigation" in status.out
        assert run.interrupt() == 130


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="makes a network namespace, which needs root")
def test_run_on_every_address_needs_the_insecure_option(tmp_path: Path) -> None:
    """The run is in its own network namespace, which has only loopback."""
    run = f"{' '.join(SNAKESIM_COMMAND)} run triplet --controller hold --duration 1 --out run"
    for flags, code in (("", 2), (" --insecure", 0), (" --insecure --with-router", 0)):
        script = f"ip link set lo up && exec {run} --endpoint tcp/0.0.0.0:7461{flags}"
        completed = run_program(["unshare", "--net", "sh", "-c", script], tmp_path, timeout_s=120.0)
        assert completed.code == code, completed.printed


@pytest.mark.heavy
def test_tutorial_controller_runs_from_file_and_installed_package(tmp_path: Path) -> None:
    blocks = re.findall(
        r"```python wave\.py\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL
    )
    example = next(block for block in blocks if "class Wave" in block)
    assert len([line for line in example.splitlines() if line.strip()]) <= 30
    (tmp_path / "wave.py").write_text(f"import shape, queue\n{example}", encoding="utf-8")
    (tmp_path / "shape.py").write_text("")  # The controller may import a file of its folder.
    # Files with names of other modules must replace no module in any process of a run.
    for name in ("random", "queue", "can", "calendar"):
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'executed')!r}, 'a').write(__name__)"
        )
    duration = ("--duration", "2")
    completed, summary = command.run_to_summary(
        tmp_path / "run", "triplet", "--controller", "./wave.py:Wave", *duration
    )
    assert completed.code == 0, completed.out + completed.err
    assert summary.controller == "./wave.py:Wave"
    assert summary.energy_j is not None
    assert summary.energy_j > 0.1

    # Another installed package provides the same class with an entry point.
    package = tmp_path / "site" / "waves-1.0.dist-info"
    package.mkdir(parents=True)
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: waves\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[snakesim.controllers]\nwave = wave:Wave\n")
    (tmp_path / "site" / "wave.py").write_text(example, encoding="utf-8")
    path = os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")])
    arguments = ("run", "triplet", "--controller", "wave", *duration, "--in-process")
    completed = snakesim(*arguments, "--out", "again", cwd=tmp_path, extra_env={"PYTHONPATH": path})
    assert completed.code == 0, completed.out + completed.err
    assert RunRecord.load(tmp_path / "again").host.command_digest == summary.command_digest
    assert not (tmp_path / "executed").exists()
