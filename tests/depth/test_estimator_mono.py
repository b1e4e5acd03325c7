"""One image: the virtual rig gives the scale, whatever camera took the image."""

import base64
import math
import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tests.depth.constant_selection import BASELINE_M, FOCAL_PX, of_all_kinds, sure_of
from torch import Tensor, nn

import depthpose
from depthpose import FakestereoNet
from depthpose.core.camera import Camera, StereoRig
from depthpose.core.checkpoint import LicenceNotice, read_checkpoint
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import rgb_from_picture
from depthpose.depth.config import (
    Answer,
    GeneratorConfig,
    MatcherConfig,
    PSMNetConfig,
    SGBMConfig,
    Speed,
)
from depthpose.depth.disparity import disparity_from_depth, resize_image
from depthpose.depth.estimator import DepthPipeline
from depthpose.depth.estimator.net import require_matcher_config
from depthpose.depth.evaluate import measure_image_confidence
from depthpose.depth.generators import SelectionGenerator, UNetGenerator
from depthpose.depth.mount import MountFilter
from depthpose.depth.stereo import (
    CallableMatcher,
    PSMNet,
    PSMNetMatcher,
    SearchRange,
    SGBMMatcher,
)
from depthpose.depth.synthesis import make_synthesiser
from depthpose.depth.types import DepthEstimate, DepthInput, Match
from depthpose.depth.weights import (
    calibrate_weights,
    read_generator,
    refuse_alarm_share,
    write_depth_weights,
)


@pytest.fixture(scope="module")
def generator() -> UNetGenerator:
    torch.manual_seed(0)
    config = GeneratorConfig(
        width=2, levels=3, virtual_focal_px=FOCAL_PX, virtual_baseline_m=BASELINE_M
    )
    return UNetGenerator(config)


def camera(width: int, height: int, focal_px: float, baseline_m: float | None = None) -> Camera:
    K = torch.tensor(
        [[focal_px, 0, width / 2 - 0.5], [0, focal_px, height / 2 - 0.5], [0, 0, 1]],
        dtype=torch.float64,
    )
    if baseline_m is None:
        return Camera(width=width, height=height, K=K)
    return StereoRig(width=width, height=height, K=K, baseline_m=baseline_m)


def each_of(net: FakestereoNet, images: Any, **options: Any) -> list[DepthEstimate]:  # noqa: ANN401
    """Estimate many, and raise the first error."""
    found = net.estimate_many(images, **options)
    for one in found:
        if isinstance(one, InputError):
            raise one
    return [one for one in found if isinstance(one, DepthEstimate)]


def by_brightness(left: Tensor, _: Tensor) -> Tensor:
    """A matcher that reads disparity off the image: 10 px a unit of brightness."""
    return 10 * left.mean(0) + 1


def test_depth_is_virtual_focal_times_baseline_over_disparity(generator: UNetGenerator) -> None:
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    image = torch.full((3, 40, 60), 0.5)
    estimate = net.estimate(image, camera(60, 40, FOCAL_PX))
    assert estimate.depth_m is not None
    assert estimate.right is not None
    torch.testing.assert_close(
        estimate.depth_m, torch.full((40, 60), FOCAL_PX * BASELINE_M / 6), rtol=1e-5, atol=0
    )
    assert estimate.right.shape == image.shape


@pytest.mark.parametrize("scale", [0.5, 2.0, 3.0])
def test_another_size_of_the_same_view_gives_the_same_metres(
    generator: UNetGenerator, scale: float
) -> None:
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    ramp = torch.linspace(0.2, 0.8, 120)[None, None].expand(3, 80, 120)
    width, height = round(120 * scale), round(80 * scale)
    whole = net.estimate(ramp, camera(120, 80, 2 * FOCAL_PX)).depth_m
    scaled_camera = camera(width, height, 2 * FOCAL_PX * scale)
    scaled = net.estimate(resize_image(ramp, height, width), scaled_camera).depth_m
    assert whole is not None
    assert scaled is not None
    back = resize_image(scaled[None].expand(3, -1, -1) / 100, 80, 120)[0] * 100
    assert float((back - whole).abs().div(whole)[2:-2, 2:-2].max()) < 0.01


def test_the_users_baseline_changes_disparity_and_no_metre(generator: UNetGenerator) -> None:
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    image = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0))
    rig = camera(60, 40, 90.0, baseline_m=0.1)
    assert isinstance(rig, StereoRig)
    with_rig, without = net.estimate(image, rig), net.estimate(image, camera(60, 40, 90.0))
    assert with_rig.depth_m is not None
    assert without.depth_m is not None
    assert torch.equal(with_rig.depth_m, without.depth_m)
    torch.testing.assert_close(
        with_rig.disparity_px, disparity_from_depth(with_rig.depth_m, rig), rtol=1e-5, atol=1e-6
    )
    torch.testing.assert_close(without.disparity_px, with_rig.disparity_px * 5, rtol=1e-4, atol=0)


