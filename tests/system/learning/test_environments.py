"""Gymnasium environments pass the checkers, depend only on their seed, and contain the command limiter."""

import importlib.util
import os
import pickle
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import snakesim
import snakesim.environments
from snakesim.environments import SCENARIOS, SnakeEnv, SnakeVectorEnv
from snakesim.environments.rewards import REWARD_TERMS
from snakesim_hal.model.scenario import write_config
from snakesim_hal.model.scene_file.randomization import Randomization
from snakesim_operator.base.extras import PACKAGES_BY_EXTRA
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.documents import REPOSITORY, parse_sections

ENVIRONMENT_IDS = [f"SnakeSIM/{name}-v0" for name in SCENARIOS]
LAG_RAD = 0.9 * np.arange(13)[::-1]  # phase of each joint in the wave
ONE_STEP_PROGRAM = """
import gymnasium
env = gymnasium.make("snakesim.environments:SnakeSIM/PegRow-v0")
env.reset(seed=1)
env.step(env.action_space.sample())
"""
needs_sb3 = pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="stable-baselines3 is not installed: it brings torch",
)


def compute_wave_rad(time_s: float, _joints: Any = None) -> Any:
    """Return the joint angles of a wave whose amplitude grows in the first second."""
    return min(time_s, 1.0) * 0.3 * np.sin(np.pi * time_s - LAG_RAD)


def make_environment(scenario: str = "triplet", **arguments: Any) -> SnakeEnv:
    """Make an environment of one second, unless the arguments set another duration."""
    env = gymnasium.make("SnakeSIM/Scenario-v0", scenario=scenario, **{"duration": 1, **arguments})
    assert isinstance(env.unwrapped, SnakeEnv)
    return env.unwrapped


def run_episode(
    env: SnakeEnv, seed: int | None = 1, compute_action=compute_wave_rad
) -> dict[str, Any]:
    """Run one episode, close the environment, and return the last info.

    Args:
        env: The environment.
        seed: Seed of the reset.
        compute_action: Returns the action at a time in s.
    """
    _, info = env.reset(seed=seed)
    is_over = False
    while not is_over:
        _, _, terminated, truncated, info = env.step(compute_action(info["time_s"]))
        is_over = terminated or truncated
    env.close()
    return info


@pytest.mark.heavy
@pytest.mark.parametrize(
    "name",
    [
        ENVIRONMENT_IDS[0],
        *(pytest.param(name, marks=pytest.mark.slow) for name in ENVIRONMENT_IDS[1:]),
    ],
)
def test_environment_passes_checker_of_gymnasium(name: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(name, duration=0.2).unwrapped, skip_render_check=True)
    # The bounds of an action in radians are not normalized. RescaleAction normalizes them.
    texts = [str(warning.message) for warning in caught]
    unexpected = [text for text in texts if "symmetric and normalized" not in text]
    assert not unexpected, unexpected


@needs_sb3
@pytest.mark.parametrize("name", ENVIRONMENT_IDS)
def test_environment_passes_checker_of_stable_baselines(name: str) -> None:
    checker = importlib.import_module("stable_baselines3.common.env_checker")
    checker.check_env(gymnasium.make(name, duration=0.2))


def test_environment_numbers_have_names_units_and_bounds() -> None:
    env = make_environment()
    observation, _ = env.reset(seed=1)
    observation_space = env.observation_space
    action_space = env.action_space
    assert isinstance(observation_space, gymnasium.spaces.Box)
    assert isinstance(action_space, gymnasium.spaces.Box)
    assert len(env.observation_names) == len(observation)
    assert len(env.observation_units) == len(observation)
    assert len(observation_space.low) == len(observation)
    assert np.isfinite(observation_space.low).all()
    assert np.isfinite(observation_space.high).all()
    units = dict(zip(env.observation_names, env.observation_units, strict=True))
    assert units["angle_rad.joint_1"] == "rad"
    assert units["contact_n.link_0"] == "N"
    assert env.action_names[0] == "joint_1"
    assert env.action_units[0] == "rad"
    assert action_space.shape == (13,)
    parts, _ = make_environment(flat=False).reset(seed=1)
    assert isinstance(parts, dict)
    assert np.concatenate(list(parts.values())).tolist() == list(observation)
    assert make_environment(action="torque").action_units[0] == "N·m"
    assert make_environment(action="velocity").action_units[0] == "rad/s"


