"""Over ten thousand damaged files: each is read or refused by InputError, soon, in little memory.

Each kind of file has its own seed, so a case comes back by its number.
"""

import time
from pathlib import Path
from random import Random

import pytest
from tests.fuzz.corpus import Kind, kinds

from depthpose.core.errors import InputError

pytestmark = pytest.mark.filterwarnings("ignore::depthpose.core.errors.Notice")
CASES = 200
"""Of each kind."""
_LONGEST_S = 20
resource = pytest.importorskip("resource", reason="a system that says no peak of memory")
_REFUSED_AS_THEY_ARE = ("sparse glb", "run record", "real *camera*.json")
"""Begin as files that their readers refuse: three points, other settings, a camera without size."""
_MOST_KIB = 700_000
"""By which memory may grow over all cases of a kind: peak of the process, measured."""


def test_there_are_ten_thousand_cases() -> None:
    assert len(kinds()) * CASES >= 10_000


@pytest.mark.parametrize("name", [name for name in kinds() if name not in _REFUSED_AS_THEY_ARE])
def test_the_good_file_is_read(tmp_path: Path, name: str) -> None:
    kind = kinds()[name]
    path = place(kind, tmp_path, kind.good)
    for reader in kind.readers[: 1 + (not name.startswith(("ply", "text", "xyz", "pcd")))]:
        reader(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", kinds())
def test_what_is_damaged_is_read_or_refused(tmp_path: Path, name: str) -> None:
    kind, foreign = kinds()[name], []
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for case in range(CASES):
        path = place(kind, tmp_path, kind.damage(kind.good, Random(f"{name} {case}")))
        for reader in kind.readers:
            began = time.process_time()
            try:
                reader(path)
            except InputError:
                pass
            except Exception as error:  # noqa: BLE001 - what is looked for
                foreign.append(f"case {case}: {type(error).__name__}: {str(error)[:200]}")
            assert time.process_time() - began < _LONGEST_S, f"case {case}"
    assert not foreign, "\n".join([f"{len(foreign)} foreign exceptions", *foreign[:10]])
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < _MOST_KIB


def place(kind: Kind, folder: Path, data: bytes) -> Path:
    """Write a case, and beside it what it needs; give what its readers take."""
    for name, content in {**(kind.beside or {}), kind.file: data}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name == kind.file or not path.exists():
            path.write_bytes(content)
    return folder if kind.is_folder else folder / kind.file
