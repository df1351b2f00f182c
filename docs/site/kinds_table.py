"""The tables of faults on request in docs/how-to/inject-faults.md, from the registry and from the driver types.

`python -m docs.site.kinds_table` writes it.
"""

from pathlib import Path

from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.drive_type import DriverTypeBackend
from snakesim_hal.model.fault_kinds import EXECUTOR_DESCRIPTIONS, FAULT_KINDS, FaultAmount
from snakesim_hal.programs.preflight import load_backend_class

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "inject-faults.md"
BEGIN, END = "<!-- from here: made by `make schemas` -->\n", "<!-- to here -->\n"
BEGIN_DRIVES = "<!-- drive types, from here: made by `make schemas` -->\n"
DRIVE_TYPES = ("odrive", "moteus", "cia402", "dynamixel", "feetech")
TARGETS = {
    "process": "`host`, `guidance`, `navigation`, `control`, and `router` with `--with-router`, which cannot hang",
    "key": "`sensor/joints`, `actuator/joints`, ...",
    "joint": "`joint_1`, ...",
    "bus": "`bus_1`, ...",
    "simulator": "`simulator`",
    "clock": "`clock`",
}


def with_table() -> str:
    """The page as it should be."""
    page = _replace(PAGE.read_text(encoding="utf-8"), BEGIN, table())
    return _replace(page, BEGIN_DRIVES, drive_table())


def _replace(page: str, begin: str, new_table: str) -> str:
    """Return a page with another table behind the mark that begins it."""
    head, _, rest = page.partition(begin)
    return head + begin + new_table + END + rest.partition(END)[2]


def table() -> str:
    """A row a kind."""
    rows = ["| target | kind | effect | amount | carried out by |", "|---|---|---|---|---|"]
    for sort, kinds in FAULT_KINDS.items():
        target = (
            f"{sort}: {TARGETS[sort]}"
            if sort in ("process", "key", "joint", "bus")
            else TARGETS[sort]
        )
        for name, kind in kinds.items():
            amount = "" if kind.amount is None else _amount(kind.amount)
            doers = ", else ".join(EXECUTOR_DESCRIPTIONS[doer] for doer in kind.executors)
            rows.append(f"| {target} | `{name}` | {kind.description} | {amount} | {doers} |")
            target = ""
    return "\n".join(rows) + "\n"


def drive_table() -> str:
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


def _amount(amount: FaultAmount) -> str:
    unit = "" if amount.unit == "1" else f" {amount.unit}"
    return f"{amount.description}, {amount.default:g}{unit} ({amount.min_value:g} to {amount.max_value:g})"


if __name__ == "__main__":
    PAGE.write_text(with_table(), encoding="utf-8")