def test_one_image_needs_a_focal_length(generator: UNetGenerator) -> None:
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    with pytest.raises(InputError, match="metres from one image need its focal length"):
        net.estimate(torch.rand(3, 8, 8), None)


def test_weights_of_pairs_alone_say_so() -> None:
    net = FakestereoNet(CallableMatcher(by_brightness))
    with pytest.raises(InputError, match="these weights match pairs only"):
        net.estimate(torch.rand(3, 8, 8), camera(8, 8, 10.0))


def small_matcher(work_focal_px: float | None = None) -> PSMNet:
    torch.manual_seed(1)
    return PSMNet(
        PSMNetConfig(
            width=2,
            max_disparity_px=16,
            blocks=(1, 1, 1, 1),
            pools=(2,),
            work_focal_px=work_focal_px,
        )
    )


def test_one_file_serves_one_image_and_pairs(generator: UNetGenerator, tmp_path: Path) -> None:
    path = tmp_path / "both.safetensors"
    write_depth_weights(path, generator=generator, matcher=small_matcher(FOCAL_PX), facts={})
    net = FakestereoNet.load(path, with_check=False)
    image = torch.rand(3, 40, 60)
    alone = net.estimate(image, camera(60, 40, 100.0))
    pair = net.estimate(image, camera(60, 40, 100.0, 0.2), right=image)
    for estimate in (alone, pair):
        assert estimate.disparity_px.shape == (40, 60)
        assert estimate.confidence is not None
        assert estimate.confidence.shape == (40, 60)
    assert pair.right is None


def test_pairs_are_matched_at_the_focal_length_of_the_weights(
    generator: UNetGenerator, tmp_path: Path
) -> None:
    sizes: list[tuple[int, ...]] = []
    path = tmp_path / "both.safetensors"
    write_depth_weights(path, generator=generator, matcher=small_matcher(50.0), facts={})
    net = FakestereoNet.load(path, with_check=False)
    assert net.matcher is not None
    assert isinstance(net.matcher, PSMNetMatcher)
    match_padded = net.matcher._match_padded

    def spy(left: torch.Tensor, right: torch.Tensor, search: SearchRange) -> Match:
        sizes.append(tuple(left.shape[1:]))
        return match_padded(left, right, search)

    net.matcher._match_padded = spy
    image = torch.rand(3, 40, 60)
    net.estimate(image, camera(60, 40, 100.0, 0.2), right=image)
    net.estimate(image, camera(60, 40, 100.0))
    assert sizes == [(40, 60), (48, 72)]


def test_a_generator_alone_takes_any_matcher(generator: UNetGenerator, tmp_path: Path) -> None:
    path, other = tmp_path / "g.safetensors", tmp_path / "s.safetensors"
    write_depth_weights(path, generator=generator, facts={})
    write_depth_weights(other, matcher=small_matcher(), facts={})
    image, lens = torch.rand(3, 40, 60), camera(60, 40, 100.0)
    with pytest.raises(InputError, match="there is no matcher in that"):
        FakestereoNet.load(path)
    own = FakestereoNet.load(path, matcher=CallableMatcher(by_brightness)).estimate(image, lens)
    file = FakestereoNet.load(path, matcher=other).estimate(image, lens)
    narrow = SGBMMatcher(SGBMConfig(num_disparities=32))
    sgbm = FakestereoNet.load(path, matcher=narrow).estimate(image, lens)
    assert [e.disparity_px.shape for e in (own, file, sgbm)] == [(40, 60)] * 3


def test_arguments_that_would_not_be_used_are_refused(
    generator: UNetGenerator, tmp_path: Path
) -> None:
    path, other = tmp_path / "g.safetensors", tmp_path / "s.safetensors"
    write_depth_weights(path, generator=generator, facts={})
    write_depth_weights(other, matcher=small_matcher(), facts={})
    for matcher in ("sgbm", CallableMatcher(by_brightness), other):
        with pytest.raises(InputError, match="matcher is given too, so nothing of these weights"):
            FakestereoNet.load(other, matcher=matcher)
    for config in (
        MatcherConfig(max_disparity_px=32),
        MatcherConfig(with_left_right_check=True),
    ):
        for matcher in ("sgbm", CallableMatcher(by_brightness)):
            with pytest.raises(InputError, match=r"config sets .*Matcher does not take: it is for"):
                FakestereoNet.load(path, matcher=matcher, config=config)


def test_terms_of_the_weights_are_said(generator: UNetGenerator, tmp_path: Path) -> None:
    path = tmp_path / "some-nc.safetensors"
    facts = {"terms": "for research alone"}
    write_depth_weights(path, generator=generator, matcher=small_matcher(), facts=facts)
    with pytest.warns(LicenceNotice, match="for research alone"):
        assert FakestereoNet.load(path).terms == "for research alone"


