"""The table of faults on request in docs/how-to/inject-faults.md, from the registry.

`python -m docs.site.kinds_table` writes it.
"""

from pathlib import Path

from snakesim_hal.model.fault_kinds import DOERS, KINDS, Amount

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "inject-faults.md"
BEGIN, END = "<!-- from here: made by `make schemas` -->\n", "<!-- to here -->\n"
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
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    return head + BEGIN + table() + END + rest.partition(END)[2]


def table() -> str:
    """A row a kind."""
    rows = ["| target | kind | effect | amount | carried out by |", "|---|---|---|---|---|"]
    for sort, kinds in KINDS.items():
        target = f"{sort}: {TARGETS[sort]}" if sort in ("process", "key", "joint", "bus") else TARGETS[sort]
        for name, kind in kinds.items():
            amount = "" if kind.amount is None else _amount(kind.amount)
            doers = ", else ".join(DOERS[doer] for doer in kind.by)
            rows.append(f"| {target} | `{name}` | {kind.description} | {amount} | {doers} |")
            target = ""
    return "\n".join(rows) + "\n"


def _amount(amount: Amount) -> str:
    unit = "" if amount.unit == "1" else f" {amount.unit}"
    return f"{amount.description}, {amount.default:g}{unit} ({amount.low:g} to {amount.high:g})"


if __name__ == "__main__":
    PAGE.write_text(with_table(), encoding="utf-8")
