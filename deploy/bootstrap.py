"""Builds `.venv` from the hashed locks, with nothing but a Python interpreter; `make setup` and `make lock` call it.

Standard library only, and plain enough for an old Python to read, so that an old Python gets a clear answer.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TOOLS = ROOT / ".tools"
UV = TOOLS / "bin" / "uv"
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
STAMP = VENV / ".setup"
UV_LOCK = Path("deploy", "bootstrap.lock")
WHEELS_LOCK = Path("deploy", "wheels.lock")
LOCK = Path("requirements.lock")

OLDEST = (3, 11)
FALLBACKS = ("python3.13", "python3.12", "python3.11")

PIP_INSTALL = "-m pip install --quiet --root-user-action=ignore --no-deps --require-hashes --only-binary :all:"
COMPILE = (
    "pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest --generate-hashes"
    " --no-emit-index-url --no-emit-find-links"
)
APT_INSTALL = "apt-get install -y --no-install-recommends"

# Of the caller's PIP_* and UV_* variables we keep those that say where and how to fetch. The others
# (PIP_TARGET, UV_SYSTEM_PYTHON, UV_PROJECT ...) would move the install; hashes make any mirror safe.
INSTALLER_VARIABLES = ("PIP_", "UV_", "PYTHON", "VIRTUAL_ENV", "CONDA_")
HOW_TO_FETCH = re.compile(
    "INDEX|FIND_LINKS|CERT|TLS|PROXY|HOST|KEYRING|TIMEOUT|RETRIES|CACHE|OFFLINE|LINK_MODE|CONCURRENT|CONFIG_FILE"
)


def main() -> None:
    """Parse the command line, and run the requested command."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command")
    commands.required = True
    setup_command = commands.add_parser("setup", help="make .venv")
    setup_command.add_argument(
        "--python", default="", help="the interpreter to use (default: search)"
    )
    lock_command = commands.add_parser("lock", help="rewrite the hashed lock files")
    lock_command.add_argument(
        "--upgrade", action="store_true", help="take the newest versions allowed"
    )
    arguments = parser.parse_args()
    os.chdir(str(ROOT))
    if arguments.command == "setup":
        set_up(arguments.python)
    else:
        lock(arguments.upgrade)


def set_up(requested: str) -> None:
    """Make `.venv` hold exactly the packages of the lock, plus this project in editable form."""
    reuse = not requested and environment_is_usable()
    python = str(VENV_PYTHON) if reuse else find_python(requested)
    if STAMP.exists():
        STAMP.unlink()
    install_uv(python)
    if not reuse:
        make_venv = "venv --quiet --clear --no-python-downloads --prompt snakesim --python"
        run(UV, *make_venv.split(), python, VENV)
    options = ("--quiet", "--python", VENV_PYTHON)
    run(UV, "pip", "sync", *options, "--require-hashes", "--only-binary", ":all:", LOCK)
    run(UV, "pip", "install", *options, "--no-deps", "--no-build-isolation", "--editable", ".")
    run(VENV_PYTHON, "-m", "snakesim_native.compile")
    run(UV, "pip", "check", *options, advice="requirements.lock is out of date: run `make lock`")
    STAMP.write_text(f"{ROOT}\n{requested}\n", encoding="utf-8")
    print(f"setup: .venv is ready (Python {python_version(VENV_PYTHON)})")


def lock(upgrade: bool) -> None:
    """Resolve the lock files for every supported Python and platform, without any address in them."""
    install_uv(find_python(""))
    resolve = (
        UV,
        *COMPILE.split(),
        "--custom-compile-command",
        "make lock",
        *["--upgrade"] * upgrade,
    )
    run(*resolve, "--all-extras", "--group", "dev", "pyproject.toml", "--output-file", LOCK)
    run(*resolve, "--group", "bootstrap", "--output-file", UV_LOCK)
    run(*resolve, "--group", "wheels", "--output-file", WHEELS_LOCK)
    for file in (LOCK, UV_LOCK, WHEELS_LOCK):
        address = re.search(r".*(://|file:|--find-links|\s/).*", file.read_text(encoding="utf-8"))
        if address:
            sys.exit(f"lock: {file} must hold no address: {address.group().strip()}")


def environment_is_usable() -> bool:
    """Return whether `.venv` was made for this very folder and its Python still runs."""
    if not STAMP.exists() or STAMP.read_text(encoding="utf-8").splitlines()[:1] != [str(ROOT)]:
        return False
    return is_new_enough(VENV_PYTHON)


