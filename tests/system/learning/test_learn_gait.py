"""The programs in examples/learning tune a wave, learn corrections with PPO, and write policies that drive a robot."""

import csv
import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import snakesim
from snakesim.environments import SnakeEnv, SnakeVectorEnv
from snakesim.training.episodes import EpisodeRunner
from snakesim.training.exported import read_learned_parameters, write_onnx_file
from snakesim.training.form import OBSERVE, PolicyArrays
from snakesim_gnc.control.policy import PolicyModel
from snakesim_testing.runs.documents import REPOSITORY

EXAMPLE = REPOSITORY / "examples" / "learning"
WAVE = {
    "amplitude": 0.7,
    "growth": 0.1,
    "omega": 3.1,
    "lag": 0.5,
    "steering": 0.1,
    "head_steering": 0.05,
}
SHORT_S = 0.2  # duration of an episode
SHORT_TICKS = 20
SEED = 7
MISSING = "the recipe needs `pip install stable-baselines3 tensorboard onnxscript`"


@pytest.fixture(autouse=True)
def _add_examples_to_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find the modules of the recipe, as Python does when one of its programs is started."""
    monkeypatch.syspath_prepend(EXAMPLE)


@pytest.fixture
def task(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The task of the recipe, with short episodes."""
    module = importlib.import_module("gait_task")
    monkeypatch.setitem(module.ENVIRONMENT, "duration", SHORT_S)
    monkeypatch.setattr(module, "TICKS_PER_EPISODE", SHORT_TICKS)
    return module


@pytest.fixture
def wave_file(tmp_path: Path) -> Path:
    """A policy file with a wave, as tune_serpenoid.py writes it."""
    env = SnakeEnv("scales", observe=OBSERVE)
    axes = [joint.axis for joint in env.description.joints]
    sizes = {name: len(part.names) for name, part in env.parts.items()}
    policy = PolicyArrays.make_from_parameters(WAVE, axes, sizes)
    write_onnx_file(tmp_path / "wave.onnx", policy, WAVE, 1, ["tune_serpenoid.py"])
    return tmp_path / "wave.onnx"


def test_wave_correction_with_zero_action_changes_nothing(task: Any, wave_file: Path) -> None:
    correction = importlib.import_module("wave_correction")
    wave = task.load_wave(str(wave_file))
    plain = task.make_environments(2)
    corrected = correction.WaveCorrection(task.make_environments(2), wave)
    observations, _ = plain.reset(seed=SEED)
    assert np.array_equal(corrected.reset(seed=SEED)[0], observations)
    no_correction = np.zeros(corrected.action_space.shape, dtype=np.float32)
    for _ in range(SHORT_TICKS + 2):  # The last steps belong to the next episode.
        observations, rewards, *_ = plain.step(wave.compute_targets(observations))
        corrected_observations, corrected_rewards, *_ = corrected.step(no_correction)
        assert np.array_equal(corrected_observations, observations)
        assert np.array_equal(corrected_rewards, rewards)


def test_wave_correction_shapes_are_smooth_along_the_body() -> None:
    correction = importlib.import_module("wave_correction")
    shapes_rad = correction.make_shapes_rad(13)
    assert shapes_rad.shape == (correction.SHAPE_COUNT, 13)
    assert np.allclose(shapes_rad[0], correction.MAX_CORRECTION_RAD)
    sign_changes = (np.diff(np.sign(shapes_rad[1:] + 1e-6), axis=1) != 0).sum(axis=1)
    assert sign_changes.tolist() == list(range(1, correction.SHAPE_COUNT))


@pytest.mark.heavy
def test_measured_policy_has_one_episode_of_each_seed(task: Any, wave_file: Path) -> None:
    result = task.measure_policy(str(wave_file), SEED, 3)
    with EpisodeRunner(task.ENVIRONMENT, worker_count=1) as runner:
        (episodes,) = runner.run([WAVE], range(SEED, SEED + 3))
    # The numbers differ slightly, because onnxruntime rounds a sine in other ways than NumPy.
    assert np.allclose(result.advance_m, [episode.advance_m for episode in episodes], atol=1e-6)
    assert np.allclose(result.energy_j, [episode.energy_j for episode in episodes], rtol=1e-4)


@pytest.mark.heavy
def test_tuned_serpenoid_with_smaller_energy_budget_uses_less_energy(
    task: Any, tmp_path: Path
) -> None:
    tuning = importlib.import_module("tune_serpenoid")
    generations = 3
    ticks = generations * tuning.POPULATION * tuning.EPISODES_PER_WAVE * SHORT_TICKS
    results: dict[float, Any] = {}
    for budget_j in (1e-3, 1e3):
        out = tmp_path / f"{budget_j}.onnx"
        wave = tuning.tune_serpenoid(budget_j, ticks, SEED, out)
        assert read_learned_parameters(str(out)) == pytest.approx(wave, abs=1e-6)
        results[budget_j] = task.measure_policy(str(out), SEED, 2)
    assert results[1e-3].energy_j.mean() < 0.9 * results[1e3].energy_j.mean()


@pytest.fixture
def adapter() -> ModuleType:
    """The adapter for Stable-Baselines3."""
    pytest.importorskip("stable_baselines3", reason=MISSING)
    return importlib.import_module("batch_vec_env")


