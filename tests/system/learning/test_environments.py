"""Gymnasium environments: Gymnasium's checker, one seed one digest, the limiter inside, rewards by name, errors."""

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

IDS = [f"SnakeSIM/{name}-v0" for name in SCENARIOS]
LAG_RAD = 0.9 * np.arange(13)[::-1]
STEP = """
import gymnasium
env = gymnasium.make("snakesim.environments:SnakeSIM/PegRow-v0")
env.reset(seed=1)
env.step(env.action_space.sample())
"""
needs_sb3 = pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="stable-baselines3 is not installed: it brings torch",
)


def wave(time_s: float, _joints: Any = None) -> Any:
    return min(time_s, 1.0) * 0.3 * np.sin(np.pi * time_s - LAG_RAD)


def made(scenario: str = "triplet", **more: Any) -> SnakeEnv:
    env = gymnasium.make("SnakeSIM/Scenario-v0", scenario=scenario, **{"duration": 1, **more})
    assert isinstance(env.unwrapped, SnakeEnv)
    return env.unwrapped


def episode(env: SnakeEnv, seed: int | None = 1, action=wave) -> dict[str, Any]:
    """The last info."""
    _, info = env.reset(seed=seed)
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(action(info["time_s"]))
        over = terminated or truncated
    env.close()
    return info


@pytest.mark.parametrize(
    "name", [IDS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in IDS[1:])]
)
def test_the_checker_of_gymnasium_has_nothing_to_say(name: str) -> None:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(gymnasium.make(name, duration=0.2).unwrapped, skip_render_check=True)
    other = [str(one.message) for one in said if "symmetric and normalized" not in str(one.message)]
    assert not other, other  # of radians, bounds are what they are; RescaleAction normalizes them


@needs_sb3
@pytest.mark.parametrize("name", IDS)
def test_the_checker_of_stable_baselines_passes(name: str) -> None:
    checker = importlib.import_module("stable_baselines3.common.env_checker")
    checker.check_env(gymnasium.make(name, duration=0.2))


def test_every_number_has_a_name_a_unit_and_bounds() -> None:
    env = made()
    seen, _ = env.reset(seed=1)
    space, actions = env.observation_space, env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    assert isinstance(actions, gymnasium.spaces.Box)
    assert len(env.observation_names) == len(env.observation_units) == len(seen) == len(space.low)
    assert np.isfinite(space.low).all()
    assert np.isfinite(space.high).all()
    units = dict(zip(env.observation_names, env.observation_units, strict=True))
    assert units["angle_rad.joint_1"] == "rad"
    assert units["contact_n.link_0"] == "N"
    assert env.action_names[0] == "joint_1"
    assert env.action_units[0] == "rad"
    assert actions.shape == (13,)
    parts, _ = made(flat=False).reset(seed=1)
    assert isinstance(parts, dict)
    assert np.concatenate(list(parts.values())).tolist() == list(seen)
    torque = made(action="torque")
    assert torque.action_units[0] == "N·m"
    assert made(action="velocity").action_units[0] == "rad/s"


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"set": {"robot.motor.latency_s": 0.007}},
        {"set": {"backend": "can"}},
        pytest.param({"set": {"robot": "planar13_camera"}}, marks=pytest.mark.slow),
    ],
    ids=["simulator", "motors with a latency", "emulated modules", "with a camera"],
)
def test_an_episode_is_the_run_of_its_actions(more: dict[str, Any]) -> None:
    """To the bit, behind the same limiter and with the same latency."""
    info = episode(made(frame_skip=1, **more), action=lambda time_s: 8.0 * wave(time_s))
    run = snakesim.run(
        "triplet", controller=lambda time_s, _: 8.0 * wave(time_s), duration=1, seed=1, **more
    )
    assert "limited" in info
    assert info["ended"] == "time"
    assert info["digest"] == run.digest


def test_a_residual_of_nothing_is_the_shipped_controller(tmp_path) -> None:
    env = made("peg_row", action="residual:obstacle_triplet", duration=0.5)
    nothing = episode(env, seed=3, action=lambda _: np.zeros(13))
    write_config(env.config, tmp_path / "config.json")
    assert nothing["digest"] == snakesim.run(tmp_path / "config.json").digest
    something = episode(env, seed=3, action=lambda _: np.full(13, 0.1))
    assert something["digest"] != nothing["digest"]


