"""The Python API runs scenarios with functions, classes and files as controllers, and returns their signals."""

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


def compute_wave_rad(time_s, joints):
    """Return the joint angles of a wave whose amplitude grows in the first second."""
    amplitude_rad = 0.2 * min(time_s, 1.0)
    return [
        amplitude_rad * np.sin(3 * time_s - 0.9 * joint) for joint in range(len(joints.angle_rad))
    ]


class ConstantAngle(snakesim.Controller):
    """A controller that bends every joint by the same parameter."""

    needs_world = False

    class Parameters(snakesim.Parameters, frozen=True):
        angle_rad: float = 0.0

    def update(self, observation):
        angles_rad = [self.parameters.angle_rad] * len(self.robot.joints)
        return snakesim.ControllerCommand(snakesim.make_position_setpoints(self.robot, angles_rad))


FAILING_CONTROLLER = """\
import numpy as np
from snakesim_gnc.control.hold import HoldPose


class Failing(HoldPose):
    def update(self, observation):
        np.linalg.solve(np.zeros((2, 2)), np.ones(2))
"""


@pytest.fixture(scope="module")
def result() -> snakesim.Result:
    """Return the result of a run of one second."""
    return snakesim.run("triplet", duration=1)


def test_run_has_digest_and_metrics_of_the_command(result: snakesim.Result) -> None:
    expected = simulate(load_scenario("triplet", [parse_set_option("duration_s=1")]).config)
    assert result.digest == expected.summary.command_digest
    assert result.complete
    assert result.metrics["path_distance_m"] == expected.summary.path_distance_m


def test_result_signals_have_names_units_and_time(result: snakesim.Result) -> None:
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


def test_run_with_function_uses_it_as_controller() -> None:
    run = snakesim.run("triplet", controller=compute_wave_rad, duration=1)
    assert run.complete
    assert run.summary.controller.startswith("program:")
    assert np.ptp(run["target.joint_5"]) > 0.1


def test_run_with_class_uses_it_and_its_parameters() -> None:
    run = snakesim.run(
        "triplet", controller=ConstantAngle, duration=1, set={"control.angle_rad": np.float64(0.3)}
    )
    assert run["target.joint_5"][-1] == 0.3
    with raises_error(snakesim.ConfigError, code="config/unknown-key", field="control.angle_rd"):
        snakesim.run("triplet", controller=ConstantAngle, set={"control.angle_rd": 1})


class GrowingTelemetry(ConstantAngle):
    """A controller with a custom telemetry value that grows with time."""

    def update(self, observation):
        command = super().update(observation)
        telemetry = snakesim.Telemetry(custom={"amplitude_rad": observation.time_s})
        return snakesim.ControllerCommand(command.setpoints, telemetry)


class TooMuchTelemetry(ConstantAngle):
    """A controller with more custom telemetry values than allowed."""

    def update(self, observation):
        command = super().update(observation)
        telemetry = snakesim.Telemetry(custom={f"value_{index}": 0.0 for index in range(33)})
        return snakesim.ControllerCommand(command.setpoints, telemetry)


def test_controller_custom_telemetry_is_a_signal() -> None:
    run = snakesim.run("triplet", controller=GrowingTelemetry, duration=1)
    amplitude_rad = run["amplitude_rad.controller"]
    assert run.units["amplitude_rad.controller"] == "rad"
    assert np.all(np.diff(amplitude_rad[np.isfinite(amplitude_rad)]) >= 0)
    # Telemetry is sent 20 times a second.
    assert amplitude_rad[-1] == pytest.approx(run.time_s[-1] - run.time_s[0], abs=0.06)


def test_controller_with_too_much_custom_telemetry_fails() -> None:
    with pytest.raises(snakesim.ControllerError, match="custom"):
        snakesim.run("triplet", controller=TooMuchTelemetry, duration=1)


def test_load_of_run_folder_returns_its_result(tmp_path: Path) -> None:
    run = snakesim.run("triplet", controller="hold", duration=0.5, out=tmp_path / "run")
    loaded = snakesim.load(tmp_path / "run")
    assert loaded.digest == run.digest
    assert np.array_equal(loaded["angle_rad"], run["angle_rad"])
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


def test_run_with_path_or_shipped_name_uses_that_controller(tmp_path: Path) -> None:
    source = "from snakesim_gnc.control.hold import HoldPose\n\n\nclass Mine(HoldPose):\n    pass\n"
    (tmp_path / "mine.py").write_text(source)
    run = snakesim.run("triplet", controller=f"{tmp_path}/mine.py:Mine", duration=0.5)
    assert run.digest == snakesim.run("triplet", controller="hold", duration=0.5).digest


