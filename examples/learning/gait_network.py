"""The features of the policy that corrects the wave, and its export as a file that `snakesim run` accepts."""

from pathlib import Path

import numpy as np
import onnx
import torch
from gait_task import FRAME_SKIP
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from wave_correction import make_shapes_rad

from snakesim.training.form import OBSERVE, RAMP_PER_S, PolicyArrays
from snakesim_gnc.control import policy as policy_file
from snakesim_hal.model.textfiles import export_atomically

HARMONICS = 2  # of the wave
BEARING_GAIN = 3.0  # so that a bearing of 20 degrees counts as 1
OPSET_VERSION = 18  # one that every onnxruntime from 1.20 on reads


class PhaseFeatures(BaseFeaturesExtractor):
    """Turns an observation into the phase of the wave, with its harmonics, and the bearing of the first heading."""

    def __init__(self, observation_space: spaces.Box, omega_rad_s: float) -> None:
        """Prepare the features.

        Args:
            observation_space: Space of observations whose first parts are the time in s and the bearing.
            omega_rad_s: Frequency of the wave.
        """
        super().__init__(observation_space, features_dim=2 * HARMONICS + 2)
        self.register_buffer("omegas_rad_s", omega_rad_s * torch.arange(1.0, HARMONICS + 1))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the features, (n, features_dim)."""
        time_s = observations[:, :1]
        bearing_sine = observations[:, 2:3]
        phases_rad = time_s * self.omegas_rad_s
        ramp = torch.clamp(RAMP_PER_S * time_s, max=1.0)
        # A higher harmonic moves the joints faster, so it counts less.
        weights = 1.0 / torch.arange(1.0, HARMONICS + 1)
        harmonics = [weights * torch.sin(phases_rad), weights * torch.cos(phases_rad)]
        return torch.cat([*harmonics, ramp, BEARING_GAIN * bearing_sine], dim=1)


class CorrectedWave(torch.nn.Module):
    """Computes what `WaveCorrection` computes with the mean action of the network: a target for each joint."""

    def __init__(self, network: ActorCriticPolicy, wave: PolicyArrays) -> None:
        super().__init__()
        self.network = network
        for name, array in vars(wave).items():
            self.register_buffer(name, torch.from_numpy(array))
        self.register_buffer("shapes_rad", torch.from_numpy(make_shapes_rad(len(wave.lag))))

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        """Return the targets in rad, (n, joints)."""
        features = self.network.extract_features(seen, self.network.pi_features_extractor)
        latent = self.network.mlp_extractor.forward_actor(features)
        action = torch.clamp(self.network.action_net(latent), -1.0, 1.0)

        time = seen @ self.time
        ramp = torch.clamp(RAMP_PER_S * time, max=1.0)
        wave_rad = ramp * self.amplitude * torch.sin(time * self.omega - self.lag)
        return wave_rad + seen @ self.steering + action @ self.shapes_rad

    def compute_targets_rad(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the targets of all joints, (n, joints), for n observations."""
        with torch.no_grad():
            return self(torch.from_numpy(observations)).numpy()


def export_policy(network: ActorCriticPolicy, wave: PolicyArrays, command: str, out: Path) -> None:
    """Write the policy as an ONNX file with the metadata that the controller `policy` needs.

    Args:
        network: The trained network.
        wave: The wave that it corrects.
        command: Command line of the training, which is stored in the file.
        out: File to write.
    """
    seen = torch.zeros(1, network.observation_space.shape[0])
    program = torch.onnx.export(
        CorrectedWave(network, wave).eval(),
        (seen,),
        input_names=["seen"],
        output_names=["target_rad"],
        opset_version=OPSET_VERSION,
        dynamo=True,
        verbose=False,
    )
    assert program is not None, "the exporter with dynamo=True returns the program"
    model = program.model_proto
    metadata = {
        policy_file.OBSERVATIONS_KEY: ",".join(OBSERVE),
        policy_file.ACTION_KEY: "position",
        policy_file.JOINTS_KEY: str(len(wave.lag)),
        policy_file.FRAME_SKIP_KEY: str(FRAME_SKIP),
        "snakesim.trained_by": command,
    }
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    with export_atomically(out) as partial:
        onnx.save(model, partial)