def test_terms_of_a_matcher_from_another_file_are_said(
    generator: UNetGenerator, tmp_path: Path
) -> None:
    free, bound = tmp_path / "g.safetensors", tmp_path / "s-nc.safetensors"
    write_depth_weights(free, generator=generator, facts={})
    write_depth_weights(bound, matcher=small_matcher(), facts={"terms": "for research alone"})
    with pytest.warns(LicenceNotice, match="for research alone"):
        net = FakestereoNet.load(free, matcher=bound)
    assert net.terms == "for research alone"
    assert FakestereoNet.load(free, matcher="sgbm").terms == ""


def test_many_images_give_what_each_gives_alone(generator: UNetGenerator, tmp_path: Path) -> None:
    path = tmp_path / "both.safetensors"
    write_depth_weights(path, generator=generator, matcher=small_matcher(FOCAL_PX), facts={})
    net = FakestereoNet.load(path)
    sizes = [(60, 40), (60, 40), (72, 40), (60, 40)]
    inputs = [
        DepthInput(
            name=f"{k}",
            left=torch.rand(3, height, width, generator=torch.Generator().manual_seed(k)),
            right=None,
            camera=camera(width, height, 100.0),
        )
        for k, (width, height) in enumerate(sizes)
    ]
    many = each_of(net, inputs, batch=3)
    assert len(many) == 4
    for given, together in zip(inputs, many, strict=True):
        alone = net.estimate_input(given)
        torch.testing.assert_close(together.disparity_px, alone.disparity_px, rtol=1e-4, atol=1e-4)
        assert together.right is not None
        assert alone.right is not None
        torch.testing.assert_close(together.right, alone.right, rtol=1e-4, atol=1e-5)
    assert net.estimate_many([]) == []


def test_among_many_a_pair_is_matched_with_its_right_view(
    generator: UNetGenerator, tmp_path: Path
) -> None:
    path = tmp_path / "both.safetensors"
    write_depth_weights(path, generator=generator, matcher=small_matcher(FOCAL_PX), facts={})
    net = FakestereoNet.load(path, with_check=False)
    left, right = torch.rand(2, 3, 40, 60, generator=torch.Generator().manual_seed(0))
    rig = camera(60, 40, 100.0, baseline_m=0.2)
    alone = DepthInput(name="alone", left=left, right=None, camera=rig)
    pair = DepthInput(name="pair", left=left, right=right, camera=rig)
    many = each_of(net, [alone, pair, pair, alone], batch=4)
    for given, found in zip([alone, pair, pair, alone], many, strict=True):
        one = net.estimate_input(given)
        torch.testing.assert_close(found.disparity_px, one.disparity_px, rtol=1e-4, atol=1e-4)
        assert (found.right is None) == (given.right is not None)


