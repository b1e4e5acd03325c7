import sys
from pathlib import Path

import pytest

from depthpose.core.devices import refused_memory
from depthpose.core.errors import (
    InputError,
    MissingExtraError,
    describe_full_memory,
    import_extra,
    suggest_name,
)


def test_the_nearest_name_is_offered() -> None:
    assert suggest_name("eigen-rw", ["eigen-raw", "kitti"]) == (
        "did you mean 'eigen-raw'? Known: 'eigen-raw', 'kitti'."
    )


def test_far_names_are_only_listed() -> None:
    assert suggest_name("zzz", ["b", "a"]) == "Known: 'a', 'b'."
    assert suggest_name("zzz", []) == "Known: none."


def test_a_missing_extra_says_what_to_install() -> None:
    error = MissingExtraError("cv2", "opencv", "SGBM")
    assert str(error) == (
        "SGBM needs cv2, which is not installed: pip install -e '.[opencv]' in the clone of "
        "depthpose, or pip install 'WHEEL[opencv]' with the file of the wheel"
    )


def test_a_package_that_is_not_there_is_not_a_package_that_does_not_load(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"needs open3d, which is not installed: pip"):
        import_extra("open3d", "open3d", "open3d", "registration")

    (tmp_path / "open3d.py").write_text(
        'raise ImportError("libusb-1.0.so.0: cannot open shared object file", name="open3d")\n'
    )
    monkeypatch.delitem(sys.modules, "open3d")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"is installed and does not load: libusb-1\.0\.so\.0: "):
        import_extra("open3d", "open3d", "open3d", "registration")

    full = "libopenblas.so: failed to map segment from shared object"  # under ulimit -v
    (tmp_path / "open3d.py").write_text(f"raise ImportError({full!r}, name='open3d')\n")
    with pytest.raises(InputError, match=r"needs open3d: the memory is full \(libopenblas"):
        import_extra("open3d", "open3d", "open3d", "registration")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError(
            "[enforce fail at alloc_cpu.cpp:1] DefaultCPUAllocator: can't allocate memory"
        ),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 9 bytes."),
        RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        OSError(12, "Cannot allocate memory"),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        RuntimeError("std::bad_alloc"),
    ],
    ids=str,
)
def test_a_full_memory_is_said_whoever_meets_it(error: Exception) -> None:
    said = describe_full_memory(error)
    assert said is not None
    assert said.startswith("the memory is full (")
    assert describe_full_memory(OSError(13, "Permission denied")) is None


def test_an_input_that_is_too_large_for_the_memory_is_named() -> None:
    said = r"^a\.png: the memory is full \(no more is given\); end"
    with pytest.raises(InputError, match=said), refused_memory("a.png"):
        raise MemoryError
    with pytest.raises(RuntimeError, match="another"), refused_memory("a.png"):
        raise RuntimeError("another")
