"""A vector environment has the bits of its single environments, and follows the rules of Gymnasium."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import snakesim
import snakesim.environments.robots
from snakesim.environments import SnakeEnv, SnakeVectorEnv
from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.batch import robots as batch_robots
from snakesim_sim_backend.batch.batched import BatchedSimulations
from snakesim_sim_backend.batch.simulations import LoopedSimulations
from snakesim_sim_backend.laws.version import choose_laws
from snakesim_testing.messages import raises_error

ALL_PARTS = (
    *("time_s", "angle_rad", "velocity_rad_s", "torque_nm", "goal_bearing", "goal_m", "contact_n"),
    *("position_w_m", "orientation_wxyz", "velocity_w_m_s", "angular_velocity_w_rad_s"),
)
NOISE_FREE = {
    "robot.sensors.joints.angle_noise_rad": 0.0,
    "robot.sensors.joints.velocity_noise_rad_s": 0.0,
    "robot.sensors.joints.torque_noise_nm": 0.0,
}
DELAYS = {
    "robot.sensors.joints.delay_s": 0.03,
    "robot.sensors.pose.delay_s": 0.02,
    "robot.sensors.pose.rate_hz": 40,
    "robot.sensors.contacts.delay_s": 0.01,
    "robot.sensors.contacts.rate_hz": 50,
    "robot.sensors.power.delay_s": 0.02,
    "robot.sensors.power.rate_hz": 30,
}
HOT = {
    "robot.heat.time_constant_s": 0.03,
    "robot.heat.rise_at_rated_k": 900.0,
    "robot.sensors.power.rate_hz": 20,
}
Case = tuple[str, dict[str, Any]]
CASES: dict[str, Case] = {
    "positions among obstacles": ("surveyed_clutter", {"observe": ALL_PARTS}),
    "velocities": ("peg_row", {"action": "velocity"}),
    "torques": ("triplet", {"action": "torque", "frame_skip": 3, "flat": False}),
    "joints that yaw and pitch": ("mamba_flat", {}),
    "hills": ("mamba_hills", {}),
    "no limits": ("triplet", {"safe": False}),
    "delayed sensors": ("peg_row", {"set": DELAYS, "observe": ALL_PARTS}),
    "sensors without noise": ("triplet", {"set": NOISE_FREE}),
    "late and rare commands": (
        "triplet",
        {"set": {"services.control.decimation": 3, "services.control.latency_ticks": 5}},
    ),
    "hot motors": ("triplet", {"action": "torque", "set": HOT}),
    "hot motors that are isolated": (
        "triplet",
        {"action": "torque", "set": {**HOT, "robot.safety.max_isolated_joints": 13}},
    ),
    "angles that jump": ("triplet", {"set": {"robot.sensors.joints.angle_noise_rad": 0.06}}),
    "motors of random strength": ("triplet", {"randomize": {"robot.limits.torque_nm": (2.0, 7.0)}}),
}
QUICK_CASES = (
    "positions among obstacles",
    "torques",
    "delayed sensors",
    "hot motors that are isolated",
    "angles that jump",
)
EVERY_CASE = [
    name if name in QUICK_CASES else pytest.param(name, marks=pytest.mark.slow) for name in CASES
]


def make_environment(case: Case, **more_arguments: Any) -> SnakeEnv:
    """Make a single environment of a case."""
    scenario, arguments = case
    return SnakeEnv(scenario, **{"duration": 0.6, **arguments, **more_arguments})


def make_vector_environment(case: Case, count: int, **more_arguments: Any) -> SnakeVectorEnv:
    """Make a vector environment of a case."""
    scenario, arguments = case
    return SnakeVectorEnv(
        count, scenario=scenario, **{"duration": 0.6, **arguments, **more_arguments}
    )


def draw_actions(env: SnakeEnv, seed: int) -> Iterator[np.ndarray]:
    """Yield random actions: at first a small one, then large ones of random sign."""
    random = np.random.default_rng(seed)
    space = env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    yield random.uniform(space.low, space.high) * 0.2
    while True:
        # Lasting torques heat the motors.
        yield space.high * random.choice([-1.0, 1.0], space.shape) * random.uniform(0.8, 1.0)


def assert_equal(first: Any, second: Any, path: str = "") -> None:
    """Assert that two values have the same type and the same bits, also for NaN.

    Args:
        first: A value, or a dictionary or array of values.
        second: The other value.
        path: Where the values are, for the message of a failure.
    """
    assert type(first) is type(second), path
    if isinstance(first, dict):
        assert first.keys() == second.keys(), path
        for key, value in first.items():
            assert_equal(value, second[key], f"{path}/{key}")
    elif isinstance(first, np.ndarray):
        assert (first.dtype, first.shape) == (second.dtype, second.shape), path
        if first.dtype == object:
            for first_item, second_item in zip(first, second, strict=True):
                assert_equal(first_item, second_item, path)
        else:
            assert first.tobytes() == second.tobytes(), path
    elif isinstance(first, float):
        assert np.float64(first).tobytes() == np.float64(second).tobytes(), path
    else:
        assert first == second, path


def run_episodes(env: SnakeEnv) -> list[Any]:
    """Run two episodes, and return everything that the environment has returned."""
    returned: list[Any] = []
    actions = draw_actions(env, seed=5)
    for seed in (3, 4):
        returned += env.reset(seed=seed)
        is_over = False
        while not is_over:
            step = env.step(next(actions))
            returned += step
            is_over = step[2] or step[3]
    env.close()
    return returned


@pytest.mark.heavy
@pytest.mark.parametrize("name", EVERY_CASE)
def test_environment_on_arrays_has_bits_of_hal_limiter(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = CASES[name]
    with_arrays = run_episodes(make_environment(case, duration=1.0))

    def never_use_arrays(_config: RunConfig) -> bool:
        return False

    monkeypatch.setattr(snakesim.environments.robots, "can_arm", never_use_arrays)
    with_hal = run_episodes(make_environment(case, duration=1.0))
    for number, (array_value, hal_value) in enumerate(zip(with_arrays, with_hal, strict=True)):
        assert_equal(array_value, hal_value, f"{number}")


QUICK_RESETS = (
    ("angles that jump", AutoresetMode.SAME_STEP),
    ("positions among obstacles", AutoresetMode.SAME_STEP),
    ("hot motors that are isolated", AutoresetMode.NEXT_STEP),
    ("delayed sensors", AutoresetMode.NEXT_STEP),
)
EVERY_RESET = [
    pytest.param(
        name,
        mode,
        id=f"{name}-{mode.name}",
        marks=() if (name, mode) in QUICK_RESETS else pytest.mark.slow,
    )
    for name in CASES
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
]


@pytest.mark.heavy
@pytest.mark.parametrize(("name", "mode"), EVERY_RESET)
def test_vector_environment_rows_have_bits_of_single_environments(
    name: str, mode: AutoresetMode
) -> None:
    """Gymnasium steps single environments one after the other, and merges their infos."""
    case = CASES[name]
    batch_envs = make_vector_environment(case, 3, autoreset_mode=mode)
    sync_envs = gymnasium.vector.SyncVectorEnv(
        [lambda: make_environment(case)] * 3, autoreset_mode=mode
    )
    seeds: list[int | None] = [3, 4, 5]
    for batch_value, sync_value in zip(
        batch_envs.reset(seed=seeds), sync_envs.reset(seed=seeds), strict=True
    ):
        assert_equal(batch_value, sync_value)
    action_sources = [draw_actions(make_environment(case), seed) for seed in (1, 2, 3)]
    for number in range(30):  # more than two episodes
        actions = np.array([next(source) for source in action_sources], dtype=np.float32)
        for batch_value, sync_value in zip(
            batch_envs.step(actions), sync_envs.step(actions), strict=True
        ):
            assert_equal(batch_value, sync_value, f"step {number}")
    batch_envs.close()
    sync_envs.close()


def test_vector_environment_without_autoreset_is_reset_by_mask() -> None:
    case = CASES["torques"]
    envs = make_vector_environment(case, 3, autoreset_mode="Disabled", duration=0.06)
    still = np.zeros((3, 13))
    envs.reset(seed=1)
    envs.step(still)
    _, _, _, truncated, infos = envs.step(still)
    assert truncated.all()
    assert infos["_digest"].all()
    with raises_error(gymnasium.error.ResetNeeded):
        envs.step(still)
    first_two = np.array([True, True, False])
    _, infos = envs.reset(seed=[7, 8, None], options={"reset_mask": first_two})
    assert infos["seed"].tolist() == [7, 8, 0]
    assert infos["_seed"].tolist() == first_two.tolist()
    with raises_error(gymnasium.error.ResetNeeded):
        envs.step(still)
    envs.reset(options={"reset_mask": ~first_two})
    observations, *_ = envs.step(still)
    single_env = make_environment(case, duration=0.06)
    single_env.reset(seed=8)
    expected, *_ = single_env.step(still[0])
    assert_equal({name: values[1] for name, values in observations.items()}, expected)
    envs.close()


@pytest.mark.heavy
@pytest.mark.parametrize("count", [6, pytest.param(64, marks=pytest.mark.slow)])
def test_vector_environment_with_more_threads_has_same_bits(count: int) -> None:
    case = CASES["positions among obstacles"]
    digests: set[tuple[str, ...]] = set()
    observation_bytes: set[bytes] = set()
    for thread_count in (1, 2, 4):
        envs = make_vector_environment(case, count, thread_count=thread_count, duration=0.2)
        actions = draw_actions(make_environment(case), seed=1)
        envs.reset(seed=1)
        for _ in range(3):
            envs.step(np.tile(next(actions), (count, 1)))
        observations, _, _, _, infos = envs.step(np.tile(next(actions), (count, 1)))
        envs.close()
        digests.add(tuple(infos["digest"]))
        observation_bytes.add(observations.tobytes())
    assert len(digests) == 1
    assert len(observation_bytes) == 1
    assert len({*digests.pop()}) > 1


@pytest.mark.heavy
def test_vector_environment_in_loop_has_bits_of_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop steps the simulations if the laws run in Python; otherwise a batch in C does."""
    if choose_laws() == "python":
        pytest.skip("there is no C version of the laws here")

    def run_steps() -> tuple[Any, type[Any]]:
        envs = make_vector_environment(CASES["delayed sensors"], 3)
        envs.reset(seed=1)
        actions = draw_actions(make_environment(CASES["delayed sensors"]), seed=1)
        returned = [envs.step(np.tile(next(actions), (3, 1))) for _ in range(16)]
        simulations = envs._episodes.robots._batch.simulation._simulations  # pyright: ignore
        envs.close()
        return returned, type(simulations)

    batched, batch_type = run_steps()
    monkeypatch.setattr(batch_robots, "choose_laws", lambda: "python")
    looped, loop_type = run_steps()
    assert (batch_type, loop_type) == (BatchedSimulations, LoopedSimulations)
    for batch_step, loop_step in zip(batched, looped, strict=True):
        for batch_value, loop_value in zip(batch_step, loop_step, strict=True):
            assert_equal(batch_value, loop_value)


