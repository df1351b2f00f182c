"""The sections of `benchmarks/RESULTS.md`: what each measures, and whether it needs a quiet machine."""

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.bus import MAX_FRAMES_PER_S, report_frame_costs
from benchmarks.cycle import make_load_table, measure_cycle
from benchmarks.echo import measure_echo_us
from benchmarks.environments import (
    FRAME_SKIP,
    Step,
    make_bare_batch_step,
    make_bare_step,
    make_environment_step,
    make_physics_step,
    make_vector_step,
    measure_steps_per_s,
)
from benchmarks.physics import encode_tick, load_config, measure_tick_times
from benchmarks.planning import PlanningCosts, format_rates
from benchmarks.size import measure_install_mb
from benchmarks.table import (
    GOAL_HEADER,
    RATIO_HEADER,
    format_maximum_row,
    format_minimum_row,
    format_row,
)
from benchmarks.whole import (
    CONTROL_IN_HOST,
    find_highest_rate_hz,
    measure_latency_us,
    measure_loop_in_process,
    measure_speed_in_process,
    measure_tick_us,
)

Report = Callable[[str], None]  # gets a line of the page

ROUNDS = 5
LATENCY_ROUNDS = 9  # more: how fast a virtual machine wakes up changes within seconds
LATENCY_ECHO_ROUNDS = 300
ROUND_S = 0.4  # CPU time of one environment in a round
CHAINS = ("peg_row", "mamba_flat")  # 12 and 7 joints
MANY = 64  # environments
STEP_TICKS = f"{FRAME_SKIP} ticks"
EXTRAS = ("", "can", "sim", "record", "report", "console", "train", "all")
LISTED_PACKAGES = 6  # the largest ones of each installation

# Goals.
# A user who wants our friction should pay less for it than for a second simulation.
MAX_LAWS_RATIO = 1.3
MAX_PHYSICS_RATIO = 1.0  # with our laws a chain should cost no more than with MuJoCo's own contacts
MAX_ENVIRONMENT_RATIO = 1.1  # learning should not be slower than with an environment of one's own
MAX_BATCH_RATIO = 1 / 0.7
MAX_OWN_US = 150.0  # of 10 ms: the rest of the period belongs to the controller
MIN_SPEED = 8.0  # times real time: a suite of 100 runs of 20 s then takes four minutes on one core
MIN_RECORDED_SPEED = 6.5
MAX_LOCKSTEP_US = 1300.0  # 7.7 times real time, with every part in a process of its own
# Of the transport alone: checks and controller should cost no more than the network.
MAX_LATENCY_RATIO = 2.0
MAX_LATENCY_IN_HOST_RATIO = 1.5
MAX_PLANNING_RATIO = 0.17  # 1 500 000 nodes/s instead of 250 000


@dataclass(frozen=True)
class ResultSection:
    """One section of the page."""

    name: str  # for the command line
    title: str
    needs_quiet_machine: bool
    measure: Callable[[Report], None]


def report_physics(report: Report) -> None:
    """Report what a user would have without our laws, our environments, or SnakeSIM."""
    report(
        "CPU time of a control period (10 ms, five physics steps), or of a step of an environment (50 ms).\n"
    )
    report(RATIO_HEADER)
    times = measure_tick_times(load_config())
    subject = "physics of `triplet`, with our ground and friction and the contact sensor"
    report(
        format_row(
            subject,
            "`mj_step` of the same states, without",
            times.physics_us,
            times.mujoco_us,
            MAX_LAWS_RATIO,
        )
    )
    report(
        format_row(
            "the same", "the same with the laws in Python", times.physics_us, times.python_us, None
        )
    )
    for scenario in CHAINS:
        steps = [
            make_physics_step(scenario),
            make_environment_step(scenario),
            make_bare_step(scenario),
        ]
        physics_us, environment_us, bare_us = _measure_in_turn(steps)
        chain = "`mj_step` of the same chain with MuJoCo's own contacts"
        subject = f"physics of `{scenario}`, {STEP_TICKS}"
        report(format_row(subject, chain, physics_us, bare_us, MAX_PHYSICS_RATIO))
        subject = f"environment of `{scenario}`, one step"
        report(format_row(subject, chain, environment_us, bare_us, MAX_ENVIRONMENT_RATIO))
    scenario = CHAINS[0]
    vector_us, batch_us = _measure_in_turn(
        [make_vector_step(scenario, MANY), make_bare_batch_step(scenario, MANY)]
    )
    subject = f"{MANY} environments of `{scenario}`, one step"
    report(
        format_row(
            subject,
            f"`mujoco.batch.Batch` of {MANY} such chains",
            vector_us,
            batch_us,
            MAX_BATCH_RATIO,
        )
    )
    report("\n[Environments](ENVIRONMENTS.md) has more scenarios, and Gymnasium's `Swimmer-v5`.")


def _measure_in_turn(steps: list[Step]) -> list[list[float]]:
    """Return the CPU times of each step in µs, one entry for each round."""
    times_us: list[list[float]] = [[] for _ in steps]
    for _ in range(ROUNDS):
        for step, of_step_us in zip(steps, times_us, strict=True):
            of_step_us.append(1e6 / measure_steps_per_s(step, ROUND_S))
    return times_us


def report_tick(report: Report) -> None:
    """Report the CPU time of a tick, in one process."""
    report(GOAL_HEADER)
    own_us = measure_tick_times(load_config()).own_us
    report(
        format_maximum_row(
            "simulator tick of `triplet` without physics: sensors, publishing, motors",
            own_us,
            MAX_OWN_US,
            "µs",
        )
    )
    speeds = [measure_loop_in_process() for _ in range(ROUNDS)]
    report(
        format_minimum_row(
            "robot time of `peg_row` in one process, for a second of CPU time",
            speeds,
            MIN_SPEED,
            "s",
        )
    )


