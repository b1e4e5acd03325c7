"""Options that several pose commands take: each is declared, and described, once."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from depthpose.cli.help import group
from depthpose.cli.options import Device, Voting, voting_config
from depthpose.core.errors import InputError
from depthpose.pose.config import EstimateConfig, Unit


@group
class OneObjectOptions:
    """A cloud or a depth image of known objects, and what is known of it."""

    cloud: str | None = None
    """points of one object (PLY, PCD, NPY, text), in the camera frame: x right, y down, z forward;
    or a folder of such files."""
    depth: str | None = None
    """16-bit PNG in the camera's depth_unit_m, or a folder of them."""
    mask: str | None = None
    """picture, not black is the object, or .json with COCO's run lengths; or a folder of masks with
    the names of the depth images. Without, the image is searched: its planes are removed, and each
    region left is tried as every object, or as --object alone."""
    camera: Path | None = None
    """of the depth images; JSON file: {"width", "height", "K": 3x3, "depth_unit_m"}, or that of
    BOP, TUM RGB-D, ROS, OpenCV, KITTI or Middlebury."""
    object: str | None = None
    """which of the objects that are known; of a data set its name or number, all by default."""
    unit: Unit | None = None
    """unit of clouds (default m), and of depth images whose camera file gives none."""


@group
class DataSetOptions:
    """A data set, in place of --cloud and --depth."""

    bop: Path | None = None
    """folder of a data set in BOP's layout, or of Linemod_preprocessed."""
    split: str = "test"
    """of the data set."""
    masks: str = "truth"
    """truth (the annotated ones), predicted (those that came with Linemod_preprocessed), a JSON
    file of BOP detections, or weights of a segmentation, by name or file."""


@group
class EstimateOptions:
    """How poses are estimated."""

    voting: Voting = "ransac"
    """how a network's directions become keypoints."""
    hypotheses: int = 128
    """of RANSAC, for each keypoint of a network."""
    icp: bool = True
    """refine the voted pose by ICP."""
    min_certainty: float = 0.9
    """below it the status is ambiguous, not ok: the likeliest pose with its alternatives."""
    up_to_symmetry: bool = False
    """copies of an object that look nearly alike are one answer, not alternatives."""
    register_refused: bool = False
    """what a network doubts is registered by its model alone, some tenths of a second each. For
    clouds and masked images."""
    batch: int = 16
    """inputs in one call of the network."""
    device: Device = "cpu"

    @property
    def config(self) -> EstimateConfig:
        """Settings of the estimator, on the device of this process.

        Raises:
            InputError: a value is out of its range.
        """
        from depthpose.core.run import own_device  # --help must not load torch

        if self.batch < 1:
            raise InputError(f"--batch {self.batch}: at least 1 input in one call of the network")
        return EstimateConfig(
            voting=voting_config(self.voting, self.hypotheses),
            with_icp=self.icp,
            min_certainty=self.min_certainty,
            up_to_symmetry=self.up_to_symmetry,
            register_refused=self.register_refused,
            device=own_device(self.device),
        )


@group
class RegisterOptions:
    """Poses by a CAD file alone, without training."""

    method: Literal["network", "register"] = "network"
    """network: trained weights. register: the CAD file alone, a second or two for each part."""
    cad: tuple[str, ...] = ()
    """of register: STL, PLY, OBJ or GLB files; an object has its file's name. A data set has its
    own models."""
    cad_unit: Unit | None = None
    """of the CAD files; as --unit by default, and of GLB metres."""


def refuse_mixture(given: OneObjectOptions, dataset: DataSetOptions) -> None:
    """Refuse none of the three kinds of input, or several, and options of another kind.

    Raises:
        InputError: which, and the rule.
    """
    count = sum(word is not None for word in (given.cloud, given.depth, dataset.bop))
    if count != 1:
        raise InputError(
            f"{count} of --cloud, --depth and --bop are given; give one: a cloud, a depth image "
            "with --mask and --camera, or a data set"
        )
    beside = {"mask": given.mask, "camera": given.camera}
    if dataset.bop is not None:
        refuse_beside("--bop", {**beside, "unit": given.unit})
    elif dataset != DataSetOptions():
        raise InputError(
            "--split and --masks are of a data set, and --bop names none; the mask of a depth "
            "image is given by --mask"
        )
    elif given.cloud is not None:
        refuse_beside("--cloud", beside)


_WHY = {
    "--bop": "a data set says its cameras and units itself, and its masks are chosen by --masks",
    "--cloud": "a cloud is of the object alone, in the camera's frame",
}
"""What makes other options meaningless beside an input."""


def refuse_beside(option: str, others: Mapping[str, object]) -> None:
    """Refuse options that would be ignored beside an input.

    Args:
        option: of the input, a key of ``_WHY``.
        others: the values of such options by name.

    Raises:
        InputError: the names of those that are given.
    """
    named = " and ".join(f"--{name}" for name, value in others.items() if value is not None)
    if named:
        raise InputError(f"{named} beside {option}: {_WHY[option]}; leave {named} out")