def test_environment_digest_depends_only_on_seed_and_actions() -> None:
    first, second = made("surveyed_clutter", duration=0.3), made("surveyed_clutter", duration=0.3)
    digest = episode(first, seed=5)["digest"]
    assert digest == episode(second, seed=5)["digest"]
    drawn = [episode(env, seed=None)["digest"] for env in (first, second)]
    assert drawn[0] == drawn[1]
    assert first.config.seed == second.config.seed != 5
    fields = [made("surveyed_clutter", new_field=new) for new in (True, False)]
    for env in fields:
        env.reset(seed=5)
    assert [env.config.scene.random_field[0].seed for env in fields] == [5, 1]


def test_environment_unspecified_choices_are_drawn_per_seed() -> None:
    env = made("surveyed_clutter", randomize={"scene.ground.friction": (0.1, 0.4)}, duration=0.1)
    found = [env.reset(seed=seed) and env.config.scene.ground.friction for seed in (7, 8, 7)]
    assert found[0] == found[2] != found[1]
    assert all(0.1 <= one <= 0.4 for one in found)
    of_suite = Randomization(set=["scene.ground.friction"], low=0.1, high=0.4)
    assert found[0] == of_suite.sample_overrides(7)[0].value
    for wrong, code in (
        ({"scene.ground.frictoin": (0.1, 0.4)}, "config/unknown-key"),
        ({"scene.ground.friction": (0.4, 0.1)}, "command/invalid-option"),
        ({"scene.ground.friction": "0.1"}, "command/invalid-option"),
        ({"scene.ground.friction": (0.1, 400.0)}, "config/out-of-range"),
    ):
        with raises_error(snakesim.ConfigError, code=code):
            made("surveyed_clutter", randomize=wrong)


def test_the_gate_is_inside_and_says_so() -> None:
    far = np.full(13, 1.5)
    env, free = made(frame_skip=10), made(frame_skip=10, safe=False)
    for one in (env, free):
        one.reset(seed=1)
    _, _, _, _, info = env.step(far)
    _, _, _, _, unlimited = free.step(far)
    assert set(info["limited"].values()) == {"angle_rate"}
    assert info["reward_terms"]["limited"] < 0
    assert "limited" not in unlimited
    assert free.digest != env.digest
    beyond = made(action="torque", frame_skip=10)
    beyond.reset(seed=1)
    _, _, _, _, info = beyond.step(np.full(13, 1e9))
    assert set(info["limited"].values()) <= {"torque", "torque_rate", "angle"}
    assert info["lifecycle"] == "armed"


@pytest.mark.parametrize("action", ["position", "residual:hold"])
@pytest.mark.parametrize(
    ("fault", "why"), [("nan:joint_3@0.2", "joint_3"), ("diverge:simulator@0.2", "diverged")]
)
def test_environment_episode_of_stopped_robot_ends_with_reason(
    action: str, fault: str, why: str
) -> None:
    env = made(set={"faults": [fault]}, action=action)
    info = episode(env, action=lambda time_s: 0.1 * wave(time_s))
    assert info["ended"] == "stopped"
    assert info["lifecycle"] == "fault"
    assert why in info["reason"]
    assert info["time_s"] < 0.4
    assert info["reward_terms"]["stopped"] == -1.0


def test_a_fault_of_what_is_not_there_is_refused() -> None:
    env = made(set={"faults": ["drop:sensor/joints@0.2"]})
    with raises_error(snakesim.ConfigError, code="injection/not-supported"):
        env.reset(seed=1)


def test_reward_terms_have_names_and_sum_to_the_reward() -> None:
    env = made(reward={"advance": 3.0, "energy": 0.0})
    _, info = env.reset(seed=1)
    advance_m = 0.0
    for _ in range(10):
        _, reward, _, _, info = env.step(wave(info["time_s"]))
        assert list(info["reward_terms"]) == list(REWARD_TERMS)
        assert reward == sum(info["reward_terms"].values())
        advance_m += info["reward_terms"]["advance"] / 3.0
        assert info["reward_terms"]["energy"] == 0.0
    assert advance_m == pytest.approx(info["advance_m"]) != 0.0


def test_the_goal_ends_the_episode() -> None:
    goal = {"mission.goal.kind": "heading", "mission.goal.distance_m": 0.02}
    info = episode(made("surveyed_clutter", set=goal, new_field=False, duration=5))
    assert info["ended"] == "goal"
    assert info["reward_terms"]["goal"] == 1.0
    assert info["time_s"] < 5


