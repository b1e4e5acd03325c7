"""``depthpose depth train view|select|stereo|adapt|finetune`` and ``depth calibrate``."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import tyro

from depthpose.cli.help import group
from depthpose.cli.options import Device, TrainingOptions, changed
from depthpose.cli.training import progress_bar, say_trained
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig

_LOOKED_AT = 20
"""Held-out pairs of a folder, by default."""


@group
class PairsOptions:
    """What a training learns from."""

    data: tuple[str, ...] = ()
    """folders of pairs; they replace the config's."""
    held_out: tuple[str, ...] = ()
    """folders of pairs for validation alone; 20 of each, evenly spaced, unless the config says
    otherwise."""

    def applied(self, chosen: Any) -> Any:  # noqa: ANN401 - any config of a training
        """Give the config of a training with these folders.

        Raises:
            InputError: the stage takes no held-out pairs.
        """
        from depthpose.depth.config import PairsConfig
        from depthpose.depth.train.config import StereoTraining

        pairs = changed(chosen.pairs, folders=self.data or None)
        if not self.held_out:
            return dataclasses.replace(chosen, pairs=pairs)
        if not hasattr(chosen, "held_out"):
            raise InputError(
                "--held-out has no meaning for 'adapt', which holds out a share of the pairs "
                "itself (validation_share in the config); leave it out."
            )
        # A generator is measured at the focal length of its own rig, whatever it is trained on.
        focal_px = pairs.focal_px if isinstance(chosen, StereoTraining) else None
        held_out = chosen.held_out or PairsConfig(
            focal_px=focal_px, truth=pairs.truth, limit=_LOOKED_AT
        )
        held_out = dataclasses.replace(held_out, folders=self.held_out)
        return dataclasses.replace(chosen, pairs=pairs, held_out=held_out)


@group
class BeginningOptions:
    """Weights that a training begins with."""

    generator: str | None = None
    """finetune: weights of the generator to begin with."""
    matcher: str | None = None
    """finetune: weights whose matcher matches the synthesised view, by name or file; they are not
    changed."""
    start: str | None = None
    """view, select, stereo, adapt: weights to begin with; adapt takes 'default' by default."""
    encoder: str | None = None
    """select, stereo with a light network: weights of the encoder to begin with, of 'depthpose
    weights import efficientnet-lite0'."""

    def applied(self, chosen: Any, stage: str) -> Any:  # noqa: ANN401 - any config of a training
        """Give the config of a stage with these weights.

        Raises:
            InputError: the stage takes none of these.
        """
        settings = {field.name for field in dataclasses.fields(chosen)}
        if stage != "finetune":
            settings -= {"generator", "matcher"}
        for name, value in vars(self).items():
            if value is not None and name not in settings:
                raise InputError(f"--{name} has no meaning for '{stage}'; see --help.")
        return changed(chosen, **vars(self))


def train(
    stage: tyro.conf.Positional[Literal["view", "select", "stereo", "adapt", "finetune"]],
    out: Path,
    config: Path | None = None,
    pairs: PairsOptions = PairsOptions(),
    beginning: BeginningOptions = BeginningOptions(),
    training: TrainingOptions = TrainingOptions(),
) -> int:
    """Train a generator, a matcher, or a generator through a matcher, in stages.

        view      the thesis's generator, a U-Net (pix2pix) for the right view; needs pairs
        select    a generator that warps the left image to the right view, and estimates depth
                  itself; needs pairs with truth
        stereo    the matcher; needs pairs with truth
        adapt     a trained matcher to your rig; needs its pairs with calibration, no truth. A fifth
                  of them is held out, and weights are written only if these fit better and
                  synthetic streets no worse
        finetune  either generator through the frozen matcher; needs weights of both

    A config holds every setting; the options below change what they name. The run folder keeps
    config, metrics, pictures, TensorBoard and the last state: --resume goes on from there, whatever
    stopped the training, and ends with the weights of a run that nothing stopped. Several GPUs or
    machines: 'accelerate launch -m depthpose depth train ...'.

        depthpose depth train view --config configs/depth/view.yaml --data kitti --out runs/view

    Args:
        stage: what is trained: view, select, stereo, adapt or finetune.
        out: the run folder.
        config: YAML with what differs from the thesis's settings.
    """
    from depthpose.core.loop import Run
    from depthpose.core.run import find_rank
    from depthpose.depth.train import STAGES

    kind, run_stage = STAGES[stage]
    chosen = training.read(config, kind)
    chosen = beginning.applied(pairs.applied(chosen), stage)
    with progress_bar(training.view) as on_step:
        run = Run(folder=out, resume=training.resume, finish=training.finish, on_step=on_step)
        path = run_stage(chosen, run)
    if find_rank().rank == 0:
        say_trained(path)
    return 0


def calibrate(
    weights: tyro.conf.Positional[str],
    data: list[Path],
    out: Path,
    alarm_share: float = 0.01,
    split: str | None = None,
    device: Device = "cpu",
) -> int:
    """Set below which confidence an image is refused as out of distribution.

    The mean confidence is measured on images like those of the training. The threshold below which
    'depth predict' refuses is set so that a share of them is refused. Tensors stay as they are.

        depthpose depth calibrate mine.safetensors --data my_pairs --out mine-calibrated.safetensors

    Args:
        weights: weights with a generator that selects, by name or file.
        data: folders of such images: KITTI raw, object, 2012/2015, or plain folders of pairs.
        out: the file of the calibrated weights.
        alarm_share: share of these images that may be refused.
        split: name or file of a split, for the first folder.
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import find_weights
    from depthpose.core.run import refuse_to_replace
    from depthpose.depth import out_of_distribution
    from depthpose.depth.datasets import join_datasets, open_dataset
    from depthpose.depth.estimator import FakestereoNet

    refuse_to_replace(out)
    if out.suffix != ".safetensors":
        raise InputError(f"{out}: end the name in .safetensors")
    path = find_weights(weights)
    parts = [open_dataset(folder, split if k == 0 else None) for k, folder in enumerate(data)]
    dataset = join_datasets(parts)
    out_of_distribution.refuse_share(len(dataset), alarm_share)
    net = FakestereoNet.load(path, config=MatcherConfig(device=device), allow_ood=True)
    shown = tqdm(range(len(dataset)), unit=" images", disable=None)
    known = out_of_distribution.measure_image_confidence(net, map(dataset.read_input, shown))
    least = out_of_distribution.calibrate(path, known, alarm_share, out)
    print(f"{len(known)} images: mean confidence {min(known):.3f} to {max(known):.3f}")
    print(f"refused below {least:.3f}; calibrated weights: {out}")
    return 0
