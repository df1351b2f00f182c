"""`snakesim lab certs` protects private keys: it keeps folder modes and reports keys that other users can read."""

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


def read_mode(path: Path) -> int:
    """Return the permission bits of a file or folder."""
    return stat.S_IMODE(path.stat().st_mode)


def create_certificates(out: Path, *options: str) -> int:
    """Run `snakesim lab certs` for the example lab, and return its exit code."""
    return main(["lab", "certs", str(EXAMPLE_PATH), "--out", str(out), *options])


def test_lab_certs_keeps_mode_of_existing_authority_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    authority_folder = tmp_path / "shared"
    authority_folder.mkdir()
    authority_folder.chmod(0o755)
    assert create_certificates(tmp_path / "lab", "--authority", str(authority_folder)) == 2
    assert read_mode(authority_folder) == 0o755
    assert not list(authority_folder.iterdir())
    error_text = capsys.readouterr().err
    assert "others may look or write into this folder (mode 755)" in error_text
    assert f"chmod 700 {authority_folder}" in error_text
    authority_folder.chmod(0o700)
    assert create_certificates(tmp_path / "lab", "--authority", str(authority_folder)) == 0
    assert read_mode(authority_folder) == 0o700
    assert create_certificates(tmp_path / "lab", "--authority", str(tmp_path / "a" / "new")) == 0
    assert read_mode(tmp_path / "a" / "new") == 0o700


def test_lab_certs_refuses_authority_key_readable_by_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert create_certificates(tmp_path) == 0
    key = tmp_path / "authority" / "authority.key"
    key.chmod(0o644)
    assert create_certificates(tmp_path, "--rotate") == 2
    error_text = capsys.readouterr().err
    assert (
        f"{key}: every user of this computer may read this private key (mode 644); chmod 600 {key}"
        in error_text
    )
    key.chmod(0o600)
    assert create_certificates(tmp_path, "--rotate") == 0


def test_session_file_with_readable_private_key_warns_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = tmp_path / "viewer.key"
    key.touch(0o600)
    session_file = tmp_path / "session.json5"
    session_file.write_text(
        '{mode: "client", connect: {endpoints: ["tls/127.0.0.1:7447"]}, '
        "scouting: {multicast: {enabled: false}, gossip: {enabled: false}}, "
        f'transport: {{link: {{tls: {{connect_private_key: "{key}"}}}}}}}}'
    )
    read_session(session_file)
    assert not capsys.readouterr().err
    key.chmod(0o644)
    _warn.cache_clear()
    assert read_session(session_file).endpoints
    assert read_session(session_file).endpoints
    warnings = capsys.readouterr().err.splitlines()
    assert len(warnings) == 1
    assert f"warning: {key}: every user of this computer may read this private key" in warnings[0]


def test_lab_check_reports_private_key_readable_by_all(tmp_path: Path) -> None:
    assert create_certificates(tmp_path) == 0
    lines = list[str]()
    identity = next(iterate_identities(load_lab(EXAMPLE_PATH)))
    results = CheckResults(lines.append)
    _check_certificate(identity, tmp_path, results)
    assert not results.wrong
    (tmp_path / identity.machine / "tls" / f"{identity.label}.key").chmod(0o604)
    _check_certificate(identity, tmp_path, results)
    assert results.wrong == 1
    assert "every user of this computer may read this private key (mode 604)" in lines[-1]


@pytest.mark.heavy
@pytest.mark.parametrize("max_memory_mb", [20, 30, 40, 100])
def test_lab_certs_without_enough_memory_prints_one_line(
    tmp_path: Path, max_memory_mb: int
) -> None:
    command = [*SNAKESIM_COMMAND, "lab", "certs", str(EXAMPLE_PATH), "--out", str(tmp_path / "lab")]
    limited_command = ["sh", "-c", f'ulimit -v {max_memory_mb * 1024}; exec "$@"', "sh", *command]
    completed = run_program(
        limited_command, tmp_path, make_environment(tmp_path, PYTHONDONTWRITEBYTECODE="1"), 60.0
    )
    assert completed.code in (0, 1), completed.err
    assert "Traceback" not in completed.err, completed.err
    if completed.code == 1:
        assert len(completed.err.splitlines()) == 1
        assert f"needs more memory than `ulimit -v` allows, {max_memory_mb} MB" in completed.err
