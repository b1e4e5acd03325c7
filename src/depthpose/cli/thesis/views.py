"""Views with truth for tables and figures of poses: of a data set, or synthetic."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from depthpose.cli.options import PoseDataOptions
from depthpose.cli.pose import evaluating as pose_evaluating
from depthpose.cli.pose import methods as pose_methods
from depthpose.core.files import read_image
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.evaluate import frames_hash
from depthpose.pose.synthetic import Objects
from depthpose.pose.types import ViewSample
from depthpose.report.choose import spread_evenly
from depthpose.report.overlay import grey_depth

SYNTHETIC_SEED = 3303
"""Of synthetic views for tables and figures; no training uses it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """Views with truth.

    Attributes:
        samples: what the network is given.
        instances: of a data set, with the picture of each.
        facts: what to write beside numbers of them.
        settings: what decides which views they are.
    """

    samples: Sequence[ViewSample]
    instances: Sequence[Instance | None]
    facts: dict[str, Any]
    settings: dict[str, Any]

    def picture(self, index: int) -> Float[Tensor, "3 h w"]:
        """Give the picture of a view, or its depth in grey."""
        instance = self.instances[index]
        if instance is not None and instance.rgb is not None:
            return read_image(instance.rgb)
        return grey_depth(self.samples[index].input.depth_m)


def open_views(net: GeoPoseNet, data: PoseDataOptions, number: int | None, synthetic: int) -> Views:
    """Read the views of a data set, or render some of the objects that the weights know.

    Args:
        net: whose objects, under whose names.
        data: the data set, if any.
        number: of a data set so many, evenly taken; None: all.
        synthetic: how many are rendered where no data set is named.

    Raises:
        InputError: the weights do not know an object, or a file is damaged.
    """
    folder = data.folder
    if folder is None:
        return _synthetic_views(net, synthetic)
    dataset = pose_evaluating.open_instances(folder, data.split, data.objects, None)
    facts = {
        "frames": f"{folder.resolve().name} {data.split}",
        "frames_sha256": frames_hash(dataset.instances)[:12],
    }
    if number is not None and number < len(dataset):
        kept = [dataset.instances[i] for i in spread_evenly(len(dataset), number)]
        dataset = replace(dataset, instances=kept)
    return Views(
        samples=list(_views_of(dataset, net)),
        instances=list(dataset.instances),
        facts=facts,
        settings=settings_of(dataset),
    )


def settings_of(dataset: BopDataset) -> dict[str, Any]:
    """Say which instances of which data set results are of."""
    return {
        "data": str(dataset.folder.resolve()),
        "split": dataset.split,
        "frames_sha256": frames_hash(dataset.instances),
    }


def _synthetic_views(net: GeoPoseNet, number: int) -> Views:
    config = ObjectsConfig(number=number, seed=SYNTHETIC_SEED)
    objects = Objects(net.weights.models, config, net.weights.cloud)
    samples = [objects.view(i) for i in range(number)]
    facts = {"frames": f"synthetic, seed {SYNTHETIC_SEED}"}
    settings = {"synthetic": number, "seed": SYNTHETIC_SEED}
    return Views(samples=samples, instances=[None] * number, facts=facts, settings=settings)


def _views_of(dataset: BopDataset, net: GeoPoseNet) -> Iterator[ViewSample]:
    names = pose_methods.match_names(dataset, net.weights.models)
    for instance in dataset.instances:
        view = dataset.view(instance)
        yield replace(view, input=replace(view.input, object=names[instance.object_id]))
