"""`python -m verification [PART ...] [--minutes N]`: run the campaign part by part, and print what became of each.

A part that fails does not stop the others. `--list` names the parts and about how long each takes on two cores.
"""

import argparse
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.base.process import make_child_environment, make_python_command
from verification.mutation.trial import TRIED_BY

ROOT = Path(__file__).parents[1]
WITH_VCAN = ("deploy/vm/with_vcan.py", "--", sys.executable, "-m")
PYTEST = ("pytest", "-q", "--timeout", "1800")


@dataclass(frozen=True)
class CampaignPart:
    """One part of the campaign: Python's arguments behind `-m`, or a script of the repository."""

    description: str
    minutes: float  # on two cores; what `--minutes` counts with
    command: tuple[str, ...]
    script: bool = False


PARTS = {
    "lease": CampaignPart(
        "mutants of lease and lifecycle",
        2,
        ("verification.mutation", "--files", "lease.py", "lifecycle.py", "stop_ramp.py"),
    ),
    "decoders": CampaignPart(
        "100,000 damaged payloads into every decoder, and damaged recordings into some commands each",
        1,
        (
            "verification.fuzz",
            *("--payloads", "100000", "--recordings", "9", "--commands-per-recording", "2"),
        ),
    ),
    "recordings": CampaignPart(
        "damaged recordings into every command that reads one",
        2,
        ("verification.fuzz", "--payloads", "0", "--recordings", "10"),
    ),
    "sanitizers": CampaignPart(
        "physics tests with a C library that checks itself", 6, ("verification.sanitize",)
    ),
    "contracts": CampaignPart(
        "tools of the campaign, and the rules of who may import whom",
        1,
        (
            *PYTEST,
            "verification/test_import_contracts.py",
            "verification/test_docstring_names.py",
            "verification/soak/test_judgement.py",
            "verification/faults/test_fault_table.py",
            "verification/attack/test_stranger.py",
            "verification/fuzz",
        ),
    ),
    "quiet": CampaignPart(
        "robots in real time, one test after the other",
        4,
        (*PYTEST, "tests", "--ignore", "tests/system/can", "-m", "quiet"),
    ),
    "slow": CampaignPart(
        "the long forms of the tests",
        16,
        (*PYTEST, "tests", "--ignore", "tests/system/can", "-n", "3", "-m", "slow and not quiet"),
    ),
    "trials": CampaignPart(
        "all random trials, of which each change makes a tenth",
        4,
        (*PYTEST, "tests/unit", "-n", "2", "-m", "(hypothesis or trials) and not (slow or quiet)"),
    ),
    "can": CampaignPart(
        "all CAN tests and the contract on a kernel's bus",
        7,
        (*WITH_VCAN, *PYTEST, "tests/system/can", "tests/contract", "-m", ""),
        script=True,
    ),
    "documents": CampaignPart(
        "every command that the documentation prints",
        10,
        (*PYTEST, "verification/documents", "-m", ""),
    ),
    "installation": CampaignPart(
        "wheels, extras and left-out packages", 5, (*PYTEST, "verification/installation", "-m", "")
    ),
    "computers": CampaignPart(
        "the digests under the code of other processors",
        4,
        (*PYTEST, "verification/computers", "-m", ""),
    ),
    "aarch64": CampaignPart(
        "the wheel for ARM, on an emulated processor (needs qemu-user-static)",
        4,
        ("verification.computers.aarch64",),
    ),
    "commissioning": CampaignPart(
        "hidden faults of joints",
        3,
        (
            *PYTEST,
            "verification/test_commissioning_trials.py",
            "verification/test_sysid.py",
            "-m",
            "",
        ),
    ),
    "attack": CampaignPart(
        "every attack of an unauthorized client, once", 5, (*PYTEST, "verification/attack")
    ),
    "links": CampaignPart(
        "bad links between machines (root)", 4, (*PYTEST, "verification/links", "-m", "")
    ),
    "faults": CampaignPart(
        "the fault table, two trials of each row", 6, ("verification.faults", "--trials", "2")
    ),
    "fuzz": CampaignPart(
        "damaged payloads into a running robot",
        3,
        ("verification.fuzz", "--network", "--payloads", "200000"),
    ),
    "kills": CampaignPart(
        "processes killed and frozen at random", 3, ("verification.soak.kills", "--trials", "20")
    ),
    "soak": CampaignPart(
        "random faults for three minutes", 4, ("verification.soak", "--minutes", "3")
    ),
    "mutation": CampaignPart(
        "mutants of the rest of the safety core",
        12,
        (
            "verification.mutation",
            "--files",
            *sorted(TRIED_BY.keys() - {"lease.py", "lifecycle.py", "stop_ramp.py"}),
        ),
    ),
}


def main() -> int:
    """Run the parts that are asked for; return 1 if one of them failed."""
    parser = argparse.ArgumentParser(prog="python -m verification", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (all)")
    parser.add_argument("--minutes", type=float, help="run the first parts that fit into this time")
    parser.add_argument("--list", action="store_true", help="name the parts, and run none")
    asked = parser.parse_args()
    if unknown := set(asked.parts) - PARTS.keys():
        parser.error(f"no part called {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    chosen = _fitting(
        [name for name in PARTS if not asked.parts or name in asked.parts], asked.minutes
    )
    if asked.list:
        for name in chosen:
            print(f"{name:<14}{PARTS[name].minutes:>4g} min  {PARTS[name].description}")
        return 0
    failed = [name for name in chosen if not _run(name)]
    print(f"verification: {len(chosen) - len(failed)} of {len(chosen)} parts passed", flush=True)
    for name in failed:
        print(f"  failed: {name} (python -m verification {name})")
    return 1 if failed else 0


def _fitting(names: list[str], minutes: float | None) -> list[str]:
    """Return the first of the parts that fit into the time together."""
    if minutes is None:
        return names
    chosen: list[str] = []
    for name in names:
        minutes -= PARTS[name].minutes
        if minutes < 0:
            break
        chosen.append(name)
    return chosen


def _run(name: str) -> bool:
    """Run one part; whether it passed."""
    part = PARTS[name]
    print(f"== {name}: {part.description}", flush=True)
    began_s = time.monotonic()
    words = part.command if part.script else ("-m", *part.command)
    code = subprocess.run(
        make_python_command(*words),
        cwd=ROOT,
        env={"SNAKESIM_HYPOTHESIS": "full", **make_child_environment()},
        check=False,
    ).returncode
    print(
        f"== {name}: exit code {code} after {(time.monotonic() - began_s) / 60:.1f} min", flush=True
    )
    return code == 0


if __name__ == "__main__":
    sys.exit(main())
