"""Arguments of `snakesim evaluate`, `sweep` and `optimize`. Importable without the extra that they need."""

import argparse
import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snakesim_hal.programs.arguments import number

if TYPE_CHECKING:
    from collections.abc import Callable

    from snakesim_hal.base.step_limit import Pulse

TASK = "run"  # under which `snakesim --help` lists it


def add_commands(commands: Any) -> None:
    """Add the three to the parser of `snakesim`."""
    tried = commands.add_parser(
        "evaluate",
        help="run controllers on many fields; a table with confidence intervals, and a page",
        epilog="Exit code: 0 all cases ran, whatever came of them; 1 some could not; 2 wrong input, nothing was run; "
        "130 stopped by Ctrl-C, and --resume goes on.",
    )
    tried.add_argument("suite", help="name of a shipped suite, or path of a suite file")
    tried.add_argument(
        "--controllers", "--controller", metavar="A,B,...", help="installed controllers, or ./file.py:Class"
    )
    tried.add_argument("--fields", type=number(1, 100_000), metavar="N", help="fields for each row and controller")
    tried.add_argument("--rows", metavar="1,2,...", help="only these rows of the table, by number")
    tried.add_argument(
        "--against",
        action="append",
        default=[],
        type=Path,
        metavar="DIR",
        help="pair with the score card there",
    )
    _add_set(tried)
    _add_shared(tried)
    tried.set_defaults(act=_evaluate)

    swept = commands.add_parser("sweep", help="run a scenario with different values of any setting")
    swept.add_argument("scenario", help="name of a shipped scenario, or path of a scenario file")
    swept.add_argument(
        "--vary", action="append", required=True, metavar="KEY=LOW:HIGH:COUNT", help="or KEY=[A, B]; may be repeated"
    )
    swept.add_argument("--seeds", type=number(1, 100_000), default=1, metavar="N", help="runs for each value (1)")
    _add_set(swept)
    _add_shared(swept)
    swept.set_defaults(act=_sweep)

    searched = commands.add_parser("optimize", help="search settings for the best mean of a number of the summary")
    searched.add_argument("scenario", help="name of a shipped scenario or path of its file; with --rows, of a suite")
    searched.add_argument("--rows", metavar="1,2,...", help="on these rows of a suite, with what it draws")
    searched.add_argument("--vary", action="append", required=True, metavar="KEY=LOW:HIGH", help="may be repeated")
    searched.add_argument("--goal", required=True, metavar="NAME", help="such as path_distance_m or energy_j_per_m")
    searched.add_argument("--minimize", action="store_true", help="search the smallest instead of the largest")
    searched.add_argument(
        "--trials", type=number(1, 100_000), default=50, metavar="N", help="in the file at the end (50)"
    )
    searched.add_argument(
        "--seeds",
        type=number(1, 100_000),
        default=1,
        metavar="N",
        help="runs for each trial, or fields for each row (1)",
    )
    searched.add_argument(
        "--storage", type=Path, metavar="FILE", help="SQLite file; an old one goes on (default: a new one in runs/)"
    )
    _add_set(searched)
    _add_workers(searched)
    searched.set_defaults(act=_optimize)


def _add_set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="in all runs; may be repeated")


def _add_shared(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", metavar="CONTROLLER:FIELD[:ROW]", help="run one case, with its folder and report")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results (default: runs/NAME-TIME)")
    parser.add_argument("--resume", action="store_true", help="go on with what is in --out")
    _add_workers(parser)


def _add_workers(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seed", type=int, metavar="S", help="the first field; the next is S + 1 (1, or drawn by the suite)"
    )
    parser.add_argument(
        "--cluster", metavar="tcp://HOST:PORT", help="scheduler of a Dask cluster (default: this computer)"
    )
    parser.add_argument(
        "--workers", type=number(1, 100_000), metavar="N", help="processes on this computer (one a core)"
    )


def _evaluate(arguments: argparse.Namespace) -> int:
    return _guarded_if_one_run(arguments, _evaluate_with)


