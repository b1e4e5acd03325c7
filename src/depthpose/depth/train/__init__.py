"""Stages of a training, one loop: a generator, the matcher, the generator through the matcher."""

from depthpose.depth.train.generator_tasks import FinetuneTask as FinetuneTask
from depthpose.depth.train.generator_tasks import ViewTask as ViewTask
from depthpose.depth.train.pairs import TrainingPairs as TrainingPairs
from depthpose.depth.train.runs import STAGES as STAGES
from depthpose.depth.train.runs import train_finetune as train_finetune
from depthpose.depth.train.runs import train_select as train_select
from depthpose.depth.train.runs import train_stereo as train_stereo
from depthpose.depth.train.runs import train_view as train_view
from depthpose.depth.train.selection_task import SelectionSamples as SelectionSamples
from depthpose.depth.train.selection_task import SelectTask as SelectTask
from depthpose.depth.train.stereo_task import StereoTask as StereoTask