def report_runs(report: Report) -> None:
    """Report the wall time of whole runs."""
    report(GOAL_HEADER)
    rounds = range(ROUNDS)
    unrecorded = [measure_speed_in_process("--no-record") for _ in rounds]
    recorded = [measure_speed_in_process() for _ in rounds]
    lockstep_us = [measure_tick_us("--no-record") for _ in rounds]
    subject = "`snakesim run peg_row --in-process"
    report(
        format_minimum_row(
            f"{subject} --no-record`, beside real time", unrecorded, MIN_SPEED, "times"
        )
    )
    report(
        format_minimum_row(f"{subject}`, beside real time", recorded, MIN_RECORDED_SPEED, "times")
    )
    report(
        format_maximum_row(
            "lockstep tick of `triplet`, five processes", lockstep_us, MAX_LOCKSTEP_US, "µs"
        )
    )


def report_latency(report: Report) -> None:
    """Report the time from a state to its command in real time, and the highest rates."""
    config = load_config()
    state, command = encode_tick(config)
    latencies_us: list[float] = []
    in_host_us: list[float] = []
    echoes_us: list[float] = []
    for _ in range(LATENCY_ROUNDS):
        latencies_us.append(measure_latency_us())
        in_host_us.append(measure_latency_us(*CONTROL_IN_HOST))
        echo_us = measure_echo_us(
            state, command, round_count=LATENCY_ECHO_ROUNDS, period_s=config.period_ns * 1e-9
        )
        echoes_us.append(echo_us)
    report(RATIO_HEADER)
    subject = "realtime state-to-command, p50, controller included"
    report(
        format_row(
            subject,
            "raw echo of the same bytes at 100 Hz",
            latencies_us,
            echoes_us,
            MAX_LATENCY_RATIO,
        )
    )
    subject = f"{subject}, in the host"
    report(
        format_row(subject, "the same raw echo", in_host_us, echoes_us, MAX_LATENCY_IN_HOST_RATIO)
    )
    report(
        format_row(
            "the same, in the host",
            "control in a process of its own",
            in_host_us,
            latencies_us,
            1.0,
        )
    )
    report("")
    for where, arguments in (("", ()), (", control in the host", CONTROL_IN_HOST)):
        highest_hz, fractions = find_highest_rate_hz(*arguments)
        rates = ", ".join(
            f"{rate_hz} Hz {100 * fraction:.1f} %" for rate_hz, fraction in fractions.items()
        )
        report(
            f"- Highest rate at which 99 % of ticks get their command in time{where}: {highest_hz} Hz ({rates})."
        )


def report_planning(report: Report) -> None:
    """Report the rates of the path search."""
    costs = PlanningCosts()
    native_us: list[float] = []
    python_us: list[float] = []
    for _ in range(ROUNDS):
        native_round_us, python_round_us = costs.measure_kilonode_us()
        native_us += native_round_us
        python_us += python_round_us
    report(RATIO_HEADER)
    subject = "path search in C, CPU time of 1000 nodes"
    report(
        format_row(subject, "the same search in Python", native_us, python_us, MAX_PLANNING_RATIO)
    )
    report(f"\n{format_rates(native_us, python_us)}")


def report_bus(report: Report) -> None:
    """Report what a CAN bus costs, and how regular it is."""
    frame_us = report_frame_costs(report, ROUNDS)
    core_fraction = frame_us * 1e-6 * MAX_FRAMES_PER_S
    report(
        f"\nA saturated bus, {MAX_FRAMES_PER_S:.0f} frames/s, takes {core_fraction:.1%} of one core "
        "(half of one allowed)."
    )
    cycle = measure_cycle()
    first_ms, first_p99_ms = cycle.command_to_first_setpoint_ms
    last_ms, last_p99_ms = cycle.command_to_last_setpoint_ms
    jitter_ms, jitter_p99_ms = cycle.sync_jitter_ms
    report(
        f"Control cycle at 100 Hz, 13 joints: a command is ready, and its first setpoint is on the bus "
        f"{first_ms:.2f} ms later (p99 {first_p99_ms:.2f}), its last {last_ms:.2f} ms (p99 {last_p99_ms:.2f}). "
        f"Sync is off its period by {jitter_ms:.3f} ms (p99 {jitter_p99_ms:.3f}).\n"
    )
    for line in make_load_table():
        report(line)


def report_sizes(report: Report) -> None:
    """Report the size of each installation."""
    report("| installed | MB, without SnakeSIM's own | the largest |\n|---|---|---|")
    for extra in EXTRAS:
        sizes_mb = measure_install_mb(extra)
        by_size = sorted(sizes_mb.items(), key=lambda item: -item[1])
        largest = ", ".join(f"{name} {size_mb:.0f}" for name, size_mb in by_size[:LISTED_PACKAGES])
        installation = f"snakesim[{extra}]" if extra else "snakesim"
        report(f"| `{installation}` | {sum(sizes_mb.values()):.0f} | {largest} |")


SECTIONS = (
    ResultSection("physics", "Physics beside MuJoCo alone", False, report_physics),
    ResultSection("tick", "CPU time of a tick", False, report_tick),
    ResultSection("runs", "Whole runs", True, report_runs),
    ResultSection("latency", "Latency in real time", True, report_latency),
    ResultSection("planning", "Path search", False, report_planning),
    ResultSection("can", "CAN", True, report_bus),
    ResultSection("size", "Size", False, report_sizes),
)
