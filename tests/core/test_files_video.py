import shutil
import sys
from pathlib import Path

import pytest
import torch

from depthpose.core.errors import InputError, MissingExtraError, Notice
from depthpose.core.files import read_video, write_image, write_video

pytest.importorskip("cv2")


def moving_square(count: int, width: int = 64) -> list[torch.Tensor]:
    frames = torch.zeros(count, 3, 48, width)
    for k in range(count):
        frames[k, 0, 8:40, 4 * k : 4 * k + 24] = 1.0  # red, so that swapped channels show
    return list(frames)


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_a_video_keeps_its_frames_rate_and_colours(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    images = moving_square(7)
    assert write_video(path, iter(images), fps=12.5) == 7
    video = read_video(path)
    assert (video.fps, video.frames) == (12.5, 7)
    read = list(video)
    assert [name for name, _ in read] == [f"drive_{k:06d}" for k in range(7)]
    for (_, image), written in zip(read, images, strict=True):
        assert image.shape == written.shape
        assert float((image - written).abs().mean()) < 0.03
    assert [path.name for path in tmp_path.iterdir()] == [path.name]


def test_a_browser_plays_what_is_written(tmp_path: Path) -> None:
    """MPEG-4 (mp4v), which was written before, has no size in it: it does not play."""
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no Chromium here")
    write_video(tmp_path / "drive.mp4", moving_square(7), fps=12.5)
    (tmp_path / "page.html").write_text('<video muted src="drive.mp4"></video>')
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto((tmp_path / "page.html").as_uri())
        seen = page.evaluate("""() => new Promise(done => {
            const video = document.querySelector("video");
            const say = () => done([video.videoWidth, video.videoHeight, video.currentTime > 0]);
            video.onended = video.onerror = say;
            video.play().catch(say);
        })""")
        browser.close()
    assert seen == [64, 48, True]


def test_an_opencv_without_vp9_writes_mpeg_4_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2

    writer = cv2.VideoWriter

    def without(path: str, codec: int, fps: float, size: tuple[int, int]) -> object:
        is_vp9 = codec == cv2.VideoWriter_fourcc(*"vp09")  # pyright: ignore[reportAttributeAccessIssue]
        return writer() if is_vp9 else writer(path, codec, fps, size)

    monkeypatch.setattr(cv2, "VideoWriter", without)
    with pytest.warns(Notice, match=r"v.mp4: OpenCV encodes no VP9 here, so it is MPEG-4"):
        assert write_video(tmp_path / "v.mp4", moving_square(3), fps=10.0) == 3
    assert len(list(read_video(tmp_path / "v.mp4"))) == 3


def test_a_video_is_read_again_from_its_start(tmp_path: Path) -> None:
    write_video(tmp_path / "v.avi", moving_square(3), fps=10.0)
    video = read_video(tmp_path / "v.avi")
    next(iter(video))
    assert len(list(video)) == len(list(video)) == 3


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"\0" * 4096)
    write_image(tmp_path / "a.png", torch.rand(3, 8, 8))
    with pytest.raises(InputError, match=r"a\.mp4: not a video that OpenCV can decode"):
        read_video(tmp_path / "a.mp4")
    with pytest.raises(InputError, match=r"b\.mp4: no such file"):
        read_video(tmp_path / "b.mp4")
    with pytest.raises(InputError, match=r"\.png is no video format; use \.mp4"):
        read_video(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("name", "images", "fps", "message"),
    [
        ("v.mov", moving_square(1), 10.0, r"\.mov is no writable video format; use \.mp4, \.avi"),
        ("v.mp4", moving_square(1), 0.0, "fps is 0, but a video has a positive rate"),
        ("v.mp4", [], 10.0, "wrote 0 of 0 frames"),
        ("v.mp4", moving_square(1) + moving_square(1, 80), 10.0, "frame 1 is 80x48, but the first"),
    ],
)
def test_what_cannot_be_written_leaves_nothing(
    tmp_path: Path, name: str, images: list[torch.Tensor], fps: float, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / name, images, fps)
    assert list(tmp_path.iterdir()) == []


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"reading a video.*pip install -e '.\[opencv"):
        read_video("v.mp4")


@pytest.mark.parametrize(("ratio", "size"), [((2, 1), (128, 48)), ((1, 2), (64, 96))])
def test_pixels_that_are_not_square_become_so(
    tmp_path: Path, ratio: tuple[int, int], size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "anamorphic.avi"
    write_video(path, iter(moving_square(2)), fps=10.0)
    cv2 = pytest.importorskip("cv2")
    capture = cv2.VideoCapture

    class Anamorphic:
        """A capture whose file names the shape of its pixels, which OpenCV cannot write."""

        def __init__(self, name: str) -> None:
            self.inner = capture(name)

        def get(self, what: int) -> float:
            said = {cv2.CAP_PROP_SAR_NUM: ratio[0], cv2.CAP_PROP_SAR_DEN: ratio[1]}
            return said[what] if what in said else self.inner.get(what)

        def __getattr__(self, name: str) -> object:
            return getattr(self.inner, name)

    monkeypatch.setattr(cv2, "VideoCapture", Anamorphic)
    with pytest.warns(Notice, match=f"frames of 64x48 become {size[0]}x{size[1]}"):
        video = read_video(path)
    (_, image), *_ = list(video)
    assert video.size == size
    assert (image.shape[2], image.shape[1]) == size
    assert float(image[0].mean()) == pytest.approx(float(moving_square(1)[0][0].mean()), abs=0.03)


def test_a_video_that_is_cut_off_says_so(tmp_path: Path) -> None:
    path = tmp_path / "drive.avi"
    write_video(path, moving_square(20), fps=10)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    video = read_video(path)
    assert video.frames == 20
    with pytest.warns(
        Notice, match=r"drive.avi: ends after \d+ of the 20 frames .* damaged or cut"
    ):
        frames = list(video)
    assert 0 < len(frames) < 20
