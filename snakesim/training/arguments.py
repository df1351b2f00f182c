"""The commands `snakesim policy`. This module can be imported without the extra that the commands need."""

import argparse
import dataclasses

from snakesim_hal.programs.arguments import (
    add_duration_argument,
    add_former_option,
    add_json_argument,
    add_output_argument,
    add_resume_argument,
    add_scenario_name_argument,
    add_seed_argument,
    add_seeds_argument,
    add_set_argument,
    add_workers_argument,
    make_number_parser,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands

DEFAULT_FRAME_SKIP = 5  # control cycles: at 100 Hz, 20 decisions a second
MAX_FRAME_SKIP = 1000  # as a policy file allows


def _add_train_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `snakesim policy train`."""
    add_scenario_name_argument(parser)
    parser.add_argument(
        "--form",
        choices=("feeling", "wave"),
        default="feeling",
        help="what is learned (default: feeling)",
    )
    parser.add_argument(
        "--frame-skip",
        type=make_number_parser(1, MAX_FRAME_SKIP),
        default=DEFAULT_FRAME_SKIP,
        metavar="N",
        help=f"control cycles for which a target is held (default: {DEFAULT_FRAME_SKIP})",
    )
    _add_count_option(parser, "--generations", 1, 20, "generations of the search")
    _add_count_option(parser, "--population", 4, 12, "policies in a generation")
    add_seeds_argument(parser, "for each policy, new ones in each generation (default: 4)", 4)
    add_former_option(parser, "--fields", "--seeds")
    _add_count_option(
        parser, "--check-seeds", 1, 8, "number of seeds with which the mean policy is checked"
    )
    add_former_option(parser, "--check-fields", "--check-seeds")
    add_seed_argument(parser, "of the search (default: 1)", 1)
    parser.add_argument(
        "--init",
        dest="begin",
        metavar="POLICY",
        help="begin at its numbers: a shipped policy, or policy.onnx",
    )
    parser.add_argument(
        "--spread",
        type=make_number_parser(0.01, 10.0),
        default=1.0,
        metavar="X",
        help="times how far the first generation looks (default: 1)",
    )
    add_duration_argument(
        parser,
        "seconds of an episode (default: the scenario's)",
        make_number_parser(0.1, 3600.0, "s"),
    )
    parser.add_argument(
        "--reward",
        action="append",
        default=[],
        metavar="TERM=WEIGHT",
        help="as energy=-0.002 (may be repeated)",
    )
    add_set_argument(parser)
    parser.add_argument(
        "--randomize",
        action="append",
        default=[],
        metavar="KEY=LOW:HIGH",
        help="a random value for each seed (may be repeated)",
    )
    add_workers_argument(parser)
    add_output_argument(parser, "folder of what comes of it", required=True)
    add_resume_argument(parser)


def _add_count_option(
    parser: argparse.ArgumentParser, option: str, minimum: int, default: int, help_text: str
) -> None:
    parser.add_argument(
        option,
        type=make_number_parser(minimum, 100_000),
        default=default,
        metavar="N",
        help=f"{help_text} (default: {default})",
    )


def _add_info_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `snakesim policy info`."""
    parser.add_argument(
        "policy", metavar="POLICY", help="path of an ONNX file, or name of a shipped policy"
    )
    add_json_argument(parser)


def _run_info(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    extras.require_extra("policy", "`snakesim policy info`")
    from snakesim.training.policy_info import show_policy

    return show_policy(arguments.policy, as_json=arguments.json)


def _run_train(arguments: argparse.Namespace) -> int:
    """Run `snakesim policy train` with the parsed arguments, and return the exit code."""
    from snakesim_operator.base import extras

    for extra in ("train", "gym", "report", "policy"):
        extras.require_extra(extra, "`snakesim policy train`")
    from snakesim.training.search import SearchEffort
    from snakesim.training.trained import train_policy
    from snakesim_hal.model.scenario import parse_set_option
    from snakesim_hal.model.scene_file.randomization import parse_randomize_option

    environment = {
        "scenario": arguments.scenario,
        "duration": arguments.duration,
        "frame_skip": arguments.frame_skip,
        "reward": {
            override.key: override.value for override in map(parse_set_option, arguments.reward)
        },
        "set": {override.key: override.value for override in map(parse_set_option, arguments.set)},
        "randomize": dict(map(parse_randomize_option, arguments.randomize)),
    }
    # Every field of Effort is the `dest` of an option.
    effort = SearchEffort(
        **{field.name: getattr(arguments, field.name) for field in dataclasses.fields(SearchEffort)}
    )
    return train_policy(
        environment,
        arguments.form,
        arguments.begin,
        effort,
        arguments.out,
        worker_count=arguments.workers,
        cluster=arguments.cluster,
        again=["snakesim", "policy", "train", arguments.scenario, *_list_search_options(arguments)],
        resume=arguments.resume,
    )


def _list_search_options(arguments: argparse.Namespace) -> list[str]:
    """Return the options that decide the result of the search. --out, --workers and --cluster do not."""
    options = ["--form", arguments.form]
    if arguments.duration:
        options += ["--duration", f"{arguments.duration:g}"]
    for name in ("generations", "population", "seeds", "check_seeds", "seed"):
        flag = f"--{name.replace('_', '-')}"
        options += [flag, str(getattr(arguments, name))]
    if arguments.frame_skip != DEFAULT_FRAME_SKIP:
        options += ["--frame-skip", str(arguments.frame_skip)]
    if arguments.begin:
        options += ["--init", arguments.begin]
    if arguments.spread != 1.0:
        options += ["--spread", f"{arguments.spread:g}"]
    for name in ("reward", "set", "randomize"):
        for value in getattr(arguments, name):
            options += [f"--{name}", value]
    return options


COMMANDS: Commands = (
    CommandGroup(
        name="policy",
        heading="runs and studies",
        help="Train policies, and show what a policy file describes.",
    ),
    Command(
        name="policy train",
        help="Search a policy for a scenario on random scenes. An ONNX file for --controller policy:FILE.",
        add=_add_train_arguments,
        run=_run_train,
        details="In --out: policy.onnx, curve.csv and curve.png, as of the newest generation. The same numbers "
        "give the same policy for any --workers. Exit code 0: done. 2: wrong input. 130: stopped by Ctrl-C, continue "
        "with --resume.",
        examples=(
            "policy train surveyed_clutter --out runs/policy",
            "policy train surveyed_clutter --form wave --generations 50 --workers 4 --out runs/policy",
        ),
    ),
    Command(
        name="policy info",
        help="Print the description in a policy file: robot, observations, actions and source.",
        add=_add_info_arguments,
        run=_run_info,
        examples=("policy info clutter", "policy info runs/policy/policy.onnx --json"),
    ),
)
