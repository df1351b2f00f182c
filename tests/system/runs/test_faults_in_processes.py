"""Faults are injected into runs of real processes: planned with an option, requested by a command, or refused."""

from pathlib import Path

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import run_to_summary, running_armed_snakesim, snakesim
from snakesim_testing.runs.in_process_command import run_command_for_robot

pytestmark = pytest.mark.e2e


@pytest.mark.slow  # the fault table measures these faults, too
@pytest.mark.parametrize(
    ("backend", "clock_mode"),
    [pytest.param("can", "lockstep", marks=pytest.mark.slow), ("sim", "realtime")],
)
def test_harmless_faults_do_not_disturb_the_run(
    tmp_path: Path, backend: str, clock_mode: str
) -> None:
    """A network may deliver messages twice, and a slow simulator is no reason to stop."""
    faults = [
        "duplicate:actuator/joints@0.5-1.5",
        "duplicate:sensor/joints@0.5-1.5",
        "slow:simulator@1-1.2=0.5",
    ]
    fault_options = [argument for fault in faults for argument in ("--fault", fault)]
    result, _ = run_to_summary(
        tmp_path / "run",
        "triplet",
        "--backend",
        backend,
        "--duration",
        "2",
        "--clock-mode",
        clock_mode,
        *fault_options,
    )
    record = RunRecord.load(tmp_path / "run").host
    assert result.code == 0
    assert record.armed_ticks == 200
    replayed = record.rejected_commands["replayed"]
    if clock_mode == "lockstep":
        assert replayed == 100
    else:
        assert 90 <= replayed <= 110
    assert [text.partition(": ")[2] for text in record.injected] == [
        "duplicate:sensor/joints@0.5-1.5=1 begins",
        "slow:simulator@1-1.2=0.5 begins",
        "slow:simulator@1-1.2=0.5 ends",
        "duplicate:sensor/joints@0.5-1.5=1 ends",
    ]


@pytest.mark.heavy
@pytest.mark.parametrize("backend", ["can", pytest.param("sim", marks=pytest.mark.slow)])
def test_fault_requested_by_command_is_injected_or_refused(tmp_path: Path, backend: str) -> None:
    arguments = [
        "triplet",
        "--controller",
        "hold",
        "--duration",
        "600",
        "--clock-mode",
        "realtime",
        "--backend",
        backend,
    ]
    with running_armed_snakesim(tmp_path / "run", *arguments) as run:
        unsupported = ("leak", "joint_3") if backend == "sim" else ("diverge", "simulator")
        result = run_command_for_robot(run, "fault", "inject", *unsupported)
        assert result.code == 1
        assert f"backend '{backend}' cannot do" in result.err
        result = run_command_for_robot(run, "fault", "inject", "mute", "joint_99")
        assert result.code == 1
        assert "no joint_99" in result.err
        result = run_command_for_robot(
            run, "fault", "inject", "drop", "guidance/world", "--amount", "0.2", "--duration", "0.5"
        )
        assert result.code == 0, result.err
        assert result.out.startswith("drop of guidance/world has begun, at ")
        result = run_command_for_robot(
            run, "fault", "inject", "mute", "joint_3", "--duration", "30"
        )
        assert result.code == 0, result.err
        assert result.out.startswith("mute of joint_3 has begun, at ")
        assert run.end() == 1
    record = RunRecord.load(tmp_path / "run").host
    assert record.faults[0].joint in (None, "joint_3")
    assert "joint_3" in record.faults[0].cause
    assert "mute:joint_3@" in record.injected[0]
    guidance_log = (tmp_path / "run" / "guidance.log").read_text()
    assert "drop:guidance/world@" in guidance_log
    assert "begins" in guidance_log


@pytest.mark.quiet  # the fault table measures this fault, too
def test_control_with_busy_interpreter_loses_its_lease(tmp_path: Path) -> None:
    flags = ["--clock-mode", "realtime", "--controller", "hold", "--fault", "hang:control@1"]
    result, summary = run_to_summary(tmp_path / "run", "triplet", *flags)
    assert result.code == 1
    assert [fault.what for fault in summary.faults] == ["lease_expired"]
    assert "hang:control@1 begins" in (tmp_path / "run" / "control.log").read_text()


@pytest.mark.quiet  # the attack on it is in verification/attack
def test_faults_are_refused_if_backend_may_move_real_motors(tmp_path: Path) -> None:
    """A backend that does not declare itself emulated counts as real."""
    (tmp_path / "bench.py").write_text(
        "import sys\nfrom pathlib import Path\n\nimport msgspec\n"
        "from snakesim_gnc.control.hold import HoldPose\n"
        "from snakesim_sim_backend.backend import SimBackend\n\n"
        "def write_loaded_modules(part):\n"
        "    loaded = [name for name in sys.modules if name.startswith('snakesim_hal.faults.')]\n"
        "    loaded = [name for name in loaded if name != 'snakesim_hal.faults.allowed']\n"
        f"    Path({str(tmp_path)!r}, part).write_text(' '.join(loaded))\n\n"
        "class Bench(SimBackend):\n"
        "    def describe(self):\n"
        "        return msgspec.structs.replace(super().describe(), emulated=False)\n"
        "    def advance(self):\n"
        "        super().advance()\n"
        "        write_loaded_modules('host')\n\n"
        "class ReportingHold(HoldPose):\n"
        "    def update(self, observation):\n"
        "        write_loaded_modules('control')\n"
        "        return super().update(observation)\n"
    )
    arguments = ["triplet", "--backend", "./bench.py:Bench"]
    arguments += ["--controller", "./bench.py:ReportingHold"]
    arguments += ["--clock-mode", "realtime", "--unchecked"]
    loaded_modules_files = [tmp_path / part for part in ("host", "control")]
    with running_armed_snakesim(tmp_path / "run", *arguments, "--duration", "600") as run:
        for fault in (("mute", "joint_3"), ("hang", "control")):
            result = run_command_for_robot(run, "fault", "inject", *fault)
            assert result.code == 1
            assert "fault injection is not allowed: something real moves here" in result.err
        run.process.terminate()
        run.end()
    assert [file.read_text() for file in loaded_modules_files] == ["", ""], (
        "a process has loaded the code that injects faults"
    )
    allow_options = (
        "--set",
        "allow_fault_injection=true",
        "--duration",
        "0.5",
        "--out",
        str(tmp_path / "allowed"),
    )
    snakesim("run", *arguments, *allow_options, "--endpoint", find_free_endpoint(), cwd=tmp_path)
    for file in loaded_modules_files:
        assert "snakesim_hal.faults.injector" in file.read_text()
    result = snakesim(
        "run",
        *arguments,
        "--fault",
        "mute:joint_3@1",
        "--out",
        str(tmp_path / "other"),
        cwd=tmp_path,
    )
    assert result.code == 1
    assert "`faults` are planned, and something real moves here" in result.out
    wait_until(lambda: not list((tmp_path / "other").glob("host.json")), "no record of it")