@pytest.mark.parametrize(("batch", "threads"), [(1, 1), (1, 2), (3, 1), (2, 2)])
def test_what_cannot_be_used_costs_the_others_nothing(
    generator: UNetGenerator, tmp_path: Path, batch: int, threads: int
) -> None:
    """A file that is none, a broken array and a pair without a baseline, among images."""
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    good = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0))
    pair = DepthInput(name="pair", left=good, right=good, camera=camera(60, 40, 100.0))
    given = [good, tmp_path / "none.png", good * 255, pair, good.flip(-1)]
    found = net.estimate_many(given, focal_px=100.0, batch=batch, threads=threads)
    errors = [str(one) for one in found if isinstance(one, InputError)]
    assert [isinstance(one, InputError) for one in found] == [False, True, True, True, False]
    named = ["none.png", "^image 2: the image .*divide 8-bit values", "pair.*no baseline"]
    for error, message in zip(errors, named, strict=True):
        assert re.search(message, error)
    for one, image in ((found[0], good), (found[4], good.flip(-1))):
        assert isinstance(one, DepthEstimate)
        expected = net.estimate(image, focal_px=100.0)
        torch.testing.assert_close(one.disparity_px, expected.disparity_px, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("threads", [1, 2])
def test_images_of_a_generator_are_taken_as_they_are_needed(
    generator: UNetGenerator, threads: int, capsys: pytest.CaptureFixture[str]
) -> None:
    taken: list[int] = []
    ahead: list[int] = []

    def pictures() -> Iterator[Tensor]:
        for k in range(20):
            taken.append(k)
            yield torch.full((3, 40, 60), 0.3 + 0.01 * k)

    def noted(left: Tensor, right: Tensor) -> Tensor:
        ahead.append(len(taken))
        return by_brightness(left, right)

    net = FakestereoNet(CallableMatcher(noted), make_synthesiser(generator))
    cores = torch.get_num_threads()
    found = net.estimate_many(pictures(), focal_px=100.0, threads=threads, with_progress=True)
    assert torch.get_num_threads() == cores
    assert all(count <= k + threads for k, count in enumerate(ahead, 1))
    assert "20 images" in capsys.readouterr().err
    means = [float(one.disparity_px.mean()) for one in found if isinstance(one, DepthEstimate)]
    assert len(means) == 20
    assert means == sorted(means)


def test_no_batch_and_no_thread_are_refused(generator: UNetGenerator) -> None:
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    image = torch.rand(1, 3, 40, 60)
    with pytest.raises(InputError, match="batch is 0; take 1 or more"):
        net.estimate_many(image, focal_px=100.0, batch=0)
    with pytest.raises(InputError, match="threads is 0; take 1 or more"):
        net.estimate_many(image, focal_px=100.0, threads=0)


@pytest.mark.parametrize("with_right", [False, True])
def test_values_that_are_no_picture_are_refused(
    generator: UNetGenerator, *, with_right: bool
) -> None:
    """An 8-bit picture as float gave metres: of the white that is left where all is above 1."""
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    image, rig = torch.rand(3, 40, 60), camera(60, 40, 100.0, baseline_m=0.2)
    broken = {
        r"must lie in \[0, 1\], got .*; divide 8-bit values by 255": (image * 255).round(),
        r"must lie in \[0, 1\].*do not normalise": 2 * image - 1,
        r"holds NaN": torch.where(image > 0.5, image, torch.nan),
    }
    for message, given in broken.items():
        sees = DepthInput(
            name="street", left=given, right=given.flip(-1) if with_right else None, camera=rig
        )
        for estimate in (net.estimate_input, lambda one: each_of(net, [one])):
            with pytest.raises(InputError, match="street: the .*" + message):
                estimate(sees)
    slightly_above = image * 1.2 - 0.1  # as bicubic resizing leaves it
    assert net.estimate(slightly_above, rig).depth_m is not None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.zeros((40, 60, 2), np.uint8), r"array of shape \(40, 60, 2\); give \(H, W, 3\)"),
        (np.zeros((5, 40, 60, 3), np.uint8), r"a batch; .* to estimate_many\(batch, camera\)"),
        (torch.zeros(5, 3, 40, 60), r"tensor of shape \(5, 3, 40, 60\), a batch"),
        (np.zeros((40, 60, 3), np.uint16), r"array of uint16; .*divide .* \(65535"),
        (torch.zeros(3, 40, 60, dtype=torch.int32), "tensor of torch.int32; give 8-bit numbers"),
        (np.full((40, 60, 3), 127.0), "divide 8-bit values by 255"),
        (torch.full((3, 40, 60), 127.0), "divide 8-bit values by 255"),
        (Image.new("F", (60, 40)), "the image: 32 bits a pixel"),
        (None, "must be a tensor, got NoneType"),
    ],
)
def test_what_is_no_picture_says_what_is_taken(given: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        rgb_from_picture(given)


GREY = np.arange(40 * 60).reshape(40, 60).astype(np.uint8)
RGB = np.stack([GREY, GREY[::-1], GREY[:, ::-1]], -1)
RGBA = np.concatenate([RGB, GREY[..., None]], -1)


@pytest.mark.parametrize(
    "given",
    [
        RGB,
        RGBA,
        RGB[None],
        RGB / 255,
        (RGB / 255).astype(np.float32),
        RGB.transpose(2, 0, 1),
        torch.from_numpy(RGB).permute(2, 0, 1),
        torch.from_numpy(RGB).permute(2, 0, 1)[None] / 255,
        torch.from_numpy(RGBA),
        Image.fromarray(RGB),
        Image.fromarray(RGBA),
    ],
    ids=[
        *("bytes", "alpha", "batch of one", "float64", "float32", "channels first"),
        *("byte tensor", "batch of a tensor", "tensor, channels last", "pillow", "pillow, alpha"),
    ],
)
def test_any_form_of_a_picture_is_the_same_picture(given: object) -> None:
    expected = torch.from_numpy(RGB).permute(2, 0, 1).float() / 255
    torch.testing.assert_close(rgb_from_picture(given), expected)


@pytest.mark.parametrize(
    "given",
    [GREY, GREY[..., None], GREY / 255, torch.from_numpy(GREY)[None], Image.fromarray(GREY)],
    ids=["bytes", "a channel", "floats", "a tensor", "pillow"],
)
def test_grey_is_three_equal_channels(given: object) -> None:
    expected = torch.from_numpy(GREY).expand(3, -1, -1).float() / 255
    torch.testing.assert_close(rgb_from_picture(given), expected)


def test_a_batch_is_estimated_image_by_image(generator: UNetGenerator) -> None:
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    batch = torch.rand(3, 3, 40, 60)
    alone = [net.estimate(image, focal_px=100.0) for image in batch]
    pixels = [image.permute(1, 2, 0).numpy() for image in batch]
    for together in (each_of(net, batch, focal_px=100.0),
                     each_of(net, pixels, camera=camera(60, 40, 100.0))):  # fmt: skip
        for one, other in zip(alone, together, strict=True):
            torch.testing.assert_close(one.disparity_px, other.disparity_px, rtol=1e-4, atol=1e-4)
    (single,) = each_of(net, batch[0], focal_px=100.0)
    torch.testing.assert_close(single.disparity_px, alone[0].disparity_px, rtol=1e-4, atol=1e-4)


def test_code_for_the_pipeline_of_transformers_runs(generator: UNetGenerator) -> None:
    """One picture gives a dict, a list a list; without a camera a phone's is taken, and said."""
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    pipe = DepthPipeline(net)
    found = pipe(Image.fromarray(RGB), focal_px=100.0)
    assert isinstance(found, dict)
    expected = net.estimate(RGB, focal_px=100.0).depth_m
    torch.testing.assert_close(found["predicted_depth"], expected)
    assert (found["depth"].mode, found["depth"].size) == ("L", (60, 40))
    assert found["depth"].getextrema() == (0, 255)
    farthest = np.unravel_index(int(found["predicted_depth"].argmax()), (40, 60))
    assert np.asarray(found["depth"])[farthest] == 255
    with pytest.warns(Notice, match="a focal length of 45 px is taken, a phone's"):
        several = pipe([RGB])
    assert isinstance(several, list)
    (one,) = several
    torch.testing.assert_close(one["predicted_depth"], net.estimate(RGB, focal_px=45.0).depth_m)
    with pytest.raises(InputError, match="task is 'image-segmentation'; Known: 'depth-estimation'"):
        depthpose.pipeline("image-segmentation")
    assert depthpose.pipeline("depth-estimation", device=-1).net.weights == "default"


def test_the_pipeline_takes_what_that_of_transformers_takes(
    generator: UNetGenerator, tmp_path: Path
) -> None:
    """An address, base64, a generator, images=, a batch: each as the picture itself."""
    pipe = DepthPipeline(
        FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator)), batch_size=2
    )
    Image.fromarray(RGB).save(tmp_path / "street.png")
    plain = base64.b64encode((tmp_path / "street.png").read_bytes()).decode()
    serve = partial(SimpleHTTPRequestHandler, directory=str(tmp_path))
    server = ThreadingHTTPServer(("127.0.0.1", 0), serve)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/"
    try:
        expected = pipe(RGB, focal_px=100.0)
        assert isinstance(expected, dict)
        pictures = [address + "street.png", plain, "data:image/png;base64," + plain, RGB]
        for found in (
            pipe(images=pictures, focal_px=100.0, timeout=10.0),
            pipe((one for one in pictures), focal_px=100.0, batch_size=3),
        ):
            several = list(found)
            assert len(several) == 4
            for one in several:
                assert isinstance(one, dict)
                torch.testing.assert_close(one["predicted_depth"], expected["predicted_depth"])
        with pytest.raises(InputError, match=r"/none.png: is no picture that can be read .*404"):
            pipe(address + "none.png")
    finally:
        server.shutdown()
        server.server_close()
    with pytest.raises(InputError, match=r"data:image/png;base64,AAAA.*: is no picture"):
        pipe("data:image/png;base64," + "A" * 400)
    with pytest.raises(InputError, match=r"street\.jpg: no such file"):
        pipe("street.jpg")
    with pytest.raises(InputError, match="as the first argument or as images="):
        pipe()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"torch_dtype": torch.float16}, "torch_dtype is torch.float16; networks run in float32"),
        ({"dtype": "bfloat16"}, "torch_dtype is bfloat16; networks run in float32, omit it"),
        ({"device": 0, "device_map": "auto"}, "device and device_map are both given"),
        ({"device_map": {"": 0}}, "device_map is a mapping; the networks go to one device"),
        ({"revision": "main"}, "revision is no option here; leave it out"),
    ],
)
def test_what_the_pipeline_cannot_take_is_one_clear_line(
    options: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=f"^pipeline: {re.escape(said)}"):
        depthpose.pipeline("depth-estimation", **options)


