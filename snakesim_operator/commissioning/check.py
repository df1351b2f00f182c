"""`snakesim joints check`: the record of a run of the joint check, judged and printed."""

from datetime import date
from pathlib import Path

import numpy as np

from snakesim_hal.arrays import Floats
from snakesim_hal.errors import ConfigError
from snakesim_hal.model.checked import Checked, mounting_digest
from snakesim_hal.model.kinematics import rotation_from_quaternion
from snakesim_hal.process import user_name
from snakesim_hal.terminal import say
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Imu
from snakesim_operator.commissioning.judge import Measured, judged
from snakesim_operator.commissioning.robot_edit import joints_on_drives, must_be_own, write_checked
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.record import RunRecord


def check(run: Path, path: Path | None, *, straight: bool, by_hand: bool) -> int:
    """Print a line a joint. Returns 0 when each is as the robot file says. Raises ConfigError.

    path: robot file into which to write that it was checked; by_hand: what could not be judged was turned by hand.
    """
    record = RunRecord.load(run)
    if record.config.controller != "joint_check":
        raise ConfigError(
            f"{run}: its controller was {record.config.controller!r}; make a run with `snakesim run joint_check`, or "
            "any other scenario with --controller joint_check"
        )
    rows = judged(_measured(record), straight=straight)
    for row in rows:
        moved = f"moved {row.moved_rad:5.3f} rad" if row.moved_rad is not None else "not moved yet  "
        turned = "link unknown    " if row.turned is None else f"link {row.turned:+5.2f} of it"
        say(f"{row.joint:10}  {moved}  {turned}  {row.verdict}")
    unknown = [row.joint for row in rows if row.unknown and by_hand]
    wrong = sum(not row.as_told and row.joint not in unknown for row in rows)
    told = f", {len(unknown)} of them as somebody found by hand" if unknown else ""
    say(f"{len(rows) - wrong} of {len(rows)} joints are as the robot file says{told}")
    unseen = [joint.name for joint in record.description.joints if joint.axis == "yaw"]
    if unseen and not straight:
        say(f"not judged: the zeros of {', '.join(unseen)}; lay the robot straight, run again, and add --straight")
    if path is not None:
        _write(path, record, unknown, wrong=wrong)
    return 1 if wrong else 0


def _write(path: Path, record: RunRecord, by_hand: list[str], *, wrong: int) -> None:
    """That it was checked, by whom, when, on which drives. Raises ConfigError."""
    robot, joints = record.description, record.config.robot.joint_table
    must_be_own(path)
    if robot.emulated:
        raise ConfigError(f"{record.folder}: its drives were emulated, which says nothing of a real robot; not written")
    if mounting_digest(joints_on_drives(path, joints)) != mounting_digest(joints):
        raise ConfigError(f"{path}: says otherwise how the joints are mounted than in {record.folder}; check it again")
    if wrong:
        say(f"{path}: nothing was written: {wrong} joints are not as it says, or could not be judged (--by-hand)")
        return
    checked = Checked(
        by=user_name(),
        on=date.today().isoformat(),
        joints=mounting_digest(joints),
        backend=robot.backend,
        hardware=robot.hardware,
        serials=[joint.serial for joint in robot.joints] if any(joint.serial for joint in robot.joints) else [],
        by_hand=by_hand,
    )
    write_checked(path, checked)
    say(f"{path}: checked by {checked.by} on {checked.on}; restart the host with it, and it is armed as any other")


def _measured(record: RunRecord) -> Measured:
    """What joints, IMUs and motion capture say."""
    config, robot, decoder = record.config, record.description, Decoder(Imu)
    path = record.folder if record.alone else record.folder / RECORDING
    ticks = np.round(record.time_s * config.rate_hz).astype(int).tolist()
    rows = {tick: row for row, tick in enumerate(ticks)}
    rates, forces = (np.full((len(rows), len(robot.links), 3), np.nan) for _ in range(2))
    for message in RecordingReader(path).messages([keys.IMU]):
        imu = decoder.decode(message.payload, message.encoding)
        row = rows.get(imu.tick)
        if row is not None:
            rates[row, imu.link] = imu.angular_velocity_rad_s
            forces[row, imu.link] = imu.acceleration_m_s2
    late = 0 if config.robot.sensors.pose is None else round(config.robot.sensors.pose.delay_s * config.rate_hz)
    poses = np.full_like(record.orientation_wxyz, np.nan)
    poses[: len(poses) - late] = record.orientation_wxyz[late:]
    return Measured(
        names=[joint.name for joint in robot.joints],
        axes=[joint.axis for joint in robot.joints],
        drives=[joint.drive for joint in config.robot.joint_table],
        angle_rad=record.angle_rad,
        velocity_rad_s=record.velocity_rad_s,
        torque_nm=record.torque_nm,
        target_rad=record.target,
        link_rate_rad_s=rates,
        link_force_m_s2=forces,
        base_turn_rad=_turns(poses),
    )


def _turns(wxyz: Floats) -> Floats:
    """Small rotations from the first known orientation, (n, 3)."""
    turns = np.full((len(wxyz), 3), np.nan)
    known = np.flatnonzero(np.isfinite(wxyz).all(axis=1) & (np.abs(wxyz).sum(axis=1) > 0))
    if len(known):
        first = rotation_from_quaternion(wxyz[known[0]])
        for row in known:
            turned = first.T @ rotation_from_quaternion(wxyz[row])
            turns[row] = (turned[2, 1], turned[0, 2], turned[1, 0])
    return turns
