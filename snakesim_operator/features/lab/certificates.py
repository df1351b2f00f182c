"""Creates the lab's own certificate authority, and a short-lived certificate for every identity.

There is no revocation list. If a machine is lost, the administrator removes it from the lab file and restarts the
routers with the rendered rules, which refuse its name at once; its certificate expires a few days later. Private keys
are P-256, only their owner may read them, and nothing here prints them.
"""

import os
import secrets
import stat
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import read_bytes
from snakesim_hal.network.private_keys import check_permissions
from snakesim_operator.features.lab.identities import CertificateIdentity, iterate_identities
from snakesim_operator.features.lab.lab_file import LabPlan

AUTHORITY_NAME = "authority"
CLOCK_SLACK = timedelta(minutes=10)  # a robot's clock may be behind
RENEWAL_FRACTION = 1 / 3  # a certificate is renewed when less than this part of its life is left


@dataclass(frozen=True)
class CertificateIssuer:
    """The certificate authority: what signs certificates."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def load_or_create_authority(folder: Path, lab: LabPlan) -> CertificateIssuer:
    """Load the lab's certificate authority from a folder, or create a new one if the folder has none.

    The private key of the authority stays in this folder: it is copied to no machine.

    Args:
        folder: The folder of the authority.
        lab: The lab, whose name and durations a new authority gets.

    Raises:
        ConfigError: The files in the folder are damaged, or other users may read them.
    """
    certificate_path = folder / f"{AUTHORITY_NAME}.pem"
    key_path = folder / f"{AUTHORITY_NAME}.key"
    if certificate_path.exists() or key_path.exists():
        return _read_authority(certificate_path, key_path)
    _make_private_folder(folder)
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _make_authority_certificate(key, lab)
    _write_file_with_mode(key_path, _encode_key(key), 0o600)
    _write_file_with_mode(
        certificate_path, certificate.public_bytes(serialization.Encoding.PEM), 0o644
    )
    return CertificateIssuer(certificate, key)


def _make_authority_certificate(key: ec.EllipticCurvePrivateKey, lab: LabPlan) -> x509.Certificate:
    """Make the authority's own certificate, signed by itself. It may only sign certificates and revocation lists.

    Args:
        key: Private key of the authority.
        lab: The lab, with its name and the days for which the certificate is valid.
    """
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"{lab.file.name} authority")])
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    return (
        _make_certificate_builder(name, name, timedelta(days=lab.file.authority_days))
        .public_key(key.public_key())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )


def _make_private_folder(folder: Path) -> None:
    """Create a folder that only its owner may use. Raises ConfigError for an existing one that others may use."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700)
    except FileExistsError:
        if not folder.is_dir():
            raise ConfigError(
                f"--authority {folder}: is a file; name a folder",
                code="certificate/invalid-authority",
            ) from None
        mode = stat.S_IMODE(folder.stat().st_mode)
        if mode & 0o077:
            raise ConfigError(
                f"--authority {folder}: others may look or write into this folder (mode {mode:o}), and who has the "
                f"authority's key controls the lab. Name a new folder, or make it yours alone: chmod 700 {folder}",
                code="certificate/invalid-authority",
            ) from None


def _read_authority(certificate_path: Path, key_path: Path) -> CertificateIssuer:
    """Read the certificate authority, and check that certificate and key belong together.

    Args:
        certificate_path: File of the certificate.
        key_path: File of the private key, which no other user may read.

    Raises:
        ConfigError: The files are damaged, expired, readable by others, or do not belong together.
    """
    warning = check_permissions(key_path)
    if warning:
        raise ConfigError(
            f"{warning}; as this is the lab's authority, anybody may have joined: better make a new one",
            code="certificate/invalid-authority",
        )
    try:
        certificate = x509.load_pem_x509_certificate(read_bytes(certificate_path))
        key = serialization.load_pem_private_key(read_bytes(key_path), None)
    except ValueError as error:
        raise ConfigError(
            f"{certificate_path.parent}: not an authority of this command: {error}",
            code="certificate/invalid-authority",
        ) from None
    if (
        not isinstance(key, ec.EllipticCurvePrivateKey)
        or key.public_key() != certificate.public_key()
    ):
        raise ConfigError(
            f"{key_path}: not the key of {certificate_path}; restore the one that belongs to it",
            code="certificate/invalid-authority",
        )
    if certificate.not_valid_after_utc < datetime.now(UTC):
        raise ConfigError(
            f"{certificate_path}: expired on {certificate.not_valid_after_utc:%Y-%m-%d}; move the folder away, run "
            "`snakesim lab certs` again, and install the new files on every machine",
            code="certificate/expired",
        )
    return CertificateIssuer(certificate, key)