@pytest.mark.parametrize("batch_size", [0, -1])
def test_a_batch_of_no_picture_is_refused(batch_size: int, generator: UNetGenerator) -> None:
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    said = f"pipeline: batch_size is {batch_size}; take 1 or more pictures"
    with pytest.raises(InputError, match=said):
        DepthPipeline(net, batch_size)
    for pictures in (RGB, [RGB]):
        with pytest.raises(InputError, match=said):
            DepthPipeline(net)(pictures, focal_px=100.0, batch_size=batch_size)


def test_the_mount_of_a_pair_is_refused(generator: UNetGenerator) -> None:
    net = FakestereoNet(
        CallableMatcher(by_brightness), make_synthesiser(generator), with_check=False
    )
    with pytest.raises(InputError, match="a pair has metres of its own; omit mount, or the right"):
        net.estimate(RGB, camera(60, 40, 100.0, 0.2), right=RGB, mount=MountFilter())


def test_options_of_transformers_that_change_nothing_are_taken() -> None:
    pipe = depthpose.pipeline(
        "depth-estimation", device_map="cpu", torch_dtype="auto", batch_size=4, token=None
    )
    assert (pipe.net.weights, pipe.batch_size) == ("default", 4)


def constant_matcher(disparity_px: float) -> CallableMatcher:
    return CallableMatcher(lambda left, _: torch.full(left.shape[1:], disparity_px))


