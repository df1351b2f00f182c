"""Run the campaign part by part: `python -m verification [PART ...] [--minutes N]`.

The campaign contains the tests that take long or need a quiet machine. A part that fails does not stop the others. The
last lines count the parts that passed, and name those that failed. `--list` prints the parts and how many minutes each
takes on two cores.
"""

import argparse
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.base.process import make_child_environment, make_python_command
from verification.mutation.trial import TESTS_BY_FILE

ROOT = Path(__file__).parents[1]
WITH_VCAN = "deploy/vm/with_vcan.py"
PYTHON_MODULE = (sys.executable, "-m")
ALL_TESTS = ("tests", "--ignore", "tests/system/can")
HEAVY = "heavy and not (slow or quiet)"
JOYSTICK_TESTS = "tests/system/can/test_joystick.py"
PYTEST = ("pytest", "-q", "--timeout", "1800")


@dataclass(frozen=True)
class CampaignPart:
    """One part of the campaign: a Python module, or a script of the repository, with its arguments."""

    description: str
    minutes: float  # on two cores; `--minutes` adds these numbers up
    command: tuple[str, ...]  # name and arguments
    is_script: bool = False  # otherwise a module


PARTS = {
    "lease": CampaignPart(
        "mutants of lease and lifecycle",
        1,
        ("verification.mutation", "--files", "lease.py", "lifecycle.py", "stop_ramp.py"),
    ),
    "decoders": CampaignPart(
        "100,000 damaged payloads into every decoder, and damaged recordings into some commands each",
        0.5,
        (
            "verification.fuzz",
            *("--payloads", "100000", "--recordings", "9", "--commands-per-recording", "2"),
        ),
    ),
    "recordings": CampaignPart(
        "damaged recordings into every command that reads one",
        0.5,
        ("verification.fuzz", "--payloads", "0", "--recordings", "10"),
    ),
    "sanitizers": CampaignPart(
        "physics tests with C libraries that check their memory accesses",
        1,
        ("verification.sanitize",),
    ),
    "contracts": CampaignPart(
        "tests of the campaign's own tools, import rules, names in docstrings",
        0.5,
        (
            *PYTEST,
            "verification/test_import_contracts.py",
            "verification/test_docstring_names.py",
            "verification/soak/test_judgement.py",
            "verification/faults/test_fault_table.py",
            "verification/attack/test_attack_suite.py",
            "verification/fuzz",
            "verification/mutation/firmware",
        ),
    ),
    "heavy": CampaignPart(
        "tests that need more than a second of processor time; CI runs them with each change",
        2,
        (*PYTEST, *ALL_TESTS, "-n", "4", "--dist", "worksteal", "-m", HEAVY),
    ),
    "quiet": CampaignPart(
        "robots in real time, one test after the other",
        7,
        (*PYTEST, *ALL_TESTS, "-m", "quiet"),
    ),
    "slow": CampaignPart(
        "the long forms of the tests",
        11,
        (*PYTEST, *ALL_TESTS, "-n", "3", "-m", "slow and not quiet"),
    ),
    "trials": CampaignPart(
        "all random trials; with each change, a tenth of them runs",
        0.5,
        (*PYTEST, "tests/unit", "-n", "2", "-m", "(hypothesis or trials) and not (slow or quiet)"),
    ),
    "can": CampaignPart(
        "all CAN tests, and the contract on virtual CAN interfaces of the kernel",
        7,
        (
            *(WITH_VCAN, "--", *PYTHON_MODULE, *PYTEST),
            *("tests/system/can", "tests/contract", "-m", ""),
            # This file needs no CAN. The parts `heavy` and `slow` run it.
            *("--ignore", "tests/contract/test_suite.py"),
        ),
        is_script=True,
    ),
    "joystick": CampaignPart(
        "a joystick that the kernel of a virtual machine emulates",
        0.5,
        (*(WITH_VCAN, "--joystick", "--", *PYTHON_MODULE, *PYTEST), JOYSTICK_TESTS),
        is_script=True,
    ),
    "documents": CampaignPart(
        "every command that the documentation prints",
        5,
        (*PYTEST, "verification/documents", "-m", ""),
    ),
    "installation": CampaignPart(
        "wheels, extras and left-out packages", 2, (*PYTEST, "verification/installation", "-m", "")
    ),
    "computers": CampaignPart(
        "digests of runs with the instructions of other processors",
        8,
        (*PYTEST, "verification/computers", "-m", ""),
    ),
    "aarch64": CampaignPart(
        "the wheel for ARM on an emulated processor (needs qemu-user-static)",
        1,
        ("verification.computers.aarch64",),
    ),
    "commissioning": CampaignPart(
        "hidden faults of joints, and system identification",
        1,
        (
            *PYTEST,
            "verification/test_commissioning_trials.py",
            "verification/test_sysid.py",
            "-m",
            "",
        ),
    ),
    "attack": CampaignPart(
        "every attack of an unauthorized client, once", 4, (*PYTEST, "verification/attack")
    ),
    "links": CampaignPart(
        "bad links between machines (root)", 0.5, (*PYTEST, "verification/links", "-m", "")
    ),
    "faults": CampaignPart(
        "the fault table, two trials of each row", 9, ("verification.faults", "--trials", "2")
    ),
    "fuzz": CampaignPart(
        "damaged payloads into a running robot",
        2,
        ("verification.fuzz", "--network", "--payloads", "200000"),
    ),
    "kills": CampaignPart(
        "processes killed and frozen at random", 1, ("verification.soak.kills", "--trials", "20")
    ),
    "soak": CampaignPart(
        "random faults for three minutes", 3, ("verification.soak", "--minutes", "3")
    ),
    "mutation": CampaignPart(
        "mutants of the rest of the safety core",
        6,
        (
            "verification.mutation",
            "--files",
            *sorted(TESTS_BY_FILE.keys() - {"lease.py", "lifecycle.py", "stop_ramp.py"}),
        ),
    ),
    "firmware": CampaignPart(
        "planted faults in the C firmware of a joint module (needs a C compiler)",
        7,
        ("verification.mutation.firmware",),
    ),
    "small-changes": CampaignPart(
        "small changes of the C firmware of a joint module",
        5,
        ("verification.mutation.firmware", "--small-changes", "states.c", "control.c"),
    ),
}


