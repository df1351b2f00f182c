"""The commands `snakesim study evaluate`, `sweep` and `optimize`. Importable without the extra that they need."""

import argparse
import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snakesim_hal.programs.arguments import (
    add_former_option,
    add_output_argument,
    add_resume_argument,
    add_scenario_name_argument,
    add_seed_argument,
    add_seeds_argument,
    add_set_argument,
    add_workers_argument,
    make_number_parser,
)
from snakesim_hal.programs.commands import Command, Commands

if TYPE_CHECKING:
    from collections.abc import Callable

    from snakesim_hal.base.step_limit import SharedStepTimes

MAX_TITLE_CHARACTERS = 200  # of a suite


def _add_evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "suite", metavar="SUITE", help="name of a shipped suite, or path of a suite file"
    )
    parser.add_argument(
        "--controllers", metavar="A,B,...", help="installed controllers, or ./file.py:Class"
    )
    add_seeds_argument(parser, "for each condition and controller (default: the suite's)")
    add_former_option(parser, "--fields", "--seeds")
    _add_conditions(parser, "only these conditions of the suite, by number")
    parser.add_argument(
        "--against",
        action="append",
        default=[],
        type=Path,
        metavar="DIR",
        help="folder of another evaluation to compare with (may be repeated)",
    )
    add_set_argument(parser)
    _add_shared_options(parser)


def _add_sweep_arguments(parser: argparse.ArgumentParser) -> None:
    add_scenario_name_argument(parser)
    _add_vary(parser, "values of a key: KEY=LOW:HIGH:COUNT, or KEY=[A, B] (may be repeated)")
    add_seeds_argument(parser, "for each value (default: 1)", 1)
    add_set_argument(parser)
    _add_shared_options(parser)


def _add_optimize_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="name of a shipped scenario, or path of its file, or of a suite with --conditions",
    )
    _add_conditions(parser, "use these conditions of a suite, by number, with its random values")
    _add_vary(parser, "range of a key: KEY=LOW:HIGH (may be repeated)")
    parser.add_argument(
        "--goal",
        required=True,
        metavar="NAME",
        help="number of the summary to maximize, such as path_distance_m",
    )
    parser.add_argument("--minimize", action="store_true", help="minimize this number instead")
    parser.add_argument(
        "--candidates",
        type=make_number_parser(1, 100_000),
        default=50,
        metavar="N",
        help="number of candidates in the file at the end (default: 50)",
    )
    add_former_option(parser, "--trials", "--candidates")
    add_seeds_argument(parser, "for each candidate and condition (default: 1)", 1)
    parser.add_argument(
        "--storage",
        type=Path,
        metavar="FILE",
        help="SQLite file, which is continued if it exists (default: a new one in runs/)",
    )
    add_set_argument(parser)
    add_seed_argument(parser, "of the first trials; default: 1", 1)
    add_workers_argument(parser)


def _add_conditions(parser: argparse.ArgumentParser, help_text: str) -> None:
    parser.add_argument("--conditions", metavar="1,2,...", help=help_text)
    add_former_option(parser, "--rows", "--conditions")


def _add_vary(parser: argparse.ArgumentParser, help_text: str) -> None:
    parser.add_argument(
        "--vary", action="append", required=True, metavar="KEY=RANGE", help=help_text
    )


def _add_shared_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trial",
        metavar="CONTROLLER:SEED[:CONDITION]",
        help="run one trial, with its folder and report",
    )
    add_former_option(parser, "--only", "--trial")
    add_output_argument(parser, "folder of the results (default: runs/NAME-TIME)")
    add_resume_argument(parser)
    add_seed_argument(
        parser, "of the first trials; default: 1, or a new one if the suite has `new_seeds`"
    )
    add_workers_argument(parser)


def _run_evaluate(arguments: argparse.Namespace) -> int:
    return _run_guarded_if_single_trial(arguments, _evaluate_suite)


