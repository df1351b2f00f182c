"""The other commands: config, scenarios, echo, status, and controllers from outside."""

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

TUTORIAL = Path("docs/tutorials/write-a-controller.md").resolve()


def echoed(run: RunningCommand, key: str, count: int, *more: str) -> list[dict[str, Any]]:
    """What `snakesim topic echo` prints, each line read as JSON."""
    ended = command.run_command_for_robot(run, "topic", "echo", key, "--count", str(count), *more)
    assert ended.code == 0 and ended.err == "", ended.err
    lines = [json.loads(line) for line in ended.out.splitlines()]
    assert len(lines) == count
    assert all(set(line) in ({"key", "message"}, {"key", "error"}) for line in lines)
    return lines


def test_output_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*SNAKESIM_COMMAND, "scenario", "list"],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.startswith("snakesim: ")
    assert done.stderr.count("\n") == 1
    seen = run_program(
        ["sh", "-c", f"{' '.join(SNAKESIM_COMMAND)} config triplet | head -1"], tmp_path
    )
    assert seen.err == ""
    assert seen.out.count("\n") == 1


@pytest.mark.slow
def test_a_run_goes_on_when_nobody_reads_what_it_prints(tmp_path: Path) -> None:
    run = f"{' '.join(SNAKESIM_COMMAND)} run triplet --in-process --duration 1 --no-record --out"
    for number, unread in enumerate(("| head -0", ">&-", "> /dev/full 2>&1")):
        ended = run_program(["bash", "-c", f"set -o pipefail; {run} {number} {unread}"], tmp_path)
        assert (ended.code, ended.err) == (0, ""), f"{unread}: {ended.err}"
        assert (tmp_path / str(number) / "summary.json").exists(), unread


