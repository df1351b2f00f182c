"""The `snakesim` command."""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from math import inf
from pathlib import Path

from snakesim_hal import host_process, serve
from snakesim_hal.arguments import (
    add_insecure,
    add_network,
    add_scenario,
    check_network,
    load_scenario,
    session_given,
)
from snakesim_hal.errors import ConfigError, SnakesimError
from snakesim_hal.model.files import ROUTER, read_part, shipped
from snakesim_hal.model.injection import explain
from snakesim_hal.model.plugins import COMMANDS, find_plugin, in_file, installed
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.terminal import complain, complain_of, say, say_json
from snakesim_operator.evaluate.command import add_commands
from snakesim_operator.lab.command import add_commands as add_lab_commands
from snakesim_operator.playback.command import add_commands as add_playback_commands
from snakesim_operator.robots.arguments import add_commands as add_robot_commands
from snakesim_operator.ros2.command import add_command as add_ros2
from snakesim_operator.tools.simulator_order import add_command as add_sim

OK, FAILED, BAD_INPUT = 0, 1, 2


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 done, 1 a fault, 2 wrong input and nothing started, 3 an incomplete record, 130 interrupted."""
    given = list(sys.argv[1:] if argv is None else argv)
    try:
        if given and given[0] in installed(COMMANDS):
            return find_plugin(COMMANDS, given[0])(given[1:])
        arguments = parser().parse_args(given)
        return arguments.act(arguments)
    except ConfigError as error:
        complain_of(error, "snakesim")
        return BAD_INPUT
    except SnakesimError as error:
        complain_of(error, "snakesim")
        return FAILED
    except OSError as error:  # such as a full disk under what is printed
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):  # the reader of a pipe has closed it
            return OK
        complain(f"snakesim: {error}")
        return FAILED


def parser() -> argparse.ArgumentParser:
    """The command's arguments, without the commands of installed packages."""
    parser = argparse.ArgumentParser(
        prog="snakesim",
        description="Snake robots that push themselves off obstacles: one controller, simulator or robot.",
    )
    parser.add_argument("--version", action="version", version=f"snakesim {version('snakesim')}")
    more = installed(COMMANDS)
    if more:
        parser.epilog = f"From installed backends: {', '.join(more)}; see their --help."
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser(
        "run",
        help="run a scenario: backend, guidance, navigation and control",
        epilog="Exit code: 0 complete, armed for all of the requested time; 1 a fault, or ended before that; 2 wrong "
        "input, nothing was started; 3 complete, but the record has gaps; 130 interrupted. 1 and 130 take precedence.",
    )
    add_scenario(run)
    run.add_argument(
        "--fault",
        action="append",
        metavar="KIND:TARGET@START[-END][=AMOUNT]",
        help="inject a fault, at seconds after arming; replaces the scenario's faults; may be repeated",
    )
    run.add_argument(
        "--stay", action="store_true", help="faults do not end the run: processes restart, you clear and arm"
    )
    run.add_argument("--with-router", action="store_true", help="start a router for the run, as in a lab")
    run.add_argument(
        "--in-process",
        action="store_true",
        help="run in one process, without a network: lockstep, and faster; nothing can connect, arm or stop it",
    )
    run.add_argument("--no-record", action="store_true", help="keep no recording of the messages")
    run.add_argument(
        "--console",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="show the run in the browser, and print the address",
    )
    run.add_argument("--out", type=Path, help="folder for the run's record (default: runs/NAME-TIME)")
    add_network(run, "")
    add_insecure(run)
    run.set_defaults(act=_run)

    host = commands.add_parser(
        "host",
        parents=[host_process.parser()],
        add_help=False,
        help="run a robot's HAL host alone, for services on this or other machines",
        epilog="It runs until Ctrl-C, and boots disarmed: `snakesim arm` arms it. Faults do not end it. Exit code: 0 "
        "ended with --once and without a fault, 1 ended otherwise, 2 wrong input.",
    )
    host.set_defaults(act=_host)
    service = commands.add_parser(
        "service",
        parents=[serve.parser()],
        add_help=False,
        help="run one service of a robot alone: guidance, navigation, control, ...",
        epilog="It waits for the network and for the robot's host, and meets the next one after a restart.",
    )
    service.set_defaults(act=serve.run)

    compare = commands.add_parser("compare", help="compare two runs, as a table and as a page with plots")
    compare.add_argument("run_a", type=Path, metavar="RUN_A", help="folder of a run; percentages refer to this one")
    compare.add_argument(
        "run_b", type=Path, metavar="RUN_B", help="folder of the other run, of a robot with the same joints"
    )
    compare.add_argument("--out", type=Path, metavar="FILE.html", help="the page (default: RUN_B/compare.html)")
    compare.add_argument(
        "--within", type=float, metavar="PERCENT", help="exit with 1 when the distances moved differ by more"
    )
    _add_json(compare)
    compare.set_defaults(act=_compare)

    add_commands(commands)
    add_lab_commands(commands)

    record = commands.add_parser("record", help="record everything that a robot publishes into an MCAP file")
    record.add_argument("--out", type=Path, metavar="FILE.mcap", help="the file (default: NAMESPACE-TIME.mcap)")
    record.add_argument("--duration", type=float, metavar="S", help="end after this time by the wall clock")
    record.add_argument(
        "--foxglove",
        type=int,
        nargs="?",
        const=8765,
        metavar="PORT",
        help="serve Foxglove live as well, at ws://127.0.0.1:PORT (8765)",
    )
    add_network(record)
    record.set_defaults(act=_record)
    add_playback_commands(commands)

    config = commands.add_parser("config", help="show every effective value, and the file or flag it came from")
    add_scenario(config)
    _add_json(config)
    config.set_defaults(act=_config)

    scenarios = commands.add_parser("scenarios", help="list the shipped scenarios, robots, scenes and suites")
    _add_json(scenarios)
    scenarios.set_defaults(act=_scenarios)

    add_robot_commands(commands)

    echo = commands.add_parser("echo", help="print what is published on a key, one JSON object a line")
    echo.add_argument("key", nargs="?", help="such as sensor/joints or sensor/*; without it, list the keys")
    echo.add_argument("--hz", action="store_true", help="print only rate and jitter")
    echo.add_argument("--count", type=int, help="end after this many messages")
    add_network(echo)
    echo.set_defaults(act=_echo)

    status = commands.add_parser("status", help="print the state of the robots on the network, and its reason")
    add_network(status)
    _add_json(status)
    status.set_defaults(act=_status)

    console = commands.add_parser(
        "console", help="show a running robot in the browser, and command it from there; or show a recorded run"
    )
    console.add_argument("run", type=Path, nargs="?", metavar="RUN", help="folder of a recorded run")
    console.add_argument("--at", type=float, default=0.0, metavar="S", help="begin S seconds into the recording")
    console.add_argument("--port", type=int, help="port on the loopback interface (default: 8080, or any free one)")
    add_network(console)
    console.set_defaults(act=_console)
    top = commands.add_parser("top", help="show rate, jitter, size and age of every key, and commands' latency")
    top.add_argument("--once", action="store_true", help="listen for two seconds, print one table, and end")
    add_network(top)
    _add_json(top)
    top.set_defaults(act=_top)

    teleop = commands.add_parser("teleop", help="drive a robot by keys or with a joystick; letting go stops it")
    teleop.add_argument(
        "--joystick",
        nargs="?",
        type=Path,
        const=Path(),
        metavar="DEVICE",
        help="such as /dev/input/event5; or the first",
    )
    teleop.add_argument("--fastest", type=float, default=0.3, metavar="M/S", help="highest speed (0.3)")
    add_network(teleop)
    teleop.set_defaults(act=_teleop)

    doctor = commands.add_parser("doctor", help="check this computer, and print what mends what it lacks")
    add_network(doctor)
    _add_json(doctor)
    doctor.set_defaults(act=_doctor)

    video = commands.add_parser("video", help="film a recorded run, as MP4 or GIF")
    video.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or a recording")
    video.add_argument("--out", type=Path, required=True, metavar="FILE", help="FILE.mp4 or FILE.gif")
    video.add_argument("--width", type=int, default=1280, help="pixels, an even number (default: 1280)")
    video.add_argument("--height", type=int, default=720, help="pixels, an even number (default: 720)")
    video.add_argument("--fps", type=float, default=30.0, help="pictures a second (default: 30)")
    video.add_argument("--speed", type=float, default=1.0, metavar="X", help="2: twice as fast as it was (default: 1)")
    video.add_argument("--from", dest="from_s", type=float, default=0.0, metavar="S", help="begin S seconds in")
    video.add_argument("--to", dest="to_s", type=float, default=inf, metavar="S", help="end S seconds in")
    video.set_defaults(act=_video)

    arm = commands.add_parser("arm", help="allow a robot to move; names robot and backend, to avoid mix-ups")
    arm.add_argument("robot", metavar="ROBOT", help="name of the robot, as printed by `snakesim status`")
    arm.add_argument("backend", metavar="BACKEND", help="its backend: sim, can, ...")
    for name, act, about in (
        ("disarm", _disarm, "make a robot's joints passive"),
        ("clear", _clear, "clear a fault or an emergency stop; the robot is disarmed then"),
        ("estop", _estop, "stop a robot now, or all on the network without --namespace"),
    ):
        told = commands.add_parser(name, help=about)
        add_network(told)
        told.set_defaults(act=act)
    add_network(arm)
    arm.set_defaults(act=_arm)

    sim = add_sim(commands)
    add_network(sim)
    sim.set_defaults(act=_sim)

    fault = commands.add_parser(
        "fault",
        help="inject a fault into a run that allows it",
        epilog=f"kinds, by target:\n{explain()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    fault.add_argument("kind", metavar="KIND", help="such as mute; `list` prints all of them")
    fault.add_argument("target", nargs="?", metavar="TARGET", help="such as joint_3, bus_1, control, actuator/joints")
    fault.add_argument("--for", dest="for_s", type=float, metavar="S", help="seconds of robot time until it ends")
    fault.add_argument("--amount", type=float, metavar="X", help="amount, for kinds that have one")
    fault.add_argument("--end", action="store_true", help="end it")
    add_network(fault)
    fault.set_defaults(act=_fault)

    preview = commands.add_parser(
        "preview", help="publish small, compressed copies of a robot's images; beside its host"
    )
    preview.add_argument("--hz", type=float, default=2.0, metavar="HZ", help="most previews a second of a camera (2)")
    preview.add_argument("--width", type=int, default=320, metavar="PIXELS", help="widest preview (320)")
    add_network(preview)
    preview.set_defaults(act=_preview)

    ros2 = add_ros2(commands)
    add_network(ros2)
    ros2.set_defaults(act=_ros2)

    router = commands.add_parser("router", help="run a Zenoh router from a JSON5 file")
    router.add_argument("config", type=Path, nargs="?", help=f"JSON5 file (default: {str(ROUTER).replace('%', '%%')})")
    add_insecure(router)
    router.set_defaults(act=_router)

    schemas = commands.add_parser("schemas", help="print where the JSON Schemas, the key space and the DBC file are")
    schemas.add_argument("--write", type=Path, metavar="FOLDER", help="write schemas and key space, from the code")
    schemas.set_defaults(act=_schemas)

    completion = commands.add_parser("completion", help="print a script for tab completion: source <(snakesim ...)")
    completion.add_argument("shell", choices=["bash", "zsh"])
    completion.set_defaults(act=_completion)
    return parser


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one line of JSON instead, for scripts")


def _run(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.plugin_check import check_plugins
    from snakesim_operator.run.run import RunRequest, run

    check_network(arguments)
    loaded = load_scenario(arguments)
    config = check_plugins(loaded.config, loaded.table)  # here, because only the table knows which flag set what
    if arguments.in_process:
        return _run_in_process(config, arguments)
    return run(
        RunRequest(
            config,
            out=arguments.out,
            endpoint=arguments.endpoint,
            router=arguments.router,
            session=session_given(arguments),
            namespace=arguments.namespace,
            stay=arguments.stay,
            with_router=arguments.with_router,
            insecure=arguments.insecure,
            record=not arguments.no_record,
            console=arguments.console,
        )
    )


def _run_in_process(config: RunConfig, arguments: argparse.Namespace) -> int:
    from snakesim_operator.run.in_process import run_in_process

    for flag in ("endpoint", "router", "session", "namespace", "stay", "with_router", "console"):
        if getattr(arguments, flag):
            raise ConfigError(f"--in-process and --{flag.replace('_', '-')}: there is no network; leave one out")
    return run_in_process(config, arguments.out, record=not arguments.no_record)


def _host(arguments: argparse.Namespace) -> int:
    from snakesim_operator.run.host import run_host

    return run_host(arguments)


def _compare(arguments: argparse.Namespace) -> int:
    from snakesim_operator.results.compare import compare

    return compare(arguments.run_a, arguments.run_b, arguments.out, arguments.within, as_json=arguments.json)


def _config(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.plugin_check import check_plugins

    loaded = load_scenario(arguments)
    check_plugins(loaded.config, loaded.table, run_files=False)
    if arguments.json:
        say_json({key: {"value": value, "origin": origin} for key, value, origin in loaded.explain()})
        return OK
    rows = [(key, _shown(value), origin) for key, value, origin in loaded.explain()]
    key_width = max(len(key) for key, _, _ in rows)
    value_width = min(max(len(value) for _, value, _ in rows), 48)
    for key, value, origin in rows:
        say(f"{key:<{key_width}}  {value:<{value_width}}  {origin}")
    for section, name in (
        (loaded.config.control_section, loaded.config.controller),
        (loaded.config.backend_section, loaded.config.backend),
    ):
        if in_file(name):
            say(f"{section}: not checked, because that would run {name}; `snakesim run` checks it")
    return OK


def _shown(value: object) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 120 else text[:117] + "..."


def _scenarios(arguments: argparse.Namespace) -> int:
    if arguments.json:
        kinds = {"scenarios": "title", "robots": "about", "scenes": "about", "suites": "title"}
        say_json(
            {k: {name: read_part(name, k).values.get(about, "") for name in shipped(k)} for k, about in kinds.items()}
        )
        return OK
    for kind, about in (("scenarios", "title"), ("robots", "about"), ("scenes", "about"), ("suites", "title")):
        say(f"{kind}:")
        for name in shipped(kind):
            table = read_part(name, kind)
            say(f"  {name:<18}{table.values.get(about, '')}")
    return OK


def _echo(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.echo import EchoRequest, echo

    return echo(EchoRequest(arguments.key, arguments.hz, arguments.count), _where(arguments))


def _record(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.record import record_robot

    return record_robot(_where(arguments), arguments.out, arguments.duration, arguments.foxglove)


def _status(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.status import show_status

    return show_status(_where(arguments), as_json=arguments.json)


def _top(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.top import TopRequest, top

    return top(TopRequest(arguments.once, arguments.json), _where(arguments))


def _teleop(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.teleop.command import TeleopRequest, teleop

    stick: Path | None = arguments.joystick
    request = TeleopRequest(arguments.fastest, stick is not None, None if stick in (None, Path()) else stick)
    return teleop(request, _where(arguments))


def _doctor(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.doctor import doctor

    return doctor(_where(arguments), as_json=arguments.json)


def _console(arguments: argparse.Namespace) -> int:
    from snakesim_operator.console.command import console, show_record

    if arguments.run is not None:
        return show_record(arguments.run, arguments.at, arguments.port)
    return console(_where(arguments), arguments.port)


def _video(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.video import video

    size = (arguments.width, arguments.height)
    for flag, value, low, high in (
        ("--width", size[0], 16, 4096),
        ("--height", size[1], 16, 4096),
        ("--fps", arguments.fps, 1, 240),
        ("--speed", arguments.speed, 0.01, 100),
    ):
        if not low <= value <= high or (flag in ("--width", "--height") and value % 2):
            raise ConfigError(f"{flag} {value:g}: give a number from {low:g} to {high:g}; pixels must be even")
    span_s = (arguments.from_s, arguments.to_s)
    return video(arguments.run, arguments.out, size=size, fps=arguments.fps, speed=arguments.speed, span_s=span_s)


def _arm(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.command import arm

    return arm(arguments.robot, arguments.backend, _where(arguments))


def _disarm(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.command import disarm

    return disarm(_where(arguments))


def _clear(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.command import clear

    return clear(_where(arguments))


def _estop(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.stop import estop

    return estop(_where(arguments))


def _sim(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.simulator import simulator
    from snakesim_operator.tools.simulator_order import order_of

    return simulator(order_of(arguments), _where(arguments))


def _fault(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.fault import FaultOrder, fault

    order = FaultOrder(arguments.kind, arguments.target, arguments.for_s, arguments.amount, arguments.end)
    return fault(order, _where(arguments))


def _where(arguments: argparse.Namespace):
    from snakesim_operator.tools.targets import Where

    check_network(arguments)
    session = session_given(arguments, or_environment=True)
    if session is not None:
        return Where(session.endpoints[0], session.namespace_for(arguments.namespace), session)
    return Where(arguments.router or arguments.endpoint, arguments.namespace)


def _preview(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.preview import preview

    return preview(_where(arguments), arguments.hz, arguments.width)


def _ros2(arguments: argparse.Namespace) -> int:
    from snakesim_operator.ros2.join import join

    return join(arguments, _where(arguments))


def _router(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.status import run_router

    return run_router(arguments.config, insecure=arguments.insecure)


def _schemas(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.schemas import published, write_schemas

    for path in published() if arguments.write is None else write_schemas(arguments.write):
        say(str(path))
    return OK


def _completion(arguments: argparse.Namespace) -> int:
    from snakesim_operator.tools.completion import completion

    for line in completion(parser(), arguments.shell):
        say(line)
    return OK
