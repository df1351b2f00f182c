"""Arguments of `snakesim evaluate`, `sweep` and `optimize`. Importable without the extra that they need."""

import argparse
import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snakesim_hal.programs.arguments import number_type

if TYPE_CHECKING:
    from collections.abc import Callable

    from snakesim_hal.base.step_limit import Pulse

TASK = "run"  # the heading of `snakesim --help` that lists it


def add_commands(commands: Any) -> None:
    """Add `evaluate`, `sweep` and `optimize` to the parser of `snakesim`."""
    _add_evaluate(commands)
    _add_sweep(commands)
    _add_optimize(commands)


def _add_evaluate(commands: Any) -> None:
    command = commands.add_parser(
        "evaluate",
        help="run controllers on many fields; a table with confidence intervals, and a page",
        epilog="Exit code: 0 all cases ran, whatever came of them; 1 some could not; 2 wrong input, nothing was run; "
        "130 stopped by Ctrl-C, and --resume goes on.",
    )
    command.add_argument("suite", help="name of a shipped suite, or path of a suite file")
    command.add_argument(
        "--controllers", "--controller", metavar="A,B,...", help="installed controllers, or ./file.py:Class"
    )
    command.add_argument(
        "--fields", type=number_type(1, 100_000), metavar="N", help="fields for each row and controller"
    )
    command.add_argument("--rows", metavar="1,2,...", help="only these rows of the table, by number")
    command.add_argument(
        "--against",
        action="append",
        default=[],
        type=Path,
        metavar="DIR",
        help="pair with the score card there",
    )
    _add_set(command)
    _add_shared(command)
    command.set_defaults(act=_evaluate)


def _add_sweep(commands: Any) -> None:
    command = commands.add_parser("sweep", help="run a scenario with different values of any setting")
    command.add_argument("scenario", help="name of a shipped scenario, or path of a scenario file")
    command.add_argument(
        "--vary", action="append", required=True, metavar="KEY=LOW:HIGH:COUNT", help="or KEY=[A, B]; may be repeated"
    )
    command.add_argument(
        "--seeds", type=number_type(1, 100_000), default=1, metavar="N", help="runs for each value (1)"
    )
    _add_set(command)
    _add_shared(command)
    command.set_defaults(act=_sweep)


def _add_optimize(commands: Any) -> None:
    command = commands.add_parser("optimize", help="search settings for the best mean of a number of the summary")
    command.add_argument("scenario", help="name of a shipped scenario or path of its file; with --rows, of a suite")
    command.add_argument("--rows", metavar="1,2,...", help="on these rows of a suite, with what it draws")
    command.add_argument("--vary", action="append", required=True, metavar="KEY=LOW:HIGH", help="may be repeated")
    command.add_argument("--goal", required=True, metavar="NAME", help="such as path_distance_m or energy_j_per_m")
    command.add_argument("--minimize", action="store_true", help="search the smallest instead of the largest")
    command.add_argument(
        "--trials", type=number_type(1, 100_000), default=50, metavar="N", help="in the file at the end (50)"
    )
    command.add_argument(
        "--seeds",
        type=number_type(1, 100_000),
        default=1,
        metavar="N",
        help="runs for each trial, or fields for each row (1)",
    )
    command.add_argument(
        "--storage", type=Path, metavar="FILE", help="SQLite file; an old one goes on (default: a new one in runs/)"
    )
    _add_set(command)
    _add_workers(command)
    command.set_defaults(act=_optimize)


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
        "--workers", type=number_type(1, 100_000), metavar="N", help="processes on this computer (one a core)"
    )


def _evaluate(arguments: argparse.Namespace) -> int:
    return _guarded_if_one_run(arguments, _evaluate_with)


def _sweep(arguments: argparse.Namespace) -> int:
    return _guarded_if_one_run(arguments, _sweep_with)


def _guarded_if_one_run(arguments: argparse.Namespace, act: "Callable[[argparse.Namespace, Pulse | None], int]") -> int:
    """Run a command; with `--only` in a child process, which can be ended whatever its controller does."""
    _check_extra()
    if arguments.only is None:
        return act(arguments, None)
    from snakesim_operator.run.guarded_process import run_guarded

    return run_guarded(lambda pulse: act(arguments, pulse), owns_process=arguments.owns_process)