def test_the_selecting_generator_answers_depth_itself() -> None:
    """Plane 3 is 4 px: no matcher is asked, and the drawn view is the image moved by 4 px."""
    never = CallableMatcher(lambda _, __: pytest.fail("the matcher was asked"))
    net = FakestereoNet(never, make_synthesiser(sure_of(3)))
    image = torch.rand(3, 64, 96, generator=torch.Generator().manual_seed(0))
    found = net.estimate(image, camera(96, 64, FOCAL_PX))
    assert found.depth_m is not None
    torch.testing.assert_close(
        found.depth_m, torch.full((64, 96), FOCAL_PX * BASELINE_M / 4), rtol=1e-4, atol=0
    )
    assert found.right is not None
    torch.testing.assert_close(found.right[..., :-4], image[..., 4:], rtol=0, atol=1e-3)
    assert found.confidence is not None
    assert float(found.confidence.min()) > 0.99
    assert found.is_sky is not None
    assert not bool(found.is_sky.any())


@pytest.mark.parametrize("baseline_m", [None, 0.1])
def test_the_sky_has_no_depth_and_a_disparity_next_to_nothing(baseline_m: float | None) -> None:
    net = FakestereoNet(constant_matcher(3.0), make_synthesiser(sure_of(0)))
    found = net.estimate(torch.rand(3, 64, 96), camera(96, 64, 2 * FOCAL_PX, baseline_m))
    assert found.is_sky is not None
    assert bool(found.is_sky.all())
    assert found.depth_m is not None
    assert bool(found.depth_m.isnan().all())
    rig_m = BASELINE_M if baseline_m is None else baseline_m
    expected = torch.full((64, 96), 2 * FOCAL_PX * rig_m / 10_000)
    torch.testing.assert_close(found.disparity_px, expected, rtol=1e-4, atol=0)
    assert found.confidence is not None
    assert float(found.confidence.min()) > 0.99


def test_the_matcher_is_one_word_away() -> None:
    image, seen = torch.rand(3, 64, 96), camera(96, 64, FOCAL_PX)
    found = {
        answer: FakestereoNet(constant_matcher(2.0), make_synthesiser(sure_of(3, answer)))
        .estimate(image, seen)
        .disparity_px.mean()
        .item()
        for answer in ("own", "matched")
    }
    assert found == pytest.approx({"own": 4.0, "matched": 2.0}, rel=1e-3)


def selection_file(folder: Path, answer: Answer = "own") -> Path:
    """Weights of a generator that is sure of plane 3 (4 px), without a matcher."""
    path = folder / f"{answer}.safetensors"
    write_depth_weights(path, generator=sure_of(3, answer), facts={})
    return path


def test_a_generator_with_an_answer_of_its_own_needs_no_matcher(tmp_path: Path) -> None:
    net = FakestereoNet.load(selection_file(tmp_path))
    assert net.matcher is None
    image, rig = torch.rand(3, 64, 96), camera(96, 64, FOCAL_PX, 0.2)
    found = net.estimate(image, rig).depth_m
    assert found is not None
    assert float(found.mean()) == pytest.approx(FOCAL_PX * BASELINE_M / 4, rel=1e-4)
    pair = DepthInput(name="street", left=image, right=image.flip(-1), camera=rig)
    for estimate in (net.estimate_input, lambda one: each_of(net, [one])):
        with pytest.raises(InputError, match=r"street: .*a pair needs a matcher.*matcher='sgbm'"):
            estimate(pair)


def test_an_answer_of_the_matcher_needs_one(tmp_path: Path) -> None:
    path = selection_file(tmp_path, "matched")
    with pytest.raises(InputError, match="there is no matcher in that"):
        FakestereoNet.load(path)
    with pytest.raises(InputError, match="matcher is None"):
        FakestereoNet(None, make_synthesiser(sure_of(3, "matched")))
    assert FakestereoNet.load(path, matcher=constant_matcher(2.0)).matcher is not None
    with pytest.raises(InputError, match="there is no matcher in that"):
        FakestereoNet.load(path, matcher=path)
    with pytest.raises(InputError, match="did you mean 'psmnet-compact'"):
        FakestereoNet.load(path, matcher="psmnet")
    with pytest.raises(InputError, match="matcher is None"):
        FakestereoNet(None)


def test_the_answer_may_be_another_than_the_weights_say(
    generator: UNetGenerator, tmp_path: Path
) -> None:
    path, painting = selection_file(tmp_path), tmp_path / "g.safetensors"
    write_depth_weights(painting, generator=generator, facts={})
    given = constant_matcher(2.0)
    matched = FakestereoNet.load(path, matcher=given, answer="matched")
    found = matched.estimate(torch.rand(3, 64, 96), camera(96, 64, FOCAL_PX))
    assert float(found.disparity_px.mean()) == pytest.approx(2.0)
    FakestereoNet.load(painting, matcher=given, answer="matched")
    with pytest.raises(InputError, match="answer is 'own'"):
        FakestereoNet.load(painting, matcher=given, answer="own")
    with pytest.raises(InputError, match="answer is 'matched'"):
        FakestereoNet.load(matcher=given, answer="matched")


