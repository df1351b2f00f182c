"""Signs a record with Ed25519, and checks the signature.

The signature covers every field but itself, as JSON with sorted keys. It needs the extra `lab`.
"""

import base64
import hashlib
import os
from pathlib import Path

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.private_keys import check_permissions
from snakesim_operator.features.qualification.protocol.record import Record, Signature


def load_or_create_key(path: Path) -> Ed25519PrivateKey:
    """Load the private key that signs records, or create one that only its owner may read.

    Raises:
        ConfigError: The file is no Ed25519 key, cannot be read or written, or every user may read it.
    """
    if not path.exists():
        return _create_key(path)
    problem = check_permissions(path)
    if problem:
        raise ConfigError(problem, code="file/not-readable")
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f"--key {path}: cannot be read: {error}", code="file/not-readable"
        ) from error
    if not isinstance(key, Ed25519PrivateKey):
        raise ConfigError(
            f"--key {path}: a record is signed with Ed25519; make a key with `openssl genpkey -algorithm ed25519`, or "
            f"name a file that does not exist",
            code="file/not-readable",
        )
    return key


def _create_key(path: Path) -> Ed25519PrivateKey:
    key = Ed25519PrivateKey.generate()
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(pem)
    except OSError as error:
        raise ConfigError(
            f"--key {path}: cannot be written: {error.strerror}", code="file/not-writable"
        ) from error
    return key


def sign_record(record: Record, key: Ed25519PrivateKey) -> Record:
    """Return a record with the signature of all its other fields."""
    public_key = key.public_key().public_bytes(
        serialization.Encoding.Raw, serialization.PublicFormat.Raw
    )
    signature = Signature(
        algorithm="ed25519",
        public_key=base64.b64encode(public_key).decode(),
        value=base64.b64encode(key.sign(_make_signed_bytes(record))).decode(),
    )
    return msgspec.structs.replace(record, signature=signature)


def find_signature_problem(record: Record, expected_public_key: str | None = None) -> str:
    """Return why the signature of a record is not valid; empty if it is.

    Args:
        record: A record that was read from a file.
        expected_public_key: Public key in base64 that must have signed it; None for any.
    """
    signature = record.signature
    if signature is None:
        return "it is not signed"
    if expected_public_key is not None and signature.public_key != expected_public_key:
        return f"it was signed by another key, {compute_fingerprint(signature.public_key)}"
    try:
        public_key = Ed25519PublicKey.from_public_bytes(
            base64.b64decode(signature.public_key, validate=True)
        )
        public_key.verify(
            base64.b64decode(signature.value, validate=True), _make_signed_bytes(record)
        )
    except (ValueError, InvalidSignature):
        return "its signature does not fit its content: it was changed after it was signed"
    return ""


def compute_fingerprint(public_key: str) -> str:
    """Return a short text by which people compare public keys."""
    return "SHA256:" + hashlib.sha256(public_key.encode()).hexdigest()[:32]


def _make_signed_bytes(record: Record) -> bytes:
    """Return the bytes that are signed: the record without its signature.

    They are those of the record as it is read from a file, in which every number of a check is a float.
    """
    unsigned = msgspec.structs.replace(record, signature=None)
    as_read = msgspec.json.decode(msgspec.json.encode(unsigned), type=Record)
    return msgspec.json.encode(as_read, order="sorted")