@pytest.mark.heavy
@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"set": {"robot.motor.latency_s": 0.007}},
        {"set": {"backend": "can"}},
        pytest.param({"set": {"robot": "planar13_camera"}}, marks=pytest.mark.slow),
    ],
    ids=["simulator", "motors with a latency", "emulated modules", "with a camera"],
)
def test_environment_episode_has_digest_of_equivalent_run(arguments: dict[str, Any]) -> None:
    """An episode and a run have the same bits, because both have the same limiter and latency."""
    info = run_episode(
        make_environment(frame_skip=1, **arguments),
        compute_action=lambda time_s: 8.0 * compute_wave_rad(time_s),
    )
    run = snakesim.run(
        "triplet",
        controller=lambda time_s, _: 8.0 * compute_wave_rad(time_s),
        duration=1,
        seed=1,
        **arguments,
    )
    assert "limited" in info
    assert info["ended"] == "time"
    assert info["digest"] == run.digest


@pytest.mark.heavy
def test_environment_zero_residual_has_digest_of_shipped_controller(tmp_path) -> None:
    env = make_environment("peg_row", action="residual:obstacle_triplet", duration=0.5)
    zero_info = run_episode(env, seed=3, compute_action=lambda _: np.zeros(13))
    write_config(env.config, tmp_path / "config.json")
    assert zero_info["digest"] == snakesim.run(tmp_path / "config.json").digest
    info = run_episode(env, seed=3, compute_action=lambda _: np.full(13, 0.1))
    assert info["digest"] != zero_info["digest"]


@pytest.mark.heavy
def test_environment_digest_depends_only_on_seed_and_actions() -> None:
    first = make_environment("surveyed_clutter", duration=0.3)
    second = make_environment("surveyed_clutter", duration=0.3)
    assert run_episode(first, seed=5)["digest"] == run_episode(second, seed=5)["digest"]
    # Without a seed, both environments continue with the same next seed.
    assert run_episode(first, seed=None)["digest"] == run_episode(second, seed=None)["digest"]
    assert first.config.seed == second.config.seed != 5
    with_new_field = make_environment("surveyed_clutter", new_field=True)
    with_scene_field = make_environment("surveyed_clutter", new_field=False)
    with_new_field.reset(seed=5)
    with_scene_field.reset(seed=5)
    assert with_new_field.config.scene.random_field[0].seed == 5
    assert with_scene_field.config.scene.random_field[0].seed == 1


def test_environment_randomized_values_depend_only_on_seed() -> None:
    env = make_environment(
        "surveyed_clutter", randomize={"scene.ground.friction": (0.1, 0.4)}, duration=0.1
    )
    frictions = []
    for seed in (7, 8, 7):
        env.reset(seed=seed)
        frictions.append(env.config.scene.ground.friction)
    assert frictions[0] == frictions[2] != frictions[1]
    assert all(0.1 <= friction <= 0.4 for friction in frictions)
    suite_randomization = Randomization(set=["scene.ground.friction"], low=0.1, high=0.4)
    assert frictions[0] == suite_randomization.sample_overrides(7)[0].value
    for randomize, code in (
        ({"scene.ground.frictoin": (0.1, 0.4)}, "config/unknown-key"),
        ({"scene.ground.friction": (0.4, 0.1)}, "command/invalid-option"),
        ({"scene.ground.friction": "0.1"}, "command/invalid-option"),
        ({"scene.ground.friction": (0.1, 400.0)}, "config/out-of-range"),
    ):
        with raises_error(snakesim.ConfigError, code=code):
            make_environment("surveyed_clutter", randomize=randomize)


def test_environment_limits_actions_and_reports_the_limits() -> None:
    far_rad = np.full(13, 1.5)
    limited_env = make_environment(frame_skip=10)
    limited_env.reset(seed=1)
    unlimited_env = make_environment(frame_skip=10, safe=False)
    unlimited_env.reset(seed=1)
    _, _, _, _, info = limited_env.step(far_rad)
    _, _, _, _, unlimited_info = unlimited_env.step(far_rad)
    assert set(info["limited"].values()) == {"angle_rate"}
    assert info["reward_terms"]["limited"] < 0
    assert "limited" not in unlimited_info
    assert unlimited_env.digest != limited_env.digest
    torque_env = make_environment(action="torque", frame_skip=10)
    torque_env.reset(seed=1)
    _, _, _, _, info = torque_env.step(np.full(13, 1e9))
    assert set(info["limited"].values()) <= {"torque", "torque_rate", "angle"}
    assert info["lifecycle"] == "armed"


