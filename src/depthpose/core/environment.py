"""What results are computed with: versions, machine, commit."""

import platform
import subprocess
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

_PACKAGES = ("depthpose", "torch", "numpy", "opencv-python-headless")
_GIT_TIMEOUT_S = 5


def describe_environment() -> dict[str, str]:
    """Describe what results are computed with: date, versions, machine, threads, GPU, commit."""
    facts = {"date": datetime.now(UTC).strftime("%Y-%m-%d"), "python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            facts[name] = version(name)
    facts["machine"] = (
        f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
    )
    if torch.cuda.is_available():
        facts["gpu"] = torch.cuda.get_device_name()
    commit = _read_commit()
    if commit:
        facts["commit"] = commit
    return facts


def _read_commit() -> str:
    """Ask Git for the commit of the running code; "" where it is not in a repository."""
    package_folder = str(Path(__file__).resolve().parent)
    # Without any tag (--exclude *), describe falls back (--always) on the hash of the commit.
    command = ["git", "-C", package_folder, "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        process = subprocess.run(  # noqa: S603
            command, capture_output=True, text=True, check=False, timeout=_GIT_TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return process.stdout.strip() if process.returncode == 0 else ""
