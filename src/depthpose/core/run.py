"""One folder per run, which says what made it: settings, versions, machine, commit."""

import platform
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from depthpose.core.errors import InputError
from depthpose.core.files import read_json, write_json

_RECORD = "run.json"
_PACKAGES = ("depthpose", "torch", "numpy", "opencv-python-headless")


def environment() -> dict[str, str]:
    """Say what a number was measured with: versions, device, threads, commit, date."""
    facts = {"date": datetime.now(UTC).strftime("%Y-%m-%d"), "python": platform.python_version()}
    facts |= {name: found for name in _PACKAGES if (found := _version(name))}
    facts["machine"] = (
        f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
    )
    if torch.cuda.is_available():
        facts["gpu"] = torch.cuda.get_device_name()
    return facts | ({"commit": found} if (found := _commit()) else {})


def claim_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Make ``folder`` the home of a run with these settings, or continue such a run.

    Args:
        folder: made where it is missing.
        settings: JSON values that decide the results; compared with those of an earlier run.

    Raises:
        InputError: the folder holds a run with other settings; the first difference is named.
    """
    record = folder / _RECORD
    if record.exists():
        _refuse_other_settings(folder, read_json(record), dict(settings))
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_json(record, {"settings": dict(settings), "environment": environment()})


def read_settings(folder: Path) -> dict[str, Any] | None:
    """Give the settings that made ``folder``, or None where no run claimed it."""
    record = folder / _RECORD
    if not record.exists():
        return None
    content = read_json(record)
    settings = content.get("settings") if isinstance(content, dict) else None
    if not isinstance(settings, dict):
        raise InputError(f"{record}: has no 'settings'. Delete the file, or choose another folder.")
    return settings


def _refuse_other_settings(folder: Path, record: object, settings: dict[str, Any]) -> None:
    earlier = record.get("settings") if isinstance(record, dict) else None
    if not isinstance(earlier, dict):
        raise InputError(f"{folder / _RECORD}: not a record of a run. Choose another folder.")
    for name in sorted(earlier.keys() | settings.keys()):
        if earlier.get(name) != settings.get(name):
            raise InputError(
                f"{folder}: holds results made with {name} = {earlier.get(name)!r}, but now it is "
                f"{settings.get(name)!r}. Two settings never share a folder: choose another, or "
                "delete this one."
            )


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _commit() -> str:
    """Commit of the source tree, where the package runs from one."""
    here = Path(__file__).resolve().parent
    command = ["git", "-C", str(here), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=False, timeout=5)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout.strip() if found.returncode == 0 else ""
