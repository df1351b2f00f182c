"""Wrong files and flags: one clear error, exit code 2, nothing started, nothing left."""

import os
from pathlib import Path

import pytest

from tests.whole.command import snakesim

ROBOT = Path("snakesim_hal/shipped/robots/planar13.toml").resolve()
SCENE = Path("snakesim_hal/shipped/scenes/triplet.toml").resolve()
SCENARIO = Path("snakesim_hal/shipped/scenarios/triplet.toml").resolve()

WRONG = {
    "absent": (["nowhere"], ["no scenario called 'nowhere'", "triplet"]),
    "unknown flag value": (["triplet", "--set", "pace=fast"], ["pace", "'fast'", "lockstep"]),
    "out of range": (["triplet", "--set", "robot.module.length_m=-0.1"], ["length_m", "-0.1 m", "> 0"]),
    "wrong unit": (["triplet", "--set", "robot.module.length_m=110"], ["length_m", "110 m", "<= 2"]),
    "not a number": (["triplet", "--set", "rate_hz=nan"], ["rate_hz", "nan"]),
    "unknown key": (["triplet", "--set", "robot.module.lenght_m=0.1"], ["lenght_m", "did you mean `length_m`"]),
    "overlap": (["triplet", "--set", "scene.pegs_along_route.0.corridor_m=0.02"], ["overlaps", "link_", "mm"]),
    "controller setting": (["triplet", "--set", "control.propulsion_n=-1"], ["propulsion_n", "-1"]),
    "unknown controller": (["triplet", "--controller", "wiggle"], ["'wiggle'", "hold", "obstacle_triplet"]),
    "controller file": (["triplet", "--controller", "./no.py:No"], ["no.py: no such file"]),
    "unknown backend": (["triplet", "--backend", "gazebo"], ["'gazebo'", "can, sim"]),
    "too much for the bus": (
        ["triplet", "--backend", "can", "--set", "robot.chain.modules=18", "--set", "rate_hz=200"],
        ["18 joints at 200 Hz do not fit", "JointState", "together", "2 channels with up to 9 joints"],
    ),
    "no such channel": (["triplet", "--backend", "can", "--set", 'backend.channels=["can7"]'], ["can7"]),
    "pace of a robot": (["triplet", "--backend", "can", "--pace", "free"], ["--pace free", "lockstep or realtime"]),
    "unknown fault": (["triplet", "--backend", "can", "--set", 'backend.faults=["x:joint_1@1"]'], ["'x'", "mute"]),
    "twins without a bus": (["triplet", "--backend", "can", "--set", "backend.twins=process"], ["channels"]),
    "set without value": (["triplet", "--set", "rate_hz"], ["section.key=value"]),
    "not TOML": (["./broken.toml"], ["broken.toml", "not valid TOML", "line"]),
    "missing field": (["./missing.toml"], ["missing.toml", "`controller` is missing"]),
    "robot file": (["./bad_robot.toml"], ["my_robot.toml", "mass_kg", "heavy"]),
    "scene file": (["./bad_scene.toml"], ["my_scene.toml", "friction"]),
    "route kind": (["triplet", "--set", 'scene.route.kind="spiral"'], ["'spiral'", "one of 'sine', 'waypoints'"]),
    "controller without a class": (
        ["triplet", "--controller", "./wave.py"],
        ["wave.py:Wave", "classes in it are Wave"],
    ),
    "controller file that is a pipe": (["triplet", "--controller", "./pipe.py:X"], ["pipe.py: is a pipe"]),
    "endpoint": (["triplet", "--endpoint", "banana"], ["--endpoint banana", "such as tcp/127.0.0.1:7447"]),
    "port 0": (["triplet", "--endpoint", "tcp/127.0.0.1:0"], ["from 1 to 65535", "such as tcp/127.0.0.1:7447"]),
    "port 70000": (["triplet", "--router", "tcp/127.0.0.1:70000"], ["--router", "from 1 to 65535"]),
    "no locator": (["triplet", "--endpoint", "127.0.0.1:7447"], ["such as tcp/127.0.0.1:7447"]),
    "open to everybody": (["triplet", "--endpoint", "tcp/0.0.0.0:7461"], ["could command the robot", "--insecure"]),
    "namespace": (["triplet", "--namespace", "a/*"], ["--namespace 'a/*'", "such as planar13"]),
    "scenario that is a pipe": (["./pipe.toml"], ["pipe.toml: is a pipe"]),
    "scenario without an end": (["./endless.toml"], ["endless.toml: is a device"]),
    "robot that is a pipe": (["triplet", "--set", "robot=./pipe.toml"], ["pipe.toml: is a pipe"]),
    "scene without an end": (["triplet", "--set", "scene=/dev/zero"], ["/dev/zero: is a device"]),
    "deep JSON": (["./deep.json"], ["deep.json: ", "nested deeper"]),
    "50,000 parts": (["triplet", "--set", ".".join("a" * 50_000) + "=1"], ["at most 16 are allowed"]),
    "UTF-16": (["./utf16.toml"], ["utf16.toml: is UTF-16"]),
    "steering": (["./steering.toml"], ["unknown field `\\u001b[2J\\u202e`"]),
    "too many pegs": (["./crowded.toml"], ["20000 obstacles; at most 4096"]),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scenario = SCENARIO.read_text()
    (tmp_path / "broken.toml").write_text("robot = \n")
    (tmp_path / "missing.toml").write_text(scenario.replace('controller = "obstacle_triplet"\n', ""))
    (tmp_path / "my_robot.toml").write_text(ROBOT.read_text().replace("mass_kg = 0.3", 'mass_kg = "heavy"'))
    (tmp_path / "bad_robot.toml").write_text(scenario.replace('"planar13"', '"my_robot.toml"'))
    (tmp_path / "my_scene.toml").write_text(SCENE.read_text().replace("friction = 0.1", "friction = 99.0"))
    (tmp_path / "bad_scene.toml").write_text(scenario.replace('scene = "triplet"', 'scene = "my_scene.toml"'))
    (tmp_path / "wave.py").write_text("class Wave: ...\n")
    for name in ("pipe.py", "pipe.toml"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "endless.toml").symlink_to("/dev/zero")
    (tmp_path / "deep.json").write_text('{"a":' * 100_000)
    (tmp_path / "utf16.toml").write_text(scenario, encoding="utf-16")
    (tmp_path / "steering.toml").write_text(f'"\\u001b[2J\\u202e" = 1\n{scenario}')
    pegs = "".join(f"[[cylinder]]\nposition_m = [{9 + i % 900}, 9]\nradius_m = 0.1\n" for i in range(20_000))
    (tmp_path / "crowd.toml").write_text(f"name = 'crowd'\n[ground]\nfriction = 0.1\n{pegs}")
    (tmp_path / "crowded.toml").write_text(
        scenario.replace('scene = "triplet"', 'scene = "crowd.toml"').replace("tail_s_m = 0.0", "on_route = false")
    )
    return tmp_path


@pytest.mark.parametrize("wrong", WRONG)
def test_one_clear_error_and_nothing_started(folder: Path, wrong: str) -> None:
    arguments, words = WRONG[wrong]
    ended = snakesim("run", *arguments, "--out", "run", cwd=folder)
    assert ended.code == 2, ended.out + ended.err
    assert ended.out == ""
    assert ended.err.startswith("snakesim: ") and "Traceback" not in ended.err
    assert ended.err.count("\n") == 1 or "together" in words, ended.err  # the arithmetic of a bus has a line a sum
    for word in words:
        assert word in ended.err, ended.err
    assert not (folder / "run").exists()


def test_output_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ended = snakesim("run", "triplet", "--out", "file/run", cwd=tmp_path)
    assert ended.code == 2 and "--out" in ended.err
