"""Makes the trials of a suite, each with its whole configuration, and selects some of them."""

import re
from collections.abc import Sequence

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.scenario import (
    KeyOverride,
    RunConfig,
    compose_config_table,
    encode_config,
    validate_start_pose,
)
from snakesim_hal.model.scene_file.randomization import Randomization
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_operator.features.evaluate.conditions import Condition, make_conditions
from snakesim_operator.features.evaluate.suite import EvaluationSuite
from snakesim_operator.features.evaluate.trial import EvaluationTrial, make_trial_id

MAX_TRIALS = 200_000
MAX_LISTED_CONDITIONS = 12  # in an error message


def make_trials(
    suite: EvaluationSuite,
    source: str,
    controllers: Sequence[str],
    seed_count: int,
    first_seed: int,
) -> list[EvaluationTrial]:
    """Make every trial of a suite in the order of the table, each with its whole configuration.

    The values that the suite sets are checked here with the first seed of each condition. If a later seed gives a scene
    without room for its obstacles, the outcome of that trial is an error.

    Args:
        suite: The suite.
        source: Path of the suite file or name of the command, for error messages.
        controllers: Names of the controllers to try; that of the scenario if empty.
        seed_count: Number of seeds for each condition and controller.
        first_seed: The first seed; each following seed is the next number.

    Raises:
        ConfigError: The suite is invalid, or has too many trials.
    """
    conditions = make_conditions(suite, source)
    trial_count = len(conditions) * len(controllers or [""]) * seed_count
    if trial_count > MAX_TRIALS:
        raise ConfigError(
            f"{source}: {trial_count} trials; at most {MAX_TRIALS} are allowed",
            code="command/invalid-option",
        )
    trials: list[EvaluationTrial] = []
    for condition_number, condition in enumerate(conditions, 1):
        for controller in controllers or [None]:
            table = _compose_scenario(suite, condition, controller)
            for seed in range(first_seed, first_seed + seed_count):
                config = _configure_seed(table, seed, condition.randomizations)
                if seed == first_seed:
                    _validate_config(
                        config,
                        table,
                        f"{source}, condition {condition_number} ({condition.name}), seed {seed}",
                    )
                trials.append(
                    EvaluationTrial(
                        id=make_trial_id(config, suite.stall_timeout_s),
                        condition_number=condition_number,
                        condition_name=condition.name,
                        controller=config.commander_name,
                        seed=seed,
                        config=encode_config(config),
                        stall_timeout_s=suite.stall_timeout_s,
                        wall_timeout_s=suite.wall_timeout_s,
                        varied_number=condition.varied_number,
                    )
                )
    return trials


def select_trials_of_conditions(
    trials: Sequence[EvaluationTrial], condition_numbers: Sequence[int], source: str
) -> list[EvaluationTrial]:
    """Return the trials of some conditions, or all trials if no number is given.

    Args:
        trials: The trials of all conditions of a suite.
        condition_numbers: Numbers of conditions, from 1.
        source: Path of the suite file or name of the command, for the error message.

    Raises:
        ConfigError: The suite has no condition of such a number.
    """
    known_numbers = {trial.condition_number for trial in trials}
    for number in condition_numbers:
        if number not in known_numbers:
            raise ConfigError(
                f"--conditions {number}: {source} has conditions 1 to {max(known_numbers)}",
                code="command/invalid-option",
            )
    if not condition_numbers:
        return list(trials)
    return [trial for trial in trials if trial.condition_number in condition_numbers]


def find_trial(suite: EvaluationSuite, source: str, name: str) -> EvaluationTrial:
    """Return the trial of a name as `--trial` accepts it.

    Args:
        suite: The suite.
        source: Path of the suite file or name of the command, for error messages.
        name: CONTROLLER:SEED:CONDITION, or CONTROLLER:SEED if the suite has one condition.

    Raises:
        ConfigError: The name has another form, or names no trial or more than one.
    """
    match = re.fullmatch(
        r"(?P<controller>.+?):(?P<seed>\d{1,10})(:(?P<condition_number>\d{1,6}))?", name
    )
    if match is None:
        raise ConfigError(
            f"--trial {shorten(name)}: give CONTROLLER:SEED or CONTROLLER:SEED:CONDITION, such as hold:3:1",
            code="command/invalid-option",
        )
    trials = make_trials(suite, source, [match["controller"]], 1, int(match["seed"]))
    condition_number = match["condition_number"]
    matching_trials = [
        trial
        for trial in trials
        if condition_number is None or trial.condition_number == int(condition_number)
    ]
    if len(matching_trials) == 1:
        return matching_trials[0]
    conditions = ", ".join(
        f"{trial.condition_number} ({trial.condition_name})"
        for trial in trials[:MAX_LISTED_CONDITIONS]
    )
    raise ConfigError(
        f"--trial {name}: give the number of one condition, as in {format_trial_name(trials[0])}; "
        f"the conditions are {conditions}",
        code="command/invalid-option",
    )


def format_trial_name(trial: EvaluationTrial) -> str:
    """Return the name of a trial as `--trial` accepts it."""
    return f"{trial.controller}:{trial.seed}:{trial.condition_number}"


def list_seed_keys(table: ConfigTable) -> list[str]:
    """Return the keys that a seed is set to: that of the run, and that of every random field in the scene."""
    scene = table.values.get("scene")
    random_fields = scene.get("random_field") if isinstance(scene, dict) else None
    count = len(random_fields) if isinstance(random_fields, list) else 0
    return ["seed", *(f"scene.random_field.{i}.seed" for i in range(count))]


def _compose_scenario(
    suite: EvaluationSuite, condition: Condition, controller: str | None
) -> ConfigTable:
    """Return the scenario with the values of a condition, and with another controller unless `controller` is None."""
    overrides = [KeyOverride("clock_mode", "lockstep", "--clock-mode lockstep")]
    if controller:
        overrides.append(KeyOverride("controller", controller, f"--controllers {controller}"))
    return compose_config_table(suite.scenario, [*overrides, *condition.overrides])


def _configure_seed(
    table: ConfigTable, seed: int, randomizations: Sequence[Randomization]
) -> RunConfig:
    """Return the configuration of one seed, with the random values that belong to it."""
    for key in list_seed_keys(table):
        table.set_value(key, seed, "--seed")
    for randomization in randomizations:
        for override in randomization.sample_overrides(seed):
            table.set_value(override.key, override.value, override.flag)
    return decode_table(table, RunConfig)


def _validate_config(config: RunConfig, table: ConfigTable, context: str) -> None:
    """Raise a ConfigError that names the place if a configuration cannot be run."""
    try:
        validate_start_pose(config)
        validate_and_complete_config(config, table)
    except ConfigError as error:
        raise ConfigError(f"{context}: {error}", code=error.code) from None
