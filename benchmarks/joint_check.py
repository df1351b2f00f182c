"""`python -m benchmarks.joint_check`: what the start check finds, on emulated modules with one hidden defect each.

Every trial is a run of the scenario `joint_check` in one process: random floor and noise, and a robot that a hand laid
straight to within 0.03 rad at each joint. Half of the trials are of robots that are as their file says.
"""

import argparse
import contextlib
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.in_process import InProcessRun
from snakesim_hal.model.scenario import load, parse_set
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Imu
from snakesim_operator.commissioning.check import measured
from snakesim_operator.commissioning.judge import Judged, judged

LAID_RAD = 0.03  # how straight a hand lays a robot, at each joint
OFFSET_RAD = 0.15
GEARS = (0.5, 2 / 3, 0.8, 1.25, 1.5, 2.0)
KINDS = ("reversed joint", "swapped ids", "0.15 rad offset", "disconnected motor", "wrong gear")
WORDS = ("the other way", "swapped", "zero is off", "did not move", "as far as its drive says")  # of the verdicts
SOUND = "none"


@dataclass(frozen=True)
class Trial:
    """One robot, and what was said of it."""

    kind: str
    joints: Sequence[int]  # that have the defect
    rows: Sequence[Judged]

    @property
    def found(self) -> bool:
        """The right thing was said of every joint that has it; of a sound robot, that nothing is wrong."""
        if self.kind == SOUND:
            return all(row.as_told for row in self.rows)
        word = WORDS[KINDS.index(self.kind)]
        named = [self.rows[i].verdict for i in self.joints]
        if self.kind == "swapped ids":
            return all(f"of joint_{j + 1}:" in text for text, j in zip(named, reversed(self.joints), strict=True))
        return all(word in text for text in named)

    @property
    def blamed(self) -> list[str]:
        """Sound joints of which something was said."""
        return [
            f"{row.joint}: {row.verdict}" for i, row in enumerate(self.rows) if i not in self.joints and not row.as_told
        ]


def trial(number: int, kind: str, *sets: str) -> Trial:
    """A robot by its number: the same each time. sets: as `--set`."""
    pick = random.Random(number)
    config = load("joint_check", [parse_set(text) for text in ("backend=can", *sets)]).config
    count = config.robot.chain.modules
    zeros = [pick.uniform(-LAID_RAD, LAID_RAD) for _ in range(count)]
    i, j = pick.sample(range(count), 2)
    defects: list[str] = []
    match kind:
        case "reversed joint":
            defects = [f"joint_{i + 1}.sign=-1"]
        case "swapped ids":
            defects = [f"joint_{i + 1}.id={j + 1}", f"joint_{j + 1}.id={i + 1}"]
        case "0.15 rad offset":
            zeros[i] += pick.choice((-OFFSET_RAD, OFFSET_RAD))
        case "disconnected motor":
            defects = [f"joint_{i + 1}.connected=false"]
        case "wrong gear":
            defects = [f"joint_{i + 1}.gear={pick.choice(GEARS)}"]
        case _:
            pass
    truth = [*defects, *(f"joint_{k + 1}.zero_rad={zero}" for k, zero in enumerate(zeros))]
    own = [f"seed={number}", f"scene.ground.friction={pick.uniform(0.2, 0.8)}"]
    own += [f"backends.can.mounted.{text}" for text in truth]
    with_defect = [] if kind == SOUND else [i, j] if kind == "swapped ids" else [i]
    return Trial(kind, with_defect, checked("backend=can", *sets, *own))


def checked(*sets: str) -> list[Judged]:
    """Run the check, and judge it."""
    config = load("joint_check", [parse_set(text) for text in sets]).config
    imus: list[Imu] = []
    with InProcessRun(config) as run:
        reader = run.network.session().reader(keys.IMU, Imu)
        box, rows = run.host.black_box, b""
        for _ in run.turns():
            imus += reader.drain()
            rows += box.rows_from(len(rows) // box.layout.row_bytes)[1]
        columns = box.layout.arrays(rows)
        ticks = columns.pop("tick").tolist()
        return judged(measured(config, run.host.description, ticks, columns, imus), straight=True)


def main() -> int:
    """Print each trial in which the check was wrong, then the table; of fewer trials after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100, help="with a defect, and as many without (default: 100)")
    parser.add_argument("--only", choices=(*KINDS, SOUND), help="of this kind alone")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="PATH=VALUE", help="as of a run")
    arguments = parser.parse_args()
    trials: list[Trial] = []
    with contextlib.suppress(KeyboardInterrupt):
        for number in range(2 * arguments.trials):
            kind = SOUND if number % 2 else KINDS[number // 2 % len(KINDS)]
            if arguments.only in (None, kind):
                trials.append(trial(number, kind, *arguments.sets))
                print_wrong(number, trials[-1])
    print_table(trials)
    return 0


def print_wrong(number: int, one: Trial) -> None:
    """A line for a trial in which the check was wrong."""
    if not one.found or one.blamed:
        said = [f"{one.rows[i].joint}: {one.rows[i].verdict}" for i in one.joints]
        blamed = "; ".join(one.blamed) or "none"
        print(f"trial {number}, {one.kind}: {'; '.join(said)} | blamed: {blamed}", flush=True)


def print_table(trials: Sequence[Trial]) -> None:
    """A row a kind of defect."""
    print("| defect | robots | found, by joint and kind | robots with a sound joint blamed |\n|---|---|---|---|")
    for kind in (*KINDS, SOUND):
        of = [one for one in trials if one.kind == kind]
        count = Counter(found=sum(one.found for one in of), blamed=sum(bool(one.blamed) for one in of))
        print(f"| {kind} | {len(of)} | {'-' if kind == SOUND else count['found']} | {count['blamed']} |")


if __name__ == "__main__":
    raise SystemExit(main())
