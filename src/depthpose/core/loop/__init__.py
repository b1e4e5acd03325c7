"""The one training loop: a task in, trained weights and a run folder out."""

from depthpose.core.loop.folder import RunLogger as RunLogger
from depthpose.core.loop.folder import add_origin as add_origin
from depthpose.core.loop.folder import format_card as format_card
from depthpose.core.loop.folder import format_last_validation as format_last_validation
from depthpose.core.loop.folder import read_metrics as read_metrics
from depthpose.core.loop.folder import write_card as write_card
from depthpose.core.loop.loop import Interrupted as Interrupted
from depthpose.core.loop.loop import Progress as Progress
from depthpose.core.loop.loop import TrainingRun as TrainingRun
from depthpose.core.loop.loop import releases_folder as releases_folder
from depthpose.core.loop.task import AdamConfig as AdamConfig
from depthpose.core.loop.task import LoopConfig as LoopConfig
from depthpose.core.loop.task import Samples as Samples
from depthpose.core.loop.task import Task as Task
from depthpose.core.loop.task import TrainingConfig as TrainingConfig
from depthpose.core.loop.task import Update as Update
from depthpose.core.loop.task import ValidationResult as ValidationResult
from depthpose.core.loop.task import make_adam as make_adam
from depthpose.core.loop.task import make_sample_generator as make_sample_generator
from depthpose.core.loop.task import shuffle_index as shuffle_index
