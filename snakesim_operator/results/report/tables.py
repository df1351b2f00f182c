"""The tables at the end of the report: every number of the summary, faults, refused and limited commands."""

from typing import Any, get_type_hints

import msgspec
from msgspec import Meta

from snakesim_hal.safety.fault_log import FIRST_KEPT
from snakesim_operator.results.report.html import absent, shown, table, words
from snakesim_operator.results.summary import RunSummary

UNTOLD = "not known"
ELSEWHERE = ("config", "faults", "rejected_commands", "limited_commands")


def all_numbers(summary: RunSummary) -> str:
    """Every field with its unit and what it means, from the Struct itself."""
    hints = get_type_hints(RunSummary, include_extras=True)
    rows: list[list[str]] = []
    for field in msgspec.structs.fields(RunSummary):
        if field.name in ELSEWHERE:
            continue
        notes = getattr(hints[field.name], "__metadata__", ())
        meta: Meta | None = next((note for note in notes if isinstance(note, Meta)), None)
        unit = ((meta.extra_json_schema or {}).get("unit", "") if meta else "").removeprefix("1")
        about = (meta.description or "") if meta else ""
        rows.append([field.name, said(getattr(summary, field.name)), unit, about])
    return table(["quantity", "value", "unit", "meaning"], rows, "numbers")


def said(value: Any) -> str:
    """A value in words; what is unknown says so."""
    if value is None:
        return UNTOLD
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return shown(value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {said(inner)}" for key, inner in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(said(inner) for inner in value) or "none"
    return str(value)


def faults(summary: RunSummary, zero_s: float) -> str:
    """Every fault: when, where, what and why."""
    if not summary.faults:
        return absent("No fault.")
    rows = [
        [f"{fault.tick / summary.rate_hz - zero_s:.2f} s", fault.what, fault.joint or "–", fault.cause]
        for fault in summary.faults
    ]
    if summary.faults_left_out:
        told = f"{summary.faults_left_out} more, between the first and the newest, are left out"
        rows.insert(FIRST_KEPT, ["…", "", "–", told])
    return table(["when", "what", "joint", "cause"], rows)


def counts(counted: dict[str, int], what: str, none: str) -> str:
    """Counts by reason with a bar each."""
    if not any(counted.values()):
        return absent(none)
    most = max(counted.values())
    rows = "".join(
        f'<tr><th scope="row">{words(reason)}</th><td class="amount">{count}</td>'
        f'<td class="bar-cell"><span class="amount-bar" style="width:{100 * count / most:.1f}%"></span></td></tr>'
        for reason, count in sorted(counted.items(), key=lambda item: -item[1])
    )
    return (
        f'<table class="counts"><thead><tr><th scope="col">{words(what)}</th><th scope="col">times</th><td></td></tr>'
        f"</thead><tbody>{rows}</tbody></table>"
    )