INVALID_CALLS = [
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
    (("triplet",), {"controller": compute_wave_rad, "processes": True}, "python/invalid-argument"),
    (("triplet",), {"set": {"clock_mode": "realtime"}}, "backend/wrong-clock-mode"),
]


@pytest.mark.parametrize(("arguments", "options", "code"), INVALID_CALLS)
def test_run_with_invalid_argument_is_refused(arguments, options, code: str) -> None:
    with raises_error(snakesim.ConfigError, code=code):
        snakesim.run(*arguments, **options)


def test_simulate_with_invalid_argument_is_refused() -> None:
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
def test_run_with_failing_controller_names_it_in_the_error(controller, cause: type | None) -> None:
    with raises_error(snakesim.ControllerError, code="controller/failed") as caught:
        snakesim.run("triplet", controller=controller, duration=0.1)
    assert type(caught.value.__cause__) is (type(None) if cause is None else cause)


@pytest.mark.heavy
def test_python_controller_failure_in_child_process_is_reported(tmp_path: Path) -> None:
    """Runs happen in a child process if the program has imported NumPy before snakesim."""
    (tmp_path / "failing.py").write_text(FAILING_CONTROLLER)
    code = "import numpy, snakesim\nsnakesim.run('triplet', controller='./failing.py:Failing', duration=0.1)"
    completed = run_program(
        [sys.executable, "-c", code], tmp_path, {"PYTHONPATH": str(REPOSITORY), "PATH": ""}
    )
    assert (
        "raised LinAlgError: Singular matrix (failing.py line 7)" in completed.err.splitlines()[-1]
    )
    assert "np.linalg.solve(np.zeros((2, 2)), np.ones(2))" in completed.err


def test_python_controller_too_slow_for_real_time_is_reported() -> None:
    def compute_slowly(time_s, joints):
        time.sleep(0.1)
        return joints.angle_rad

    run = snakesim.run("triplet", controller=compute_slowly, duration=0.03)
    assert run.complete
    assert re.match(
        r"control: update\(\) took \d\d\d ms of 10 ms; 3 of 3 updates", run.summary.too_slow[0]
    )
    assert "update() took" in repr(run)


@pytest.mark.heavy
def test_result_without_folder_makes_pages_plots_and_videos(
    result: snakesim.Result, tmp_path: Path
) -> None:
    report = result.report(tmp_path / "report.html").read_text()
    assert "Save the effective configuration below as <code>config.json</code>" in report
    notebook_html = result._repr_html_()
    assert notebook_html.startswith("<iframe")
    assert "class=&quot;player card&quot;" in notebook_html
    assert len(notebook_html) < 500_000
    plot = result.plot("angle_rad", "torque_nm.joint_3")
    assert "torque_nm.joint_3, N·m" in plot.save(tmp_path / "plot.html").read_text()
    assert plot._repr_html_().startswith("<iframe")
    film = result.video(tmp_path / "run.gif", width=64, height=48, fps=5)
    assert film.read_bytes().startswith(b"GIF8")


def test_result_to_pandas_without_pandas_names_the_extra(
    result: snakesim.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with raises_error(snakesim.ConfigError, code="extra/not-installed"):
        result.to_pandas()


@needs_pandas
def test_result_to_pandas_has_signals_and_units(result: snakesim.Result) -> None:
    frame = result.to_pandas()
    assert frame.index.name == "time_s"
    assert np.array_equal(frame["angle_rad.joint_3"], result["angle_rad.joint_3"])
    assert frame.attrs["units"]["angle_rad.joint_3"] == "rad"


@pytest.mark.heavy
@pytest.mark.e2e
def test_run_in_processes_has_same_digest(result: snakesim.Result, tmp_path: Path) -> None:
    run = snakesim.run("triplet", duration=1, processes=True, out=tmp_path / "run")
    assert run.complete
    assert run.digest == result.digest
    assert (tmp_path / "run" / "report.html").is_file()


def test_snakesim_module_with_unknown_name_raises_attribute_error() -> None:
    with raises_error(AttributeError, field="snakesim"):
        snakesim.runn  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    assert {name for name in snakesim.__all__ if getattr(snakesim, name) is None} == set()


def test_snakesim_import_loads_neither_numpy_nor_simulator() -> None:
    code = "import sys, snakesim; print(sorted({'numpy', 'mujoco', 'zenoh'} & set(sys.modules)))"
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert completed.stdout == "[]\n"


def test_snakesim_import_changes_no_environment_variable() -> None:
    code = (
        "import os; before = dict(os.environ); import snakesim; print(before == dict(os.environ))"
    )
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert completed.stdout == "True\n"


def test_python_process_computes_like_snakesim_run_after_one_call() -> None:
    code = (
        "import snakesim; snakesim.use_common_arithmetic()\n"
        "from snakesim_hal.base.arithmetic import make_common_arithmetic_env, is_pinned\n"
        "import os, numpy; print(make_common_arithmetic_env().items() <= os.environ.items(), is_pinned())\n"
        "snakesim.use_common_arithmetic()"
    )
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert completed.stdout == "True True\n"


def test_use_common_arithmetic_after_numpy_import_fails() -> None:
    code = "import numpy, snakesim\nsnakesim.is_pinned = lambda: False\nsnakesim.use_common_arithmetic()"
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=REPOSITORY
    )
    assert completed.returncode == 1
    assert "before NumPy is imported" in completed.stderr


