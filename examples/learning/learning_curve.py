"""The learning curve: a row for each check of the policy, and a picture of it.

python examples/learning/learning_curve.py runs/gait/ppo/curve.csv docs/pictures/learn-a-gait.svg
"""

import csv
import resource
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

CURVE_FILE = "curve.csv"


@dataclass(frozen=True)
class CurveRow:
    """What a check of the policy measured: means over the validation episodes."""

    ticks: int  # of training so far
    advance_m: float
    energy_j: float
    score_m: float  # advance less the weighted energy
    processor_s: float  # of training and checks so far


def append_row(path: Path, row: CurveRow) -> None:
    """Append a row to the table. The first row also writes the header."""
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        table = csv.DictWriter(file, list(asdict(row)))
        if is_new:
            table.writeheader()
        table.writerow(asdict(row))


def read_rows(path: Path) -> list[CurveRow]:
    """Read the table. Without a file, there are no rows."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            CurveRow(
                ticks=int(row["ticks"]),
                advance_m=float(row["advance_m"]),
                energy_j=float(row["energy_j"]),
                score_m=float(row["score_m"]),
                processor_s=float(row["processor_s"]),
            )
            for row in csv.DictReader(file)
        ]


def measure_processor_s() -> float:
    """Return the processor time of this process and of the processes that it has started and that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def draw_curve(rows: list[CurveRow], picture: Path) -> None:
    """Draw advance and energy over the ticks of training. The first check shows the wave without corrections."""
    from matplotlib.figure import Figure  # unlike pyplot, this works without a display

    million_ticks = [row.ticks / 1e6 for row in rows]
    figure = Figure(figsize=(6.5, 3.2), layout="constrained")
    advance_axes, energy_axes = figure.subplots(1, 2)
    advance_axes.plot(million_ticks, [row.advance_m for row in rows], "o-", markersize=3)
    advance_axes.axhline(rows[0].advance_m, color="0.5", linestyle=":", label="tuned wave alone")
    advance_axes.set(xlabel="million control cycles", ylabel="advance in 6 s, m")
    advance_axes.legend(frameon=False)
    energy_axes.plot(million_ticks, [row.energy_j for row in rows], "o-", markersize=3)
    energy_axes.axhline(rows[0].energy_j, color="0.5", linestyle=":")
    energy_axes.set(xlabel="million control cycles", ylabel="energy in 6 s, J")
    for axes in (advance_axes, energy_axes):
        axes.grid(alpha=0.3)
    figure.savefig(picture, metadata={"Date": None})


def main() -> None:
    curve, picture = sys.argv[1:]
    draw_curve(read_rows(Path(curve)), Path(picture))


if __name__ == "__main__":
    main()
