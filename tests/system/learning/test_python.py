"""`import snakesim`: runs from a program, with what it gives as a controller, and what comes of them."""

import gc
import importlib.util
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import snakesim
from snakesim.environments import SnakeEnv
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.signals import UNITS
from snakesim_operator.run.in_process import simulate
from snakesim_testing.harness.command import run_program
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.documents import REPOSITORY, parse_sections

needs_pandas = pytest.mark.skipif(
    importlib.util.find_spec("pandas") is None, reason="pandas is not installed"
)


def wave(time_s, joints):
    return [
        0.2 * min(time_s, 1.0) * np.sin(3 * time_s - 0.9 * i) for i in range(len(joints.angle_rad))
    ]


class Nod(snakesim.Controller):
    needs_world = False

    class Parameters(snakesim.Parameters, frozen=True):
        by_rad: float = 0.0

    def update(self, observation):
        angles_rad = [self.parameters.by_rad] * len(self.robot.joints)
        return snakesim.ControllerCommand(snakesim.make_position_setpoints(self.robot, angles_rad))


FAILING = """\
import numpy as np
from snakesim_gnc.control.hold import HoldPose


class Failing(HoldPose):
    def update(self, observation):
        np.linalg.solve(np.zeros((2, 2)), np.ones(2))
"""


@pytest.fixture(scope="module")
def result() -> snakesim.Result:
    return snakesim.run("triplet", duration=1)


def test_a_run_is_that_of_the_command(result: snakesim.Result) -> None:
    same = simulate(load_scenario("triplet", [parse_set_option("duration_s=1")]).config)
    assert result.digest == same.summary.command_digest
    assert result.complete
    assert result.metrics["path_distance_m"] == same.summary.path_distance_m


def test_signals_have_names_units_and_time(result: snakesim.Result) -> None:
    assert result["angle_rad"].shape == (100, 13)
    assert result.time_s.shape == (100,)
    assert np.array_equal(
        result["angle_rad.joint_3"], result["angle_rad"][:, result.joints.index("joint_3")]
    )
    assert result.units["torque_nm.joint_1"] == "N·m"
    assert result.units["position_w_m.x"] == "m"
    assert set(result.arrays) <= set(UNITS)
    assert set(result.units) == set(result.signal_names)
    with raises_error(snakesim.ConfigError, code="recording/unknown-signal", field="angle_rd"):
        result["angle_rd"]


def test_a_function_is_a_controller() -> (
    None
):  # a lambda, too: tests/system/learning/test_environments.py
    found = snakesim.run("triplet", controller=wave, duration=1)
    assert found.complete
    assert found.summary.controller.startswith("program:")
    assert np.ptp(found["target.joint_5"]) > 0.1


def test_a_class_is_a_controller_and_takes_parameters() -> None:
    found = snakesim.run(
        "triplet", controller=Nod, duration=1, set={"control.by_rad": np.float64(0.3)}
    )
    assert found["target.joint_5"][-1] == 0.3
    with raises_error(snakesim.ConfigError, code="config/unknown-key", field="control.by_rd"):
        snakesim.run("triplet", controller=Nod, set={"control.by_rd": 1})


class Growing(Nod):
    def update(self, observation):
        command = super().update(observation)
        telemetry = snakesim.Telemetry(custom={"amplitude_rad": observation.time_s})
        return snakesim.ControllerCommand(command.setpoints, telemetry)


class Boundless(Nod):
    def update(self, observation):
        command = super().update(observation)
        telemetry = snakesim.Telemetry(custom={f"value_{i}": 0.0 for i in range(33)})
        return snakesim.ControllerCommand(command.setpoints, telemetry)


def test_custom_telemetry_of_a_controller_is_a_signal() -> None:
    found = snakesim.run("triplet", controller=Growing, duration=1)
    amplitude_rad = found["amplitude_rad.controller"]
    assert found.units["amplitude_rad.controller"] == "rad"
    assert np.all(np.diff(amplitude_rad[np.isfinite(amplitude_rad)]) >= 0)
    # Sent 20 times a second.
    assert amplitude_rad[-1] == pytest.approx(found.time_s[-1] - found.time_s[0], abs=0.06)