def main() -> int:
    """Run the requested parts. Return 1 if one of them failed, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m verification", description=__doc__)
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"parts to run: {', '.join(PARTS)} (all)"
    )
    parser.add_argument("--minutes", type=float, help="run the first parts that fit into this time")
    parser.add_argument("--list", action="store_true", help="print the parts, and run none")
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - PARTS.keys():
        parser.error(f"no part called {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    requested = [name for name in PARTS if not arguments.parts or name in arguments.parts]
    selected = _select_parts_within(requested, arguments.minutes)
    if arguments.list:
        for name in selected:
            print(f"{name:<14}{PARTS[name].minutes:>4g} min  {PARTS[name].description}")
        return 0
    failed = [name for name in selected if not _run_part(name)]
    passed_count = len(selected) - len(failed)
    print(f"verification: {passed_count} of {len(selected)} parts passed", flush=True)
    for name in failed:
        print(f"  failed: {name} (python -m verification {name})")
    return 1 if failed else 0


def _select_parts_within(names: list[str], minutes: float | None) -> list[str]:
    """Return the first parts that together take no longer than some minutes. None stands for no limit."""
    if minutes is None:
        return names
    selected: list[str] = []
    remaining_minutes = minutes
    for name in names:
        remaining_minutes -= PARTS[name].minutes
        if remaining_minutes < 0:
            break
        selected.append(name)
    return selected


def _run_part(name: str) -> bool:
    """Run one part, and return whether it passed."""
    part = PARTS[name]
    print(f"== {name}: {part.description}", flush=True)
    start_s = time.monotonic()
    python_arguments = part.command if part.is_script else ("-m", *part.command)
    completed = subprocess.run(
        make_python_command(*python_arguments),
        cwd=ROOT,
        env={"SNAKESIM_HYPOTHESIS": "full", **make_child_environment()},
        check=False,
    )
    duration_min = (time.monotonic() - start_s) / 60
    print(f"== {name}: exit code {completed.returncode} after {duration_min:.1f} min", flush=True)
    return completed.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
