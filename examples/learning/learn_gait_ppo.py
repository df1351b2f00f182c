"""Learn a gait with PPO: a small network corrects a serpenoid wave, and becomes a policy file for `snakesim run`.

    pip install stable-baselines3 tensorboard onnxscript
    python examples/learning/learn_gait_ppo.py --wave runs/gait/wave.onnx --out runs/gait/ppo

The folder of --out gets the newest checkpoint, the learning curve, videos, and the best policy so far.
"""

import argparse
import sys
from pathlib import Path

import gait_task

# isort: split
import numpy as np
import torch
from batch_vec_env import BatchVecEnv
from gait_network import CorrectedWave, PhaseFeatures, export_policy
from learning_curve import CURVE_FILE, CurveRow, append_row, measure_processor_s, read_rows
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor
from wave_correction import WaveCorrection

import snakesim
from snakesim.training.form import PolicyArrays

ENVIRONMENT_COUNT = 32
VALIDATION_EPISODES = 8
FILM_S = 5.0
ENERGY_WEIGHT_M_PER_J = 0.005  # advance for which the policy may spend a joule
REWARD_PER_M = 20.0  # so that the discounted return is about 1
REWARD = {
    "advance": REWARD_PER_M,
    "energy": -REWARD_PER_M * ENERGY_WEIGHT_M_PER_J,
    "limited": 0.0,
}
# The policy is linear in its features, so it learns a Fourier series for each shape of the body.
NETWORK = {"net_arch": {"pi": [], "vf": [64, 64]}, "log_std_init": -2.7}
HYPERPARAMETERS = {
    "n_steps": 200,  # of each environment, about one period: 6400 samples for an update
    "batch_size": 1600,
    "n_epochs": 8,
    "learning_rate": 1e-3,
    "gamma": 0.998,  # a horizon of 5 s
    "gae_lambda": 0.995,
    "target_kl": 0.05,
    # Exploration that depends on the phase is smooth in time. White noise at 100 Hz would only shake the joints.
    "use_sde": True,
    "sde_sample_freq": -1,  # new exploration for each update, since each change is a jump
}
CHECKPOINT_FILE = "checkpoint.zip"
POLICY_FILE = "policy.onnx"


class GaitCallback(BaseCallback):
    """Checks the policy regularly: measures it, keeps a checkpoint and the best policy, and films it now and then."""

    def __init__(self, wave: PolicyArrays, out: Path, check_ticks: int, film_ticks: int) -> None:
        """Prepare the checks.

        Args:
            wave: The wave that the policy corrects.
            out: Folder for the checkpoint, the policy, the learning curve and the videos.
            check_ticks: Ticks of training between two checks.
            film_ticks: Ticks of training between two videos. 0 makes none.
        """
        super().__init__()
        self._wave = wave
        self._out = out
        self._check_ticks = check_ticks
        self._film_ticks = film_ticks
        rows = read_rows(out / CURVE_FILE)
        self._is_curve_empty = not rows
        self._best_score_m = max((row.score_m for row in rows), default=-np.inf)
        self._earlier_processor_s = rows[-1].processor_s if rows else 0.0

    def _on_training_start(self) -> None:
        self._next_check = self.num_timesteps + self._check_ticks
        self._next_film = self.num_timesteps + self._film_ticks
        if self._is_curve_empty:
            self._check()  # the wave alone: the corrections are still almost 0

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next_check:
            self._next_check += self._check_ticks
            self._check()
        if self._film_ticks and self.num_timesteps >= self._next_film:
            self._next_film += self._film_ticks
            self._film()

    def _on_training_end(self) -> None:
        self._check()

    def _on_step(self) -> bool:
        return True  # go on

    def _check(self) -> None:
        """Measure the policy without exploration on the validation seeds, and keep a checkpoint."""
        gait = CorrectedWave(self.model.policy, self._wave)
        result = gait_task.measure_gait(
            gait.compute_targets_rad, gait_task.VALIDATION_SEED, VALIDATION_EPISODES
        )
        advance_m = float(result.advance_m.mean())
        energy_j = float(result.energy_j.mean())
        score_m = advance_m - ENERGY_WEIGHT_M_PER_J * energy_j
        processor_s = self._earlier_processor_s + measure_processor_s()
        print(
            f"{self.num_timesteps} ticks: {advance_m:.3f} m, {energy_j:.1f} J, "
            f"{processor_s:.0f} s of processor time",
            flush=True,
        )
        for name, value in (("advance_m", advance_m), ("energy_j", energy_j), ("score_m", score_m)):
            self.logger.record(f"check/{name}", value)
        self.logger.dump(self.num_timesteps)

        self.model.save(self._out / CHECKPOINT_FILE)
        row = CurveRow(self.num_timesteps, advance_m, energy_j, score_m, processor_s)
        append_row(self._out / CURVE_FILE, row)
        if score_m > self._best_score_m:
            self._best_score_m = score_m
            self._export(self._out / POLICY_FILE)

    def _film(self) -> None:
        """Run the policy as a controller, with the HAL and its limiter, and write a video of the run."""
        policy = self._out / "filmed.onnx"
        self._export(policy)
        run = snakesim.run(gait_task.SCENARIO, controller=f"policy:{policy}", duration=FILM_S)
        video = self._out / f"gait-{self.num_timesteps}.mp4"
        run.video(video, width=480, height=270, fps=15.0)  # small, since it is drawn without a GPU

    def _export(self, out: Path) -> None:
        export_policy(self.model.policy, self._wave, " ".join(sys.argv), out)


