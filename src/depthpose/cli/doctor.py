"""``depthpose doctor``."""

import re
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from time import perf_counter

import tyro

from depthpose.cli.arguments import NewPath
from depthpose.core.errors import InputError, install_command

_REQUIREMENT = re.compile(r"([\w.-]+)[^;]*(?:;.*extra == ['\"](\w+)['\"])?")
"""A package, and the extra that it belongs to, if any."""
_DEVELOPER_EXTRAS = ("dev",)
_SHIFT_PX = 12
"""Disparity of the pair that depth is tested with."""


def doctor(files: tyro.conf.Positional[tuple[NewPath, ...]] = ()) -> int:
    """Check this installation, or the files that you want to use.

    Without files: versions, devices, extras (and how to install missing ones), weights, and one
    small estimate of depth and of a pose; put this into a bug report. With files: what each is, in
    which unit, and what is odd about it, alone and together with the others: images (two of one
    size are a pair, left first), depth maps, cameras, clouds, meshes, masks. Exit code 1: an
    estimate failed, or something is odd.

        depthpose doctor
        depthpose doctor left.png right.png camera.yaml
        depthpose doctor depth.png mask.png camera.json part.stl cloud.ply

    Args:
        files: images, cameras, clouds, ... of one job.
    """
    if files:
        from depthpose.cli.doctor_files import describe_files

        return describe_files(files)
    from depthpose.core.checkpoint import SHIPPED
    from depthpose.core.environment import describe_environment

    facts = {**describe_environment(), "device": list_device_names(), "weights in": SHIPPED}
    for name, value in facts.items():
        print(f"{name}: {value}")
    for extra, packages in _find_missing_packages().items():
        outcome = f"lacks {', '.join(packages)}" if packages else "installed"
        print(f"extra {extra}: {outcome}")
    print(f"another extra: {install_command('EXTRA')}")
    for path in sorted(SHIPPED.glob("*.safetensors")):
        print(f"weights {path.stem}: {_describe_weights(path)}")
    has_worked = [_run_trial("depth", _try_depth), _run_trial("pose", _try_pose)]
    return 0 if all(has_worked) else 1


def _find_missing_packages() -> dict[str, list[str]]:
    """List the packages of each extra that are not installed; none for an extra that is whole."""
    missing: dict[str, list[str]] = {}
    for line in metadata.requires("depthpose") or ():
        requirement = _REQUIREMENT.match(line)
        assert requirement is not None, line
        package, extra = requirement.groups()
        if extra is None or extra in _DEVELOPER_EXTRAS:
            continue
        packages = missing.setdefault(extra, [])
        try:
            metadata.version(package)
        except metadata.PackageNotFoundError:
            packages.append(package)
    return missing


def _describe_weights(path: Path) -> str:
    """Describe weights by their kind and licence, or by why they cannot be read."""
    from depthpose.core.checkpoint import read_checkpoint

    try:
        checkpoint = read_checkpoint(path)
    except InputError as error:
        return str(error)
    return f"{checkpoint.kind}, {checkpoint.facts.get('licence', 'no licence')}"


def _run_trial(name: str, trial: Callable[[], str]) -> bool:
    """Run a trial, print its outcome or its error, and return whether it worked."""
    start = perf_counter()
    try:
        outcome = trial()
    except Exception as error:  # noqa: BLE001 - any error is what the user asks for
        print(f"{name}: failed: {type(error).__name__}: {error}", file=sys.stderr)
        return False
    print(f"{name}: {outcome}, {perf_counter() - start:.1f} s with loading")
    return True


def list_device_names() -> str:
    """List the GPUs that torch has, or the processor where there are none."""
    import torch

    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return ", ".join(f"cuda:{i} {name}" for i, name in enumerate(gpus)) or "cpu alone"


def _try_depth() -> str:
    """Match a synthetic pair of known disparity, and describe the outcome.

    Raises:
        RuntimeError: the match is more than a pixel off.
    """
    import torch

    from depthpose.depth.estimator import FakestereoNet

    # Noise, enlarged to be smooth; the right view sees each of its points further to the left.
    noise = torch.rand(3, 48, 160, generator=torch.Generator().manual_seed(0))
    scene = torch.nn.functional.interpolate(noise[None], scale_factor=4, mode="bicubic")[0]
    scene = scene.clamp(0, 1)
    left = scene[..., :-_SHIFT_PX]
    right = scene[..., _SHIFT_PX:]
    net = FakestereoNet.load("default", with_check=False)
    estimate = net.estimate(left, None, right=right)
    # The first columns of the left view are not in the right one; they and as many beside them are
    # left out.
    median_px = float(estimate.disparity_px[:, 2 * _SHIFT_PX :].median())
    outcome = f"a pair shifted by {_SHIFT_PX} px was matched at {median_px:.2f} px"
    if not abs(median_px - _SHIFT_PX) <= 1:  # NaN of a single pixel makes the median NaN
        raise RuntimeError(outcome)
    return outcome


def _try_pose() -> str:
    """Pose a part in a synthetic view, and describe the outcome.

    Raises:
        RuntimeError: the part is refused, or off by more than a tenth of its diameter.
    """
    from depthpose.pose.config import ObjectsConfig
    from depthpose.pose.metrics import adds_m
    from depthpose.pose.network_pose import GeoPoseNet
    from depthpose.pose.synthetic import SyntheticViews

    net = GeoPoseNet.load("parts")
    flange = next(model for model in net.weights.models if model.name == "flange")
    config = ObjectsConfig(number=1, occluded_share=0.0, views=None)
    view = SyntheticViews((flange,), config).view(0)
    (estimate,) = net.estimate_many([view.input])
    if estimate.camera_from_model is None:
        raise RuntimeError(f"a synthetic view of a flange was refused: {estimate.reason}")
    error_m = adds_m(estimate.camera_from_model, view.truth.camera_from_model, flange.vertices_m)
    outcome = f"a synthetic flange was posed {1000 * float(error_m):.1f} mm off (ADD-S)"
    if error_m > flange.diameter_m / 10:
        raise RuntimeError(outcome)
    return outcome
