"""Measure distance, speed and energy of each gait: `python -m verification.gaits [NAME ...] [--seeds N] [--write]`.

Each row is a shipped scenario with one gait, run with several seeds of the sensor noise. The distance is that between
the first and the last position of the center of mass, in any direction. `--write` replaces the table in
docs/concepts/gaits.md.
"""

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.in_process import simulate

PAGE = Path(__file__).parents[1] / "docs" / "concepts" / "gaits.md"
# These lines of the page enclose the table.
TABLE_BEGIN = "<!-- from here: made by `python -m verification.gaits --write` -->\n"
TABLE_END = "<!-- to here -->\n"
DURATION_S = 10
HEADER = "| gait | scenario | distance in 10 s, m | speed, body lengths/s | energy, J/m |\n|---|---|---|---|---|\n"


@dataclass(frozen=True)
class GaitRow:
    """A gait on a scene where it works."""

    gait: str
    scenario: str
    set_options: tuple[str, ...] = ()  # changes of the scenario, as `--set` takes them


ROWS = (
    GaitRow("serpenoid", "scales"),
    GaitRow("serpenoid", "peg_row", ("control.wavelength=0.31", "control.winding_angle_rad=0.45")),
    GaitRow("cpg", "scales"),
    GaitRow("cpg", "peg_row", ("control.wavelength=0.31", "control.winding_angle_rad=0.45")),
    GaitRow("backbone_sidewinding", "mamba_flat"),
    GaitRow("backbone_rolling", "mamba_flat"),
    GaitRow("sinus_lifting", "mamba_flat"),
    GaitRow("rectilinear", "mamba_flat"),
    GaitRow("concertina", "corridor"),
)


def run_trial(row: GaitRow, seed: int) -> RunSummary:
    """Run one trial, and return its summary."""
    set_options = (
        f"controller={row.gait}",
        f"duration_s={DURATION_S}",
        f"seed={seed}",
        *row.set_options,
    )
    scenario = load_scenario(row.scenario, [parse_set_option(option) for option in set_options])
    return simulate(scenario.config).summary


def format_row(row: GaitRow, summaries: Sequence[RunSummary]) -> str:
    """Return a line of the table, with the mean, minimum and maximum over the trials."""
    options = "".join(f", `{option}`" for option in row.set_options)
    distances_m = [summary.net_displacement_m or 0.0 for summary in summaries]
    speeds = [summary.displacement_body_lengths_s or 0.0 for summary in summaries]
    energies = [summary.displacement_energy_j_per_m or float("nan") for summary in summaries]
    return (
        f"| `{row.gait}` | `{row.scenario}`{options} | {_format_range(distances_m, 2)} | {_format_range(speeds, 3)} | "
        f"{_format_range(energies, 0)} |\n"
    )


def replace_table(page: str, table: str) -> str:
    """Return the text of a page with another table between its marks."""
    before, _, rest = page.partition(TABLE_BEGIN)
    _, _, after = rest.partition(TABLE_END)
    return before + TABLE_BEGIN + table + TABLE_END + after


def _format_range(values: Sequence[float], digits: int) -> str:
    mean = sum(values) / len(values)
    return f"{mean:.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def main() -> int:
    """Run the requested rows, print each, and write the table into the page if requested."""
    parser = argparse.ArgumentParser(prog="python -m verification.gaits", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="gaits to run (all)")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds, from 1 (5)")
    parser.add_argument("--workers", type=int, default=2, help="number of processes (2)")
    parser.add_argument(
        "--write",
        action="store_true",
        help=f"write the table into {PAGE.name}; only with all gaits",
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - {row.gait for row in ROWS}:
        parser.error(
            f"no gait called {', '.join(sorted(unknown))}; there are {', '.join(row.gait for row in ROWS)}"
        )
    if arguments.write and arguments.names:
        parser.error("--write needs all gaits: leave the names out")
    table = HEADER
    print(HEADER, end="", flush=True)
    rows = [row for row in ROWS if not arguments.names or row.gait in arguments.names]
    seeds = range(1, arguments.seeds + 1)
    with ProcessPoolExecutor(arguments.workers) as pool:
        trials = {row: [pool.submit(run_trial, row, seed) for seed in seeds] for row in rows}
        for row in rows:
            line = format_row(row, [trial.result() for trial in trials[row]])
            print(line, end="", flush=True)
            table += line
    if arguments.write:
        PAGE.write_text(replace_table(PAGE.read_text(encoding="utf-8"), table), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