def make_model(wave: PolicyArrays, resume: Path | None, tensorboard: Path | None) -> PPO:
    """Return the model with its environments: a new one, or the one of a checkpoint."""
    vector_env = gait_task.make_environments(ENVIRONMENT_COUNT, reward=REWARD)
    env = VecMonitor(BatchVecEnv(WaveCorrection(vector_env, wave)))
    if resume is not None:
        model = PPO.load(resume, env=env, tensorboard_log=tensorboard)
        # Otherwise the episodes of the first training would be repeated.
        model.set_random_seed(gait_task.TRAINING_SEED + model.num_timesteps)
        return model
    network = {
        **NETWORK,
        "features_extractor_class": PhaseFeatures,
        "features_extractor_kwargs": {"omega_rad_s": float(wave.omega[0])},
    }
    return PPO(
        "MlpPolicy",
        env,
        policy_kwargs=network,
        tensorboard_log=tensorboard,
        seed=gait_task.TRAINING_SEED,
        device="cpu",
        **HYPERPARAMETERS,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wave", required=True, help="policy file of tune_serpenoid.py")
    parser.add_argument("--out", type=Path, required=True, help="folder of what is learned")
    parser.add_argument("--ticks", type=int, default=500_000, help="control cycles to train on")
    parser.add_argument("--check-ticks", type=int, default=100_000, help="between two checks")
    parser.add_argument("--film-ticks", type=int, default=0, help="between two videos; 0: none")
    parser.add_argument("--resume", type=Path, metavar="FILE", help="checkpoint to continue from")
    parser.add_argument("--tensorboard", type=Path, metavar="FOLDER", help="folder of event files")
    arguments = parser.parse_args()

    torch.set_num_threads(1)  # more threads make such a small network slower
    arguments.out.mkdir(parents=True, exist_ok=True)
    wave = gait_task.load_wave(arguments.wave)
    model = make_model(wave, arguments.resume, arguments.tensorboard)
    callback = GaitCallback(wave, arguments.out, arguments.check_ticks, arguments.film_ticks)
    is_new = arguments.resume is None
    remaining_ticks = arguments.ticks - model.num_timesteps
    try:
        model.learn(max(remaining_ticks, 0), callback=callback, reset_num_timesteps=is_new)
    except KeyboardInterrupt:
        print(f"stopped; continue with --resume {arguments.out / CHECKPOINT_FILE}")


if __name__ == "__main__":
    main()
