"""The one training loop: a task in, trained weights and a run folder out."""

from depthpose.core.loop.config import AdamConfig, LoopConfig, make_adam
from depthpose.core.loop.journal import (
    Journal,
    card_text,
    held_out_text,
    leave_card,
    read_metrics,
    run_files,
)
from depthpose.core.loop.loop import Interrupted, Progress, train
from depthpose.core.loop.run import Run
from depthpose.core.loop.task import (
    Evidence,
    Samples,
    Task,
    Turn,
    sample_generator,
    shuffled_index,
)

__all__ = [
    "AdamConfig",
    "Evidence",
    "Interrupted",
    "Journal",
    "LoopConfig",
    "Progress",
    "Run",
    "Samples",
    "Task",
    "Turn",
    "card_text",
    "held_out_text",
    "leave_card",
    "make_adam",
    "read_metrics",
    "run_files",
    "sample_generator",
    "shuffled_index",
    "train",
]