def test_adapter_at_episode_end_returns_its_last_observation(adapter: Any, task: Any) -> None:
    plain = task.make_environments(2)
    env = adapter.BatchVecEnv(task.make_environments(2))
    env.seed(SEED)
    observations, _ = plain.reset(seed=SEED)
    assert np.array_equal(env.reset(), observations)
    actions = np.full((2, 13), 0.1, dtype=np.float32)

    def compare_step() -> tuple[Any, list[dict[str, Any]], dict[str, Any]]:
        """Step both, and return the ends, the infos of the adapter, and those of the environments."""
        observations, rewards, _, _, infos = plain.step(actions)
        adapted_observations, adapted_rewards, is_over, adapted_infos = env.step(actions)
        assert np.array_equal(adapted_observations, observations)
        assert np.allclose(adapted_rewards, rewards)
        return is_over, adapted_infos, infos

    for _ in range(SHORT_TICKS - 1):
        is_over, adapted_infos, _ = compare_step()
        assert not is_over.any()
        assert adapted_infos == [{}, {}]
    is_over, adapted_infos, infos = compare_step()
    assert is_over.all()
    assert infos["time_s"].tolist() == [0.0, 0.0], "the next episodes have begun"
    time_index = OBSERVE.index("time_s")
    for row, info in enumerate(adapted_infos):
        assert np.array_equal(info["terminal_observation"], infos["final_obs"][row])
        assert info["terminal_observation"][time_index] == pytest.approx(SHORT_S)
        assert info["TimeLimit.truncated"] is True


def test_adapter_after_fault_reports_no_time_limit(adapter: Any) -> None:
    arguments = {"scenario": "triplet", "set": {"faults": ["nan:joint_3@0.1"]}}
    env = adapter.BatchVecEnv(SnakeVectorEnv(1, autoreset_mode="SameStep", **arguments))
    env.reset()
    actions = np.zeros((1, *env.action_space.shape), dtype=np.float32)
    for _ in range(20):  # steps of 50 ms
        _, _, is_over, infos = env.step(actions)
        if is_over[0]:
            assert infos[0]["TimeLimit.truncated"] is False
            return
    pytest.fail("the fault has not stopped the robot")


def test_adapter_of_environments_with_next_step_reset_is_refused(adapter: Any) -> None:
    with pytest.raises(ValueError, match="NextStep"):
        adapter.BatchVecEnv(SnakeVectorEnv(1, scenario="triplet"))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_ppo_training_resumes_and_its_policy_drives_the_robot(
    wave_file: Path, tmp_path: Path
) -> None:
    for package in ("stable_baselines3", "tensorboard", "onnxscript"):
        pytest.importorskip(package, reason=MISSING)
    out = tmp_path / "ppo"
    command = [sys.executable, str(EXAMPLE / "learn_gait_ppo.py"), "--wave", str(wave_file)]
    command += ["--out", str(out), "--check-ticks", "6400", "--tensorboard", str(tmp_path / "log")]
    subprocess.run([*command, "--ticks", "12800", "--film-ticks", "6400"], check=True, timeout=400)
    assert (out / "gait-6400.mp4").stat().st_size > 1000
    resume = ["--resume", str(out / "checkpoint.zip"), "--ticks", "19200"]
    subprocess.run([*command, *resume], check=True, timeout=400)

    with (out / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["ticks"]) for row in rows] == [0, 6400, 12800, 19200]
    processor_s = [float(row["processor_s"]) for row in rows]
    assert processor_s == sorted(processor_s)
    assert len(list((tmp_path / "log").rglob("events.out.tfevents.*"))) == 2

    # The policy computes the same bits in the environment and as a controller of the HAL.
    policy = out / "policy.onnx"
    env = SnakeEnv("scales", observe=OBSERVE, frame_skip=1, duration=1.0)
    model = PolicyModel(env.description, str(policy))
    observation, info = env.reset(seed=SEED)
    is_over = False
    while not is_over:
        observation, _, _, is_over, info = env.step(model(np.asarray(observation)))
    run = snakesim.run("scales", controller=f"policy:{policy}", duration=1.0, seed=SEED)
    assert run.complete
    assert run.digest == info["digest"]


@pytest.mark.slow
def test_exported_policy_computes_the_corrected_wave(wave_file: Path, tmp_path: Path) -> None:
    for package in ("stable_baselines3", "onnxscript"):
        pytest.importorskip(package, reason=MISSING)
    task = importlib.import_module("gait_task")
    network = importlib.import_module("gait_network")
    learning = importlib.import_module("learn_gait_ppo")
    wave = task.load_wave(str(wave_file))
    policy = learning.make_model(wave, None, None).policy
    policy.action_net.bias.data += 0.3
    network.export_policy(policy, wave, "a test", tmp_path / "policy.onnx")
    env = SnakeEnv("scales", observe=OBSERVE)
    model = PolicyModel(env.description, str(tmp_path / "policy.onnx"))
    random = np.random.default_rng(SEED)
    observations = random.normal(size=(20, len(env.observation_names))).astype(np.float32)
    targets_rad = network.CorrectedWave(policy, wave).compute_targets_rad(observations)
    assert np.allclose([model(observation) for observation in observations], targets_rad, atol=1e-4)
    assert not np.allclose(targets_rad, wave.compute_targets(observations), atol=0.1)