def test_custom_telemetry_beyond_its_bound_is_an_error_of_the_controller() -> None:
    with pytest.raises(snakesim.ControllerError, match="custom"):
        snakesim.run("triplet", controller=Boundless, duration=1)


def test_load_returns_the_run_of_a_folder(tmp_path: Path) -> None:
    ran = snakesim.run("triplet", controller="hold", duration=0.5, out=tmp_path / "run")
    loaded = snakesim.load(tmp_path / "run")
    assert loaded.digest == ran.digest
    assert np.array_equal(loaded["angle_rad"], ran["angle_rad"])
    with raises_error(snakesim.ConfigError, code="recording/not-a-run"):
        snakesim.load(tmp_path / "nothing")


def test_compute_body_points_w_ends_at_the_head(result: snakesim.Result) -> None:
    nodes_w = snakesim.compute_body_points_w(
        result.record.description,
        result["position_w_m"][0],
        result["orientation_wxyz"][0],
        result["angle_rad"][0],
    )
    assert nodes_w.shape == (len(result.joints) + 2, 3)
    assert np.allclose(nodes_w[0], result["position_w_m"][0])


def test_a_path_and_a_shipped_name_are_controllers_too(tmp_path: Path) -> None:
    source = "from snakesim_gnc.control.hold import HoldPose\n\n\nclass Mine(HoldPose):\n    pass\n"
    (tmp_path / "mine.py").write_text(source)
    mine = snakesim.run("triplet", controller=f"{tmp_path}/mine.py:Mine", duration=0.5)
    assert mine.digest == snakesim.run("triplet", controller="hold", duration=0.5).digest


WRONG = [
    (("triplett",), {}, "config/unknown-name"),
    ((3,), {}, "python/invalid-argument"),
    (("triplet",), {"controller": "hodl"}, "plugin/not-found"),
    (("triplet",), {"set": {"control.lead": 1}}, "config/unknown-key"),
    (("triplet",), {"set": ["control.lead"]}, "python/invalid-argument"),
    (("triplet",), {"duration": -1}, "config/out-of-range"),
    (("triplet",), {"seed": "a"}, "config/invalid-value"),
    (("triplet",), {"backend": "simm"}, "plugin/not-found"),
    (("triplet",), {"controller": lambda time_s: 0}, "python/invalid-argument"),
    (("triplet",), {"controller": 5}, "python/invalid-argument"),
    (("triplet",), {"controller": int}, "plugin/not-loadable"),
    (("triplet",), {"controller": wave, "processes": True}, "python/invalid-argument"),
    (("triplet",), {"set": {"clock_mode": "realtime"}}, "backend/wrong-clock-mode"),
]


@pytest.mark.parametrize(("given", "more", "code"), WRONG)
def test_wrong_input_is_answered_at_the_call(given, more, code: str) -> None:
    with raises_error(snakesim.ConfigError, code=code):
        snakesim.run(*given, **more)


def test_simulate_says_what_it_takes() -> None:
    with raises_error(snakesim.ConfigError, code="python/invalid-argument", field="triplet"):
        simulate("triplet")  # pyright: ignore[reportArgumentType]


def solve_singular(time_s, joints):
    return np.linalg.solve(np.zeros((13, 13)), joints.angle_rad)  # the line that an error names


@pytest.mark.parametrize(
    ("controller", "cause"),
    [
        (lambda time_s, joints: [0.0] * 12, None),
        (lambda time_s, joints: np.zeros((13, 1)), None),
        (lambda time_s, joints: "ahead", ValueError),
        (solve_singular, np.linalg.LinAlgError),
    ],
    ids=["length", "shape", "type", "in NumPy"],
)
def test_a_controller_that_fails_is_an_error_that_names_it(controller, cause: type | None) -> None:
    with raises_error(snakesim.ControllerError, code="controller/failed") as caught:
        snakesim.run("triplet", controller=controller, duration=0.1)
    assert type(caught.value.__cause__) is (type(None) if cause is None else cause)


