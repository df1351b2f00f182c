"""Private keys of a lab: a folder that is there keeps its mode, and keys that everybody may read are named."""

import stat
from pathlib import Path

import pytest

from snakesim_hal.network.private_keys import _warn
from snakesim_hal.network.session_file import read_session
from snakesim_operator.cli import main
from snakesim_operator.features.lab.check import CheckResults, _check_certificate
from snakesim_operator.features.lab.identities import iterate_identities
from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH, load_lab
from snakesim_testing.harness.command import SNAKESIM_COMMAND, make_environment, run_program


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def certs(out: Path, *more: str) -> int:
    return main(["lab", "certs", str(EXAMPLE_PATH), "--out", str(out), *more])


def test_a_folder_that_is_there_keeps_its_mode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o755)
    assert certs(tmp_path / "lab", "--authority", str(shared)) == 2
    assert mode(shared) == 0o755
    assert not list(shared.iterdir())
    said = capsys.readouterr().err
    assert "others may look or write into this folder (mode 755)" in said
    assert f"chmod 700 {shared}" in said
    shared.chmod(0o700)
    assert certs(tmp_path / "lab", "--authority", str(shared)) == 0
    assert mode(shared) == 0o700
    assert certs(tmp_path / "lab", "--authority", str(tmp_path / "a" / "new")) == 0
    assert mode(tmp_path / "a" / "new") == 0o700


def test_an_authority_that_everybody_may_read_signs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert certs(tmp_path) == 0
    key = tmp_path / "authority" / "authority.key"
    key.chmod(0o644)
    assert certs(tmp_path, "--rotate") == 2
    said = capsys.readouterr().err
    assert (
        f"{key}: every user of this computer may read this private key (mode 644); chmod 600 {key}"
        in said
    )
    key.chmod(0o600)
    assert certs(tmp_path, "--rotate") == 0


def test_private_key_readable_by_all_is_named_in_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = tmp_path / "viewer.key"
    key.touch(0o600)
    path = tmp_path / "session.json5"
    path.write_text(
        '{mode: "client", connect: {endpoints: ["tls/127.0.0.1:7447"]}, '
        "scouting: {multicast: {enabled: false}, gossip: {enabled: false}}, "
        f'transport: {{link: {{tls: {{connect_private_key: "{key}"}}}}}}}}'
    )
    read_session(path)
    assert not capsys.readouterr().err
    key.chmod(0o644)
    _warn.cache_clear()
    assert read_session(path).endpoints
    assert read_session(path).endpoints
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert f"warning: {key}: every user of this computer may read this private key" in said[0]


def test_a_check_of_the_lab_marks_such_a_key(tmp_path: Path) -> None:
    assert certs(tmp_path) == 0
    said, identity = list[str](), next(iterate_identities(load_lab(EXAMPLE_PATH)))
    found = CheckResults(said.append)
    _check_certificate(identity, tmp_path, found)
    assert not found.wrong
    (tmp_path / identity.machine / "tls" / f"{identity.label}.key").chmod(0o604)
    _check_certificate(identity, tmp_path, found)
    assert found.wrong == 1
    assert "every user of this computer may read this private key (mode 604)" in said[-1]


@pytest.mark.parametrize("max_mb", [20, 30, 40, 100])
def test_too_little_memory_is_one_line(tmp_path: Path, max_mb: int) -> None:
    typed = [*SNAKESIM_COMMAND, "lab", "certs", str(EXAMPLE_PATH), "--out", str(tmp_path / "lab")]
    limited = ["sh", "-c", f'ulimit -v {max_mb * 1024}; exec "$@"', "sh", *typed]
    ended = run_program(
        limited, tmp_path, make_environment(tmp_path, PYTHONDONTWRITEBYTECODE="1"), 60.0
    )
    assert ended.code in (0, 1) and "Traceback" not in ended.err, ended.err
    if ended.code == 1:
        assert len(ended.err.splitlines()) == 1
        assert f"needs more memory than `ulimit -v` allows, {max_mb} MB" in ended.err