def _run_sweep(arguments: argparse.Namespace) -> int:
    return _run_guarded_if_single_trial(arguments, _evaluate_sweep)


def _run_guarded_if_single_trial(
    arguments: argparse.Namespace,
    run_command: "Callable[[argparse.Namespace, SharedStepTimes | None], int]",
) -> int:
    """Run a command; with `--trial`, run it in a child process that can be ended whatever its controller does.

    Args:
        arguments: The parsed command line.
        run_command: Runs the command and returns its exit code; its second argument is None without `--trial`.
    """
    _require_train_extra()
    if arguments.trial is None:
        return run_command(arguments, None)
    from snakesim_operator.run.processes.guarded_process import run_in_guarded_child

    return run_in_guarded_child(
        lambda step_times: run_command(arguments, step_times), owns_process=arguments.owns_process
    )


def _evaluate_suite(arguments: argparse.Namespace, step_times: "SharedStepTimes | None") -> int:
    """Run `snakesim study evaluate`, and return its exit code.

    Args:
        arguments: The parsed command line.
        step_times: Shared memory that shows another process that a run makes progress; None if no process watches.
    """
    from snakesim_operator.features.evaluate.evaluation import EvaluationRequest, run_evaluation
    from snakesim_operator.features.evaluate.suite import read_suite, set_suite_values

    suite, source = read_suite(arguments.suite)
    suite = set_suite_values(suite, _parse_set_options(arguments.set))
    names = (arguments.controllers or "").split(",")
    controllers = [name.strip() for name in names if name.strip()]

    # The command that repeats a trial, for the report.
    command_words = ["snakesim", "study", "evaluate", arguments.suite]
    if controllers:
        command_words += ["--controllers", ",".join(controllers)]
    if arguments.conditions:
        command_words += ["--conditions", arguments.conditions]
    command_words += _repeat_option("--set", arguments.set)

    request = EvaluationRequest(
        suite=suite,
        source=source,
        name=Path(arguments.suite).stem,
        controllers=controllers or suite.controllers,
        seeds=arguments.seeds or suite.seeds,
        conditions=_parse_numbers(arguments.conditions or "", "--conditions"),
        against=arguments.against,
        **_collect_shared_values(arguments, command_words),
    )
    return run_evaluation(request, step_times)


def _evaluate_sweep(arguments: argparse.Namespace, step_times: "SharedStepTimes | None") -> int:
    """Run `snakesim study sweep` as the evaluation of a suite that varies one scenario, and return its exit code.

    Args:
        arguments: The parsed command line.
        step_times: Shared memory that shows another process that a run makes progress; None if no process watches.
    """
    from snakesim_operator.features.evaluate.evaluation import EvaluationRequest, run_evaluation
    from snakesim_operator.features.evaluate.suite import EvaluationSuite, parse_vary

    title = f"{Path(arguments.scenario).stem}: {', '.join(arguments.vary)}"
    vary = dict(map(parse_vary, arguments.vary))
    suite = EvaluationSuite(
        title=title[:MAX_TITLE_CHARACTERS],
        scenario=arguments.scenario,
        set=_parse_set_options(arguments.set),
        vary=vary,
    )

    # The command that repeats a trial, for the report.
    command_words = ["snakesim", "study", "sweep", arguments.scenario]
    command_words += _repeat_option("--vary", arguments.vary)
    command_words += _repeat_option("--set", arguments.set)

    request = EvaluationRequest(
        suite=suite,
        source="sweep",
        name="sweep",
        controllers=[],
        seeds=arguments.seeds,
        **_collect_shared_values(arguments, command_words),
    )
    return run_evaluation(request, step_times)


def _collect_shared_values(arguments: argparse.Namespace, command: list[str]) -> dict[str, Any]:
    """Return the values of an `EvaluationRequest` that both commands have. `command` repeats a trial."""
    names = ("seed", "trial", "out", "resume", "cluster", "workers")
    values = {name: getattr(arguments, name) for name in names}
    values["command"] = shlex.join(command)
    return values