def _evaluate_with(arguments: argparse.Namespace, pulse: "Pulse | None") -> int:
    from snakesim_operator.features.evaluate.evaluation import EvaluationRequest, evaluate
    from snakesim_operator.features.evaluate.suite import override_suite, read_suite

    suite, source = read_suite(arguments.suite)
    suite = override_suite(suite, _parse_settings(arguments.set))
    names = (arguments.controllers or "").split(",")
    controllers = [name.strip() for name in names if name.strip()]
    command = ["snakesim", "evaluate", arguments.suite]
    if controllers:
        command += ["--controllers", ",".join(controllers)]
    if arguments.rows:
        command += ["--rows", arguments.rows]
    command += _repeat_option("--set", arguments.set)
    request = EvaluationRequest(
        suite=suite,
        source=source,
        name=Path(arguments.suite).stem,
        controllers=controllers or suite.controllers,
        fields=arguments.fields or suite.fields,
        rows=_parse_numbers(arguments.rows or "", "--rows"),
        against=arguments.against,
        **_shared_values(arguments, command),
    )
    return evaluate(request, pulse)


def _sweep_with(arguments: argparse.Namespace, pulse: "Pulse | None") -> int:
    from snakesim_operator.features.evaluate.evaluation import EvaluationRequest, evaluate
    from snakesim_operator.features.evaluate.suite import Suite, parse_vary

    title = f"{Path(arguments.scenario).stem}: {', '.join(arguments.vary)}"[:200]
    vary = dict(map(parse_vary, arguments.vary))
    suite = Suite(title=title, scenario=arguments.scenario, set=_parse_settings(arguments.set), vary=vary)
    command = ["snakesim", "sweep", arguments.scenario]
    command += _repeat_option("--vary", arguments.vary)
    command += _repeat_option("--set", arguments.set)
    request = EvaluationRequest(
        suite=suite,
        source="sweep",
        name="sweep",
        controllers=[],
        fields=arguments.seeds,
        **_shared_values(arguments, command),
    )
    return evaluate(request, pulse)


def _shared_values(arguments: argparse.Namespace, command: list[str]) -> dict[str, Any]:
    """Return the values of an `EvaluationRequest` that both commands have. command: that runs one case again."""
    names = ("seed", "only", "out", "resume", "cluster", "workers")
    values = {name: getattr(arguments, name) for name in names}
    values["command"] = shlex.join(command)
    return values


def _optimize(arguments: argparse.Namespace) -> int:
    _check_extra()
    from snakesim_hal.base.process import stop_signals_raise
    from snakesim_hal.base.terminal import print_line
    from snakesim_operator.features.evaluate.optimize import SearchRequest, optimize
    from snakesim_operator.run.conclusion import INTERRUPTED
    from snakesim_operator.run.folder import default_folder

    values = {field.name: getattr(arguments, field.name) for field in dataclasses.fields(SearchRequest)}
    storage = arguments.storage or default_folder("optimize").with_suffix(".db")
    values["storage"] = storage
    values["rows"] = _parse_numbers(arguments.rows or "", "--rows")
    values["seed"] = 1 if arguments.seed is None else arguments.seed
    with stop_signals_raise():
        try:
            return optimize(SearchRequest(**values))
        except KeyboardInterrupt:  # no trial that is done is lost
            if storage.is_file():
                print_line(f"stopped: {storage} keeps the trials that are done; the same command goes on with")
                print_line(f"  --storage {shlex.quote(str(storage))}")
            return INTERRUPTED


def _parse_settings(texts: list[str]) -> dict[str, Any]:
    """Return the values of `--set`, by key. Raises ConfigError."""
    from snakesim_hal.model.scenario import parse_set

    overrides = map(parse_set, texts)
    return {override.key: override.value for override in overrides}


def _parse_numbers(text: str, option: str) -> list[int]:
    """Return the numbers of a list such as `1,2`. Raises ConfigError."""
    from snakesim_hal.base.errors import ConfigError

    words = [word.strip() for word in text.split(",") if word.strip()]
    if not all(word.isdecimal() and len(word) < 7 for word in words):
        raise ConfigError(
            f"{option} {text[:60]}: give whole numbers, such as {option} 1,2", code="command/invalid-option"
        )
    return [int(word) for word in words]


def _repeat_option(option: str, values: list[str]) -> list[str]:
    """Return the words of an option that is given once for each value."""
    words: list[str] = []
    for value in values:
        words += [option, value]
    return words


def _check_extra() -> None:
    """Raise an error that names the extra `train` if it is not installed."""
    from snakesim_operator.base import extras

    extras.require("train", "this command")
