from depthpose.core.errors import MissingExtraError, nearest_name


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
