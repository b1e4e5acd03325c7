"""The work behind ``--engine ray`` of ``depthpose depth predict`` and ``depth match``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from depthpose.cli.depth_match import estimate_pair, read_pair, rig_facts
from depthpose.cli.depth_methods import Method, MethodSource
from depthpose.cli.depth_options import LensOptions, PredictOutput, ScaleOptions
from depthpose.cli.depth_predict import Lens, Predictor, read_lens, settings_of
from depthpose.cli.engine import EngineOptions, Inputs, run, say
from depthpose.core.camera import StereoRig, read_rig
from depthpose.core.engine import Files, Function, Sample
from depthpose.core.errors import InputError
from depthpose.core.files import VIDEO_SUFFIXES, image_size
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.predictions import CLOUD_M, ENDINGS, write_estimate

IMAGES = Files(roles=("image",), suffixes=LISTED_SUFFIXES)


@dataclass(frozen=True, kw_only=True)
class PredictWork:
    """Single images to the files of their depth, by the workers of an engine."""

    method: MethodSource
    lens: Lens
    output: PredictOutput
    files: Files = IMAGES
    endings: Sequence[str] = ENDINGS

    @property
    def batch(self) -> int:
        """Images that go through the networks together."""
        return self.output.batch

    def start(self) -> Function:
        """Build the networks."""
        net = self.method.build().net
        assert isinstance(net, FakestereoNet)

        def predict(samples: Sequence[Sample], out: Path) -> list[str]:
            predictor = Predictor(lens=self.lens, net=net, out=out, output=self.output)
            files = {sample.name: sample.files[0] for sample in samples}
            predictor.predict(predictor.read_images(files), len(files), "images")
            return [str(predictor.failures.get(sample.name, "")) for sample in samples]

        return predict


def predict_on_ray(
    images: Sequence[str],
    lens: LensOptions,
    scale: ScaleOptions,
    method: MethodSource,
    output: PredictOutput,
    out: str,
    engine: EngineOptions,
) -> int:
    """Predict images, manifests or tar shards by the workers of an engine."""
    video = next((word for word in images if word.lower().endswith(tuple(VIDEO_SUFFIXES))), None)
    if video is not None:
        raise InputError(f"{video}: --engine ray takes no videos; omit --engine for them")
    inputs = Inputs.find(images, IMAGES)
    with inputs.first() as (image,):
        known = read_lens(lens, [image], scale)
    settings = settings_of(method.settings(), known, output)
    work = PredictWork(method=method, lens=known, output=output)
    return say(run(work, inputs, out, settings, engine), out, "depth maps")


PAIRS = Files(roles=("left", "right"), suffixes=LISTED_SUFFIXES)


@dataclass(frozen=True, kw_only=True)
class MatchWork:
    """Stereo pairs to the files of their depth, by the workers of an engine."""

    method: MethodSource
    rig: StereoRig
    with_cloud: bool
    with_check: bool
    files: Files = PAIRS
    endings: Sequence[str] = ENDINGS
    batch: int = 1

    def start(self) -> Function:
        """Build the matcher."""
        method = self.method.build()

        def match(samples: Sequence[Sample], out: Path) -> list[str]:
            return [self._match(method, sample, out) for sample in samples]

        return match

    def _match(self, method: Method, sample: Sample, out: Path) -> str:
        """Match one pair, and give why not where it fails."""
        try:
            pair = read_pair(sample.name, sample.files[0], sample.files[1], self.rig)
            estimate = estimate_pair(pair, method, with_check=self.with_check)
            write_estimate(out, pair, estimate, cloud_m=CLOUD_M if self.with_cloud else None)
        except InputError as error:
            return str(error)
        return ""


def match_on_ray(
    sides: Sequence[str],
    camera: Path,
    method: MethodSource,
    out: str,
    engine: EngineOptions,
    *,
    with_cloud: bool,
    with_check: bool,
) -> int:
    """Match left and right sides, manifests or tar shards by the workers of an engine."""
    inputs = Inputs.find(sides, PAIRS)
    with inputs.first() as (left, _):
        rig = read_rig(camera, image_size(left))
    work = MatchWork(method=method, rig=rig, with_cloud=with_cloud, with_check=with_check)
    settings = {**method.settings(), "camera": rig_facts(rig)}
    return say(run(work, inputs, out, settings, engine), out, "pairs")
