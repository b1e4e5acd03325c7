"""Views with truth for tables and figures of poses: of a data set, or synthetic."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from depthpose.cli.pose import evaluating as pose_evaluating
from depthpose.cli.pose import methods as pose_methods
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.evaluate import frames_hash
from depthpose.pose.synthetic import Objects
from depthpose.pose.types import ViewSample
from depthpose.report.choose import spread_evenly
from depthpose.report.overlay import grey_depth

MADE_SEED = 3303
"""Of synthetic views for tables and figures; no training uses it."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where views come from.

    Attributes:
        linemod: Linemod_preprocessed, or LineMOD in BOP's layout.
        bop: any other data set in BOP's layout.
        split: of it.
        objects: keep these alone; all where there is none.
        made: number of synthetic views where no data set is named.
    """

    linemod: Path | None
    bop: Path | None
    split: str
    objects: tuple[str, ...] = ()
    made: int = 0

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
        return self.linemod or self.bop


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """Views, the picture of each, and what to write beside numbers of them."""

    samples: Sequence[ViewSample]
    instances: Sequence[Instance | None]
    facts: dict[str, Any]

    def picture(self, index: int) -> Float[Tensor, "3 h w"]:
        """Give the picture of a view, or its depth in grey."""
        instance = self.instances[index]
        if instance is not None and instance.rgb is not None:
            return read_image(instance.rgb)
        return grey_depth(self.samples[index].input.depth_m)


def open_views(net: GeoPoseNet, source: Source, number: int | None = None) -> Views:
    """Read the views of a data set, or make some of the objects that the weights know.

    Args:
        net: whose objects, under whose names.
        source: where from.
        number: of a data set so many from all over; None: all.

    Raises:
        InputError: the weights do not know an object, or a file is damaged.
    """
    folder = source.folder
    if folder is None:
        config = ObjectsConfig(number=source.made, seed=MADE_SEED)
        objects = Objects(net.weights.models, config, net.weights.cloud)
        samples = [objects.view(i) for i in range(source.made)]
        return Views(
            samples=samples,
            instances=[None] * len(samples),
            facts={"frames": f"made, seed {MADE_SEED}"},
        )
    dataset = pose_evaluating.open_instances(folder, source.split, source.objects, None)
    facts = {
        "frames": f"{folder.resolve().name} {source.split}",
        "frames_sha256": frames_hash(dataset.instances)[:12],
    }
    if number is not None and number < len(dataset):
        kept = [dataset.instances[i] for i in spread_evenly(len(dataset), number)]
        dataset = replace(dataset, instances=kept)
    return Views(
        samples=list(_views_of(dataset, net)), instances=list(dataset.instances), facts=facts
    )


def _views_of(dataset: BopDataset, net: GeoPoseNet) -> Iterator[ViewSample]:
    names = pose_methods.match_names(dataset, net.weights.models)
    for instance in dataset.instances:
        view = dataset.view(instance)
        yield replace(view, input=replace(view.input, object=names[instance.object_id]))
