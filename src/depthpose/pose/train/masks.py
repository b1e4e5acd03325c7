"""Training of segmentation: annotated images, their augmentation, and the task."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from depthpose.core.arrays import grey_from_rgb
from depthpose.core.checkpoint import Checkpoint, find_weights, load_weights, read_checkpoint
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.core.loop import (
    TrainingRun,
    Update,
    ValidationResult,
    add_origin,
    format_last_validation,
    make_adam,
    make_sample_generator,
    releases_folder,
    shuffle_index,
    write_card,
)
from depthpose.core.processes import find_rank
from depthpose.pose.datasets import Instance, open_bop, read_object_names
from depthpose.pose.datasets.dataset import read_instance_mask
from depthpose.pose.metrics import count_overlap, intersection_over_union
from depthpose.pose.networks.fcn import ENCODER_KIND, FCN, normalise_colors
from depthpose.pose.segmentation import (
    KIND,
    SegmentationWeights,
    predict_probabilities,
    write_segmentation,
)
from depthpose.pose.synthetic.random_numbers import random_index, uniform
from depthpose.pose.train.config import ImageAugmentConfig, ImagesConfig, SegmentationTraining
from depthpose.pose.train.poses import WEIGHTS_FILES


class LabelledImage(NamedTuple):
    """An image with the class of each pixel, or a batch of them."""

    image: Float[Tensor, "*b 3 h w"]  #: RGB in [0, 1]
    labels: Int[Tensor, "*b h w"]  #: 0 is the background, ``1 + i`` object i


class _StoredImage(NamedTuple):
    """A labelled image in less memory."""

    rgb: UInt8[Tensor, "3 h w"]  #: 0 to 255
    labels: UInt8[Tensor, "h w"]  #: class of each pixel


_ABOUT_OBJECT_SHARE = 0.5  # of the windows: most of an image is background


class AnnotatedImages:
    """Images of a dataset with their labels, by index.

    Args:
        config: the dataset.
        objects: names of the classes by number of the object; None: those of the config.

    Raises:
        InputError: there is no picture, or none of the objects.
    """

    def __init__(self, config: ImagesConfig, objects: Mapping[int, str] | None = None) -> None:
        if not config.folder:
            raise InputError("there is no image to learn from; name a folder in BOP's layout")

        # The instances of each image that has a picture.
        dataset = open_bop(config.folder, config.split)
        images: dict[tuple[int, int], list[Instance]] = {}
        for instance in dataset.instances:
            if instance.rgb is not None:
                images.setdefault((instance.scene_id, instance.image_id), []).append(instance)
        if not images:
            raise InputError(f"{config.folder}: split {config.split!r} has no picture (rgb)")

        # The objects that are classes: ``objects``, or those that the config wants and images show.
        if objects is None:
            shown = [instance for instances in images.values() for instance in instances]
            shown_numbers = sorted({instance.object_id for instance in shown})
            wanted = [n for n in shown_numbers if not config.objects or n in config.objects]
            if not wanted:
                raise InputError(
                    f"{config.folder}: shows none of the objects {list(config.objects)}; it has "
                    f"{shown_numbers}"
                )
            objects = read_object_names(Path(config.folder), wanted)
        self.objects = objects  # names by number, in the order of the classes
        self._class_of = {number: k for k, number in enumerate(objects, 1)}
        self._images = list(images.values())
        self._cache: dict[int, _StoredImage] = {}
        self._with_cache = config.with_cache

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: int) -> LabelledImage:
        """Read one whole image, or take it from the cache."""
        stored = self._cache.get(index)
        if stored is None:
            stored = self._read(self._images[index])
            if self._with_cache:
                self._cache[index] = stored
        return LabelledImage(stored.rgb.float() / 255, stored.labels.long())

    def _read(self, instances: list[Instance]) -> _StoredImage:
        """Read the image that shows some instances, and label the pixels of their masks."""
        path = instances[0].rgb
        assert path is not None
        image = read_image(path)
        labels = torch.zeros(image.shape[1:], dtype=torch.uint8)
        for instance in instances:
            number = self._class_of.get(instance.object_id)
            if number is None:
                continue
            mask = read_instance_mask(instance)
            if mask.shape != labels.shape:
                raise InputError(
                    f"{instance.name}: the mask is {mask.shape[1]}x{mask.shape[0]}, but the "
                    f"picture {labels.shape[1]}x{labels.shape[0]}; one of them is another's"
                )
            labels[mask] = number
        return _StoredImage((image * 255).round().to(torch.uint8), labels)


@dataclass(frozen=True, eq=False)
class TrainingImages:
    """Augmented windows of annotated images, by sample index."""

    images: AnnotatedImages  #: the images
    config: ImageAugmentConfig  #: of the augmentation
    long_side_px: int  #: of the images that the network is given
    seed: int  #: of the order and of the augmentation

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> LabelledImage:
        """Make the sample of an index."""
        # A window of an image at a random scale.
        generator = make_sample_generator(index, self.seed)
        labelled = self.images[shuffle_index(index, len(self), self.seed)]
        scale = self.long_side_px / max(labelled.image.shape[-2:])
        scale *= uniform(generator, *self.config.scale)
        window = cut_window(labelled, scale, self.config.crop_px, generator)

        image = _jitter_colors(window.image, self.config.jitter, generator)
        return LabelledImage(image, window.labels)


def _jitter_colors(
    image: Float[Tensor, "3 h w"], jitter: float, generator: torch.Generator
) -> Float[Tensor, "3 h w"]:
    """Change brightness, contrast and saturation by the jitter at most, each color by a third."""
    changes = 1 + jitter * (2 * torch.rand(6, generator=generator) - 1)
    brightness, contrast, saturation = changes[:3].tolist()
    balance = 1 + (changes[3:, None, None] - 1) / 3
    image = image * brightness * balance
    image = (image - image.mean()) * contrast + image.mean()
    grey = grey_from_rgb(image)
    return (grey + (image - grey) * saturation).clamp(0, 1)


def cut_window(
    labelled: LabelledImage, scale: float, size: tuple[int, int], generator: torch.Generator
) -> LabelledImage:
    """Scale an image and crop it to a random window; pixels beside a small image are background.

    Half of the windows show the middle of an object, since most of an image is background.

    Args:
        labelled: the image and the class of each pixel, 0 the background.
        scale: of both.
        size: rows and columns of the window [px].
        generator: chooses the window.

    Returns:
        The window of the image and of its labels.
    """
    # Scale.
    height, width = size
    rows, columns = (max(1, round(side * scale)) for side in labelled.image.shape[-2:])
    image = F.interpolate(
        labelled.image[None], (rows, columns), mode="bilinear", antialias=scale < 1
    )[0].clamp(0, 1)
    labels = F.interpolate(
        labelled.labels[None, None].float(), (rows, columns), mode="nearest-exact"
    )
    labels = labels[0, 0].long()

    # Pad what is smaller than the window.
    bottom = max(0, height - rows)
    right = max(0, width - columns)
    image = F.pad(image[None], (0, right, 0, bottom), mode="replicate")[0]
    labels = F.pad(labels, (0, right, 0, bottom))

    # The window: about the middle of an object, or anywhere.
    last_top = labels.shape[0] - height
    last_left = labels.shape[1] - width
    is_about_object = uniform(generator, 0.0, 1.0) < _ABOUT_OBJECT_SHARE
    classes = labels[labels > 0].unique()
    if is_about_object and len(classes):
        chosen = labels == classes[random_index(generator, len(classes))]
        row, column = chosen.nonzero().float().mean(0).tolist()
        top = min(max(round(row - height / 2), 0), last_top)
        left = min(max(round(column - width / 2), 0), last_left)
    else:
        top = random_index(generator, last_top + 1)
        left = random_index(generator, last_left + 1)
    window = (slice(top, top + height), slice(left, left + width))
    return LabelledImage(image[:, *window], labels[window])


class SegmentationTask:
    """Trains FCN by the cross entropy of each pixel, objects weighing more than the background.

    With equal weights the background would dominate, for objects cover a few percent.
    """

    def __init__(
        self, network: FCN, config: SegmentationTraining, objects: Mapping[int, str]
    ) -> None:
        self.config = config
        self.objects = objects
        self.network = network.train()
        self.modules: dict[str, nn.Module] = {"network": network}
        self.optimizers = {"network": (make_adam(network.parameters(), config.adam), config.adam)}
        self._held_out = None
        if config.held_out is not None:
            self._held_out = AnnotatedImages(config.held_out, objects)

    def step(self, batch: LabelledImage) -> Iterator[Update]:
        """Make one update: the loss of a batch, and its intersection over union."""
        logits = self.network(normalise_colors(batch.image)).float()
        weight = logits.new_full((logits.shape[1],), self.config.object_weight)
        weight[0] = 1.0
        loss = F.cross_entropy(logits, batch.labels, weight)
        table = count_overlap(logits.argmax(1), batch.labels, self.network.classes)
        iou = intersection_over_union(table)[1:].nanmean().nan_to_num(0.0)
        yield Update("network", loss, {"iou": iou})

    def validate(self) -> ValidationResult:
        """Measure intersection over union on held-out images; the first one becomes a picture."""
        if self._held_out is None:
            return ValidationResult()

        # All images count in one table.
        self.network.eval()
        classes = self.network.classes
        pictures = {}
        table = torch.zeros(classes, classes, dtype=torch.int64)
        for index in range(len(self._held_out)):
            image, labels = self._held_out[index]
            predicted = predict_probabilities(self.network, image).argmax(0)
            table += count_overlap(predicted, labels, classes)
            if index == 0:
                segmented = _tint_objects(image, predicted, classes)
                truth = _tint_objects(image, labels, classes)
                pictures["found_truth"] = torch.cat([segmented, truth], -1)
        self.network.train()

        # The numbers of each class that occurs, and their mean over objects.
        iou = intersection_over_union(table)
        numbers = {
            f"held_out/iou_{name}": float(value)
            for name, value in zip(("background", *self.objects.values()), iou, strict=True)
            if bool(value.isfinite())
        }
        numbers["held_out/iou_objects"] = float(iou[1:].nanmean())
        return ValidationResult(numbers=numbers, pictures=pictures)


def _tint_objects(
    image: Float[Tensor, "3 h w"], labels: Int[Tensor, "h w"], classes: int
) -> Float[Tensor, "3 h w"]:
    """Darken the background of an image, and tint the pixels of each object by a colour."""
    angle = 2 * torch.pi * torch.arange(classes) / max(classes - 1, 1)
    phase = torch.tensor([0.0, 2.0, 4.0]) * torch.pi / 3
    tint = (0.5 + 0.5 * (angle[:, None] + phase).cos())[labels].movedim(-1, 0)
    return torch.where(labels > 0, 0.5 * image + 0.5 * tint, 0.3 * image)


@releases_folder
def train_segmentation(config: SegmentationTraining, run: TrainingRun) -> Path:
    """Train FCN, and write its weights and their card.

    Returns:
        The path of the weights.

    Raises:
        InputError: settings, images or an encoder to begin with that do not fit.
    """
    # What is learnt from, and the network, perhaps with a trained encoder.
    torch.manual_seed(config.loop.seed)
    images = AnnotatedImages(config.images)
    network = FCN(len(images.objects), config.network)
    if config.start is not None:
        path = find_weights(config.start)
        encoder = Checkpoint(kind=KIND, config={}, state=read_checkpoint(path, ENCODER_KIND).state)
        load_weights(network.encoder, encoder, str(path))

    # The folder is claimed only now: until here a setting may be refused.
    run.claim(config, WEIGHTS_FILES)
    task = SegmentationTask(network, config, images.objects)
    samples = TrainingImages(images, config.augment, config.network.long_side_px, config.loop.seed)
    seconds = run.train(task, samples, config.loop)
    path = run.folder / "segmentation.safetensors"
    if find_rank().rank:
        return path

    # Weights and their card.
    licence = "not stated; that of the training data binds"
    facts = {"trained_on": Path(config.images.folder).name, "licence": licence}
    weights = SegmentationWeights(
        network=network.cpu().eval(),
        objects=tuple(images.objects.values()),
        numbers=tuple(images.objects),
        facts=add_origin(facts, config),
    )
    write_segmentation(path, weights, with_half=config.with_half)
    measured = format_last_validation(
        run.folder, "Images that were held out: intersection over union."
    )
    card = {"objects": ", ".join(weights.objects), **weights.facts}
    write_card(path, "pose train --what segmentation", seconds, card, measured)
    return path
