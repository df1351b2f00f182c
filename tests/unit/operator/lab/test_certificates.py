"""The lab's certificates on the disk: who can read them, and when they are made again."""

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


def states(folder: Path, *, rotate: bool = False) -> dict[str, str]:
    done = write_certificates(LAB, folder, folder / "authority", rotate=rotate)
    return {identity.common_name: state for identity, state, _ in done}


def test_private_keys_are_their_owners_and_never_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lab", "certs", str(EXAMPLE_PATH), "--out", str(tmp_path)]) == 0
    keys = list(tmp_path.rglob("*.key"))
    assert len(keys) == len(list(iterate_identities(LAB))) + 1
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}
    assert stat.S_IMODE((tmp_path / "authority").stat().st_mode) == 0o700
    said = capsys.readouterr()
    assert "PRIVATE" not in said.out + said.err
    assert not list(tmp_path.glob("*/tls/authority.key"))


def test_certificate_is_renewed_in_last_third_of_its_life(tmp_path: Path) -> None:
    assert set(states(tmp_path).values()) == {"made"}
    assert set(states(tmp_path).values()) == {"kept"}
    old = next(identity for identity in iterate_identities(LAB) if identity.role == "gnc")
    at = tmp_path / "ws1" / "tls" / "gnc.planar13.pem"
    certificate, key = issue_certificate(
        load_or_create_authority(tmp_path / "authority", LAB), old, LAB, timedelta(minutes=4)
    )
    at.write_bytes(certificate)
    at.with_suffix(".key").write_bytes(key)
    after = states(tmp_path)
    assert after.pop("gnc.planar13.ws1") == "renewed"
    assert set(after.values()) == {"kept"}
    assert read_certificate(at).not_valid_after_utc > datetime.now(UTC) + timedelta(days=29)
    assert set(states(tmp_path, rotate=True).values()) == {"renewed"}


def test_certificates_of_another_authority_are_replaced(tmp_path: Path) -> None:
    states(tmp_path)
    (tmp_path / "authority").rename(tmp_path / "former")
    assert set(states(tmp_path).values()) == {"renewed"}


def test_an_authority_without_its_key_is_not_replaced_in_silence(tmp_path: Path) -> None:
    states(tmp_path)
    (tmp_path / "authority" / "authority.key").unlink()
    with raises_error(ConfigError, code="certificate/invalid-authority", field="authority.key"):
        states(tmp_path)
