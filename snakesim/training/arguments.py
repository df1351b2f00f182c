"""Arguments of `snakesim train`. This module can be imported without the extra that the command needs."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from snakesim_hal.programs.arguments import number_type

TASK = "run"  # under which `snakesim --help` lists it


def add_commands(commands: Any) -> None:
    """Add `train` to the parser of `snakesim`."""
    train = commands.add_parser(
        "train",
        help="search a policy for a scenario on random fields; an ONNX file for --controller policy:FILE",
        epilog="In --out: policy.onnx, curve.csv and curve.png, as of the newest generation. The same numbers give the "
        "same policy, whatever --workers. Exit code: 0; 2 wrong input; 130 stopped by Ctrl-C, and --resume goes on.",
    )
    train.add_argument("scenario", help="name of a shipped scenario, or path of a scenario file")
    train.add_argument("--form", choices=("feeling", "wave"), default="feeling", help="what is learned (feeling)")
    for flag, least, default, about in (
        ("--generations", 1, 20, "of the search"),
        ("--population", 4, 12, "policies in a generation"),
        ("--fields", 1, 4, "for each of them, anew in each generation"),
        ("--check-fields", 1, 8, "on which the mean of the search is checked"),
        ("--seed", 0, 1, "of the search"),
    ):
        train.add_argument(
            flag, type=number_type(least, 100_000), default=default, metavar="N", help=f"{about} ({default})"
        )
    train.add_argument("--from", dest="begin", metavar="POLICY", help="begin at its numbers: shipped, or policy.onnx")
    train.add_argument(
        "--spread",
        type=number_type(0.01, 10.0),
        default=1.0,
        metavar="X",
        help="times how far the first generation looks (1)",
    )
    train.add_argument(
        "--duration", type=number_type(0.1, 3600.0, "s"), metavar="S", help="of an episode (the scenario's)"
    )
    train.add_argument(
        "--reward", action="append", default=[], metavar="TERM=WEIGHT", help="as energy=-0.002; may be repeated"
    )
    train.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="may be repeated")
    train.add_argument(
        "--draw", action="append", default=[], metavar="KEY=LOW:HIGH", help="a number for each field; may be repeated"
    )
    train.add_argument("--workers", type=number_type(1, 1000), metavar="N", help="processes (one a core)")
    train.add_argument("--cluster", metavar="tcp://HOST:PORT", help="scheduler of a Dask cluster, instead")
    train.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of what comes of it")
    train.add_argument("--resume", action="store_true", help="go on with the search that was stopped in --out")
    train.set_defaults(act=_train)


def _train(arguments: argparse.Namespace) -> int:
    """Run the command; return its exit code."""
    from snakesim_operator.base import extras

    for extra in ("train", "gym", "report", "policy"):
        extras.require(extra, "`snakesim train`")
    from snakesim.training.search import Effort
    from snakesim.training.trained import train
    from snakesim_hal.model.drawn import parse_draw
    from snakesim_hal.model.scenario import parse_set

    environment = {
        "scenario": arguments.scenario,
        "duration": arguments.duration,
        "reward": {override.key: override.value for override in map(parse_set, arguments.reward)},
        "set": {override.key: override.value for override in map(parse_set, arguments.set)},
        "draw": dict(map(parse_draw, arguments.draw)),
    }
    effort = Effort(**{field.name: getattr(arguments, field.name) for field in dataclasses.fields(Effort)})
    return train(
        environment,
        arguments.form,
        arguments.begin,
        effort,
        arguments.out,
        workers=arguments.workers,
        cluster=arguments.cluster,
        again=["snakesim", "train", arguments.scenario, *_repeat_options(arguments)],
        resume=arguments.resume,
    )


def _repeat_options(arguments: argparse.Namespace) -> list[str]:
    """Return the options that give the same search again; --out, --workers and --cluster change no number."""
    options = ["--form", arguments.form]
    if arguments.duration:
        options += ["--duration", f"{arguments.duration:g}"]
    for name in ("generations", "population", "fields", "check_fields", "seed"):
        flag = f"--{name.replace('_', '-')}"
        options += [flag, str(getattr(arguments, name))]
    if arguments.begin:
        options += ["--from", arguments.begin]
    if arguments.spread != 1.0:
        options += ["--spread", f"{arguments.spread:g}"]
    for name in ("reward", "set", "draw"):
        for value in getattr(arguments, name):
            options += [f"--{name}", value]
    return options