def find_python(requested: str) -> str:
    """Return the interpreter that was asked for, or the first new enough one; exit when there is none."""
    for candidate in [requested] if requested else [sys.executable, *FALLBACKS]:
        path = shutil.which(candidate)
        if path and is_new_enough(path):
            return path
    oldest = ".".join(map(str, OLDEST))
    found = requested or sys.executable
    version = python_version(found) or "not a working Python"
    sys.exit(
        f"setup: SnakeSIM needs Python {oldest} or newer; {found} is {version}.\n"
        f"Install one and name it: make setup PYTHON=/path/to/python{oldest}"
    )


def is_new_enough(python: object) -> bool:
    """Return whether this interpreter runs and is at least `OLDEST`."""
    version = python_version(python)
    return bool(version) and tuple(map(int, version.split(".")[:2])) >= OLDEST


def python_version(python: object) -> str:
    """Return for example "3.11.7", or "" when it does not run."""
    return probe(python, "-c", "import sys; print('%d.%d.%d' % sys.version_info[:3])")


def install_uv(python: str) -> None:
    """Put the pinned uv into `.tools/bin`, unless it is there already."""
    pinned = re.search(r"^uv==(\S+)", UV_LOCK.read_text(encoding="utf-8"), re.MULTILINE)
    if pinned and probe(UV, "--version").split()[1:2] == [pinned.group(1)]:
        return
    shutil.rmtree(str(TOOLS), ignore_errors=True)
    pip_install = (*PIP_INSTALL.split(), "-r", UV_LOCK)
    if has_pip(python):
        run(python, *pip_install, "--target", TOOLS)
        return
    if not has_venv(python):
        install_debian_venv(python)
    run(python, "-m", "venv", TOOLS)
    run(TOOLS / "bin" / "python", *pip_install)


def has_pip(python: str) -> bool:
    """Return whether this interpreter has pip."""
    return bool(probe(python, "-m", "pip", "--version"))


def has_venv(python: str) -> bool:
    """Return whether `python -m venv` can put pip into a new environment; Debian splits that off."""
    return bool(probe(python, "-c", "import venv, ensurepip; print(ensurepip.version())"))


def install_debian_venv(python: str) -> None:
    """Install Debian's package of venv if the user is root; otherwise exit with the command to type."""
    package = "python{}-venv".format(*re.findall(r"^\d+\.\d+", python_version(python)))
    install = [*APT_INSTALL.split(), package]
    if os.geteuid() == 0 and shutil.which("apt-get"):
        print(f"setup: {python} has neither pip nor venv; installing {package}", flush=True)
        os.environ["DEBIAN_FRONTEND"] = "noninteractive"
        if subprocess.call(install) != 0:
            subprocess.call(["apt-get", "update"])
            subprocess.call(install)
    if not has_venv(python):
        sys.exit(
            f"setup: {python} has neither pip nor a working venv module. On Debian or Ubuntu type:\n"
            f"    sudo apt-get update && sudo {' '.join(install)}\n"
            "then `make setup` again."
        )


def probe(*command: object) -> str:
    """Return what a command prints, stripped, or "" when it is missing or fails."""
    words = [str(word) for word in command]
    try:
        output = subprocess.check_output(words, stderr=subprocess.DEVNULL, env=fetch_environment())
    except (OSError, subprocess.CalledProcessError):
        return ""
    return output.decode("utf-8", "replace").strip()


def run(*command: object, advice: str = "") -> None:
    """Run a command in the clean environment; exit with the advice when it fails."""
    words = [str(word) for word in command]
    status = subprocess.call(words, env=fetch_environment())
    if status:
        sys.exit("bootstrap: " + (advice or f"failed with status {status}: {' '.join(words)}"))


def fetch_environment() -> "dict[str, str]":
    """Return the caller's environment without what would change where or what we install."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(INSTALLER_VARIABLES) or HOW_TO_FETCH.search(name)
    }
    # The first two override a pip.conf that asks for --user or for an active environment. The last one keeps
    # `python -m` from taking modules from the folder in which `make setup` was typed.
    return dict(
        kept,
        PIP_USER="0",
        PIP_REQUIRE_VIRTUALENV="0",
        PIP_DISABLE_PIP_VERSION_CHECK="1",
        PYTHONSAFEPATH="1",
    )


if __name__ == "__main__":
    main()
