"""`snakesim recording plot` draws any signals of runs, and the figures of the paper, as vector graphics."""

import xml.etree.ElementTree as ElementTree
from importlib.util import find_spec
from pathlib import Path

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import compute_signals
from snakesim_testing.harness.command import snakesim as start_snakesim
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

# `find_spec` does not import matplotlib, which would take a second in each worker.
pytestmark = pytest.mark.skipif(find_spec("matplotlib") is None, reason="needs the extra `report`")
MEAN_BANDS = 2 + 14  # confidence intervals of two velocities and of 14 link forces
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a scenario of three seconds, and return its folder."""
    out = tmp_path_factory.mktemp("plot") / "run"
    completed, _ = run_to_summary(out, "triplet", "--duration", "3")
    assert completed.code == 0, completed.err
    return out


def read_svg_texts(path: Path) -> list[str]:
    """Return all texts of an SVG file."""
    return [
        "".join(text.itertext()) for text in ElementTree.parse(path).getroot().iter(f"{SVG}text")
    ]


@pytest.mark.slow
def test_plot_of_signals_has_names_and_units_on_axes(run: Path) -> None:
    signals = ["angle_rad.joint_7,target.joint_7", "torque_nm", "contact_count"]
    out = run / "chosen.svg"
    command = ["recording", "plot", str(run), *signals, "--out", str(out)]
    completed = snakesim(*command, "--from", "1", "--to", "2.5", cwd=run)
    assert completed.code == 0, completed.err
    texts = set(read_svg_texts(out))
    assert {"[rad]", "torque_nm [N·m]", "contact_count", "time [s]"} <= texts
    assert {"angle_rad.joint_7", "target.joint_7", "joint_1", "joint_13", "1.0", "2.4"} <= texts
    light_svg = out.read_text()
    assert snakesim(*command, "--dark", cwd=run).code == 0
    # White is the background of a light figure, and the color of all texts in a dark one.
    white = "fill: #ffffff"
    assert 0 < light_svg.count(white) < out.read_text().count(white)


@pytest.mark.slow
def test_plot_with_matplotlib_settings_of_other_environment_is_drawn(run: Path) -> None:
    """The environment names the window library of a notebook, and TeX, which is not installed."""
    (run / "matplotlibrc").write_text("text.usetex: True\n")
    environment = {
        "MPLBACKEND": "module://of_a_notebook",
        "MATPLOTLIBRC": str(run),
        "PATH": "/nowhere",
    }
    completed = start_snakesim(
        "recording",
        "plot",
        str(run),
        "angle_rad",
        "--out",
        "inherited.svg",
        cwd=run,
        extra_env=environment,
    )
    assert completed.code == 0, completed.err
    assert "joint_13" in read_svg_texts(run / "inherited.svg")


@pytest.mark.slow
def test_plot_of_any_signal_draws_lines(run: Path) -> None:
    from snakesim_operator.features.figures.run_groups import make_single_run_groups
    from snakesim_operator.features.figures.signal_axes import draw_signals

    record = RunRecord.load(run)
    signals = [name for name in compute_signals(record) if name != "time_s"]
    axes = draw_signals(make_single_run_groups([record]), signals, 3.5, (0.0, 3.0)).axes
    undrawn = [name for name, ax in zip(signals, axes, strict=True) if not ax.lines]
    assert undrawn == []


@pytest.mark.slow
def test_plot_of_runs_overlays_them_and_draws_mean_interval(run: Path, tmp_path: Path) -> None:
    other, _ = run_to_summary(tmp_path / "other", "triplet", "--duration", "2", "--seed", "7")
    longer, _ = run_to_summary(tmp_path / "longer", "triplet", "--duration", "3", "--seed", "7")
    assert other.code == longer.code == 0
    signals = ["velocity_b_m_s.x,velocity_b_m_s.y", "link_force_n"]
    runs = [str(run), str(tmp_path / "other"), str(tmp_path / "longer")]

    overlaid = snakesim("recording", "plot", *runs, *signals, "--out", "overlaid.svg", cwd=tmp_path)
    assert overlaid.code == 0, overlaid.err
    texts = read_svg_texts(tmp_path / "overlaid.svg")
    assert {
        "run",
        "other",
        "longer",
        "other: velocity_b_m_s.y",
        "[m/s]",
        "link_force_n [N]",
    } <= set(texts)

    mean = snakesim(
        "recording", "plot", *runs, *signals, "--mean", "--out", "mean.svg", cwd=tmp_path
    )
    assert mean.code == 0, mean.err
    assert (
        "duration_s 3 (mean of 2 runs), with its 95 % interval by Student's t; until 2.99 s"
        in mean.out
    )
    assert {"duration_s 3 (mean of 2 runs)", "duration_s 2 (1 run)"} <= set(
        read_svg_texts(tmp_path / "mean.svg")
    )
    assert (tmp_path / "mean.svg").read_text().count("FillBetweenPolyCollection") == MEAN_BANDS


@pytest.mark.slow
def test_plot_legend_covers_no_axes(run: Path) -> None:
    from snakesim_operator.features.figures.run_groups import make_single_run_groups
    from snakesim_operator.features.figures.signal_axes import draw_signals

    groups = make_single_run_groups([RunRecord.load(run)])
    figure = draw_signals(
        groups, ["angle_rad", "angle_rad.joint_1,target.joint_1"], 3.5, (0.0, 3.0)
    )
    figure.draw_without_rendering()
    for axes in figure.axes:
        legend = axes.get_legend()
        assert legend is not None
        assert legend.get_window_extent().y0 >= axes.get_window_extent().y1
        assert legend.get_window_extent().x1 <= figure.bbox.x1


@pytest.mark.slow
def test_plot_path_option_draws_head_and_tail(run: Path) -> None:
    completed = snakesim(
        "recording", "plot", str(run), "--path", "--out", str(run / "path.svg"), cwd=run
    )
    assert completed.code == 0, completed.err
    assert {"head", "tail", "x [m]", "y [m]"} <= set(read_svg_texts(run / "path.svg"))


@pytest.mark.slow
def test_plot_paper_option_writes_all_figures(run: Path) -> None:
    completed = snakesim(
        "recording", "plot", str(run), "--paper", "--out", str(run / "figures"), cwd=run
    )
    assert completed.code == 0, completed.err
    figures = sorted(run.glob("figures/*"), key=lambda path: int(path.stem.removeprefix("figure-")))
    assert [path.name for path in figures] == [f"figure-{number}.pdf" for number in range(8, 14)]
    assert all(path.read_bytes().startswith(b"%PDF") for path in figures)
    assert completed.out.count("written: ") == 6


@pytest.mark.parametrize(
    ("arguments", "expected_text"),
    [
        (["angel_rad"], "no signal 'angel_rad'; did you mean `angle_rad`"),
        (["angle_rad,torque_nm"], "have no axis in common"),
        (["--from", "9"], "within the 0 to 2.99 s of this run"),
        (["--out", "plot.docx"], "give a file that ends in .pdf, .svg, .png"),
        (["--paper", "--out", "one.pdf"], "several files; give a folder"),
        (["--paper", "--from", "2.98"], "at no time within it"),
        (["angle_rad", "--mean"], "one run has no mean"),
        (["angle_rad", "--path"], "draw one run, without signals"),
        (["--path", "--from", "9"], "the pose is unknown in this part of the run"),
    ],
)
def test_plot_with_invalid_arguments_is_refused(
    run: Path, arguments: list[str], expected_text: str
) -> None:
    completed = snakesim("recording", "plot", str(run), *arguments, cwd=run)
    assert completed.code == 2, completed.err
    assert expected_text in completed.err, completed.err
    assert "Traceback" not in completed.err
