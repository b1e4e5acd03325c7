"""Real partial clouds of known pose: two of LineMOD, five scans of the bunny, YCB's two frames.

From ``$DEPTHPOSE_DATA/pose``; the data have a non-commercial licence and are never committed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from depthpose.core.files import read_cloud
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import open_bop
from depthpose.pose.mesh import read_model
from depthpose.pose.types import CloudInput, CloudSample, ObjectModel, PoseTruth

_SCANNER_M = 0.7
"""The bunny's scanner looks along -z, our camera along +z, from about this distance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RealCase:
    """A cloud with its truth and model.

    Attributes:
        sample: the cloud and its pose.
        model: of its object.
        is_symmetric: evaluated by ADD-S. All of YCB are: geometry alone does not show the sides of
            boxes, nor how a can is turned.
    """

    sample: CloudSample
    model: ObjectModel
    is_symmetric: bool

    @property
    def name(self) -> str:
        """Data set, object and frame."""
        return self.sample.input.name


def lm_cases(folder: Path) -> Iterator[RealCase]:
    """One Kinect frame of LineMOD: cat, annotated, and ape, of a fitted pose."""
    data = open_bop(folder / "lm")
    for place, instance in enumerate(data.instances):
        model = data.objects[instance.object_id]
        yield _case(f"lm {model.name}", data[place], model, not model.symmetries.is_none)


def bunny_cases(folder: Path, every: int = 5) -> Iterator[RealCase]:
    """Range scans of the bunny, each ``every``-th point of some 40,000."""
    model = read_model(folder / "bunny/model/bun_zipper_res2.ply", "m", name="bunny")
    flip = Rigid(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0, 0, _SCANNER_M]))
    for line in (folder / "bunny/bun.conf").read_text().splitlines():
        words = line.split()
        scan = folder / "bunny/scans" / words[1] if words[:1] == ["bmesh"] else None
        if scan is None or not scan.is_file():
            continue
        t, q = np.array(words[2:5], float), np.array(words[5:9], float)
        R = Rotation.from_quat(q).as_matrix()
        pose = Rigid(torch.from_numpy(R).float(), torch.from_numpy(-R @ t).float())
        points_m = flip.apply(read_cloud(scan).points[::every].float())
        truth = PoseTruth(camera_from_model=flip @ pose)
        given = CloudInput(name=scan.stem, points_m=points_m, object="bunny")
        sample = CloudSample(input=given, truth=truth)
        yield _case(f"bunny {scan.stem}", sample, model, is_symmetric=False)


def ycb_cases(folder: Path) -> Iterator[RealCase]:
    """Ten instances in two frames of a RealSense; poses fitted, models of bare points."""
    data = open_bop(folder / "ycb_frames")
    for place, instance in enumerate(data.instances):
        model = data.objects[instance.object_id]
        name = f"ycb {instance.image_id} {model.name}"
        yield _case(name, data[place], model, is_symmetric=True)


def real_cases(folder: Path) -> list[RealCase]:
    """All instances."""
    return [*lm_cases(folder), *bunny_cases(folder), *ycb_cases(folder)]


def _case(name: str, sample: CloudSample, model: ObjectModel, is_symmetric: bool) -> RealCase:
    given = replace(sample.input, name=name)
    return RealCase(sample=replace(sample, input=given), model=model, is_symmetric=is_symmetric)