@pytest.mark.parametrize("action", ["position", "residual:hold"])
@pytest.mark.parametrize(
    ("fault", "expected_reason"),
    [("nan:joint_3@0.2", "joint_3"), ("diverge:simulator@0.2", "diverged")],
)
def test_environment_episode_of_stopped_robot_ends_with_reason(
    action: str, fault: str, expected_reason: str
) -> None:
    env = make_environment(set={"faults": [fault]}, action=action)
    info = run_episode(env, compute_action=lambda time_s: 0.1 * compute_wave_rad(time_s))
    assert info["ended"] == "stopped"
    assert info["lifecycle"] == "fault"
    assert expected_reason in info["reason"]
    assert info["time_s"] < 0.4
    assert info["reward_terms"]["stopped"] == -1.0


def test_environment_with_fault_of_missing_part_is_refused() -> None:
    env = make_environment(set={"faults": ["drop:sensor/joints@0.2"]})
    with raises_error(snakesim.ConfigError, code="injection/not-supported"):
        env.reset(seed=1)


def test_environment_reward_is_the_sum_of_named_terms() -> None:
    env = make_environment(reward={"advance": 3.0, "energy": 0.0})
    _, info = env.reset(seed=1)
    advance_m = 0.0
    for _ in range(10):
        _, reward, _, _, info = env.step(compute_wave_rad(info["time_s"]))
        assert list(info["reward_terms"]) == list(REWARD_TERMS)
        assert reward == sum(info["reward_terms"].values())
        advance_m += info["reward_terms"]["advance"] / 3.0
        assert info["reward_terms"]["energy"] == 0.0
    assert advance_m == pytest.approx(info["advance_m"]) != 0.0


def test_environment_episode_ends_at_the_goal() -> None:
    goal = {"mission.goal.kind": "heading", "mission.goal.distance_m": 0.02}
    info = run_episode(make_environment("surveyed_clutter", set=goal, new_field=False, duration=5))
    assert info["ended"] == "goal"
    assert info["reward_terms"]["goal"] == 1.0
    assert info["time_s"] < 5


def test_environment_with_waypoints_observes_distance_and_bearing_of_goal() -> None:
    goal = {
        "mission.goal": {"kind": "waypoints", "points_m": [[1.2, 0.0], [3.0, 0.0]], "within_m": 0.5}
    }
    env = make_environment(
        "surveyed_clutter", set=goal, new_field=False, observe=["goal_m", "goal_bearing"]
    )
    observation, _ = env.reset(seed=1)
    info = run_episode(env)
    assert isinstance(observation, np.ndarray)
    goal_m = observation[0]
    goal_bearing = observation[1:]
    assert goal_m > 1.5
    assert abs(np.hypot(*goal_bearing) - 1) < 1e-6
    assert -0.5 < info["advance_m"] < 1.0


@pytest.mark.parametrize("mode", [None, "async"], ids=["SnakeVectorEnv", "AsyncVectorEnv"])
def test_vector_environment_has_digests_of_single_environments(mode: str | None) -> None:
    envs = gymnasium.make_vec(
        "SnakeSIM/Scenario-v0",
        num_envs=3,
        vectorization_mode=mode,
        scenario="triplet",
        duration=0.1,
    )
    envs.reset(seed=1)
    envs.step(np.zeros((3, 13)))
    observations, rewards, _, truncated, infos = envs.step(np.zeros((3, 13)))
    # The next step resets every environment, as Gymnasium does.
    reset_observations, reset_rewards, _, truncated_at_reset, reset_infos = envs.step(
        np.zeros((3, 13))
    )
    envs.close()
    assert observations.shape == (3, 56)
    assert envs.observation_space.contains(observations)
    assert rewards.shape == (3,)
    assert rewards.all()
    assert truncated.all()
    single_digests = [
        run_episode(
            make_environment(duration=0.1), seed=seed, compute_action=lambda _: np.zeros(13)
        )["digest"]
        for seed in (1, 2, 3)
    ]
    assert list(infos["digest"]) == single_digests
    assert len({*single_digests}) == 3
    assert not truncated_at_reset.any()
    assert not reset_rewards.any()
    assert not reset_infos["time_s"].any()
    assert reset_observations.shape == observations.shape


