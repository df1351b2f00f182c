"""Tables of the comparison, as lines of Markdown."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import median

from snakesim_operator.results.metrics.intervals import compute_wilson_interval
from verification.sysid.comparison import OURS, OURS_WITHOUT_IMUS, THEIRS, RobotComparison
from verification.sysid.estimates import MAX_CLOSE_ERROR, PARAMETERS, Estimate, IdentificationResult

METHODS = (OURS, OURS_WITHOUT_IMUS, THEIRS)
JointFilter = Callable[[RobotComparison, int], bool]


def is_any_joint(_robot: RobotComparison, _joint_index: int) -> bool:
    """Accept every joint."""
    return True


def is_loose(robot: RobotComparison, joint_index: int) -> bool:
    """Accept joints with backlash."""
    return joint_index == robot.loose


def is_intact(robot: RobotComparison, joint_index: int) -> bool:
    """Accept joints without backlash."""
    return joint_index != robot.loose


def make_report(robots: Sequence[RobotComparison]) -> Iterator[str]:
    """Yield all tables. Robots with backlash have separate tables for joints with backlash and without."""
    groups: dict[str, JointFilter] = {"all": is_any_joint}
    if any(robot.loose is not None for robot in robots):
        groups = {"with backlash": is_loose, "without backlash": is_intact}
    yield from make_verdict_table(robots)
    yield ""
    yield from make_value_table(robots, groups)
    for label, accepts in groups.items():
        yield from ("", f"Errors, joints: {label}", "", *make_error_table(robots, accepts))
        yield from ("", f"Intervals, joints: {label}", "", *make_interval_table(robots, accepts))
    yield ""
    yield from describe_costs(robots)


def make_error_table(
    robots: Sequence[RobotComparison], accepts: JointFilter = is_any_joint
) -> Iterator[str]:
    """Yield the table of the errors of each parameter, and how often `mujoco.sysid` is closer to the truth."""
    yield (
        f"| parameter | joints | `{OURS}`: unknown | median error | worst "
        f"| `{THEIRS}`: median error | worst | closer |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for parameter in PARAMETERS:
        ours = _collect_estimates(robots, OURS, accepts, parameter)
        theirs = _collect_estimates(robots, THEIRS, accepts, parameter)
        unknown = sum(estimate.value is None for estimate in ours)
        yield (
            f"| `{parameter}` | {len(ours)} | {unknown} | {_describe_errors(ours)} "
            f"| {_describe_errors(theirs)} | {_describe_closer(ours, theirs)} |"
        )


def make_interval_table(
    robots: Sequence[RobotComparison], accepts: JointFilter = is_any_joint
) -> Iterator[str]:
    """Yield the table of how many intervals cover the truth, and how wide they are."""
    yield (
        f"| parameter | `{OURS}`: covered | median half-width | `{THEIRS}`: covered "
        "| median half-width |"
    )
    yield "|---|---|---|---|---|"
    for parameter in PARAMETERS:
        cells = [
            _describe_intervals(_collect_estimates(robots, method, accepts, parameter))
            for method in (OURS, THEIRS)
        ]
        yield f"| `{parameter}` | {' | '.join(cells)} |"


def make_verdict_table(robots: Sequence[RobotComparison]) -> Iterator[str]:
    """Yield the table of how many robots each method warns about, and of the joints that it names."""
    yield "| method | robots | warns | names the joint | names another joint |"
    yield "|---|---|---|---|---|"
    for method in METHODS:
        results = [(robot, robot.by_method[method]) for robot in robots]
        warned = sum(result.warns for _, result in results)
        named = sum(result.suspect is not None for _, result in results)
        named_right = sum(
            result.suspect is not None and result.suspect == robot.loose
            for robot, result in results
        )
        yield f"| {method} | {len(results)} | {warned} | {named_right} | {named - named_right} |"


def make_value_table(
    robots: Sequence[RobotComparison], groups: Mapping[str, JointFilter]
) -> Iterator[str]:
    """Yield the table of values with a large error, and of those whose interval does not cover the truth either."""
    yield f"| method | joints | values | more than {_format_percent(MAX_CLOSE_ERROR, 0)} off | of these, not covered |"
    yield "|---|---|---|---|---|"
    for method in METHODS:
        for label, accepts in groups.items():
            estimates = [
                estimate
                for robot in robots
                for estimate in robot.by_method[method].estimates
                if accepts(robot, estimate.joint_index)
            ]
            known = [estimate for estimate in estimates if estimate.value is not None]
            yield (
                f"| {method} | {label} | {len(known)} of {len(estimates)} "
                f"| {sum(not estimate.is_close for estimate in known)} "
                f"| {sum(estimate.misleads for estimate in known)} |"
            )


def describe_costs(robots: Sequence[RobotComparison]) -> Iterator[str]:
    """Yield the CPU time of each method, and how well `mujoco.sysid` fits the records."""
    for method in METHODS:
        cpu_s = median(robot.by_method[method].cpu_s for robot in robots)
        yield f"{method}: median CPU time of a robot {cpu_s:.1f} s"
    ratios = sorted(_list_noise_ratios(robot.by_method[THEIRS] for robot in robots))
    yield (
        f"{THEIRS}: rms of the residuals {ratios[0]:.3f} to {ratios[-1]:.3f} times the noise, "
        f"median {median(ratios):.3f}"
    )


def _list_noise_ratios(results: Iterator[IdentificationResult]) -> Iterator[float]:
    """Yield the noise ratio of each result that has one."""
    for result in results:
        if result.noise_ratio is not None:
            yield result.noise_ratio


def _collect_estimates(
    robots: Sequence[RobotComparison], method: str, accepts: JointFilter, parameter: str
) -> list[Estimate]:
    """Return the estimates of one parameter by one method, in the order of the joints."""
    return [
        estimate
        for robot in robots
        for estimate in robot.by_method[method].estimates
        if estimate.parameter == parameter and accepts(robot, estimate.joint_index)
    ]


def _describe_errors(estimates: Sequence[Estimate]) -> str:
    """Return the median and the maximum relative error."""
    errors = [estimate.error for estimate in estimates if estimate.error is not None]
    if not errors:
        return "- | -"
    return f"{_format_percent(median(errors), 2)} | {_format_percent(max(errors), 1)}"


def _describe_closer(ours: Sequence[Estimate], theirs: Sequence[Estimate]) -> str:
    """Return in how many joints `mujoco.sysid` is closer to the truth, of those that both know."""
    errors = [(estimate.error, other.error) for estimate, other in zip(ours, theirs, strict=True)]
    known = [(our, their) for our, their in errors if our is not None and their is not None]
    return f"{sum(their < our for our, their in known)} of {len(known)}"


def _describe_intervals(estimates: Sequence[Estimate]) -> str:
    """Return how many intervals cover the truth, with the 95 % interval of that fraction, and their median half-width.

    Joints count as independent.
    """
    known = [estimate for estimate in estimates if estimate.value is not None]
    if not known:
        return "- | -"
    covered = sum(estimate.covers for estimate in known)
    low, high = compute_wilson_interval(covered, len(known))
    width = median(estimate.half_width / abs(estimate.truth) for estimate in known)
    interval = f"{100 * low:.0f} to {_format_percent(high, 0)}"
    return f"{covered} of {len(known)} ({interval}) | {_format_percent(width, 1)}"


def _format_percent(fraction: float, digits: int) -> str:
    """Return a fraction in percent, with a space before the sign."""
    return f"{100 * fraction:.{digits}f} %"