def unsure(least: float) -> SelectionGenerator:
    """A network that says sky with a probability of 0.3 and one disparity with 0.7."""
    network = sure_of(1)
    network.config = replace(network.config, least_confidence=least)
    network.head.bias = nn.Parameter(torch.tensor([20 + math.log(0.3 / 0.7), 20, 0, 0, 0] * 2))
    return network


def test_an_image_unlike_the_known_is_refused_or_warned_of() -> None:
    image, lens = torch.rand(3, 40, 60), camera(60, 40, FOCAL_PX)
    known = FakestereoNet(None, make_synthesiser(unsure(0.65))).estimate(image, lens)
    assert known.image_confidence == pytest.approx(0.7)
    assert known.warning == ""
    synthesiser = make_synthesiser(unsure(0.8))
    with pytest.raises(
        InputError,
        match=r"cup: out of .* \(mean confidence 0\.70, below 0\.80\), .* allow_ood=True",
    ):
        FakestereoNet(None, synthesiser).estimate(image, lens, name="cup")
    guess = FakestereoNet(None, synthesiser, allow_ood=True).estimate(image, lens, name="cup")
    assert guess.warning.startswith("out of distribution for these weights")
    torch.testing.assert_close(guess.depth_m, known.depth_m)


def test_how_probable_a_street_is_decides_where_the_weights_know_it() -> None:
    """A layer that tells an image from itself upside down refuses the one and answers the other."""
    torch.manual_seed(0)
    upright = torch.full((3, 64, 96), 0.5)
    upright[:, :24] = torch.rand(3, 24, 96)
    images = [upright, upright.flip(1)]
    network = of_all_kinds()
    rows = [network.encoder(image[None])[-1][0].mean(2).double() for image in images]
    y = torch.linspace(-0.5, 0.5, 2).double()
    weights = torch.stack([torch.ones(2).double(), y, (3 * y**2 - 1) / 2])
    first, second = (torch.einsum("cr,mr->mc", row, weights).flatten() / 2 for row in rows)
    across = 40 * (first - second) / (first - second).square().sum()
    network.config = replace(network.config, with_street=True, least_confidence=0.5)
    network.street = nn.Linear(len(across), 1)
    network.street.weight = nn.Parameter(across[None].float())
    network.street.bias = nn.Parameter(-(across @ (first + second))[None].float() / 2)
    net = FakestereoNet(None, make_synthesiser(network, speed="quick"), allow_ood=True)
    street, other = each_of(net, images, camera=camera(96, 64, FOCAL_PX))
    assert (street.image_confidence, street.warning) == (pytest.approx(1.0, abs=1e-3), "")
    assert other.image_confidence == pytest.approx(0.0, abs=1e-3)
    assert "(probability of a street 0.00, below 0.50)" in other.warning


