"""The certificate files of a lab: which users can read them, and when they are renewed."""

import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.cli import main
from snakesim_operator.features.lab.certificates import (
    issue_certificate,
    load_or_create_authority,
    read_certificate,
    write_certificates,
)
from snakesim_operator.features.lab.identities import iterate_identities
from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH, load_lab
from snakesim_testing.messages import raises_error

LAB = load_lab(EXAMPLE_PATH)


def write_and_list_states(folder: Path, *, rotate: bool = False) -> dict[str, str]:
    """Write the certificates, and return for each name whether it was made, kept or renewed."""
    results = write_certificates(LAB, folder, folder / "authority", rotate=rotate)
    return {identity.common_name: state for identity, state, _ in results}


def test_certificate_keys_are_private_and_never_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lab", "certs", str(EXAMPLE_PATH), "--out", str(tmp_path)]) == 0
    keys = list(tmp_path.rglob("*.key"))
    assert len(keys) == len(list(iterate_identities(LAB))) + 1
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}
    assert stat.S_IMODE((tmp_path / "authority").stat().st_mode) == 0o700
    output = capsys.readouterr()
    assert "PRIVATE" not in output.out + output.err
    assert not list(tmp_path.glob("*/tls/authority.key"))


def test_certificate_is_renewed_in_last_third_of_its_life(tmp_path: Path) -> None:
    assert set(write_and_list_states(tmp_path).values()) == {"made"}
    assert set(write_and_list_states(tmp_path).values()) == {"kept"}
    identity = next(identity for identity in iterate_identities(LAB) if identity.role == "gnc")
    path = tmp_path / "ws1" / "tls" / "gnc.planar13.pem"
    authority = load_or_create_authority(tmp_path / "authority", LAB)
    certificate, key = issue_certificate(authority, identity, LAB, timedelta(minutes=4))
    path.write_bytes(certificate)
    path.with_suffix(".key").write_bytes(key)
    states = write_and_list_states(tmp_path)
    assert states.pop("gnc.planar13.ws1") == "renewed"
    assert set(states.values()) == {"kept"}
    assert read_certificate(path).not_valid_after_utc > datetime.now(UTC) + timedelta(days=29)
    assert set(write_and_list_states(tmp_path, rotate=True).values()) == {"renewed"}


def test_certificates_of_another_authority_are_replaced(tmp_path: Path) -> None:
    write_and_list_states(tmp_path)
    (tmp_path / "authority").rename(tmp_path / "former")
    assert set(write_and_list_states(tmp_path).values()) == {"renewed"}


def test_certificate_authority_without_its_key_is_refused(tmp_path: Path) -> None:
    write_and_list_states(tmp_path)
    (tmp_path / "authority" / "authority.key").unlink()
    with raises_error(ConfigError, code="certificate/invalid-authority", field="authority.key"):
        write_and_list_states(tmp_path)
