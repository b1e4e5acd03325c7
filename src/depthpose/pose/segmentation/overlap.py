"""Intersection over union of labels, class by class, over many images."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Overlap:
    """Counts pixels of each class that are found, true and both, over all images given.

    Args:
        classes: background and objects.
    """

    def __init__(self, classes: int) -> None:
        self.both = torch.zeros(classes, dtype=torch.int64)
        self.either = torch.zeros(classes, dtype=torch.int64)

    def add(self, found: Int[Tensor, "*b h w"], truth: Int[Tensor, "*b h w"]) -> None:
        """Count one image, or a batch."""
        classes = len(self.both)
        pairs = (truth * classes + found).flatten().cpu()
        table = torch.bincount(pairs, minlength=classes**2).view(classes, classes)
        self.both += table.diagonal()
        self.either += table.sum(0) + table.sum(1) - table.diagonal()

    def iou(self) -> Float[Tensor, " classes"]:
        """Intersection over union of each class; NaN for one that is neither found nor true."""
        return torch.where(self.either > 0, self.both / self.either, torch.nan)