def test_vector_environment_with_diverged_simulation_stops_only_that_one() -> None:
    still = np.zeros(13)
    reasons: list[str] = []
    for envs in (SnakeVectorEnv(3, scenario="triplet"), SnakeEnv("triplet")):
        envs.reset(seed=1)
        action = still if isinstance(envs, SnakeEnv) else np.tile(still, (3, 1))
        envs.step(action)
        episodes = envs._episodes
        simulations = episodes.robots._batch.simulation._simulations  # pyright: ignore
        simulations.base_velocity[0, 0] = 1e4
        _, _, terminated, _, infos = envs.step(action)
        if isinstance(envs, SnakeEnv):
            reasons.append(infos["reason"])
        else:
            assert np.array_equal(terminated, [True, False, False])
            assert infos["_reason"].tolist() == [True, False, False]
            reasons.append(infos["reason"][0])
            _, _, terminated, _, infos = envs.step(action)
            assert not terminated.any()
            assert infos["time_s"].round(6).tolist() == [0.0, 0.15, 0.15]
        envs.close()
    assert reasons[0] == reasons[1]
    assert "diverged at tick 6" in reasons[0]


@pytest.mark.heavy
def test_vector_environment_of_different_scenes_has_single_digests() -> None:
    case: Case = (
        "surveyed_clutter",
        {"randomize": {"scene.random_field.0.density_per_m2": (5.0, 12.0)}},
    )
    envs = make_vector_environment(case, 4, duration=0.1)
    envs.reset(seed=1)
    still = np.zeros((4, 13))
    envs.step(still)
    _, _, _, _, infos = envs.step(still)
    envs.close()
    for row, seed in enumerate((1, 2, 3, 4)):
        single_env = make_environment(case, duration=0.1)
        single_env.reset(seed=seed)
        single_env.step(still[0])
        assert single_env.step(still[0])[4]["digest"] == infos["digest"][row]