def test_python_controller_failure_in_child_process_is_a_cause(tmp_path: Path) -> None:
    """As when NumPy was imported first."""
    (tmp_path / "failing.py").write_text(FAILING)
    code = "import numpy, snakesim\nsnakesim.run('triplet', controller='./failing.py:Failing', duration=0.1)"
    done = run_program(
        [sys.executable, "-c", code], tmp_path, {"PYTHONPATH": str(REPOSITORY), "PATH": ""}
    )
    assert "raised LinAlgError: Singular matrix (failing.py line 7)" in done.err.splitlines()[-1]
    assert "np.linalg.solve(np.zeros((2, 2)), np.ones(2))" in done.err


def test_python_controller_too_slow_for_real_time_is_reported() -> None:
    def slow(time_s, joints):
        time.sleep(0.1)
        return joints.angle_rad

    run = snakesim.run("triplet", controller=slow, duration=0.03)
    assert run.complete
    assert re.match(
        r"control: update\(\) took \d\d\d ms of 10 ms; 3 of 3 updates", run.summary.too_slow[0]
    )
    assert "update() took" in repr(run)


def test_pages_plots_and_films_need_no_folder(result: snakesim.Result, tmp_path: Path) -> None:
    report = result.report(tmp_path / "report.html").read_text()
    assert "Save the effective configuration below as <code>config.json</code>" in report
    shown = result._repr_html_()
    assert shown.startswith("<iframe")
    assert "class=&quot;player card&quot;" in shown
    assert len(shown) < 500_000
    plot = result.plot("angle_rad", "torque_nm.joint_3")
    assert "torque_nm.joint_3, N·m" in plot.save(tmp_path / "plot.html").read_text()
    assert plot._repr_html_().startswith("<iframe")
    film = result.video(tmp_path / "run.gif", width=64, height=48, fps=5)
    assert film.read_bytes().startswith(b"GIF8")


