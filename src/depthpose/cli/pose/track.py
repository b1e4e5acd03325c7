"""``depthpose pose track``."""

from pathlib import Path

from depthpose.cli.help import group
from depthpose.cli.options import Device
from depthpose.cli.pose.options import RegisterOptions, refuse_beside
from depthpose.core.errors import InputError
from depthpose.pose.config import EstimateConfig, Unit


@group
class SequenceOptions:
    """The frames, and what is followed in them."""

    depth: Path | None = None
    """folder of 16-bit PNG files, whole images without masks."""
    camera: Path | None = None
    """of the depth images; a JSON file, as for 'pose predict'."""
    cloud: Path | None = None
    """folder of clouds (PLY, PCD, NPY, text) in the camera frame, of the object alone or of what is
    about it too, which needs --first: the object is found in clouds of it alone."""
    first: Path | None = None
    """text file with the pose in the first frame, as far as it is known: the 4x4 matrix
    camera_from_model, in metres; without it the object is looked for."""
    bop: Path | None = None
    """folder of a data set in BOP's layout; every object of each scene is followed that the weights
    know (with --method register: that has a model there), or --object alone."""
    split: str = "test"
    """of the data set."""
    object: str | None = None
    """which of the known objects; of a data set its name or number."""
    unit: Unit | None = None
    """of the clouds, metres by default; of depth images, where their camera says none."""
    min_certainty: float = 0.9
    """below it a pose that is found is ambiguous, not ok, and so are those that follow from it."""
    device: Device = "cpu"

    def refuse_unusable(self) -> None:
        """Refuse none of the three kinds of input, or several, options of others, and processes.

        Raises:
            InputError: which, and the rule.
        """
        from depthpose.core.run import find_rank

        if sum(given is not None for given in (self.depth, self.cloud, self.bop)) != 1:
            raise InputError("give one of --depth with --camera, --cloud and --bop")
        if self.depth is not None and self.camera is None:
            raise InputError("--depth needs --camera beside it")
        if self.bop is not None:
            refuse_beside("--bop", {"camera": self.camera, "unit": self.unit})
            if self.first is not None:
                raise InputError(
                    "--first beside --bop: a data set has many sequences and one pose is given; "
                    "leave --first out, or give the frames of one sequence by --depth"
                )
        if self.cloud is not None:
            refuse_beside("--cloud", {"camera": self.camera})
        if find_rank().world > 1:
            raise InputError("a sequence is followed by one process; start one")

    @property
    def dataset(self) -> tuple[Path, str] | None:
        """Folder and split of a data set whose scenes are followed."""
        return None if self.bop is None else (self.bop, self.split)


def track(
    out: Path,
    weights: str = "parts",
    frames: SequenceOptions = SequenceOptions(),
    register: RegisterOptions = RegisterOptions(),
) -> int:
    """Follow a known object through depth images, clouds or the scenes of a data set.

    Each frame starts from the pose of the one before and needs ICP alone. Where the depth
    contradicts the pose, the object is detected again in that frame; where that fails too,
    the frame is lost, and the next is searched. poses.json says of each frame which of the three it
    was ("tracking"); else the files are those of 'pose predict'. Frames are taken in the order of
    their names, numbers in them by value (2 before 10). A rerun begins anew; what an interrupted
    one has found is in poses.json.

        depthpose pose track --depth frames --camera cam.json --object mug --out out
        depthpose pose track --bop lm --split test --weights linemod.safetensors --out out
        depthpose pose track --method register --cad p.stl --cad-unit mm --cloud frames --out out

    Args:
        out: folder for the results.
        weights: of a pose network, by name or file ('depthpose weights list').
    """
    from depthpose.cli.pose.methods import source_of
    from depthpose.cli.pose.tracking import track_bop, track_folder

    frames.refuse_unusable()
    config = EstimateConfig(device=frames.device, min_certainty=frames.min_certainty)
    method = source_of(weights, register, frames.unit, frames.dataset, config).build()
    if method.track is None:
        raise InputError(f"--weights {weights}: these need masked views; give weights that vote")
    if frames.dataset is not None:
        return track_bop(method, (*frames.dataset, frames.object), out)
    files = (frames.depth, frames.camera, frames.cloud, frames.first)
    return track_folder(method, files, frames.object, frames.unit, out)
