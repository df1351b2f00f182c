"""Runs the cases of a suite, keeps what is done, prints the table and draws the page."""

import re
import secrets
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError, short
from snakesim_hal.base.process import stop_signals_raise
from snakesim_hal.base.step_limit import Pulse
from snakesim_hal.base.terminal import say
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.base.dask_cluster import check_address
from snakesim_operator.features.evaluate import store
from snakesim_operator.features.evaluate.card import CARD, Card, card_of, compare, read_card, text
from snakesim_operator.features.evaluate.case import Case
from snakesim_operator.features.evaluate.cluster import workers
from snakesim_operator.features.evaluate.page import page
from snakesim_operator.features.evaluate.progress import Progress
from snakesim_operator.features.evaluate.suite import Suite, cases_of, rows_of
from snakesim_operator.features.evaluate.table import best_of, lines_of, table, worst
from snakesim_operator.run.conclusion import INTERRUPTED
from snakesim_operator.run.folder import named_after
from snakesim_operator.run.in_process import run_in_process

FRESH = (1_000_000, 2_000_000_000)  # fields that a suite draws: beyond any that settings were tuned on
PAGE = "evaluation.html"


@dataclass(frozen=True)
class Request:
    """What the command line asks for."""

    suite: Suite
    source: str  # the suite's file, or the command that stands for one
    name: str
    controllers: Sequence[str]  # none: the scenario's
    fields: int
    again: str  # the command for one case, but for `--only`
    seed: int | None = None  # None: 1, or fields that the suite draws
    rows: Sequence[int] = ()  # none: all
    against: Sequence[Path] = ()  # other evaluations' score cards
    only: str | None = None
    out: Path | None = None
    resume: bool = False
    cluster: str | None = None
    workers: int | None = None


def go(request: Request, pulse: Pulse | None = None) -> int:
    """Run all cases that are not done yet, or one as a run of its own. pulse: of that one, as of `run_in_process`.

    Returns: 0; 1 when a case could not run; 130 when it was stopped, which loses no case that is done.
    """
    if request.only is not None:
        return _run_one(request, request.only, pulse)
    with stop_signals_raise():
        try:
            return _run_all(request)
        except KeyboardInterrupt:
            say("stopped before any case was begun")
            return INTERRUPTED


def _run_all(request: Request) -> int:
    if request.resume and request.out is None:
        raise ConfigError("--resume: name the folder of the evaluation with --out")
    check_address(request.cluster)
    others = [read_card(path) for path in request.against]
    seed = first_field(request)
    cases = cases_of(request.suite, request.source, request.controllers, request.fields, seed)
    cases = rows_of(cases, request.rows, request.source)
    out = request.out or named_after(request.name)
    with store.opened(out, resume=request.resume) as kept:
        todo = list({case.id: case for case in cases if case.id not in kept.done}.values())
        todo.sort(key=lambda case: case.field)  # whenever it ends early, every row has as many fields
        if request.resume:
            say(f"{len(cases) - len(todo)} of {len(cases)} cases are done already")
        try:
            if todo:
                _run(request, todo, kept, out)
            _finish(request, cases, kept.done, out, others)
        except KeyboardInterrupt:
            done = sum(case.id in kept.done for case in cases)
            drawn = f" --seed {seed}" if request.suite.fresh else ""
            say(f"stopped: {done} of {len(cases)} cases are done; the same command goes on with")
            say(f"  --resume --out {shlex.quote(str(out))}{drawn}")
            return INTERRUPTED
        return 1 if any(kept.done[case.id].error is not None for case in cases) else 0


def first_field(request: Request) -> int:
    """As asked for, else 1, or drawn now and said. Raises ConfigError."""
    if request.seed is not None or not request.suite.fresh:
        return 1 if request.seed is None else request.seed
    if request.resume:
        raise ConfigError("--resume: this suite draws its fields; name with --seed those that were printed as drawn")
    seed = secrets.randbelow(FRESH[1] - FRESH[0]) + FRESH[0]
    say(f"fields {seed} to {seed + request.fields - 1}, drawn now; --seed {seed} takes them again")
    return seed


def _run_one(request: Request, only: str, pulse: Pulse | None) -> int:
    """One case again, in this process, with the whole folder of a run. Exit code: of `snakesim run`."""
    case = choose(request.suite, request.source, only)
    say(f"{case.setting}, {case.controller}, field {case.field}")
    config = msgspec.json.decode(case.config, type=RunConfig)
    return run_in_process(config, request.out, until_goal=True, give_up_s=case.give_up_s, pulse=pulse)


def choose(suite: Suite, source: str, only: str) -> Case:
    """The case of CONTROLLER:FIELD:ROW, or of CONTROLLER:FIELD if there is one row. Raises ConfigError."""
    named = re.fullmatch(r"(?P<controller>.+?):(?P<field>\d{1,10})(:(?P<row>\d{1,6}))?", only)
    if named is None:
        raise ConfigError(f"--only {short(only)}: give CONTROLLER:FIELD or CONTROLLER:FIELD:ROW, such as hold:3:1")
    cases = cases_of(suite, source, [named["controller"]], 1, int(named["field"]))
    fitting = [case for case in cases if named["row"] is None or case.row == int(named["row"])]
    if len(fitting) == 1:
        return fitting[0]
    rows = ", ".join(f"{case.row} ({case.setting})" for case in cases[:12])
    raise ConfigError(f"--only {only}: add one of the rows, as in {name_of(cases[0])}; there are {rows}")


def name_of(case: Case) -> str:
    """As `--only` takes it."""
    return f"{case.controller}:{case.field}:{case.row}"


def _run(request: Request, todo: Sequence[Case], kept: store.Store, out: Path) -> None:
    with workers(request.cluster, request.workers) as working, Progress(len(todo)) as shown:
        where = request.cluster or "on this computer"
        say(f"{len(todo)} cases on {working.size()} workers, {where}")
        say(f"results: {out}; if this ends early, --resume --out {out} goes on")
        for case, outcome in working.solve(todo):
            kept.add(case, outcome)
            shown.done(outcome)


def _finish(request: Request, cases: Sequence[Case], done: store.Results, out: Path, others: Sequence[Card]) -> None:
    lines = lines_of(cases, done)
    best = best_of(lines)
    failed = worst([case for case in cases if case.controller == best], done)
    for words in table(lines):
        say(words)
    if any(line.runs == 1 and line.crossed is None for line in lines):
        say("a row of one run has no interval; give --seeds 2 or more (of a suite --fields)")
    if broken := [(case, why) for case in cases if (why := done[case.id].error) is not None]:
        say(f"{len(broken)} could not run, the first: {name_of(broken[0][0])}: {broken[0][1]}")
    again = [
        (f"{case.setting}, {name_of(case)}", why, f"{request.again} --only {shlex.quote(name_of(case))}")
        for case, why in failed
    ]
    if again:
        say(f"the worst {len(again)} of {best}:" if len(again) > 1 else f"the worst of {best}:")
    for name, why, command in again:
        for words in (f"  {name}: {why}", f"    {command}"):
            say(words)
    paths = store.write_tables(out, cases, done)
    card = card_of(request.name, cases, done)
    if request.suite.fresh or others:
        for words in text(card, compare(card, others)):
            say(words)
    write_text(out / CARD, msgspec.json.format(msgspec.json.encode(card), indent=1).decode())
    write_text(out / PAGE, page(request.suite.title or request.name, request.source, lines, again))
    for path in (*paths, out / CARD, out / PAGE):
        say(f"written: {path}")
