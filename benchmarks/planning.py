"""`python -m benchmarks.planning`: how fast a core expands nodes of the planner's search, against the declared rate.

Runs of the shipped scenarios, in one process. Each turn of navigation that plans is timed, by CPU time of its thread.
"""

import argparse
import statistics
import time

from snakesim_gnc.navigation.clutter import NODES_PER_S, ClutterPlanner
from snakesim_hal.model.scenario import load, parse_set
from snakesim_operator.run.in_process import simulate

HEADER = (
    "| scenario | turns that plan | nodes a turn, most | CPU a turn, median (most) | nodes/s, median (slowest turn) "
    "| share of a core at the declared rate |\n|---|---|---|---|---|---|"
)
FEWEST = 1000  # nodes of a turn from which a rate can be told


def main() -> int:
    """Print a row a scenario."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each run")
    seconds = parser.parse_args().seconds
    turns: list[tuple[int, float]] = []
    update = ClutterPlanner._turn  # pyright: ignore[reportPrivateUsage] - what it does in a turn is what is timed

    def timed(self: ClutterPlanner, *arguments: object) -> None:
        began = time.thread_time()
        update(self, *arguments)  # pyright: ignore[reportArgumentType]
        turns.append((self.searched_nodes, time.thread_time() - began))

    ClutterPlanner._turn = timed  # pyright: ignore[reportAttributeAccessIssue, reportPrivateUsage]
    print(HEADER, flush=True)
    for name in ("surveyed_clutter", "clutter"):
        turns.clear()
        simulate(load(name, [parse_set(f"duration_s={seconds}")]).config)
        print(row(name, [one for one in turns if one[0] >= FEWEST]), flush=True)
    return 0


def row(name: str, turns: list[tuple[int, float]]) -> str:
    """The numbers of a scenario's turns."""
    took_ms = [1e3 * taken for _, taken in turns]
    rates = [nodes / taken for nodes, taken in turns]
    rate = statistics.median(rates)
    return (
        f"| {name} | {len(turns)} | {max(nodes for nodes, _ in turns)} | {statistics.median(took_ms):.0f} ms "
        f"({max(took_ms):.0f} ms) | {rate:,.0f} ({min(rates):,.0f}) | {NODES_PER_S / rate:.0%} |"
    )


if __name__ == "__main__":
    raise SystemExit(main())