def test_without_a_camera_a_photograph_is_asked_for_its_exif(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 40
    Image.fromarray(RGB).save(tmp_path / "a.jpg", exif=exif.tobytes())
    net = FakestereoNet(None, make_synthesiser(sure_of(1)))
    with pytest.warns(Notice, match=r"a: a focal length of \d+ px, by its EXIF \(Focal.* 40 mm\)"):
        found = net.estimate(tmp_path / "a.jpg")
    height, width = RGB.shape[:2]
    focal_px = 40 / math.hypot(36, 24) * math.hypot(width, height)
    expected = net.estimate(tmp_path / "a.jpg", focal_px=focal_px)
    torch.testing.assert_close(found.depth_m, expected.depth_m)


def test_a_field_of_view_is_a_focal_length() -> None:
    net = FakestereoNet(None, make_synthesiser(sure_of(1)))
    by_angle = net.estimate(RGB, fov_deg=90.0).depth_m
    torch.testing.assert_close(by_angle, net.estimate(RGB, focal_px=RGB.shape[1] / 2).depth_m)
    for degrees in (0.0, 180.0, math.nan):
        with pytest.raises(InputError, match="spans 1 to 170 degrees"):
            net.estimate(RGB, fov_deg=degrees)
    with pytest.raises(InputError, match="focal_px and fov_deg are both given"):
        net.estimate(RGB, focal_px=100.0, fov_deg=90.0)


def test_a_threshold_is_chosen_by_known_images(tmp_path: Path) -> None:
    given, out = tmp_path / "w.safetensors", tmp_path / "c.safetensors"
    write_depth_weights(given, generator=unsure(0.0), facts={"licence": "MIT"})
    images = [
        DepthInput(name=str(k), left=torch.rand(3, 40, 60), right=None,
                    camera=camera(60, 40, FOCAL_PX))
        for k in range(5)
    ]  # fmt: skip
    known = measure_image_confidence(FakestereoNet.load(given, allow_ood=True), images)
    least = calibrate_weights(given, [*known, 0.1, 0.9], 0.2, out)
    assert least == pytest.approx(0.7, abs=1e-4)
    found = read_generator(out)
    assert isinstance(found, SelectionGenerator)
    assert found.config.least_confidence == least
    assert read_checkpoint(out).facts == read_checkpoint(given).facts
    for share in (0.0, 1.0, math.nan):
        with pytest.raises(InputError, match="must be above 0 and below 1"):
            refuse_alarm_share(100, share)
    with pytest.raises(InputError, match=r"7 images cannot say what refuses 0\.01 of them"):
        calibrate_weights(given, [*known, 0.1, 0.9], 0.01, out)


def test_a_generator_without_confidence_cannot_be_calibrated(
    generator: UNetGenerator, tmp_path: Path
) -> None:
    given = tmp_path / "w.safetensors"
    write_depth_weights(given, generator=generator, facts={})
    with pytest.raises(InputError, match="holds no generator that selects"):
        calibrate_weights(given, [0.5, 0.6], 0.5, tmp_path / "c.safetensors")
    net = FakestereoNet(CallableMatcher(by_brightness), make_synthesiser(generator))
    image = DepthInput(name="a", left=torch.rand(3, 40, 60), right=None,
                        camera=camera(60, 40, FOCAL_PX))  # fmt: skip
    with pytest.raises(InputError, match="no generator with a confidence of its own"):
        measure_image_confidence(net, [image])


def speed_of(matcher: PSMNet, speed: Speed) -> PSMNetMatcher:
    return PSMNetMatcher(matcher, MatcherConfig(speed=speed))


@pytest.mark.parametrize(
    ("own_px", "size", "quick", "fine"),
    [
        (FOCAL_PX / 2, (40, 60), (80, 120), (80, 120)),
        (FOCAL_PX, (40, 60), (40, 60), (40, 60)),
        (FOCAL_PX * 2, (40, 60), (20, 30), (40, 60)),
        (FOCAL_PX * 10, (700, 1600), (70, 160), (350, 800)),
        (FOCAL_PX, (700, 1600), (700, 1600), (700, 1600)),
    ],
)
def test_a_fine_match_looks_closer_but_never_enlarges_for_it(
    own_px: float, size: tuple[int, int], quick: tuple[int, int], fine: tuple[int, int]
) -> None:
    network = small_matcher(FOCAL_PX)
    seen = camera(size[1], size[0], own_px)
    assert speed_of(network, "quick").work_size(seen) == quick
    assert speed_of(network, "fine").work_size(seen) == fine
    free = small_matcher(None)
    assert speed_of(free, "fine").work_size(seen) == size


def test_a_fine_match_is_the_same_network_at_a_larger_size_and_range() -> None:
    network = small_matcher(FOCAL_PX)
    left, right = torch.rand(2, 3, 80, 120)
    seen = camera(120, 80, 1.25 * FOCAL_PX)
    found = speed_of(network, "fine").match(left, right, seen)
    farther = PSMNet(replace(network.config, max_disparity_px=32))
    farther.load_state_dict(network.state_dict())
    # 1.25 times 16 px of disparity takes a range of 32, a multiple of 16.
    expected = PSMNetMatcher(farther).match(left, right)
    assert torch.equal(found.disparity_px, expected.disparity_px)
    quick = speed_of(network, "quick").match(left, right, seen)
    assert not torch.equal(found.disparity_px, quick.disparity_px)


def test_at_the_focal_length_of_training_there_is_one_speed() -> None:
    network = small_matcher(FOCAL_PX)
    left, right = torch.rand(2, 3, 40, 60)
    seen = camera(60, 40, FOCAL_PX)
    quick, fine = (speed_of(network, s).match(left, right, seen) for s in ("quick", "fine"))
    assert torch.equal(quick.disparity_px, fine.disparity_px)


def test_a_focal_length_in_millimetres_is_refused() -> None:
    net = FakestereoNet(None, make_synthesiser(sure_of(3)))
    with pytest.raises(InputError, match=r"4\.2 px would enlarge .* is it in millimetres\?"):
        net.estimate(torch.rand(3, 750, 1000), focal_px=4.2)


def test_results_can_be_changed_in_place_and_pictures_be_of_any_byte_order() -> None:
    net = FakestereoNet(None, make_synthesiser(sure_of(3)))
    picture = torch.rand(40, 60, 3).numpy()
    plain = net.estimate(picture, focal_px=45.0).depth_m
    other = net.estimate(picture.astype(">f4"), focal_px=45.0).depth_m
    assert plain is not None
    assert other is not None
    torch.testing.assert_close(plain, other)
    plain[plain > 1.0] = 0.0
    assert float(plain.nan_to_num(0.0).max()) <= 1.0


def test_settings_of_opencv_are_the_matcher_s() -> None:
    require_matcher_config(None)
    with pytest.raises(InputError, match=r"config is a SGBMConfig.*give matcher=SGBMMatcher"):
        require_matcher_config(SGBMConfig())
