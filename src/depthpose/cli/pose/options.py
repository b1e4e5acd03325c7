"""Options that several pose commands take: each is declared, and described, once."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from depthpose.cli.arguments import (
    Device,
    NewPath,
    Source,
    WeightsName,
    refuse_below,
    refuse_outside,
    shown_as,
)
from depthpose.cli.option_rules import is_registration
from depthpose.core.units import Unit
from depthpose.pose.config import DiameterTable, EstimateConfig, VotingConfig, VotingMethod

Voting = Literal["ransac", "least-squares"]
_VOTING_METHODS: dict[Voting, VotingMethod] = {"ransac": "ransac", "least-squares": "least squares"}
"""What the configs call each word of ``--voting``."""


@dataclass(frozen=True, kw_only=True)
class PoseDataOptions:
    """The dataset of a table or figure of poses."""

    linemod: Path | None = None
    """Linemod_preprocessed, or LineMOD in BOP's layout; masks are the annotated ones."""
    bop: Path | None = None
    """any other dataset in BOP's layout."""
    split: str = "test"
    """name of the split: train, test, ..."""
    objects: tuple[str, ...] = ()
    """keep these alone, by name or number."""

    @property
    def folder(self) -> Path | None:
        """The dataset's folder, by either option; None: neither is given."""
        return self.linemod or self.bop


@dataclass(frozen=True, kw_only=True)
class PoseMeasureOptions:
    """The settings by which poses of a dataset are estimated and measured."""

    masks: tuple[str, ...] = ("truth",)
    """truth; predicted (those that came with Linemod_preprocessed); a JSON file of BOP detections;
    or weights of a segmentation. Each is a row of its own."""
    targets: NewPath | None = None
    """a BOP list of targets, such as test_targets_bop24.json: a file, or its name in the folder of
    the dataset; by default all instances."""
    diameters: DiameterTable = "bop"
    """bop: as the dataset declares them; pvnet: PVNet's table of LineMOD."""
    voting: Voting = "ransac"
    """how directions become keypoints."""
    icp: bool = True
    """refine each pose by ICP."""
    vsd: bool = False
    """measure VSD and BOP's average recall too, which takes most of the time."""
    device: Device = "cpu"

    @property
    def config(self) -> EstimateConfig:
        """The settings of the estimators that these options stand for."""
        voting = VotingConfig(method=_VOTING_METHODS[self.voting])
        return EstimateConfig(voting=voting, with_icp=self.icp, device=self.device)


@dataclass(frozen=True, kw_only=True)
class PoseTableOptions(PoseMeasureOptions):
    """The settings by which the poses of a table are estimated, measured and shown."""

    pictures: int = 4
    """instances that the page shows."""

    def refuse_unusable(self) -> None:
        """Refuse a negative number of pictures."""
        refuse_below(0, "--pictures", self.pictures, "4")


@dataclass(frozen=True, kw_only=True)
class CadOptions:
    """The CAD files of the objects that are looked for."""

    cad: tuple[Source, ...] = ()
    """STL, PLY, OBJ or GLB files of the parts: they are posed without training, a second or two for
    each; an object has its file's name."""
    cad_unit: Unit | None = None
    """unit of the CAD files; by default that of --unit, and of GLB metres."""


@dataclass(frozen=True, kw_only=True)
class SymmetryOptions:
    """The symmetries of the objects of CAD files."""

    symmetry: tuple[str, ...] = ()
    """symmetries of --cad, in place of what is found: z,18 where a part looks alike after each of
    18 equal turns about an axis along z, z,free after any, z,6+x,2 about two axes; or a JSON file
    with BOP's symmetries_discrete and symmetries_continuous. The axis goes where the surface fits
    best. Of several CAD files with the name: NAME:z,18."""


@dataclass(frozen=True, kw_only=True)
class InputOptions(CadOptions):
    """The objects that are looked for, and the clouds or depth images that show them."""

    depth: Source | None = None
    """16-bit PNG in the camera's depth_unit_m, or a folder of them. Without --mask, --box and
    --detections the whole image is searched for every object, or for --object alone."""
    camera: Path | None = None
    """camera of the depth images; JSON file: {"width", "height", "K": 3x3, "depth_unit_m"}, or a
    file of ROS, OpenCV, KITTI and others, which the error of an unknown file lists."""
    mask: Source | None = None
    """picture, not black is the object, or .json with COCO's run lengths; or a folder of masks with
    the names of the depth images. Each number of a label map is an object (see --labels)."""
    box: Annotated[tuple[str, ...], shown_as(metavar="X0,Y0,X1,Y1 ...")] = ()
    """where objects are in the depth image, or in each of a folder: left, top, right and bottom
    edge [px]."""
    cloud: Source | None = None
    """points of one object (PLY, PCD, NPY, text), in the camera frame: x right, y down, z forward;
    or a folder of such files."""