FIRST_EXAMPLES = [
    ("tutorials/first-controller.md", "Wave"),
    ("tutorials/write-a-controller.md", "Wave"),
    ("how-to/python.md", "wave"),
    ("how-to/python.md", "Nod"),
]


@pytest.mark.parametrize(("page", "name"), FIRST_EXAMPLES, ids=lambda value: value)
def test_documented_controller_starts_slowly_from_measured_pose(page: str, name: str) -> None:
    blocks = [
        content
        for section in parse_sections(REPOSITORY / "docs" / page)
        for _, content in section.blocks
    ]
    definition = next(
        block for block in blocks if f"class {name}" in block or f"def {name}" in block
    )
    names: dict[str, Any] = {"__name__": "example", "snakesim": snakesim}
    exec(re.split(r"first = |snakesim.run\(", definition)[0], names)
    controller = names[name](0.3) if name == "wave" else names[name]
    run = snakesim.run("triplet", controller=controller, duration=0.2)
    assert np.abs(run["velocity_rad_s"]).max() < 1.0  # rad/s; the robot's limit is 7.5


def count_objects_by_class() -> Counter[str]:
    """Return the number of objects in memory for each class of this project."""
    names = [f"{type(item).__module__}.{type(item).__qualname__}" for item in gc.get_objects()]
    return Counter(name for name in names if name.startswith("snakesim"))


def run_on_backend(backend: str) -> None:
    snakesim.run("triplet", duration=0.05, backend=backend)


def run_with_failing_controller() -> None:
    with pytest.raises(snakesim.ControllerError):
        snakesim.run("triplet", duration=0.05, controller=lambda time_s, joints: [1 / 0])


def step_an_environment(action: str) -> None:
    env = SnakeEnv("triplet", action=action)
    env.reset(seed=1)
    env.step(np.zeros(13))
    env.close()


@pytest.mark.heavy
@pytest.mark.parametrize(
    "use",
    [
        *(partial(run_on_backend, backend) for backend in ("sim", "can", "moteus", "dynamixel")),
        run_with_failing_controller,
        *(partial(step_an_environment, action) for action in ("position", "residual:hold")),
    ],
    ids=["sim", "can", "moteus", "dynamixel", "fails", "environment", "residual"],
)
def test_run_leaves_no_objects_in_memory(use: Callable[[], None]) -> None:
    use()  # The first use fills caches, which stay in memory.
    gc.collect()
    gc.disable()
    try:
        counts_before = count_objects_by_class()
        use()
        # On a busy computer a stopped thread may still be ending, and then it keeps its objects in memory.
        wait_until(
            lambda: not count_objects_by_class() - counts_before,
            "a run that leaves no object in memory",
        )
    finally:
        gc.enable()


@pytest.mark.slow
def test_python_page_study_runs_as_printed(tmp_path: Path) -> None:
    """The study runs, plots, sweeps a gain, runs the best value on emulated modules, and compares."""
    page = REPOSITORY / "docs" / "how-to" / "python.md"
    sections = parse_sections(page)
    study = next(section for section in sections if "study.py" in section.files).files["study.py"]
    (tmp_path / "study.py").write_text(study)
    completed = run_program(
        [sys.executable, "study.py"], tmp_path, {"PYTHONPATH": str(REPOSITORY), "PATH": ""}
    )
    assert completed.code == 0, completed.err
    assert (tmp_path / "first.html").is_file()
    assert "incomplete" not in completed.out
    assert "0.5 rad: " in completed.out
    assert "sim -> can" in completed.out
    assert "A moved" in completed.out
