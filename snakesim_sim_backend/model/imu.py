"""The IMUs in the model: a gyroscope and an accelerometer at the middle of every link, axes as the link's frame."""

from collections.abc import Sequence

import mujoco


def add_imus(spec: mujoco.MjSpec, link_lengths_m: Sequence[float]) -> None:
    """Add IMUs to a model whose links are complete. In `sensordata` all gyroscopes come first, tail to head."""
    sites: list[str] = []
    for i, length in enumerate(link_lengths_m):
        sites.append(f"imu_{i}")
        spec.body(f"link_{i}").add_site(name=sites[i], pos=[length / 2, 0.0, 0.0])
    for kind in (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER):
        for site in sites:
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)