def test_vector_environment_with_latency_has_digests_of_single_environments() -> None:
    arguments = {"duration": 0.3, "set": {"robot.motor.latency_s": 0.007}}
    envs = gymnasium.make_vec("SnakeSIM/Scenario-v0", num_envs=2, scenario="triplet", **arguments)
    envs.reset(seed=1)
    truncated = np.zeros(2, dtype=bool)
    infos: dict[str, Any] = {}
    step = 0
    while not truncated.all():
        step += 1
        _, _, _, truncated, infos = envs.step(np.full((2, 13), 0.2 * (-1) ** step))
    envs.close()
    for seed in (1, 2):
        single_env = make_environment(**arguments)
        single_env.reset(seed=seed)
        info: dict[str, Any] = {}
        for number in range(1, step + 1):
            _, _, _, _, info = single_env.step(np.full(13, 0.2 * (-1) ** number))
        assert info["digest"] == infos["digest"][seed - 1]


def test_vector_environment_with_invalid_input_is_refused() -> None:
    arguments: dict[str, Any] = {"num_envs": 2, "duration": 0.1}
    with raises_error(snakesim.ConfigError, code="config/unknown-name", field="triplett"):
        gymnasium.make_vec("SnakeSIM/Scenario-v0", scenario="triplett", **arguments)
    envs = SnakeVectorEnv(scenario="peg_row", flat=False, **arguments)
    parts, _ = envs.reset(seed=[4, 4])
    assert np.array_equal(parts["angle_rad"][0], parts["angle_rad"][1])
    with raises_error(ValueError):
        envs.step(np.zeros((3, 13)))
    with raises_error(ValueError, field="joint_1"):
        envs.step(np.full((2, 13), np.nan))
    envs.step(np.zeros((2, 13)))  # The refused actions have changed nothing.
    envs.close()


@pytest.fixture
def ctrl_c_raises() -> Iterator[None]:
    """Give SIGINT Python's own handler, which another test of this process may have replaced."""
    previous_handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous_handler)


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c_raises")
def test_vector_environment_after_interrupted_step_needs_reset() -> None:
    envs = SnakeVectorEnv(num_envs=2, scenario="triplet", frame_skip=600, duration=18)
    still = np.zeros((2, 13))
    envs.reset(seed=1)
    threading.Timer(0.1, os.kill, [os.getpid(), signal.SIGINT]).start()
    with pytest.raises(KeyboardInterrupt):
        envs.step(still)
    with raises_error(gymnasium.error.ResetNeeded):
        envs.step(still)
    _, reset_infos = envs.reset(seed=1)
    _, _, _, _, infos = envs.step(still)
    envs.close()
    assert reset_infos["time_s"].tolist() == [0.0, 0.0]
    assert infos["time_s"].tolist() == [6.0, 6.0]


def test_vector_environment_with_invalid_seed_or_mask_is_refused() -> None:
    envs = SnakeVectorEnv(num_envs=2, scenario="triplet", duration=0.1)
    invalid_seeds: list[Any] = [np.int64(0), -1, [], [1, -2], [1, np.int64(2)], "12", 1.0]
    for seed in invalid_seeds:
        with raises_error((ValueError, gymnasium.error.Error)):
            envs.reset(seed=seed)
    for mask in (np.array([True]), np.array([False, False]), [True, False], np.array([1, 0])):
        with raises_error(ValueError):
            envs.reset(options={"reset_mask": mask})
    envs.close()


def test_environment_pickle_is_new_environment_of_same_arguments() -> None:
    env = gymnasium.make("SnakeSIM/Scenario-v0", scenario="triplet", duration=0.1, flat=False)
    env.reset(seed=1)
    loaded_env = pickle.loads(pickle.dumps(env))
    assert isinstance(env.unwrapped, SnakeEnv)
    assert loaded_env.spec == env.spec
    assert loaded_env.observation_space == env.observation_space
    with pytest.raises(gymnasium.error.ResetNeeded):
        loaded_env.unwrapped.step(np.zeros(13))
    assert run_episode(loaded_env.unwrapped)["digest"] == run_episode(env.unwrapped)["digest"]
    envs = SnakeVectorEnv(num_envs=2, scenario="triplet", duration=0.1)
    loaded_envs = pickle.loads(pickle.dumps(envs))
    observations, _ = loaded_envs.reset(seed=1)
    assert np.array_equal(observations, envs.reset(seed=1)[0])
    envs.close()
    loaded_envs.close()