def test_vector_environment_of_different_slopes_has_single_bits() -> None:
    """Every row has the gravity of its own scene."""
    slopes = {"scene.ground.slope_rad": (0.05, 0.3), "scene.gravity_m_s2": (1.6, 9.81)}
    case: Case = ("slope", {"randomize": slopes, "observe": ("velocity_w_m_s",)})
    envs = make_vector_environment(case, 3)
    envs.reset(seed=1)
    still = np.zeros((3, 13))
    envs.step(still)
    velocities_m_s = envs.step(still)[0]
    envs.close()
    assert len(np.unique(velocities_m_s[:, 0])) == 3
    for row, seed in enumerate((1, 2, 3)):
        single_env = make_environment(case)
        single_env.reset(seed=seed)
        single_env.step(still[0])
        assert_equal(single_env.step(still[0])[0], velocities_m_s[row])


@pytest.mark.parametrize(
    ("scenario", "randomized"),
    [
        (
            "swimming",
            {
                "scene.fluid.density_kg_m3": (500.0, 1500.0),
                "scene.fluid.viscosity_pa_s": (0.0, 5.0),
            },
        ),
        (
            "pipe",
            {"scene.pipe.0.inner_radius_m": (0.07, 0.105), "scene.pipe.0.friction": (0.1, 0.9)},
        ),
    ],
)
def test_vector_environment_of_different_fluids_and_pipes_has_single_bits(
    scenario: str, randomized: dict[str, tuple[float, float]]
) -> None:
    case: Case = (scenario, {"randomize": randomized, "observe": ("velocity_w_m_s",)})
    envs = make_vector_environment(case, 3)
    envs.reset(seed=1)
    bent = np.tile(np.linspace(-0.5, 0.5, 13), (3, 1))
    for _ in range(4):
        envs.step(bent)
    velocities_m_s = envs.step(bent)[0]
    envs.close()
    assert len(np.unique(velocities_m_s[:, 0])) == 3
    for row, seed in enumerate((1, 2, 3)):
        single_env = make_environment(case)
        single_env.reset(seed=seed)
        for _ in range(4):
            single_env.step(bent[0])
        assert_equal(single_env.step(bent[0])[0], velocities_m_s[row])


def test_vector_environment_works_in_wrappers_of_gymnasium() -> None:
    envs = DictInfoToList(
        RecordEpisodeStatistics(make_vector_environment(CASES["torques"], 2, duration=0.06))
    )
    envs.reset(seed=1)
    envs.step(np.zeros((2, 13)))
    _, _, _, _, infos = envs.step(np.zeros((2, 13)))
    envs.close()
    assert [info["ended"] for info in infos] == ["time", "time"]
    assert infos[0]["episode"]["l"] == 2


INVALID_ARGUMENTS = [
    {"num_envs": 0},
    {"num_envs": 2.0},
    {"thread_count": 0},
    {"thread_count": 1.5},
    {"autoreset_mode": "sometimes"},
]


@pytest.mark.parametrize("arguments", INVALID_ARGUMENTS)
def test_vector_environment_with_invalid_arguments_is_refused(arguments: dict[str, Any]) -> None:
    with raises_error(snakesim.ConfigError, code="python/invalid-argument"):
        SnakeVectorEnv(**{"num_envs": 2, "scenario": "triplet", **arguments})
