"""A data set of any known layout as samples."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files import read_depth_png
from depthpose.pose.cloud import cloud_from_depth, refuse_other_size
from depthpose.pose.config import CloudConfig, MeshConfig
from depthpose.pose.datasets.layouts import (
    Instance,
    find_layout,
    layout_of,
    models_folder,
    object_name,
    read_bop_models,
    read_models_info,
)
from depthpose.pose.datasets.masks import read_mask
from depthpose.pose.types import (
    CloudInput,
    CloudSample,
    ObjectModel,
    PoseTruth,
    ViewInput,
    ViewSample,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class BopDataset:
    """Instances of one split, each a sample when it is asked for.

    Attributes:
        folder: of the data set.
        split: its name.
        layout: a key of ``LAYOUTS``.
        instances: what is annotated, in the order of scene, image and place.
        mesh_config: for its models.
        cloud_config: for its clouds.
        sha256: of all annotations of the split: tells data sets of one name apart.
    """

    folder: Path
    split: str
    layout: str
    instances: Sequence[Instance]
    mesh_config: MeshConfig
    cloud_config: CloudConfig
    sha256: str

    def __len__(self) -> int:
        """How many instances."""
        return len(self.instances)

    def __getitem__(self, index: int) -> CloudSample:
        """Give a sample with the annotated mask; see :meth:`sample`."""
        return self.sample(self.instances[index])

    @cached_property
    def objects(self) -> dict[int, ObjectModel]:
        """The models of all objects that occur, by number. Read when first asked for.

        Raises:
            InputError: a mesh is missing or damaged.
        """
        numbers = {instance.object_id for instance in self.instances}
        return read_bop_models(self.folder, numbers, self.mesh_config)

    def sample(
        self, instance: Instance, mask: Bool[Tensor, "mask_h mask_w"] | None = None
    ) -> CloudSample:
        """Cut an instance out of its depth image.

        Args:
            instance: one of ``instances``.
            mask: predicted; None: the annotated one.

        Raises:
            InputError: a file is missing or damaged, or the mask does not fit the depth.
        """
        model, view = self.objects[instance.object_id], self.view(instance, mask)
        given = view.input
        points_m = cloud_from_depth(
            given.depth_m, given.mask, given.K, model.diameter_m, self.cloud_config
        )
        return CloudSample(
            input=CloudInput(name=instance.name, points_m=points_m, object=model.name),
            truth=view.truth,
        )

    def view(
        self, instance: Instance, mask: Bool[Tensor, "mask_h mask_w"] | None = None
    ) -> ViewSample:
        """Read the whole depth image of an instance, and its mask.

        Args:
            instance: one of ``instances``.
            mask: predicted; None: the annotated one.

        Raises:
            InputError: a file is missing or damaged, or the mask does not fit the depth.
        """
        mask = read_instance_mask(instance) if mask is None else mask
        depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
        refuse_other_size(mask, depth_m)
        return ViewSample(
            input=ViewInput(
                name=instance.name,
                depth_m=depth_m,
                mask=mask,
                K=instance.K,
                object=self.objects[instance.object_id].name,
            ),
            truth=PoseTruth(
                camera_from_model=instance.camera_from_model,
                visible_fraction=instance.visible_fraction,
                is_measured=instance.is_measured,
            ),
        )

    def of_objects(self, *objects: int | str) -> "BopDataset":
        """Keep the instances of some objects, by number or name; digits are a number too.

        Raises:
            InputError: none is left.
        """
        infos = read_models_info(models_folder(self.folder))
        there = sorted({instance.object_id for instance in self.instances})
        names = {number: object_name(number, infos.get(number, {})) for number in there}
        digits = (o for o in objects if isinstance(o, str) and o.isdecimal())
        wanted = {*objects, *(int(o) for o in digits if o not in names.values())}
        kept = [i for i in self.instances if {i.object_id, names[i.object_id]} & wanted]
        if not kept:
            asked = ", ".join(map(repr, objects))
            known = ", ".join(f"{number} ({name})" for number, name in names.items())
            raise InputError(
                f"{self.folder}: no instance of {asked}; objects here: {known}; name one of them"
            )
        return replace(self, instances=kept)


def open_bop(
    folder: str | Path,
    split: str = "test",
    *,
    mesh: MeshConfig | None = None,
    cloud: CloudConfig | None = None,
) -> BopDataset:
    """Open a split of a data set in BOP's layout, or in another of ``LAYOUTS``.

    Args:
        folder: of the data set, with ``models`` and the splits in it.
        split: ``test``, ``train_pbr``, ...; ``train`` or ``test`` of Linemod_preprocessed.
        mesh: how many keypoints its models get.
        cloud: how its clouds are cut.

    Raises:
        InputError: no such folder or split, or an annotation is damaged.
    """
    folder = Path(folder)
    name, layout = layout_of(folder)
    instances = list(layout.instances(folder, split))
    return BopDataset(
        folder=folder,
        split=split,
        layout=name,
        instances=instances,
        mesh_config=MeshConfig() if mesh is None else mesh,
        cloud_config=CloudConfig() if cloud is None else cloud,
        sha256=_annotations_sha256(instances),
    )


def _annotations_sha256(instances: Sequence[Instance]) -> str:
    said = hashlib.sha256()
    for one in instances:
        pose = one.camera_from_model
        said.update(f"{one.name} {one.object_id} {one.depth_unit_m}".encode())
        numbers = torch.cat([one.K.flatten(), pose.R.flatten(), pose.t_m]).double().numpy()
        said.update(numbers.tobytes())
    return said.hexdigest()


def is_bop(folder: str | Path) -> bool:
    """Whether a folder holds a data set that :func:`open_bop` knows."""
    return find_layout(Path(folder)) is not None


def read_instance_mask(instance: Instance) -> Bool[Tensor, "mask_h mask_w"]:
    """Read the annotated mask of the visible part."""
    if instance.mask is None:
        raise InputError(
            f"{instance.name}: there is no mask beside {instance.depth.parent}; render mask_visib, "
            "or give masks of your own"
        )
    return read_mask(instance.mask)
