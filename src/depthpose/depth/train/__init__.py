"""Stages of a training, one loop: a generator, the matcher, the generator through the matcher."""

from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.runs import (
    STAGES,
    train_adapt,
    train_finetune,
    train_select,
    train_stereo,
    train_view,
)
from depthpose.depth.train.stages import (
    FinetuneTask,
    SelectionSamples,
    SelectTask,
    StereoTask,
    ViewTask,
)

__all__ = [
    "STAGES",
    "FinetuneTask",
    "SelectTask",
    "SelectionSamples",
    "StereoTask",
    "TrainingPairs",
    "ViewTask",
    "train_adapt",
    "train_finetune",
    "train_select",
    "train_stereo",
    "train_view",
]