def _run_optimize(arguments: argparse.Namespace) -> int:
    """Run `snakesim study optimize`, and return its exit code. If it is stopped, print how to continue it."""
    _require_train_extra()
    from snakesim_hal.base.process import raise_on_stop_signals
    from snakesim_hal.base.terminal import print_line
    from snakesim_operator.features.evaluate.optimize import SearchRequest, run_optimization
    from snakesim_operator.run.conclusion import EXIT_INTERRUPTED
    from snakesim_operator.run.folder import choose_default_folder

    # Every field of `SearchRequest` has the name of its option; two of them are converted below.
    values = {
        field.name: getattr(arguments, field.name) for field in dataclasses.fields(SearchRequest)
    }
    # Without --storage, the file has the name that a new run folder would have.
    storage = arguments.storage or choose_default_folder("optimize").with_suffix(".db")
    values["storage"] = storage
    values["conditions"] = _parse_numbers(arguments.conditions or "", "--conditions")
    with raise_on_stop_signals():
        try:
            return run_optimization(SearchRequest(**values))
        except KeyboardInterrupt:  # the storage keeps every finished candidate
            if storage.is_file():
                print_line(
                    f"stopped: {storage} keeps the finished candidates; the same command continues with"
                )
                print_line(f"  --storage {shlex.quote(str(storage))}")
            return EXIT_INTERRUPTED


def _parse_set_options(texts: list[str]) -> dict[str, Any]:
    """Return the values of `--set`, by key. Raises ConfigError."""
    from snakesim_hal.model.scenario import parse_set_option

    overrides = map(parse_set_option, texts)
    return {override.key: override.value for override in overrides}


def _parse_numbers(text: str, option: str) -> list[int]:
    """Return the numbers of a list such as `1,2`. Raises ConfigError."""
    from snakesim_hal.base.errors import ConfigError

    words = [word.strip() for word in text.split(",") if word.strip()]
    if not all(word.isdecimal() and len(word) < 7 for word in words):
        raise ConfigError(
            f"{option} {text[:60]}: give whole numbers, such as {option} 1,2",
            code="command/invalid-option",
        )
    return [int(word) for word in words]


def _repeat_option(option: str, values: list[str]) -> list[str]:
    """Return the words of an option that stands once for each value."""
    words: list[str] = []
    for value in values:
        words += [option, value]
    return words


def _require_train_extra() -> None:
    """Raise an error that names the extra `train` if it is not installed."""
    from snakesim_operator.base import extras

    extras.require_extra("train", "this command")


COMMANDS: Commands = (
    Command(
        name="study evaluate",
        help="Run controllers on many random scenes. Writes a table with confidence intervals, and a page.",
        add=_add_evaluate_arguments,
        run=_run_evaluate,
        details="A trial is one run: one controller, one condition and one seed, which gives the random scene. "
        "Exit code 0: all trials ran, whatever their results are. 1: some could not run. 2: wrong input, nothing was "
        "run. 130: stopped by Ctrl-C, continue with --resume.",
        examples=(
            "study evaluate clutter --controllers obstacle_aided,hold --seeds 20",
            "study evaluate ./suite.toml --out runs/suite --resume",
        ),
    ),
    Command(
        name="study sweep",
        help="Run a scenario with different values of any key.",
        add=_add_sweep_arguments,
        run=_run_sweep,
        examples=(
            "study sweep peg_row --vary control.propulsion_n=10:30:5",
            "study sweep peg_row --vary control.propulsion_n=10:30:5 --seeds 4 --out runs/sweep",
        ),
    ),
    Command(
        name="study optimize",
        help="Search values of keys that give the best mean of a number of the summary.",
        add=_add_optimize_arguments,
        run=_run_optimize,
        examples=(
            "study optimize peg_row --vary control.propulsion_n=10:30 --goal path_distance_m",
            "study optimize peg_row --vary control.propulsion_n=10:30 --goal energy_j_per_m --minimize --candidates 90",
        ),
    ),
)
