"""`snakesim policy train`: a search in small, the same with any number of processes; what it writes drives robots."""

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

RANDOMIZE = ("--randomize", "scene.ground.friction=0.1:0.4")
FEW = ("--generations", "2", "--population", "4", "--seeds", "1", "--check-seeds", "1")
SMALL = (*FEW, "--duration", "0.5", "--frame-skip", "4", *RANDOMIZE)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a search with two processes."""
    out = tmp_path_factory.mktemp("train") / "two"
    assert (
        main(["policy", "train", "surveyed_clutter", *SMALL, "--workers", "2", "--out", str(out)])
        == 0
    )
    return out


def test_a_search_leaves_a_policy_and_its_learning_curve(trained: Path) -> None:
    rows = list(csv.DictReader((trained / "curve.csv").open()))
    assert [row["episodes"] for row in rows] == ["4", "8", "8"]
    assert rows[0]["check_reward"]
    assert not rows[1]["check_reward"]
    assert rows[2]["check_reward"]
    assert (trained / "curve.png").read_bytes().startswith(b"\x89PNG")
    told = {one.key: one.value for one in onnx.load(trained / "policy.onnx").metadata_props}
    assert told["snakesim.trained_by"].startswith(
        "snakesim policy train surveyed_clutter --form feeling --duration 0.5 "
    )
    assert " ".join(("--frame-skip 4", *RANDOMIZE)) in told["snakesim.trained_by"]
    assert told["snakesim.frame_skip"] == "4"
    assert set(json.loads(told["snakesim.learned"])) == set(FORMS["feeling"])


def test_training_search_resumed_reaches_the_same_policy(trained: Path, tmp_path: Path) -> None:
    out = tmp_path / "two"
    out.mkdir()
    first, second, *_ = (trained / "search.jsonl").read_bytes().splitlines(keepends=True)
    (out / "search.jsonl").write_bytes(first + second + b'{"rewards": [0.')  # killed while it wrote
    # With another number of processes than the first search, because that changes nothing.
    typed = ["policy", "train", "surveyed_clutter", *SMALL, "--workers", "1", "--out", str(out)]
    assert main(typed) == main([*typed, "--resume", "--seed", "2"]) == 2, (
        "another search is in that folder"
    )
    assert main([*typed, "--resume"]) == 0
    for name in ("policy.onnx", "curve.csv", "search.jsonl"):
        assert (out / name).read_bytes() == (trained / name).read_bytes(), name


@pytest.mark.slow
def test_a_search_begins_where_another_one_ended(trained: Path, tmp_path: Path) -> None:
    began = read_learned_parameters(str(trained / "policy.onnx"))
    nothing = (
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
    typed = [
        "policy",
        "train",
        "surveyed_clutter",
        *nothing,
        "--init",
        str(trained / "policy.onnx"),
        "--spread",
        "0.01",
    ]
    assert main([*typed, "--workers", "1", "--out", str(tmp_path / "on")]) == 0
    ended = read_learned_parameters(str(tmp_path / "on" / "policy.onnx"))
    assert ended.keys() == began.keys()
    for name, one in FORMS["feeling"].items():
        assert abs(ended[name] - began[name]) < 0.1 * one.sigma
    (tmp_path / "other.onnx").write_bytes(b"no model")
    for wrong in (str(tmp_path / "other.onnx"), str(tmp_path / "absent.onnx")):
        assert main([*typed[:-3], wrong, "--out", str(tmp_path / "on")]) == 2


@pytest.mark.slow
def test_the_number_of_processes_changes_nothing(trained: Path, tmp_path: Path) -> None:
    main(
        [
            "policy",
            "train",
            "surveyed_clutter",
            *SMALL,
            "--workers",
            "1",
            "--out",
            str(tmp_path / "one"),
        ]
    )
    for name in ("policy.onnx", "curve.csv"):
        assert (tmp_path / "one" / name).read_bytes() == (trained / name).read_bytes(), name


def test_the_file_computes_what_was_searched_with(tmp_path: Path) -> None:
    env = SnakeEnv("surveyed_clutter", observe=OBSERVE, duration=1)
    values = {name: one.start + one.sigma for name, one in FORMS["feeling"].items()}
    sizes = {name: len(part.names) for name, part in env.parts.items()}
    policy = PolicyArrays.make_from_parameters(
        values, [joint.axis for joint in env.description.joints], sizes
    )
    write_onnx_file(tmp_path / "policy.onnx", policy, values, 5, ["snakesim", "policy", "train"])
    model = PolicyModel(env.description, str(tmp_path / "policy.onnx"))
    random = np.random.default_rng(1)
    for _ in range(20):
        seen = random.normal(size=len(env.observation_names)).astype(np.float32)
        assert np.allclose(model(seen), policy.compute_targets(seen), atol=1e-5)


@pytest.mark.parametrize("backend", ["sim", pytest.param("can", marks=pytest.mark.slow)])
def test_what_was_trained_drives_simulator_and_emulated_modules(
    trained: Path, backend: str
) -> None:
    name = f"policy:{trained / 'policy.onnx'}"
    run = snakesim.run("surveyed_clutter", controller=name, duration=1, backend=backend)
    assert run.complete
    assert np.ptp(run["target.joint_5"]) > 0.05


@pytest.mark.parametrize(
    ("name", "out"), [("clutter", "trained"), ("free", "free"), ("lab", "lab")]
)
def test_training_shipped_policy_names_its_documented_command(name: str, out: str) -> None:
    told = {one.key: one.value for one in onnx.load(POLICY_FOLDER / f"{name}.onnx").metadata_props}
    page = (
        (REPOSITORY / "docs" / "development" / "shipped-policies.md")
        .read_text()
        .replace("\\\n", " ")
    )
    (given,) = [
        line
        for line in page.splitlines()
        if line.startswith("snakesim policy train") and line.endswith(f"--out {out}")
    ]
    ours, documented = (
        vars(make_parser().parse_args(words))
        for words in (
            [*told["snakesim.trained_by"].split()[1:], "--out", out],
            shlex.split(given)[1:],
        )
    )
    assert ours == documented


@pytest.mark.slow
def test_training_shipped_policy_crosses_an_unseen_field() -> None:
    given = {"scene.random_field.0.seed": 5400}
    run = snakesim.run(
        "surveyed_clutter", controller="policy:clutter", duration=4, seed=5400, set=given
    )
    assert run.complete
    assert (run.metrics["advance_m"] or 0.0) > 2.95


def test_training_policy_of_other_robot_or_missing_is_refused(trained: Path) -> None:
    with raises_error(snakesim.ConfigError, code="policy/invalid", field="policy.onnx"):
        snakesim.run("mamba_flat", controller=f"policy:{trained / 'policy.onnx'}")
    with raises_error(snakesim.ConfigError, code="config/unknown-name", field="cluter"):
        snakesim.run("surveyed_clutter", controller="policy:cluter")