@dataclass(frozen=True, kw_only=True)
class InputDetailOptions(SymmetryOptions):
    """Further facts of the objects and the images."""

    detections: Source | None = None
    """boxes or masks of a detector: .json of COCO or BOP, .txt of YOLO, or a folder of such files
    with the names of the depth images."""
    labels: Annotated[str | None, shown_as(metavar="CLASS=OBJECT,...")] = None
    """which object a number of --mask or a class of --detections is: 1=bracket,2=gear; 3= leaves 3
    out."""
    object: str | None = None
    """which of the objects that are known; of a dataset its name or number, all by default."""
    unit: Unit | None = None
    """unit of clouds (default m), of depth images whose camera file gives none, and of CAD files
    without --cad-unit."""
    bin: Source | None = None
    """CAD file of the bin, tray or table that holds the parts, in --cad-unit; with --bin-pose. What
    lies on it is no part, and no part lies in it."""
    bin_pose: Path | None = None
    """where the bin is: text file with the 4x4 matrix camera_from_model, in metres, or the
    poses.json of a run that posed it alone."""
    empty_frame: Source | None = None
    """in place of --bin: depth image of the bin or table without the parts, by the same camera."""
    focal_px: float | None = None
    """focal length of the depth images [px], in place of --camera; the axis meets their centre."""
    color: Source | None = None
    """picture of the depth camera's frame and moment, or with its own --color-camera; or a folder
    of them with the names of the depth images. Print on a part (PLY with colours of its vertices,
    OBJ or GLB with a texture) then tells apart the copies that depth cannot."""
    color_camera: Path | None = None
    """camera of the colour pictures, as --camera; without it they are pixel by pixel of the
    depth."""
    color_from_depth: Path | None = None
    """text file with the pose of the depth camera in the frame of --color-camera: 4x4, in metres;
    without it both are at one place."""
    base_from_camera: Annotated[tuple[str, ...], shown_as(metavar="PATH | 16 NUMBERS")] = ()
    """hand-eye calibration of a camera that does not move: the 4x4 matrix row by row, in metres, or
    a text file with it; base_from_model then stands beside camera_from_model."""


@dataclass(frozen=True, kw_only=True)
class PoseInputs(InputOptions, InputDetailOptions):
    """All options of ``pose predict`` about clouds and depth images, and the objects in them."""

    @property
    def has_regions(self) -> bool:
        """Whether masks, boxes or detections are given."""
        return self.mask is not None or bool(self.box) or self.detections is not None

    @property
    def lens(self) -> Path | float | None:
        """The camera file of the depth images, or their focal length [px]; None: neither."""
        return self.camera or self.focal_px


@dataclass(frozen=True, kw_only=True)
class PairOptions:
    """A rectified pair in place of a depth image: it is matched first."""

    left: Source | None = None
    """left image, or a folder of them, in place of --depth; --camera is the rig, with "baseline_m".
    Masks, boxes and detections are of the left image."""
    right: Source | None = None
    """right image, or a folder of them with the names or the numbers of the left ones."""
    matcher: WeightsName | None = None
    """what matches the pair: weights with a matcher, by name or file ('default'), or sgbm."""
    min_confidence: float = 0.5
    """depth that is less sure is left out, 0 to 1."""

    def refuse_unusable(self) -> None:
        """Refuse a confidence that is no share."""
        refuse_outside(0, 1, "--min-confidence", self.min_confidence, "; 0 leaves nothing out")


@dataclass(frozen=True, kw_only=True)
class DataSetOptions:
    """A dataset, in place of --cloud and --depth."""

    bop: Path | None = None
    """folder of a dataset in BOP's layout, or of Linemod_preprocessed."""
    split: str = "test"
    """name of the split: train, test, ...; where it is of several sensors with the name of one,
    such as val_photoneo."""
    masks: str = "truth"
    """truth (the annotated ones), predicted (those that came with Linemod_preprocessed), a JSON
    file of BOP detections, or weights of a segmentation, by name or file; or search: no mask is
    told, and every image is searched for every object of the dataset."""
    targets: NewPath | None = None
    """a BOP list of targets, such as test_targets_bop24.json: a file, or its name in the folder of
    the dataset; by default all instances."""


