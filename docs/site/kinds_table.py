"""Writes the tables of faults on request in docs/how-to/inject-faults.md, from the registry and the driver types.

Run `python -m docs.site.kinds_table` after a change of fault kinds or drivers.
"""

from pathlib import Path

from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.drive_type import DriverTypeBackend
from snakesim_hal.model.fault_kinds import EXECUTOR_DESCRIPTIONS, FAULT_KINDS, FaultAmount
from snakesim_hal.programs.preflight import load_backend_class

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "inject-faults.md"
# Lines of the page that enclose its tables.
FAULTS_BEGIN = "<!-- from here: made by `make schemas` -->\n"
DRIVES_BEGIN = "<!-- drive types, from here: made by `make schemas` -->\n"
TABLE_END = "<!-- to here -->\n"
DRIVE_TYPES = ("odrive", "moteus", "cia402", "dynamixel", "feetech")
TARGETS = {
    "process": "`host`, `guidance`, `navigation`, `control`, and `router` with `--with-router`, which cannot hang",
    "key": "`sensor/joints`, `actuator/joints`, ...",
    "joint": "`joint_1`, ...",
    "bus": "`bus_1`, ...",
    "simulator": "`simulator`",
    "clock": "`clock`",
}


def make_page() -> str:
    """Return the text of the page with new tables."""
    page = _replace_table(PAGE.read_text(encoding="utf-8"), FAULTS_BEGIN, make_fault_table())
    return _replace_table(page, DRIVES_BEGIN, make_drive_table())


def _replace_table(page: str, begin: str, new_table: str) -> str:
    """Return a page with another table behind the mark that begins it."""
    before, _, rest = page.partition(begin)
    _, _, after = rest.partition(TABLE_END)
    return before + begin + new_table + TABLE_END + after


def make_fault_table() -> str:
    """Return the table with a row for each kind of fault."""
    rows = ["| target | kind | effect | amount | carried out by |", "|---|---|---|---|---|"]
    for sort, kinds in FAULT_KINDS.items():
        has_names = sort in ("process", "key", "joint", "bus")
        target = f"{sort}: {TARGETS[sort]}" if has_names else TARGETS[sort]
        for name, kind in kinds.items():
            amount = "" if kind.amount is None else _describe_amount(kind.amount)
            executors = ", else ".join(
                EXECUTOR_DESCRIPTIONS[executor] for executor in kind.executors
            )
            rows.append(f"| {target} | `{name}` | {kind.description} | {amount} | {executors} |")
            target = ""  # only the first row of a target names it
    return "\n".join(rows) + "\n"


def make_drive_table() -> str:
    """Return the table of faults that emulated drives and their buses have, with a row for each drive type."""
    rows = ["| `--backend` | in an emulated drive | on its bus | in samples |", "|---|---|---|---|"]
    in_samples = [
        name
        for name, kind in FAULT_KINDS["joint"].items()
        if "samples" in kind.executors and name not in FAULTS
    ]
    for name in DRIVE_TYPES:
        backend = load_backend_class(name)
        assert issubclass(backend, DriverTypeBackend)
        on_bus = {*backend.list_bus_faults(backend.Settings()), "slow"}
        cells = [
            " ".join(f"`{kind}`" for kind in kinds)
            for kinds in (FAULTS, sorted(on_bus), in_samples)
        ]
        rows.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def _describe_amount(amount: FaultAmount) -> str:
    """Return the meaning of an amount, with its default, minimum and maximum."""
    unit = "" if amount.unit == "1" else f" {amount.unit}"
    return f"{amount.description}, {amount.default:g}{unit} ({amount.min_value:g} to {amount.max_value:g})"


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")
