"""Tables of the comparison, as lines of Markdown."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import median

from snakesim_operator.features.evaluate.table import compute_wilson_interval
from verification.sysid.comparison import OURS, OURS_WITHOUT_IMUS, THEIRS, RobotComparison
from verification.sysid.estimates import CLOSE, PARAMETERS, Estimate, Identified

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
        unknown = sum(one.value is None for one in ours)
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
    """Yield the table of the robots of which a method warns, and of the joints that it names."""
    yield "| method | robots | warns | names the joint | names another joint |"
    yield "|---|---|---|---|---|"
    for method in METHODS:
        found = [(robot, robot.by_method[method]) for robot in robots]
        warned = sum(identified.warns for _, identified in found)
        named = sum(identified.suspect is not None for _, identified in found)
        named_right = sum(
            identified.suspect is not None and identified.suspect == robot.loose
            for robot, identified in found
        )
        yield f"| {method} | {len(found)} | {warned} | {named_right} | {named - named_right} |"


def make_value_table(
    robots: Sequence[RobotComparison], groups: Mapping[str, JointFilter]
) -> Iterator[str]:
    """Yield the table of the values that are far off, and of those of them whose intervals do not cover the truth."""
    yield f"| method | joints | values | more than {_percent(CLOSE, 0)} off | of these, not covered |"
    yield "|---|---|---|---|---|"
    for method in METHODS:
        for label, accepts in groups.items():
            estimates = [
                one
                for robot in robots
                for one in robot.by_method[method].estimates
                if accepts(robot, one.joint_index)
            ]
            known = [one for one in estimates if one.value is not None]
            yield (
                f"| {method} | {label} | {len(known)} of {len(estimates)} "
                f"| {sum(not one.is_close for one in known)} "
                f"| {sum(one.misleads for one in known)} |"
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


def _list_noise_ratios(found: Iterator[Identified]) -> Iterator[float]:
    """Yield the residuals of the fits that have any."""
    for identified in found:
        if identified.noise_ratio is not None:
            yield identified.noise_ratio


def _collect_estimates(
    robots: Sequence[RobotComparison], method: str, accepts: JointFilter, parameter: str
) -> list[Estimate]:
    """Return the estimates of one parameter by one method, in the order of the joints."""
    return [
        one
        for robot in robots
        for one in robot.by_method[method].estimates
        if one.parameter == parameter and accepts(robot, one.joint_index)
    ]


def _describe_errors(estimates: Sequence[Estimate]) -> str:
    """Return median and greatest relative error."""
    errors = [one.error for one in estimates if one.error is not None]
    if not errors:
        return "- | -"
    return f"{_percent(median(errors), 2)} | {_percent(max(errors), 1)}"


def _describe_closer(ours: Sequence[Estimate], theirs: Sequence[Estimate]) -> str:
    """Return in how many joints `mujoco.sysid` is closer to the truth, of those that both know."""
    errors = [(one.error, other.error) for one, other in zip(ours, theirs, strict=True)]
    known = [(our, their) for our, their in errors if our is not None and their is not None]
    return f"{sum(their < our for our, their in known)} of {len(known)}"


def _describe_intervals(estimates: Sequence[Estimate]) -> str:
    """Return how many intervals cover the truth, with the 95 % interval of that fraction, and their median half-width.

    Joints count as independent.
    """
    known = [one for one in estimates if one.value is not None]
    if not known:
        return "- | -"
    covered = sum(one.covers for one in known)
    low, high = compute_wilson_interval(covered, len(known))
    width = median(one.half_width / abs(one.truth) for one in known)
    interval = f"{100 * low:.0f} to {_percent(high, 0)}"
    return f"{covered} of {len(known)} ({interval}) | {_percent(width, 1)}"


def _percent(fraction: float, digits: int) -> str:
    """Return a fraction as the documentation has it."""
    return f"{100 * fraction:.{digits}f} %"
