"""The work behind ``depthpose depth match``."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from depthpose.cli.depth_methods import Method
from depthpose.cli.depth_predict import PAGE, write_depth_page
from depthpose.core.camera import StereoRig, read_rig
from depthpose.core.errors import InputError
from depthpose.core.files import image_size, list_images, read_image
from depthpose.core.files.disk import find_partners
from depthpose.core.run import claim_folder, claim_names, find_rank, note_result
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.predictions import CLOUD_M, ENDINGS, is_finished, write_estimate
from depthpose.depth.stereo import NetworkMatcher, tile_change_px
from depthpose.depth.types import DepthEstimate, StereoInput


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Files of stereo pairs that share one rig."""

    left: list[Path]
    right: list[Path]
    rig: StereoRig

    @classmethod
    def find(cls, left: str, right: str, camera: Path) -> "Pairs":
        """List both sides, and refuse sides that cannot be paired."""
        lefts, rights = list_pairs(left, right)
        return cls(left=lefts, right=rights, rig=read_rig(camera, image_size(lefts[0])))

    def read(self, index: int) -> StereoInput:
        """Read one pair."""
        left, right = self.left[index], self.right[index]
        return read_pair(left.stem, left, right, self.rig)


def read_pair(name: str, left: Path, right: Path, rig: StereoRig) -> StereoInput:
    """Read the two images of a pair."""
    return StereoInput(name=name, left=read_image(left), right=read_image(right), camera=rig)


def list_pairs(left: str, right: str) -> tuple[list[Path], list[Path]]:
    """List the images of both sides, paired by their names or the numbers in them."""
    lefts, rights = list_images(left), list_images(right)
    stems, others = ([path.stem for path in side] for side in (lefts, rights))
    if len(set(stems)) != len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError(f"{left}: two images are called {twice!r}, so would their results.")
    if (lefts, rights) == ([Path(left)], [Path(right)]):
        return lefts, rights
    return lefts, [rights[k] for k in find_partners(stems, others, f"{left} and {right}")]


def say_tile_change(pairs: Pairs, method: Method) -> None:
    """Print how far tiles move the disparity of the first pair from that of the whole image."""
    pair = pairs.read(0)
    assert pair.right is not None
    assert isinstance(method.net, FakestereoNet)
    if not isinstance(method.net.matcher, NetworkMatcher):
        raise InputError(f"--tile: {method.name} matches no tiles; omit --tile")
    change_px = tile_change_px(method.net.matcher, pair.left, pair.right, pair.camera)
    print(f"tiles change the disparity of {pair.name} by {change_px:.4f} px on average")


def rig_facts(rig: StereoRig) -> dict[str, object]:
    """Give what of a rig decides depth, for the record of a run."""
    facts: dict[str, object] = {"K": rig.K.tolist(), "baseline_m": rig.baseline_m}
    return facts | {"cx_right_minus_left_px": rig.cx_right_minus_left_px}


def match_all(
    pairs: Pairs, method: Method, out: Path, *, with_cloud: bool, with_check: bool
) -> int:
    """Match what is not finished; a pair that fails is named at the end and stops no other."""
    claim_folder(out, {**method.settings, "camera": rig_facts(pairs.rig)}, [PAGE])
    both = {left.stem: (left, right) for left, right in zip(pairs.left, pairs.right, strict=True)}
    claim_names(out, both, [f".{end}" for end in ENDINGS])
    failures: list[str] = []
    mine = find_rank().share(len(pairs.left))
    for index in tqdm(mine, unit=" pairs", disable=None):
        name = pairs.left[index].stem
        if is_finished(out, name, with_cloud=with_cloud):
            continue
        try:
            pair = pairs.read(index)
            estimate = estimate_pair(pair, method, with_check=with_check)
        except InputError as error:
            if len(pairs.left) == 1:
                raise
            failures.append(str(error))
            continue
        cloud_m = CLOUD_M if with_cloud else None
        note_result(out, name, write_estimate(out, pair, estimate, cloud_m=cloud_m))
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    print(f"{len(mine) - len(failures)} of {len(mine)} pairs are in {out}")
    if find_rank().rank == 0:
        _write_page(pairs, out, failures)
    return 1 if failures else 0


def estimate_pair(pair: StereoInput, method: Method, *, with_check: bool) -> DepthEstimate:
    """Match a pair, and print what is doubtful about it."""
    assert isinstance(method.net, FakestereoNet)
    estimate = method.net.estimate_pair(pair, with_check=with_check)
    if estimate.warning:
        tqdm.write(f"depthpose: warning: {pair.name}: {estimate.warning}", sys.stderr)
    return estimate


def _write_page(pairs: Pairs, out: Path, failures: list[str]) -> None:
    """Write the page of what is finished: other processes may still be at work."""
    places = {path.stem: k for k, path in enumerate(pairs.left) if is_finished(out, path.stem)}

    def read(names: Sequence[str]) -> Iterator[StereoInput]:
        for name in names:
            with suppress(InputError):
                yield pairs.read(places[name])

    write_depth_page(out, list(places), read, failures)