def test_environments_in_one_process_do_not_affect_each_other() -> None:
    envs = [make_environment(action="residual:obstacle_triplet", duration=0.3) for _ in range(3)]
    expected_digest = run_episode(envs.pop(), compute_action=lambda _: np.zeros(13))["digest"]
    for env in envs:
        env.reset(seed=1)
    infos = [env.step(np.zeros(13))[4] for _ in range(6) for env in envs]
    assert [info["digest"] for info in infos[-2:]] == [expected_digest, expected_digest]
    for env in envs:
        env.close()


def test_environment_renders_an_image() -> None:
    env = make_environment(render_mode="rgb_array", width=64, height=48)
    env.reset(seed=1)
    image = env.render()
    env.close()
    assert image is not None
    assert image.shape == (48, 64, 3)
    assert image.std() > 5


INVALID_ARGUMENTS = [
    ({"scenario": "triplett"}, "config/unknown-name"),
    ({"scenario": None}, "python/invalid-argument"),
    ({"action": "torqe"}, "python/invalid-argument"),
    ({"action": "residual:obstacle_aidd"}, "plugin/not-found"),
    ({"action": "residual:hold", "safe": False}, "python/invalid-argument"),
    ({"observe": ["angle_rd"]}, "policy/invalid"),
    ({"observe": "angle_rad"}, "policy/invalid"),
    ({"reward": {"advence": 1}}, "python/invalid-argument"),
    ({"reward": lambda info: 0.0}, "python/invalid-argument"),
    ({"reward": 0.5}, "python/invalid-argument"),
    ({"reward": {"advance": "much"}}, "python/invalid-argument"),
    ({"frame_skip": 0}, "python/invalid-argument"),
    ({"duration": -1}, "config/out-of-range"),
    ({"set": {"control.lead": 1}}, "config/unknown-key"),
]


@pytest.mark.parametrize(("arguments", "code"), INVALID_ARGUMENTS)
def test_environment_with_invalid_argument_is_refused(arguments: dict[str, Any], code: str) -> None:
    with raises_error(snakesim.ConfigError, code=code):
        SnakeEnv(**{"scenario": "triplet", **arguments})


@pytest.mark.parametrize(
    "action",
    [
        np.zeros(3),
        [0.0] * 12 + [float("nan")],
        "ahead",
    ],
)
def test_environment_with_invalid_action_raises_value_error(action: Any) -> None:
    env = make_environment()
    env.reset(seed=1)
    with raises_error(ValueError):
        env.step(action)


def test_environment_outside_an_episode_needs_reset() -> None:
    env = make_environment(duration=0.05, render_mode="rgb_array")
    with raises_error(gymnasium.error.ResetNeeded):
        env.step(compute_wave_rad(0.0))
    with raises_error(gymnasium.error.ResetNeeded):
        env.render()
    run_episode(env)
    env.reset()
    env.step(compute_wave_rad(0.0))
    with raises_error(gymnasium.error.ResetNeeded):
        env.step(compute_wave_rad(0.0))


@pytest.mark.heavy
def test_gym_extra_contains_all_packages_of_a_step() -> None:
    unneeded_packages = {
        package
        for extra, packages in PACKAGES_BY_EXTRA.items()
        if extra not in ("gym", "sim")
        for package in packages
    }
    code = f"import sys\nsys.modules |= dict.fromkeys({unneeded_packages})\n" + ONE_STEP_PROGRAM
    subprocess.run([sys.executable, "-c", code], check=True)


def test_environments_import_without_gymnasium_names_the_extra() -> None:
    code = "import sys\nsys.modules['gymnasium'] = None\nimport snakesim\nprint('core')\nimport snakesim.environments"
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert completed.stdout == "core\n", completed
    assert "pip install 'snakesim[gym]'" in completed.stderr, completed


@pytest.mark.slow
def test_environments_page_example_runs(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    section = next(
        section
        for section in parse_sections(REPOSITORY / "docs" / "how-to" / "environments.md")
        if "search.py" in section.files
    )
    exec(compile(section.files["search.py"], "search.py", "exec"), {"__name__": "__main__"})
