"""Segmentation as a task of the loop."""

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import nn

from depthpose.core.checkpoint import Checkpoint, find_weights, load_weights
from depthpose.core.loop import (
    Run,
    Update,
    ValidationResult,
    held_out_text,
    make_adam,
    releases_folder,
    write_card,
)
from depthpose.core.run import find_rank
from depthpose.pose.losses import mask_loss
from depthpose.pose.resnet import KIND, normalise_colors, read_encoder_state
from depthpose.pose.segmentation import (
    FCN,
    Overlap,
    SegmentationWeights,
    class_probabilities,
    write_segmentation,
)
from depthpose.pose.train.images import (
    AnnotatedImages,
    KnownObjects,
    LabelledImage,
    TrainingImages,
)
from depthpose.pose.train.other_configs import SegmentationTraining
from depthpose.pose.train.task import claim_run, with_origin


class SegmentationTask:
    """Cross entropy of each pixel, objects weighing more."""

    def __init__(self, network: FCN, config: SegmentationTraining, objects: KnownObjects) -> None:
        self.config, self.objects = config, objects
        self.network = network.train()
        self.modules: dict[str, nn.Module] = {"network": network}
        self.optimizers = {"network": (make_adam(network.parameters(), config.adam), config.adam)}
        self._held_out = None
        if config.held_out is not None:
            self._held_out = AnnotatedImages(config.held_out, objects)

    def step(self, batch: LabelledImage) -> Iterator[Update]:
        """One update: label and compare."""
        logits = self.network(normalise_colors(batch.image)).float()
        loss = mask_loss(logits, batch.labels, self.config.object_weight)
        overlap = Overlap(self.network.classes)
        overlap.add(logits.argmax(1), batch.labels)
        yield Update("network", loss, {"iou": overlap.iou()[1:].nanmean().nan_to_num(0.0)})

    def validate(self) -> ValidationResult:
        """Intersection over union on held-out images; the first with its labels as a picture."""
        if self._held_out is None:
            return ValidationResult()
        self.network.eval()
        overlap = Overlap(self.network.classes)
        pictures = {}
        for index in range(len(self._held_out)):
            image, labels = self._held_out[index]
            found = class_probabilities(self.network, image).argmax(0)
            overlap.add(found, labels)
            if index == 0:
                pictures["found_truth"] = torch.cat(
                    [_painted(image, part, self.network.classes) for part in (found, labels)], -1
                )
        self.network.train()
        iou = overlap.iou()
        numbers = {
            f"held_out/iou_{name}": float(value)
            for name, value in zip(("background", *self.objects.names), iou, strict=True)
            if bool(value.isfinite())
        }
        numbers["held_out/iou_objects"] = float(iou[1:].nanmean())
        return ValidationResult(numbers=numbers, pictures=pictures)


@releases_folder
def train_segmentation(config: SegmentationTraining, run: Run) -> Path:
    """Train FCN; give its weights file."""
    torch.manual_seed(config.loop.seed)
    images = AnnotatedImages(config.images)
    network = FCN(len(images.objects.names), config.network)
    if config.start is not None:
        path = find_weights(config.start)
        held = Checkpoint(kind=KIND, config={}, state=read_encoder_state(path))
        load_weights(network.encoder, held, str(path))
    claim_run(config, run)
    task = SegmentationTask(network, config, images.objects)
    samples = TrainingImages(images, config.augment, config.network, config.loop.seed)
    seconds = run.train(task, samples, config.loop)
    path = run.folder / "segmentation.safetensors"
    if find_rank().rank:
        return path
    licence = "not stated; that of the training data binds"
    facts = {"trained_on": Path(config.images.folder).name, "licence": licence}
    weights = SegmentationWeights(
        network=network.cpu().eval(),
        objects=images.objects.names,
        numbers=images.objects.numbers,
        facts=with_origin(facts, config),
    )
    write_segmentation(path, weights, with_half=config.with_half)
    measured = held_out_text(run.folder, "Images that were held out: intersection over union.")
    known = {"objects": ", ".join(weights.objects), **weights.facts}
    write_card(path, "pose train --what segmentation", seconds, known, measured)
    return path


def _painted(image: torch.Tensor, labels: torch.Tensor, classes: int) -> torch.Tensor:
    """Darken the background, and tint each object with a colour of its own."""
    angle = 2 * torch.pi * torch.arange(classes) / max(classes - 1, 1)
    phase = torch.tensor([0.0, 2.0, 4.0]) * torch.pi / 3
    colors = 0.5 + 0.5 * (angle[:, None] + phase).cos()
    tint = colors[labels].movedim(-1, 0)
    return torch.where(labels > 0, 0.5 * image + 0.5 * tint, 0.3 * image)