def issue_certificate(
    issuer: CertificateIssuer,
    identity: CertificateIdentity,
    lab: LabPlan,
    lifetime: timedelta | None = None,
) -> tuple[bytes, bytes]:
    """Create a private key and a certificate that identifies one machine of a lab with its role.

    Args:
        issuer: The authority that signs.
        identity: The router, robot or machine that the certificate is for.
        lab: The lab.
        lifetime: Time for which the certificate is valid; None for `certificate_days` of the lab file.

    Returns:
        Certificate and private key as PEM.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, identity.common_name)])
    if lifetime is None:
        lifetime = timedelta(days=lab.file.certificate_days)
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if identity.role is None:  # a router
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    builder = (
        _make_certificate_builder(subject, issuer.certificate.subject, lifetime)
        .public_key(key.public_key())
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(
            x509.SubjectAlternativeName(_list_alternative_names(identity, lab)), critical=False
        )
    )
    certificate = builder.sign(issuer.key, hashes.SHA256())
    return certificate.public_bytes(serialization.Encoding.PEM), _encode_key(key)


def _list_alternative_names(identity: CertificateIdentity, lab: LabPlan) -> list[x509.GeneralName]:
    """Return the address of a router, which its clients compare; a role has no address, only its name."""
    address = lab.file.machines[identity.machine].address if identity.role is None else None
    if address is None:
        return [x509.DNSName(identity.common_name.replace("_", "-"))]
    try:
        return [x509.IPAddress(ip_address(address))]
    except ValueError:
        return [x509.DNSName(address)]


def write_certificates(
    lab: LabPlan, folder: Path, authority_folder: Path, *, rotate: bool = False
) -> list[tuple[CertificateIdentity, str, datetime]]:
    """Write the certificates of all identities into `folder/MACHINE/tls`.

    Args:
        lab: The lab.
        folder: The output folder.
        authority_folder: The folder of the certificate authority.
        rotate: Renew all certificates. Otherwise those of another authority, for another address, or with less than
            RENEWAL_FRACTION of their life left are renewed.

    Returns:
        Each identity with what was done ("made", "renewed" or "kept"), and the end of its certificate.
    """
    issuer = load_or_create_authority(authority_folder, lab)
    authority_pem = issuer.certificate.public_bytes(serialization.Encoding.PEM)
    results: list[tuple[CertificateIdentity, str, datetime]] = []
    for identity in iterate_identities(lab):
        tls_folder = folder / identity.machine / "tls"
        tls_folder.mkdir(parents=True, exist_ok=True)
        path = tls_folder / f"{identity.label}.pem"
        is_valid = _is_still_valid(path, issuer, identity, lab)
        if is_valid and not rotate:
            action = "kept"
        elif is_valid or path.exists():
            action = "renewed"
        else:
            action = "made"
        if action != "kept":
            certificate, key = issue_certificate(issuer, identity, lab)
            _write_file_with_mode(path.with_suffix(".key"), key, 0o600)
            _write_file_with_mode(path, certificate, 0o644)
        _write_file_with_mode(tls_folder / f"{AUTHORITY_NAME}.pem", authority_pem, 0o644)
        results.append((identity, action, read_certificate(path).not_valid_after_utc))
    return results


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate from a file. Raises ConfigError."""
    try:
        return x509.load_pem_x509_certificate(read_bytes(path))
    except ValueError as error:
        raise ConfigError(
            f"{path}: not a certificate: {error}; remove it and run `snakesim lab certs`",
            code="certificate/invalid-authority",
        ) from None


def _is_still_valid(
    path: Path, issuer: CertificateIssuer, identity: CertificateIdentity, lab: LabPlan
) -> bool:
    """Return whether the certificate at a path is there, and need not be renewed."""
    if not path.exists() or not path.with_suffix(".key").exists():
        return False
    certificate = read_certificate(path)
    try:
        certificate.verify_directly_issued_by(issuer.certificate)
    except (ValueError, TypeError, InvalidSignature):
        return False
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    lifetime = certificate.not_valid_after_utc - certificate.not_valid_before_utc
    remaining = certificate.not_valid_after_utc - datetime.now(UTC)
    return (
        list(names) == _list_alternative_names(identity, lab)
        and remaining > lifetime * RENEWAL_FRACTION
    )


def _make_certificate_builder(
    subject: x509.Name, issuer: x509.Name, lifetime: timedelta
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SLACK)
        .not_valid_after(now + lifetime)
    )


def _encode_key(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write_file_with_mode(path: Path, content: bytes, mode: int) -> None:
    """Replace a file atomically; a private key is readable for its owner only."""
    temporary_path = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    descriptor = os.open(temporary_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(descriptor, mode)
        file.write(content)
        os.fsync(descriptor)
    temporary_path.replace(path)