def test_a_closed_terminal_ends_a_run_in_order(tmp_path: Path) -> None:
    (ours, theirs), endpoint = pty.openpty(), find_free_endpoint()
    run = ["run", "triplet", "--clock-mode", "realtime", "--out", "run", "--endpoint", endpoint]
    process = subprocess.Popen(
        ["env", "--default-signal=HUP", "setsid", "--ctty", *SNAKESIM_COMMAND, *run],
        cwd=tmp_path,
        env=make_environment(tmp_path),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    said = b""
    while b" of 10 s" not in said:
        said += os.read(ours, 4096)
    os.close(ours)
    assert process.wait(30) == 130
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["command_digest"]
    assert_no_process_left(tmp_path / "run")


INTERRUPTED = (
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


@pytest.mark.parametrize(
    "words",
    [
        words if words[0] == "run" else pytest.param(words, marks=pytest.mark.slow)
        for words in INTERRUPTED
    ],
    ids=lambda words: words[0],
)
def test_ctrl_c_at_any_moment_leaves_no_traceback(words: list[str], tmp_path: Path) -> None:
    """From the first line of ours on; what comes before is the interpreter's own start."""
    on_network = words[0] in ("topic", "status", "robot", "run")
    endpoint = ["--endpoint", find_free_endpoint()] if on_network else []
    for snapshot in range(7):
        process = subprocess.Popen(
            [*SNAKESIM_COMMAND, *words, *endpoint],
            cwd=tmp_path,
            env=make_environment(tmp_path),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        wait_until(lambda pid=process.pid: first_line_ran(pid), "our first line")
        time.sleep(0.12 * snapshot)
        os.killpg(process.pid, signal.SIGINT)  # a terminal tells all that it has started
        said, _ = process.communicate(timeout=60)
        assert "Traceback" not in said and "KeyboardInterrupt" not in said, said
        assert "Exception ignored" not in said, said
    assert_no_process_left(tmp_path / "run")


def first_line_ran(pid: int) -> bool:
    """Whether the interpreter's own handler of SIGINT is gone again, and the command's modules are being loaded."""
    fields = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    maps = Path(f"/proc/{pid}/maps").read_text()
    caught = int(fields.get("SigCgt", "0"), 16) >> (signal.SIGINT - 1) & 1
    ended = fields["State"].strip().startswith("Z")
    return ended or (not caught and ("lib-dynload" in maps or "site-packages" in maps))


def test_echo_and_status_of_a_running_robot(tmp_path: Path) -> None:
    arguments = ["triplet", "--controller", "hold", "--duration", "600", "--clock-mode", "realtime"]
    with running_armed_snakesim(tmp_path / "run", *arguments) as run:
        rate = command.run_command_for_robot(run, "topic", "rate", "sensor/joints", "--count", "2")
        found = re.findall(r"planar13/sensor/joints: ([\d.]+) Hz", rate.out)
        assert found and float(found[-1]) == pytest.approx(100, rel=0.1), rate.out + rate.err
        (reported,) = echoed(run, "hal/description", 1)
        assert reported["key"] == "planar13/hal/description"
        assert reported["message"]["joints"][12]["name"] == "joint_13"
        found = echoed(run, "sensor/**", 40)
        assert {"planar13/sensor/joints", "planar13/sensor/imu"} <= {line["key"] for line in found}
        assert all("tick" in line["message"] for line in found)
        everything = {line["key"] for line in echoed(run, "**", 200)}
        assert {
            "planar13/hal/description",
            "planar13/hal/clock",
            "planar13/hal/done/guidance",
        } <= everything
        named = echoed(run, "*/joints", 3, "--namespace", "planar13")
        assert {line["key"] for line in named} <= {"sensor/joints", "actuator/joints"}
        unknown = command.run_command_for_robot(run, "topic", "echo", "sensor/smell")
        assert unknown.code == 2
        assert "sensor/contacts" in unknown.err
        wrong = command.run_command_for_robot(run, "topic", "echo", "sensor/***")
        assert wrong.code == 2
        assert "is not a key" in wrong.err
        assert wrong.err.count("\n") == 1
        status = command.run_command_for_robot(run, "status")
        assert status.code == 0
        assert "planar13: armed" in status.out
        assert "control, guidance, navigation" in status.out
        assert run.interrupt() == 130


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="makes a network namespace, which needs root")
def test_a_run_that_accepts_the_risk_listens_on_every_address(tmp_path: Path) -> None:
    """In a network namespace of its own, which has nothing but loopback."""
    run = "ip link set lo up && exec " + " ".join(
        [
            *SNAKESIM_COMMAND,
            "run",
            "triplet",
            "--controller",
            "hold",
            "--duration",
            "1",
            "--out",
            "run",
        ]
    )
    for flags, code in (("", 2), (" --insecure", 0), (" --insecure --with-router", 0)):
        typed = ["unshare", "--net", "sh", "-c", f"{run} --endpoint tcp/0.0.0.0:7461{flags}"]
        ended = run_program(typed, tmp_path, timeout_s=120.0)
        assert ended.code == code, ended.printed


def test_the_controller_of_the_tutorial(tmp_path: Path) -> None:
    blocks = re.findall(
        r"```python wave\.py\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL
    )
    example = next(block for block in blocks if "class Wave" in block)
    assert len([line for line in example.splitlines() if line.strip()]) <= 30
    (tmp_path / "wave.py").write_text(f"import shape, queue\n{example}", encoding="utf-8")
    (tmp_path / "shape.py").write_text("")  # a neighbor, which the file may import
    for name in ("random", "queue", "can", "calendar"):  # replace no module in any process of a run
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'executed')!r}, 'a').write(__name__)"
        )
    flags = ("--duration", "2", "--in-process")
    ended, summary = command.run_to_summary(
        tmp_path / "run", "triplet", "--controller", "./wave.py:Wave", *flags[:2]
    )
    assert ended.code == 0, ended.out + ended.err
    assert summary.controller == "./wave.py:Wave"
    assert summary.energy_j is not None
    assert summary.energy_j > 0.1

    # The same class as a stranger's installed package: an entry point is all it takes.
    package = tmp_path / "site" / "waves-1.0.dist-info"
    package.mkdir(parents=True)
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: waves\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[snakesim.controllers]\nwave = wave:Wave\n")
    (tmp_path / "site" / "wave.py").write_text(example, encoding="utf-8")
    path = os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")])
    typed = ("run", "triplet", "--controller", "wave", *flags, "--out", "again")
    ended = snakesim(*typed, cwd=tmp_path, extra_env={"PYTHONPATH": path})
    assert ended.code == 0, ended.out + ended.err
    assert RunRecord.load(tmp_path / "again").host.command_digest == summary.command_digest
    assert not (tmp_path / "executed").exists()
