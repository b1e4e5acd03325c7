"""What each extra installs beside torch and numpy: packages, download and disk.

    python bench/install_sizes.py

In an empty environment that holds what `torch` brings. Nothing else is installed: pip says which
packages it would take, they are downloaded, and their files are counted.
"""

import json
import subprocess
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

from shared import report

PROJECT = Path(__file__).parents[1]
CONSTRAINTS = str(PROJECT / "constraints.txt")


def pip(python: Path, *words: str) -> str:
    """The output of ``python -m pip WORDS``."""
    command = [str(python), "-m", "pip", *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def wanted(python: Path, requirement: str) -> set[str]:
    """The packages that ``pip install REQUIREMENT`` would add, as name==version."""
    words = ("install", "--quiet", "--dry-run", "--report", "-", "-c", CONSTRAINTS, requirement)
    found = json.loads(pip(python, *words))["install"]
    return {"{name}=={version}".format(**package["metadata"]) for package in found}


def wheel(python: Path, package: str, folder: Path) -> Path:
    """The wheel of a package; depthpose's own is built."""
    name = package.split("==")[0]
    where = folder / name
    if not where.exists():
        source = str(PROJECT) if name == "depthpose" else package
        pip(python, "wheel", "--quiet", "--no-deps", "--wheel-dir", str(where), source)
    return next(where.glob("*.whl"))


def size(file: Path) -> tuple[float, float]:
    """Megabytes of a wheel, as downloaded and as unpacked."""
    with zipfile.ZipFile(file) as packed:
        unpacked = sum(entry.file_size for entry in packed.infolist())
    return file.stat().st_size / 1e6, unpacked / 1e6


def row(name: str, wheels: list[Path]) -> dict[str, object]:
    """One row of the table; the three largest packages are named."""
    sizes = {file.name.split("-")[0]: size(file) for file in wheels}
    largest = sorted(sizes, key=lambda key: -sizes[key][1])[:3]
    named = ", ".join(f"{key} {sizes[key][1]:.0f}" for key in largest)
    download, disk = (sum(both[part] for both in sizes.values()) for part in (0, 1))
    return {"installs": name, "packages": len(sizes), "download, MB": download,
            "on disk, MB": disk, "largest, MB on disk": named}  # fmt: skip


def main() -> None:
    """Print a table: the core, then what each extra adds to it."""
    extras = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    torch = next(line for line in Path(CONSTRAINTS).read_text().split() if line.startswith("torch"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "env", with_pip=True)
        python = folder / "env/bin/python"
        pip(python, "install", "--quiet", torch, "numpy")
        core = wanted(python, str(PROJECT))
        rows = [row("core", [wheel(python, package, folder) for package in sorted(core)])]
        for extra in extras:
            more = sorted(wanted(python, f"{PROJECT}[{extra}]") - core)
            rows.append(row(f"`{extra}`", [wheel(python, package, folder) for package in more]))
    report("install_sizes", rows)


if __name__ == "__main__":
    main()
