"""`snakesim recording plot`: figures of a run as vector graphics, of any signals and of the paper."""

import xml.etree.ElementTree as ElementTree
from importlib.util import find_spec
from pathlib import Path

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import compute_signals
from snakesim_testing.harness.command import snakesim as started
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

# Found and not imported, which would take a second in each worker.
pytestmark = pytest.mark.skipif(find_spec("matplotlib") is None, reason="needs the extra `report`")
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("plot") / "run"
    ended, _ = run_to_summary(out, "triplet", "--duration", "3")
    assert ended.code == 0, ended.err
    return out


def words(path: Path) -> list[str]:
    return [
        "".join(text.itertext()) for text in ElementTree.parse(path).getroot().iter(f"{SVG}text")
    ]


@pytest.mark.slow
def test_signals_have_their_names_and_units_on_the_axes(run: Path) -> None:
    given = ["angle_rad.joint_7,target.joint_7", "torque_nm", "contact_count"]
    out = run / "chosen.svg"
    ended = snakesim(
        "recording",
        "plot",
        str(run),
        *given,
        "--out",
        str(out),
        "--from",
        "1",
        "--to",
        "2.5",
        cwd=run,
    )
    assert ended.code == 0, ended.err
    written = words(out)
    assert {"[rad]", "torque_nm [N·m]", "contact_count", "time [s]"} <= set(written)
    assert {"angle_rad.joint_7", "target.joint_7", "joint_1", "joint_13", "1.0", "2.4"} <= set(
        written
    )
    light = out.read_text()
    assert (
        snakesim("recording", "plot", str(run), *given, "--out", str(out), "--dark", cwd=run).code
        == 0
    )
    white = "fill: #ffffff"  # the ground, or all that is written on it
    assert 0 < light.count(white) < out.read_text().count(white)


@pytest.mark.slow
def test_settings_of_another_environment_keep_no_figure_from_being_drawn(run: Path) -> None:
    """A notebook's window library, and TeX without a TeX."""
    (run / "matplotlibrc").write_text("text.usetex: True\n")
    inherited = {
        "MPLBACKEND": "module://of_a_notebook",
        "MATPLOTLIBRC": str(run),
        "PATH": "/nowhere",
    }
    ended = started(
        "recording",
        "plot",
        str(run),
        "angle_rad",
        "--out",
        "inherited.svg",
        cwd=run,
        extra_env=inherited,
    )
    assert ended.code == 0, ended.err
    assert "joint_13" in words(run / "inherited.svg")


@pytest.mark.slow
def test_every_signal_of_a_run_is_drawn(run: Path) -> None:
    from snakesim_operator.features.figures.run_groups import make_single_run_groups
    from snakesim_operator.features.figures.signal_axes import draw_signals

    record = RunRecord.load(run)
    signals = [name for name in compute_signals(record) if name != "time_s"]
    axes = draw_signals(make_single_run_groups([record]), signals, 3.5, (0.0, 3.0)).axes
    empty = [name for name, ax in zip(signals, axes, strict=True) if not ax.lines]
    assert empty == []


@pytest.mark.slow
def test_runs_are_overlaid_and_their_mean_has_an_interval(run: Path, tmp_path: Path) -> None:
    other, _ = run_to_summary(tmp_path / "other", "triplet", "--duration", "2", "--seed", "7")
    longer, _ = run_to_summary(tmp_path / "longer", "triplet", "--duration", "3", "--seed", "7")
    assert other.code == longer.code == 0
    signals = ["velocity_b_m_s.x,velocity_b_m_s.y", "link_force_n"]
    runs = [str(run), str(tmp_path / "other"), str(tmp_path / "longer")]

    overlaid = snakesim("recording", "plot", *runs, *signals, "--out", "overlaid.svg", cwd=tmp_path)
    assert overlaid.code == 0, overlaid.err
    written = words(tmp_path / "overlaid.svg")
    assert {
        "run",
        "other",
        "longer",
        "other: velocity_b_m_s.y",
        "[m/s]",
        "link_force_n [N]",
    } <= set(written)

    meant = snakesim(
        "recording", "plot", *runs, *signals, "--mean", "--out", "mean.svg", cwd=tmp_path
    )
    assert meant.code == 0, meant.err
    assert (
        "duration_s 3 (mean of 2 runs), with its 95 % interval by Student's t; until 2.99 s"
        in meant.out
    )
    assert {"duration_s 3 (mean of 2 runs)", "duration_s 2 (1 run)"} <= set(
        words(tmp_path / "mean.svg")
    )
    assert (tmp_path / "mean.svg").read_text().count("FillBetweenPolyCollection") == 2 + 14


@pytest.mark.slow
def test_no_legend_covers_the_axes(run: Path) -> None:
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
def test_path_option_draws_head_and_tail_from_above(run: Path) -> None:
    ended = snakesim(
        "recording", "plot", str(run), "--path", "--out", str(run / "path.svg"), cwd=run
    )
    assert ended.code == 0, ended.err
    assert {"head", "tail", "x [m]", "y [m]"} <= set(words(run / "path.svg"))


@pytest.mark.slow
def test_the_papers_figures_come_from_one_command(run: Path) -> None:
    ended = snakesim(
        "recording", "plot", str(run), "--paper", "--out", str(run / "figures"), cwd=run
    )
    assert ended.code == 0, ended.err
    made = sorted(run.glob("figures/*"), key=lambda path: int(path.stem.removeprefix("figure-")))
    assert [path.name for path in made] == [f"figure-{number}.pdf" for number in range(8, 14)]
    assert all(path.read_bytes().startswith(b"%PDF") for path in made)
    assert ended.out.count("written: ") == 6


@pytest.mark.parametrize(
    ("words", "why"),
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
def test_what_cannot_be_drawn_is_told(run: Path, words: list[str], why: str) -> None:
    ended = snakesim("recording", "plot", str(run), *words, cwd=run)
    assert ended.code == 2 and why in ended.err and "Traceback" not in ended.err, ended.err