def _guarded_if_one_run(arguments: argparse.Namespace, act: "Callable[[argparse.Namespace, Pulse | None], int]") -> int:
    """A single run is computed in a child, which can be ended whatever its controller does."""
    _check_extra()
    if arguments.only is None:
        return act(arguments, None)
    from snakesim_operator.run.guarded_process import guarded

    return guarded(lambda pulse: act(arguments, pulse), owns_process=arguments.owns_process)


def _evaluate_with(arguments: argparse.Namespace, pulse: "Pulse | None") -> int:
    from snakesim_hal.model.scenario import parse_set
    from snakesim_operator.features.evaluate.evaluation import Request, go
    from snakesim_operator.features.evaluate.suite import also_set, read_suite

    suite, source = read_suite(arguments.suite)
    suite = also_set(suite, {one.key: one.value for one in map(parse_set, arguments.set)})
    controllers = [name.strip() for name in (arguments.controllers or "").split(",") if name.strip()]
    again = ["evaluate", arguments.suite, *(["--controllers", ",".join(controllers)] if controllers else [])]
    if arguments.rows:
        again += ["--rows", arguments.rows]
    again += [word for value in arguments.set for word in ("--set", value)]
    fields = arguments.fields or suite.fields
    chosen = controllers or suite.controllers
    rows = _numbers(arguments.rows or "", "--rows")
    name = Path(arguments.suite).stem
    return go(
        Request(suite, source, name, chosen, fields, rows=rows, against=arguments.against, **_shared(arguments, again)),
        pulse,
    )


def _numbers(text: str, flag: str) -> list[int]:
    """Raises ConfigError."""
    from snakesim_hal.base.errors import ConfigError

    words = [word.strip() for word in text.split(",") if word.strip()]
    if not all(word.isdecimal() and len(word) < 7 for word in words):
        raise ConfigError(f"{flag} {text[:60]}: give whole numbers, such as {flag} 1,2")
    return [int(word) for word in words]


def _sweep(arguments: argparse.Namespace) -> int:
    return _guarded_if_one_run(arguments, _sweep_with)


def _sweep_with(arguments: argparse.Namespace, pulse: "Pulse | None") -> int:
    from snakesim_hal.model.scenario import parse_set
    from snakesim_operator.features.evaluate.evaluation import Request, go
    from snakesim_operator.features.evaluate.suite import Suite, parse_vary

    title = f"{Path(arguments.scenario).stem}: {', '.join(arguments.vary)}"[:200]
    vary, always = dict(map(parse_vary, arguments.vary)), {one.key: one.value for one in map(parse_set, arguments.set)}
    suite = Suite(title=title, scenario=arguments.scenario, set=always, vary=vary)
    again = ["sweep", arguments.scenario]
    for flag, values in (("--vary", arguments.vary), ("--set", arguments.set)):
        again += [word for value in values for word in (flag, value)]
    return go(Request(suite, "sweep", "sweep", [], arguments.seeds, **_shared(arguments, again)), pulse)


def _shared(arguments: argparse.Namespace, again: list[str]) -> dict[str, Any]:
    names = ("seed", "only", "out", "resume", "cluster", "workers")
    return {"again": shlex.join(["snakesim", *again]), **{name: getattr(arguments, name) for name in names}}


def _optimize(arguments: argparse.Namespace) -> int:
    _check_extra()
    from snakesim_hal.base.process import stop_signals_raise
    from snakesim_hal.base.terminal import say
    from snakesim_operator.features.evaluate.optimize import Request, optimize
    from snakesim_operator.run.conclusion import INTERRUPTED
    from snakesim_operator.run.folder import named_after

    given = {one.name: getattr(arguments, one.name) for one in dataclasses.fields(Request)}
    given["rows"] = _numbers(arguments.rows or "", "--rows")
    given["seed"] = 1 if arguments.seed is None else arguments.seed
    storage = arguments.storage or named_after("optimize").with_suffix(".db")
    with stop_signals_raise():
        try:
            return optimize(Request(**{**given, "storage": storage}))
        except KeyboardInterrupt:  # no trial that is done is lost
            if storage.is_file():
                say(f"stopped: {storage} keeps the trials that are done; the same command goes on with")
                say(f"  --storage {shlex.quote(str(storage))}")
            return INTERRUPTED


def _check_extra() -> None:
    from snakesim_operator.base import extras

    extras.check("evaluate", "this command")
