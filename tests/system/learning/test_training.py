"""`snakesim policy train` searches a policy that drives robots; the number of processes does not change the result."""

import csv
import json
import shlex
from pathlib import Path

import numpy as np
import onnx
import pytest

import snakesim
from snakesim.environments import SnakeEnv
from snakesim.training.exported import read_learned_parameters, write_onnx_file
from snakesim.training.form import FORMS, OBSERVE, PolicyArrays
from snakesim_gnc.control.policy import POLICY_FOLDER, PolicyModel
from snakesim_operator.cli import main, make_parser
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.documents import REPOSITORY

MIN_ADVANCE_M = 2.95  # through the field of the unseen scene
RANDOMIZE = ("--randomize", "scene.ground.friction=0.1:0.4")
SHORT_SEARCH = ("--generations", "2", "--population", "4", "--seeds", "1", "--check-seeds", "1")
SMALL_SEARCH = (*SHORT_SEARCH, "--duration", "0.5", "--frame-skip", "4", *RANDOMIZE)


@pytest.fixture(scope="module")
def search_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train a policy with two processes, and return the folder of the search."""
    out = tmp_path_factory.mktemp("train") / "two"
    command = ["policy", "train", "surveyed_clutter", *SMALL_SEARCH]
    assert main([*command, "--workers", "2", "--out", str(out)]) == 0
    return out


def read_metadata(model: Path) -> dict[str, str]:
    """Return the metadata of an ONNX file."""
    return {entry.key: entry.value for entry in onnx.load(model).metadata_props}


@pytest.mark.heavy
def test_training_search_writes_policy_and_learning_curve(search_folder: Path) -> None:
    rows = list(csv.DictReader((search_folder / "curve.csv").open()))
    assert [row["episodes"] for row in rows] == ["4", "8", "8"]
    assert rows[0]["check_reward"]
    assert not rows[1]["check_reward"]
    assert rows[2]["check_reward"]
    assert (search_folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    metadata = read_metadata(search_folder / "policy.onnx")
    assert metadata["snakesim.trained_by"].startswith(
        "snakesim policy train surveyed_clutter --form feeling --duration 0.5 "
    )
    assert " ".join(("--frame-skip 4", *RANDOMIZE)) in metadata["snakesim.trained_by"]
    assert metadata["snakesim.frame_skip"] == "4"
    assert set(json.loads(metadata["snakesim.learned"])) == set(FORMS["feeling"])


@pytest.mark.heavy
def test_training_search_resumed_reaches_the_same_policy(
    search_folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "two"
    out.mkdir()
    first_line, second_line, *_ = (
        (search_folder / "search.jsonl").read_bytes().splitlines(keepends=True)
    )
    # The search was killed while it wrote its third line.
    (out / "search.jsonl").write_bytes(first_line + second_line + b'{"rewards": [0.')
    # The resumed search has another number of processes, which changes nothing.
    command = [
        "policy",
        "train",
        "surveyed_clutter",
        *SMALL_SEARCH,
        "--workers",
        "1",
        "--out",
        str(out),
    ]
    assert main(command) == 2, "a search without --resume overwrote the folder"
    assert main([*command, "--resume", "--seed", "2"]) == 2, "a search with another seed resumed"
    assert main([*command, "--resume"]) == 0
    for name in ("policy.onnx", "curve.csv", "search.jsonl"):
        assert (out / name).read_bytes() == (search_folder / name).read_bytes(), name


@pytest.mark.slow
def test_training_search_with_init_starts_at_its_parameters(
    search_folder: Path, tmp_path: Path
) -> None:
    initial = read_learned_parameters(str(search_folder / "policy.onnx"))
    tiny_search = (
        "--generations",
        "1",
        "--population",
        "4",
        "--seeds",
        "1",
        "--check-seeds",
        "1",
        "--duration",
        "0.1",
    )
    command = [
        "policy",
        "train",
        "surveyed_clutter",
        *tiny_search,
        "--init",
        str(search_folder / "policy.onnx"),
        "--spread",
        "0.01",
    ]
    assert main([*command, "--workers", "1", "--out", str(tmp_path / "on")]) == 0
    learned = read_learned_parameters(str(tmp_path / "on" / "policy.onnx"))
    assert learned.keys() == initial.keys()
    for name, parameter in FORMS["feeling"].items():
        assert abs(learned[name] - initial[name]) < 0.1 * parameter.sigma
    (tmp_path / "other.onnx").write_bytes(b"no model")
    for invalid_file in (str(tmp_path / "other.onnx"), str(tmp_path / "absent.onnx")):
        assert main([*command[:-3], invalid_file, "--out", str(tmp_path / "on")]) == 2


@pytest.mark.slow
def test_training_search_with_one_process_gives_same_policy(
    search_folder: Path, tmp_path: Path
) -> None:
    command = ["policy", "train", "surveyed_clutter", *SMALL_SEARCH]
    main([*command, "--workers", "1", "--out", str(tmp_path / "one")])
    for name in ("policy.onnx", "curve.csv"):
        assert (tmp_path / "one" / name).read_bytes() == (search_folder / name).read_bytes(), name


def test_training_policy_file_computes_same_targets_as_numpy(tmp_path: Path) -> None:
    """A search evaluates its policies in NumPy; a robot executes the ONNX file that is written of them."""
    env = SnakeEnv("surveyed_clutter", observe=OBSERVE, duration=1)
    # Any parameters will do; these are not 0, so that each has an effect.
    parameters = {
        name: parameter.start + parameter.sigma for name, parameter in FORMS["feeling"].items()
    }
    numpy_policy = PolicyArrays.make_from_parameters(
        values=parameters,
        axes=[joint.axis for joint in env.description.joints],
        sizes={name: len(part.names) for name, part in env.parts.items()},
    )
    onnx_path = tmp_path / "policy.onnx"
    write_onnx_file(
        onnx_path,
        numpy_policy,
        values=parameters,
        # Two entries of the metadata, which do not change the targets.
        frame_skip=5,
        again=["snakesim", "policy", "train"],
    )
    onnx_policy = PolicyModel(env.description, str(onnx_path))

    random = np.random.default_rng(1)
    for _ in range(20):
        observation = random.normal(size=len(env.observation_names)).astype(np.float32)
        target_rad = onnx_policy(observation)
        expected_rad = numpy_policy.compute_targets(observation)
        assert np.allclose(target_rad, expected_rad, atol=1e-5)


@pytest.mark.heavy
@pytest.mark.parametrize("backend", ["sim", pytest.param("can", marks=pytest.mark.slow)])
def test_training_policy_drives_simulator_and_emulated_modules(
    search_folder: Path, backend: str
) -> None:
    name = f"policy:{search_folder / 'policy.onnx'}"
    run = snakesim.run("surveyed_clutter", controller=name, duration=1, backend=backend)
    assert run.complete
    assert np.ptp(run["target.joint_5"]) > 0.05


@pytest.mark.parametrize(
    ("name", "out"), [("clutter", "trained"), ("free", "free"), ("lab", "lab")]
)
def test_training_shipped_policy_names_its_documented_command(name: str, out: str) -> None:
    metadata = read_metadata(POLICY_FOLDER / f"{name}.onnx")
    page = (REPOSITORY / "docs" / "development" / "shipped-policies.md").read_text()
    page = page.replace("\\\n", " ")  # joins the lines of a command
    (command,) = [
        line
        for line in page.splitlines()
        if line.startswith("snakesim policy train") and line.endswith(f"--out {out}")
    ]
    stored_arguments = [*metadata["snakesim.trained_by"].split()[1:], "--out", out]
    documented_arguments = shlex.split(command)[1:]
    stored = vars(make_parser().parse_args(stored_arguments))
    documented = vars(make_parser().parse_args(documented_arguments))
    assert stored == documented


@pytest.mark.slow
def test_training_shipped_policy_crosses_an_unseen_field() -> None:
    settings = {"scene.random_field.0.seed": 5400}
    run = snakesim.run(
        "surveyed_clutter", controller="policy:clutter", duration=4, seed=5400, set=settings
    )
    assert run.complete
    assert (run.metrics["advance_m"] or 0.0) > MIN_ADVANCE_M


def test_training_policy_of_other_robot_or_missing_is_refused(search_folder: Path) -> None:
    with raises_error(snakesim.ConfigError, code="policy/invalid", field="policy.onnx"):
        snakesim.run("mamba_flat", controller=f"policy:{search_folder / 'policy.onnx'}")
    with raises_error(snakesim.ConfigError, code="config/unknown-name", field="cluter"):
        snakesim.run("surveyed_clutter", controller="policy:cluter")
