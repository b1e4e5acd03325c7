"""Size of the core and of each extra, beside torch and numpy: packages, download and disk.

    python bench/install_sizes.py

An empty environment gets torch and numpy alone. For the core and each extra, pip lists the packages
that it would install; these are downloaded, and their files are counted.
"""

import json
import subprocess
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

from shared import make_parser, report

PROJECT = Path(__file__).parents[1]
CONSTRAINTS = str(PROJECT / "constraints.txt")


def pip(python: Path, *arguments: str) -> str:
    """Run ``python -m pip ARGUMENTS``; return its output."""
    command = [str(python), "-m", "pip", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def packages_of(python: Path, requirement: str) -> set[str]:
    """List the packages that ``pip install REQUIREMENT`` would add, as name==version."""
    report_file = "-"  # standard output
    arguments = ("install", "--quiet", "--dry-run", "--report", report_file, "-c", CONSTRAINTS)
    packages = json.loads(pip(python, *arguments, requirement))["install"]
    return {"{name}=={version}".format(**package["metadata"]) for package in packages}


def get_wheel(python: Path, package: str, folder: Path) -> Path:
    """Download the wheel of a package; depthpose's is built."""
    name = package.split("==")[0]
    wheel_folder = folder / name
    if not wheel_folder.exists():
        source = str(PROJECT) if name == "depthpose" else package
        pip(python, "wheel", "--quiet", "--no-deps", "--wheel-dir", str(wheel_folder), source)
    return next(wheel_folder.glob("*.whl"))


def unpacked_mb(wheel: Path) -> float:
    """Compute the size of a wheel's files [MB]."""
    with zipfile.ZipFile(wheel) as archive:
        return sum(entry.file_size for entry in archive.infolist()) / 1e6


def table_row(name: str, wheels: list[Path]) -> dict[str, object]:
    """Add up the sizes of wheels, and name the three largest packages."""
    sizes_mb = {wheel.name.split("-")[0]: unpacked_mb(wheel) for wheel in wheels}
    largest = sorted(sizes_mb, key=lambda package: -sizes_mb[package])[:3]
    return {
        "installs": name,
        "packages": len(sizes_mb),
        "download, MB": sum(wheel.stat().st_size for wheel in wheels) / 1e6,
        "on disk, MB": sum(sizes_mb.values()),
        "largest, MB on disk": ", ".join(
            f"{package} {sizes_mb[package]:.0f}" for package in largest
        ),
    }


def main() -> None:
    """Print a table: the core, then what each extra adds to it."""
    make_parser(__doc__).parse_args()
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    torch = next(line for line in Path(CONSTRAINTS).read_text().split() if line.startswith("torch"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "env", with_pip=True)
        python = folder / "env/bin/python"
        pip(python, "install", "--quiet", torch, "numpy")
        core = packages_of(python, str(PROJECT))
        packages = {"core": core}
        for extra in project["optional-dependencies"]:
            packages[f"`{extra}`"] = packages_of(python, f"{PROJECT}[{extra}]") - core
        rows = []
        for installed, names in packages.items():
            wheels = [get_wheel(python, package, folder) for package in sorted(names)]
            rows.append(table_row(installed, wheels))
    report("install_sizes", rows)


if __name__ == "__main__":
    main()
