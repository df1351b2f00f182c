"""The readable form of a record, as Markdown. Pure."""

from collections.abc import Iterator

from snakesim_operator.features.qualification.protocol.checks import describe_check
from snakesim_operator.features.qualification.protocol.record import Record

EMULATED_BANNER = (
    "**EMULATED. No hardware was there. This record confirms nothing about a real drive.**"
)


def make_summary(record: Record) -> str:
    """Return a record as Markdown."""
    return "\n".join(_iterate_lines(record)) + "\n"


def describe_subject(record: Record) -> list[tuple[str, str]]:
    """Return name and value of everything that the record contains about drive, computer and operator."""
    subject = record.subject
    computer = record.computer
    kind = "emulated drive" if subject.emulated else "real drive"
    return [
        ("drive", f"{subject.driver_type}, {kind}"),
        ("serial number", subject.serial or "not reported"),
        ("firmware", subject.firmware or "not reported"),
        ("bus, adapter", f"{subject.bus}, {subject.adapter}"),
        ("configuration", subject.config_hash),
        ("host", f"{computer.name}, {computer.kernel}, {computer.machine}"),
        ("software", f"SnakeSIM {computer.snakesim}, Python {computer.python}"),
        ("operator", record.operator),
        ("time", f"{record.started_utc} to {record.finished_utc or 'not finished'}"),
    ]


def _iterate_lines(record: Record) -> Iterator[str]:
    yield f"# Qualification record: {record.subject.driver_type}, {record.verdict}"
    yield ""
    if record.subject.emulated:
        yield EMULATED_BANNER
        yield ""
    yield "| What | Value |"
    yield "|---|---|"
    for name, value in describe_subject(record):
        yield f"| {name} | {_escape(value)} |"
    yield ""
    if record.confirmations:
        yield "The operator confirmed before the first step:"
        yield ""
        for confirmation in record.confirmations:
            yield f"* {_escape(confirmation)}"
        yield ""
    yield "## Claims of the documentation"
    yield ""
    subject = "an emulated drive" if record.subject.emulated else "this drive"
    yield f"Each row is a sentence of the documentation, and whether it was confirmed on {subject}."
    yield ""
    yield "| Claim | Sentence | Page | Verdict |"
    yield "|---|---|---|---|"
    for claim in record.claims:
        yield f"| `{claim.id}` | {_escape(claim.sentence)} | `docs/{claim.page}` | {claim.verdict} |"
    yield ""
    yield "## Steps"
    yield ""
    for number, step in enumerate(record.steps, start=1):
        yield f"### {number}. {step.title}: {step.verdict}"
        yield ""
        yield f"Criterion: {_escape(step.criterion)} Caused by: {step.caused_by}."
        yield ""
        for check in step.checks:
            yield f"* {_escape(describe_check(check))}"
        if step.problem:
            yield f"* Problem: {_escape(step.problem)}"
        yield ""
    yield "Check the signature of `record.json` with `snakesim drive verify record.json`."


def _escape(text: str) -> str:
    """Return a text that cannot end a table cell or start markup: values come from drives and from people."""
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")