@dataclass(frozen=True, kw_only=True)
class PoseMethodOptions:
    """The estimator of the poses."""

    method: Literal["network", "register"] | None = None
    """network: trained weights. register: the CAD files alone, a second or two for each part, or
    the models of --bop; it is taken where --cad is given."""

    def is_registration(self, cad: Sequence[str]) -> bool:
        """Whether models are registered, without a network; ``cad``: the words of ``--cad``."""
        return is_registration(self.method, has_cad=bool(cad))


@dataclass(frozen=True, kw_only=True)
class EstimateOptions(PoseMethodOptions):
    """The settings of the estimator; those from ``weights`` on have no effect on registration."""

    min_certainty: float = 0.9
    """below it the status is ambiguous, not ok: the likeliest pose with its alternatives."""
    object_deviation_mm: float | None = None
    """standard deviation of the real surface from its file [mm]: 0.3 for a machined part, 2 for a
    carton or a scan; by default 2 for a model of points or with colours, else 1."""
    weights: WeightsName = "parts"
    """weights of a pose network, by name or file ('depthpose weights list')."""
    voting: Voting = "ransac"
    """how a network's directions become keypoints."""
    hypotheses: int = 128
    """hypotheses of RANSAC for each keypoint of a network."""
    icp: bool = True
    """refine the voted pose by ICP."""
    register_refused: bool = False
    """what a network doubts is registered by its model alone, some tenths of a second each; not
    where an image is searched."""
    batch: int = 16
    """inputs in one call of the network."""
    device: Device = "cpu"

    def refuse_unusable(self) -> None:
        """Refuse a batch without an input."""
        refuse_below(1, "--batch", self.batch, "16")

    @property
    def config(self) -> EstimateConfig:
        """The settings of the estimator that these options stand for, on this process's device."""
        from depthpose.core.devices import device_of_process  # --help must not load torch

        object_deviation_m = None
        if self.object_deviation_mm is not None:
            object_deviation_m = self.object_deviation_mm / 1000
        voting = VotingConfig(method=_VOTING_METHODS[self.voting], hypotheses=self.hypotheses)
        return EstimateConfig(
            voting=voting,
            with_icp=self.icp,
            min_certainty=self.min_certainty,
            object_deviation_m=object_deviation_m,
            register_refused=self.register_refused,
            device=device_of_process(self.device),
        )


@dataclass(frozen=True, kw_only=True)
class RegisterOptions(SymmetryOptions, CadOptions, PoseMethodOptions):
    """Poses by a CAD file alone, without training."""


@dataclass(frozen=True, kw_only=True)
class SequenceOptions:
    """The frames, and what is followed in them."""

    depth: Path | None = None
    """folder of 16-bit PNG files, whole images without masks."""
    camera: Path | None = None
    """camera of the depth images; a JSON file, as for 'pose predict'."""
    cloud: Path | None = None
    """folder of clouds (PLY, PCD, NPY, text) in the camera frame, of the object alone; with --first
    also of what is about it."""
    first: NewPath | None = None
    """text file with the pose in the first frame, about: the 4x4 matrix camera_from_model, in
    metres; without it the object is looked for."""
    bop: Path | None = None
    """folder of a dataset in BOP's layout; every known object of each scene is followed (with
    --method register: that has a model there), or --object alone."""
    split: str = "test"
    """name of the split: train, test, ..."""
    object: str | None = None
    """which of the known objects; of a dataset its name or number."""
    unit: Unit | None = None
    """unit of the clouds, metres by default; of depth images, where their camera says none."""
    base_from_camera: Annotated[tuple[str, ...], shown_as(metavar="PATH | 16 NUMBERS")] = ()
    """hand-eye calibration of a camera that does not move: the 4x4 matrix row by row, in metres, or
    a text file with it; base_from_model then stands beside camera_from_model."""
    min_certainty: float = 0.9
    """below it a pose that is found is ambiguous, not ok, and so are those that follow from it."""
    device: Device = "cpu"
