"""Stages of a training, one loop: a generator, the matcher, the generator through the matcher."""

from depthpose.depth.train.finetune import FinetuneTask
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.runs import (
    STAGES,
    Run,
    train_finetune,
    train_select,
    train_stereo,
    train_view,
)
from depthpose.depth.train.select import SelectTask
from depthpose.depth.train.select_pairs import SelectionSamples
from depthpose.depth.train.stereo import StereoTask
from depthpose.depth.train.view import ViewTask

__all__ = [
    "STAGES",
    "FinetuneTask",
    "Run",
    "SelectTask",
    "SelectionSamples",
    "StereoTask",
    "TrainingPairs",
    "ViewTask",
    "train_finetune",
    "train_select",
    "train_stereo",
    "train_view",
]