def test_without_pandas_it_says_what_to_install(
    result: snakesim.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with raises_error(snakesim.ConfigError, code="extra/not-installed"):
        result.to_pandas()


@needs_pandas
def test_a_data_frame_has_the_columns_and_their_units(result: snakesim.Result) -> None:
    frame = result.to_pandas()
    assert frame.index.name == "time_s"
    assert np.array_equal(frame["angle_rad.joint_3"], result["angle_rad.joint_3"])
    assert frame.attrs["units"]["angle_rad.joint_3"] == "rad"


@pytest.mark.e2e
def test_in_processes_it_is_the_same_run(result: snakesim.Result, tmp_path: Path) -> None:
    apart = snakesim.run("triplet", duration=1, processes=True, out=tmp_path / "run")
    assert apart.complete
    assert apart.digest == result.digest
    assert (tmp_path / "run" / "report.html").is_file()


def test_an_unknown_name_lists_what_there_is() -> None:
    with raises_error(AttributeError, field="snakesim"):
        snakesim.runn  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    assert {name for name in snakesim.__all__ if getattr(snakesim, name) is None} == set()


def test_importing_it_loads_neither_numpy_nor_a_simulator() -> None:
    code = "import sys, snakesim; print(sorted({'numpy', 'mujoco', 'zenoh'} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert done.stdout == "[]\n"


def test_importing_it_changes_no_environment_variable() -> None:
    code = (
        "import os; before = dict(os.environ); import snakesim; print(before == dict(os.environ))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert done.stdout == "True\n"


def test_python_process_computes_like_snakesim_run_after_one_call() -> None:
    code = (
        "import snakesim; snakesim.use_common_arithmetic()\n"
        "from snakesim_hal.base.arithmetic import make_common_arithmetic_env, is_pinned\n"
        "import os, numpy; print(make_common_arithmetic_env().items() <= os.environ.items(), is_pinned())\n"
        "snakesim.use_common_arithmetic()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert done.stdout == "True True\n"


def test_a_call_that_comes_too_late_is_an_error() -> None:
    code = "import numpy, snakesim\nsnakesim.is_pinned = lambda: False\nsnakesim.use_common_arithmetic()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=REPOSITORY
    )
    assert done.returncode == 1
    assert "before NumPy is imported" in done.stderr


FIRST_EXAMPLES = [
    ("tutorials/first-controller.md", "Wave"),
    ("tutorials/write-a-controller.md", "Wave"),
    ("how-to/python.md", "wave"),
    ("how-to/python.md", "Nod"),
]


@pytest.mark.parametrize(("page", "name"), FIRST_EXAMPLES, ids=lambda one: one)
def test_a_first_example_starts_gently_from_the_measured_pose(page: str, name: str) -> None:
    blocks = [
        content
        for section in parse_sections(REPOSITORY / "docs" / page)
        for _, content in section.blocks
    ]
    defined = next(block for block in blocks if f"class {name}" in block or f"def {name}" in block)
    names: dict[str, Any] = {"__name__": "example", "snakesim": snakesim}
    exec(re.split(r"first = |snakesim.run\(", defined)[0], names)
    controller = names[name](0.3) if name == "wave" else names[name]
    run = snakesim.run("triplet", controller=controller, duration=0.2)
    assert np.abs(run["velocity_rad_s"]).max() < 1.0  # rad/s; the robot's limit is 7.5


def live_objects() -> Counter[str]:
    """How many objects of our classes are in memory, by class."""
    names = [f"{type(one).__module__}.{type(one).__qualname__}" for one in gc.get_objects()]
    return Counter(name for name in names if name.startswith("snakesim"))


def run_on(backend: str) -> None:
    snakesim.run("triplet", duration=0.05, backend=backend)


def run_that_fails() -> None:
    with pytest.raises(snakesim.ControllerError):
        snakesim.run("triplet", duration=0.05, controller=lambda time_s, joints: [1 / 0])


def step_an_environment(action: str) -> None:
    env = SnakeEnv("triplet", action=action)
    env.reset(seed=1)
    env.step(np.zeros(13))
    env.close()


@pytest.mark.parametrize(
    "use",
    [
        *(partial(run_on, backend) for backend in ("sim", "can", "moteus", "dynamixel")),
        run_that_fails,
        *(partial(step_an_environment, action) for action in ("position", "residual:hold")),
    ],
    ids=["sim", "can", "moteus", "dynamixel", "fails", "environment", "residual"],
)
def test_no_reference_cycle_keeps_a_run_in_memory(use: Callable[[], None]) -> None:
    use()  # what is cached for good
    gc.collect()
    gc.disable()
    try:
        before = live_objects()
        use()
        # A thread that has been stopped may still be about to end on a busy computer, and holds what it works on.
        wait_until(lambda: not live_objects() - before, "a run that leaves no object in memory")
    finally:
        gc.enable()


@pytest.mark.slow
def test_the_study_in_the_documents_as_printed(tmp_path: Path) -> None:
    """Run, plot, sweep a gain, take the best, run it on emulated modules, compare."""
    page = REPOSITORY / "docs" / "how-to" / "python.md"
    study = next(section for section in parse_sections(page) if "study.py" in section.files).files[
        "study.py"
    ]
    (tmp_path / "study.py").write_text(study)
    done = run_program(
        [sys.executable, "study.py"], tmp_path, {"PYTHONPATH": str(REPOSITORY), "PATH": ""}
    )
    assert done.code == 0, done.err
    assert (tmp_path / "first.html").is_file()
    assert "incomplete" not in done.out
    assert "0.5 rad: " in done.out
    assert "sim -> can" in done.out
    assert "A moved" in done.out
