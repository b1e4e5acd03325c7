"""Options that several commands take: each is declared, and described, once.

A group is a class with ``@group``; a parameter of a command that is one gives the command all of
its fields as options.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from depthpose.cli.help import group
from depthpose.core.errors import InputError
from depthpose.pose.config import DiameterTable, EstimateConfig, EvaluationConfig, VotingConfig

Voting = Literal["ransac", "least-squares"]


Device = Annotated[str, tyro.conf.arg(help="cpu, cuda, cuda:1, ...")]


def voting_config(voting: Voting, hypotheses: int | None = None) -> VotingConfig:
    """Give the config of a way to vote."""
    method = "ransac" if voting == "ransac" else "least squares"
    return changed(VotingConfig(method=method), hypotheses=hypotheses)


def refuse_below(least: int, option: str, given: int, usual: str) -> None:
    """Refuse a count that is too small.

    Raises:
        InputError: the option, its value, the least and a usual value are named.
    """
    if given < least:
        raise InputError(f"{option} {given}: give {least} or more, such as {usual}")


@group
class PoseDataOptions:
    """The data set of a table or figure of poses."""

    linemod: Path | None = None
    """Linemod_preprocessed, or LineMOD in BOP's layout; masks are the annotated ones."""
    bop: Path | None = None
    """any other data set in BOP's layout."""
    split: str = "test"
    """of the data set: train, test, ..."""
    objects: tuple[str, ...] = ()
    """keep these alone, by name or number."""

    @property
    def folder(self) -> Path | None:
        """The one data set that was named, if any.

        Raises:
            InputError: two were.
        """
        if self.linemod is not None and self.bop is not None:
            raise InputError(
                f"two data sets were named, {self.linemod} and {self.bop}; a table is of one."
            )
        if self.linemod is None and self.bop is None:
            self._refuse_ignored()
        return self.linemod or self.bop

    def _refuse_ignored(self) -> None:
        given = [f"--objects {' '.join(self.objects)}"] if self.objects else []
        given += [f"--split {self.split}"] if self.split != "test" else []
        if given:
            raise InputError(
                f"{' and '.join(given)}: chooses from a data set, and none is named; give "
                "--linemod or --bop, or leave it out"
            )


@group
class PoseMeasureOptions:
    """How poses of a data set are estimated and measured."""

    masks: tuple[str, ...] = ("truth",)
    """truth; predicted (those that came with Linemod_preprocessed); a JSON file of BOP detections;
    or weights of a segmentation. Each is a row of its own."""
    targets: Path | None = None
    """a BOP list of targets, such as test_targets_bop19.json; by default all instances."""
    diameters: DiameterTable = "bop"
    """bop: as the data set declares them; pvnet: PVNet's table of LineMOD."""
    voting: Voting = "ransac"
    """how directions become keypoints."""
    icp: bool = True
    """refine each pose by ICP."""
    vsd: bool = False
    """measure VSD and BOP's average recall too, which takes most of the time."""
    device: Device = "cpu"

    @property
    def estimate(self) -> EstimateConfig:
        """Settings of the estimators."""
        voting = voting_config(self.voting)
        return EstimateConfig(voting=voting, with_icp=self.icp, device=self.device)

    @property
    def evaluation(self) -> EvaluationConfig:
        """Settings of the metrics."""
        return EvaluationConfig(diameters=self.diameters, with_vsd=self.vsd)


@group
class PoseTableOptions(PoseMeasureOptions):
    """How the poses of a table are estimated, measured and shown."""

    pictures: int = 4
    """instances that the page shows."""


@group
class TrainingOptions:
    """How long a training goes, on what, and from which state."""

    steps: int | None = None
    """optimiser steps in place of the config's length."""
    seed: int | None = None
    """decides initial weights, order, random changes and dropout."""
    device: Literal["auto", "cpu"] | None = None
    """auto takes what accelerate finds; cpu takes no GPU."""
    precision: Literal["fp32", "bf16", "fp16"] | None = None
    """arithmetic of the forward pass."""
    resume: bool = False
    """go on from the state that OUT holds."""
    finish: bool = False
    """write weights and card of the state that OUT holds, without another step; Ctrl-C twice does
    the same while it trains."""
    view: str | None = None
    """live draws the losses in Rerun's viewer (an extra); FILE.rrd records them."""

    def read(self, path: Path | None, kind: type, default: object = None, **others: Any) -> Any:  # noqa: ANN401
        """Read the config of a training, or take its defaults, with what was said here.

        Args:
            path: of the config.
            kind: its dataclass.
            default: the config if none is named; None: the dataclass's own.
            others: more settings of the loop.

        Raises:
            InputError: a value is refused, or a warm-up longer than the config's own steps. A try
                (``--steps``) may be shorter, and a run that goes on keeps its config.
        """
        from depthpose.core.config import read_config
        from depthpose.core.loop import refuse_long_warmup  # --help must not load torch

        chosen: Any = (default or kind()) if path is None else read_config(path, kind)
        if not (self.resume or self.finish):
            own = chosen.loop.steps
            refuse_long_warmup(chosen, None if own is None else max(own, self.steps or 0))
        loop = changed(
            chosen.loop, seed=self.seed, device=self.device, precision=self.precision, **others
        )
        if self.steps is not None:
            loop = dataclasses.replace(loop, steps=self.steps, epochs=None)
        return dataclasses.replace(chosen, loop=loop)


def changed(config: Any, **values: Any) -> Any:  # noqa: ANN401 - any config
    """Give a config with other values; None leaves a setting as it is."""
    return dataclasses.replace(config, **{k: v for k, v in values.items() if v is not None})