def test_waypoints_lead_to_a_goal() -> None:
    goal = {
        "mission.goal": {"kind": "waypoints", "points_m": [[1.2, 0.0], [3.0, 0.0]], "within_m": 0.5}
    }
    env = made("surveyed_clutter", set=goal, new_field=False, observe=["goal_m", "goal_bearing"])
    seen, _ = env.reset(seed=1)
    info = episode(env)
    assert isinstance(seen, np.ndarray)
    assert seen[0] > 1.5
    assert abs(np.hypot(*seen[1:]) - 1) < 1e-6
    assert -0.5 < info["advance_m"] < 1.0


@pytest.mark.parametrize("mode", [None, "async"], ids=["ours", "that of Gymnasium"])
def test_many_at_once_are_what_each_is_alone(mode: str | None) -> None:
    envs = gymnasium.make_vec(
        "SnakeSIM/Scenario-v0",
        num_envs=3,
        vectorization_mode=mode,
        scenario="triplet",
        duration=0.1,
    )
    envs.reset(seed=1)
    envs.step(np.zeros((3, 13)))
    seen, rewards, _, truncated, infos = envs.step(np.zeros((3, 13)))
    again, nothing, _, truncated_again, after = envs.step(np.zeros((3, 13)))
    envs.close()
    assert seen.shape == (3, 56)
    assert envs.observation_space.contains(seen)
    assert rewards.shape == (3,)
    assert rewards.all()
    assert truncated.all()
    alone = [
        episode(made(duration=0.1), seed=seed, action=lambda _: np.zeros(13))["digest"]
        for seed in (1, 2, 3)
    ]
    assert list(infos["digest"]) == alone
    assert len({*alone}) == 3
    assert not truncated_again.any()
    assert not nothing.any()
    assert not after["time_s"].any()  # reset, as by Gymnasium's own
    assert again.shape == seen.shape


def test_many_with_a_latency_of_motors_are_what_each_is_alone() -> None:
    late = {"duration": 0.3, "set": {"robot.motor.latency_s": 0.007}}
    envs = gymnasium.make_vec("SnakeSIM/Scenario-v0", num_envs=2, scenario="triplet", **late)
    envs.reset(seed=1)
    truncated = np.zeros(2, dtype=bool)
    infos: dict[str, Any] = {}
    step = 0
    while not truncated.all():
        step += 1
        _, _, _, truncated, infos = envs.step(np.full((2, 13), 0.2 * (-1) ** step))
    envs.close()
    for seed in (1, 2):
        alone = made(**late)
        alone.reset(seed=seed)
        info: dict[str, Any] = {}
        for number in range(1, step + 1):
            _, _, _, _, info = alone.step(np.full(13, 0.2 * (-1) ** number))
        assert info["digest"] == infos["digest"][seed - 1]


def test_many_say_what_is_wrong() -> None:
    many: dict[str, Any] = {"num_envs": 2, "duration": 0.1}
    with raises_error(snakesim.ConfigError, code="config/unknown-name", field="triplett"):
        gymnasium.make_vec("SnakeSIM/Scenario-v0", scenario="triplett", **many)
    envs = SnakeVectorEnv(scenario="peg_row", flat=False, **many)
    parts, _ = envs.reset(seed=[4, 4])
    assert np.array_equal(parts["angle_rad"][0], parts["angle_rad"][1])
    with raises_error(ValueError):
        envs.step(np.zeros((3, 13)))
    with raises_error(ValueError, field="joint_1"):
        envs.step(np.full((2, 13), np.nan))
    envs.step(np.zeros((2, 13)))  # it goes on
    envs.close()


