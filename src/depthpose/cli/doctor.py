"""``depthpose doctor``."""

import re
import sys
from importlib import metadata
from time import perf_counter

import tyro

from depthpose.cli.arguments import NewPath
from depthpose.core.errors import InputError, install_command

_REQUIREMENT = re.compile(r"([\w.-]+)[^;]*(?:;.*extra == ['\"](\w+)['\"])?")
_EXTRAS_OF_OURS = ("dev",)  # extras for those who develop the package
_SHIFT_PX = 12  # disparity of the pair that depth is tested with


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
    from depthpose.core.checkpoint import SHIPPED, read_checkpoint
    from depthpose.core.run import environment

    for name, value in {**environment(), "device": device_names(), "weights in": SHIPPED}.items():
        print(f"{name}: {value}")
    lacking: dict[str, list[str]] = {}
    for line in metadata.requires("depthpose") or ():
        requirement = _REQUIREMENT.match(line)
        assert requirement is not None, line
        package, extra = requirement.groups()
        if extra is None or extra in _EXTRAS_OF_OURS:
            continue
        lacking.setdefault(extra, [])
        try:
            metadata.version(package)
        except metadata.PackageNotFoundError:
            lacking[extra].append(package)
    for extra, packages in lacking.items():
        outcome = f"lacks {', '.join(packages)}" if packages else "installed"
        print(f"extra {extra}: {outcome}")
    print(f"another extra: {install_command('EXTRA')}")
    for path in sorted(SHIPPED.glob("*.safetensors")):
        try:
            checkpoint = read_checkpoint(path)
            licence = checkpoint.facts.get("licence", "no licence")
            print(f"weights {path.stem}: {checkpoint.kind}, {licence}")
        except InputError as error:
            print(f"weights {path.stem}: {error}")
    code = 0
    for what, work in {"depth": _try_depth, "pose": _try_pose}.items():
        began = perf_counter()
        try:
            outcome = work()
        except Exception as error:  # noqa: BLE001 - whatever it is, it is what is asked for
            print(f"{what}: failed: {type(error).__name__}: {error}", file=sys.stderr)
            code = 1
        else:
            print(f"{what}: {outcome}, {perf_counter() - began:.1f} s with loading")
    return code


def device_names() -> str:
    """Name what computes: the GPUs, or the processor alone."""
    import torch

    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return ", ".join(f"cuda:{i} {name}" for i, name in enumerate(gpus)) or "cpu alone"


def _try_depth() -> str:
    """Match a pair of known disparity."""
    import torch

    from depthpose.depth.estimator import FakestereoNet

    noise = torch.rand(3, 48, 160, generator=torch.Generator().manual_seed(0))
    scene = torch.nn.functional.interpolate(noise[None], scale_factor=4, mode="bicubic")[0]
    scene = scene.clamp(0, 1)
    left = scene[..., :-_SHIFT_PX]
    right = scene[..., _SHIFT_PX:]
    net = FakestereoNet.load("default")
    estimate = net.estimate(left, None, right=right, with_check=False)
    median_px = float(estimate.disparity_px[:, 2 * _SHIFT_PX :].median())
    outcome = f"a pair shifted by {_SHIFT_PX} px was matched at {median_px:.2f} px"
    if abs(median_px - _SHIFT_PX) > 1:
        raise RuntimeError(outcome)
    return outcome


def _try_pose() -> str:
    """Pose a part in a synthetic view."""
    from depthpose.pose.config import ObjectsConfig
    from depthpose.pose.metrics import adds_m
    from depthpose.pose.network_pose import GeoPoseNet
    from depthpose.pose.synthetic import Objects

    net = GeoPoseNet.load("parts")
    flange = next(model for model in net.weights.models if model.name == "flange")
    view = Objects((flange,), ObjectsConfig(number=1, occluded_share=0.0, views=None)).view(0)
    (estimate,) = net.estimate_many([view.input])
    if estimate.camera_from_model is None:
        raise RuntimeError(f"a synthetic view of a flange was refused: {estimate.reason}")
    off_m = adds_m(estimate.camera_from_model, view.truth.camera_from_model, flange.vertices_m)
    outcome = f"a synthetic flange was posed {1000 * float(off_m):.1f} mm off (ADD-S)"
    if off_m > flange.diameter_m / 10:
        raise RuntimeError(outcome)
    return outcome
