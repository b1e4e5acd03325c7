import sys
from pathlib import Path

import pytest

from depthpose.core.errors import InputError, MissingExtraError, import_open3d, nearest_name


def test_the_nearest_name_is_offered() -> None:
    assert nearest_name("eigen-rw", ["eigen-raw", "kitti"]) == (
        "did you mean 'eigen-raw'? Known: 'eigen-raw', 'kitti'."
    )


def test_far_names_are_only_listed() -> None:
    assert nearest_name("zzz", ["b", "a"]) == "Known: 'a', 'b'."
    assert nearest_name("zzz", []) == "Known: none."


def test_a_missing_extra_says_what_to_install() -> None:
    error = MissingExtraError("cv2", "opencv", "SGBM")
    assert str(error) == (
        "SGBM needs cv2, which is not installed: pip install -e '.[opencv]' in the clone of "
        "depthpose"
    )


def test_a_package_that_is_not_there_is_not_a_package_that_does_not_load(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"needs open3d, which is not installed: pip"):
        import_open3d("registration")

    (tmp_path / "open3d.py").write_text(
        'raise ImportError("libusb-1.0.so.0: cannot open shared object file", name="open3d")\n'
    )
    monkeypatch.delitem(sys.modules, "open3d")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"is installed and does not load: libusb-1\.0\.so\.0: "):
        import_open3d("registration")