@pytest.fixture
def ctrl_c_raises() -> Iterator[None]:
    """Give SIGINT Python's own handler, which another test of this process may have replaced."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c_raises")
def test_an_interrupted_step_of_many_needs_a_reset() -> None:
    envs = SnakeVectorEnv(num_envs=2, scenario="triplet", frame_skip=600, duration=18)
    still = np.zeros((2, 13))
    envs.reset(seed=1)
    threading.Timer(0.1, os.kill, [os.getpid(), signal.SIGINT]).start()
    with pytest.raises(KeyboardInterrupt):
        envs.step(still)
    with raises_error(gymnasium.error.ResetNeeded):
        envs.step(still)
    _, at_reset = envs.reset(seed=1)
    _, _, _, _, after = envs.step(still)
    envs.close()
    assert at_reset["time_s"].tolist() == [0.0, 0.0]
    assert after["time_s"].tolist() == [6.0, 6.0]


def test_seeds_are_read_as_by_gymnasium() -> None:
    envs = SnakeVectorEnv(num_envs=2, scenario="triplet", duration=0.1)
    wrong: list[Any] = [np.int64(0), -1, [], [1, -2], [1, np.int64(2)], "12", 1.0]
    for seed in wrong:
        with raises_error((ValueError, gymnasium.error.Error)):
            envs.reset(seed=seed)
    for mask in (np.array([True]), np.array([False, False]), [True, False], np.array([1, 0])):
        with raises_error(ValueError):
            envs.reset(options={"reset_mask": mask})
    envs.close()


def test_a_pickle_is_a_new_environment_of_the_same_arguments() -> None:
    env = gymnasium.make("SnakeSIM/Scenario-v0", scenario="triplet", duration=0.1, flat=False)
    env.reset(seed=1)
    again = pickle.loads(pickle.dumps(env))
    assert isinstance(env.unwrapped, SnakeEnv)
    assert again.spec == env.spec
    assert again.observation_space == env.observation_space
    with pytest.raises(gymnasium.error.ResetNeeded):
        again.unwrapped.step(np.zeros(13))
    assert episode(again.unwrapped)["digest"] == episode(env.unwrapped)["digest"]
    many = SnakeVectorEnv(num_envs=2, scenario="triplet", duration=0.1)
    loaded = pickle.loads(pickle.dumps(many))
    seen, _ = loaded.reset(seed=1)
    assert np.array_equal(seen, many.reset(seed=1)[0])
    many.close()
    loaded.close()


def test_two_in_one_process_do_not_disturb_each_other() -> None:
    envs = [made(action="residual:obstacle_triplet", duration=0.3) for _ in range(3)]
    alone = episode(envs.pop(), action=lambda _: np.zeros(13))["digest"]
    for env in envs:
        env.reset(seed=1)
    infos = [env.step(np.zeros(13))[4] for _ in range(6) for env in envs]
    assert [info["digest"] for info in infos[-2:]] == [alone, alone]
    for env in envs:
        env.close()


def test_a_picture_of_it() -> None:
    env = made(render_mode="rgb_array", width=64, height=48)
    env.reset(seed=1)
    picture = env.render()
    env.close()
    assert picture is not None
    assert picture.shape == (48, 64, 3)
    assert picture.std() > 5


WRONG = [
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


@pytest.mark.parametrize(("given", "code"), WRONG)
def test_wrong_input_is_answered_at_the_call(given: dict[str, Any], code: str) -> None:
    with raises_error(snakesim.ConfigError, code=code):
        SnakeEnv(**{"scenario": "triplet", **given})


@pytest.mark.parametrize(
    "action",
    [
        np.zeros(3),
        [0.0] * 12 + [float("nan")],
        "ahead",
    ],
)
def test_a_wrong_action_is_a_value_error(action: Any) -> None:
    env = made()
    env.reset(seed=1)
    with raises_error(ValueError):
        env.step(action)


def test_an_episode_that_is_over_wants_a_reset() -> None:
    env = made(duration=0.05, render_mode="rgb_array")
    for before_reset in (lambda: env.step(wave(0.0)), env.render):
        with raises_error(gymnasium.error.ResetNeeded):
            before_reset()
    episode(env)
    env.reset()
    env.step(wave(0.0))
    with raises_error(gymnasium.error.ResetNeeded):
        env.step(wave(0.0))


def test_the_extra_brings_all_that_it_needs() -> None:
    others = {
        package
        for extra, packages in PACKAGES_BY_EXTRA.items()
        if extra not in ("gym", "sim")
        for package in packages
    }
    code = f"import sys\nsys.modules |= dict.fromkeys({others})\n" + STEP
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_the_extra_the_import_says_how_to_get_it() -> None:
    code = "import sys\nsys.modules['gymnasium'] = None\nimport snakesim\nprint('core')\nimport snakesim.environments"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "core\n" and "pip install 'snakesim[gym]'" in done.stderr, done


@pytest.mark.slow
def test_the_example_of_the_documentation_runs(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = next(
        of
        for of in parse_sections(REPOSITORY / "docs" / "how-to" / "environments.md")
        if "search.py" in of.files
    )
    exec(compile(found.files["search.py"], "search.py", "exec"), {"__name__": "__main__"})
