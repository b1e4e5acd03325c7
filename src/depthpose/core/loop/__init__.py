"""The one training loop: a task in, trained weights and a run folder out."""

from depthpose.core.loop.config import AdamConfig, LoopConfig, make_adam, refuse_long_warmup
from depthpose.core.loop.journal import (
    Journal,
    card_text,
    held_out_text,
    read_metrics,
    run_files,
    write_card,
)
from depthpose.core.loop.loop import Interrupted, Progress, train
from depthpose.core.loop.run import Run, releases_folder
from depthpose.core.loop.task import (
    Samples,
    Task,
    Update,
    ValidationResult,
    sample_generator,
    shuffled_index,
)

__all__ = [
    "AdamConfig",
    "Interrupted",
    "Journal",
    "LoopConfig",
    "Progress",
    "Run",
    "Samples",
    "Task",
    "Update",
    "ValidationResult",
    "card_text",
    "held_out_text",
    "make_adam",
    "read_metrics",
    "refuse_long_warmup",
    "releases_folder",
    "run_files",
    "sample_generator",
    "shuffled_index",
    "train",
    "write_card",
]
