"""Whole depth images of the pose commands: read without masks, or masked by a pose in them."""

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import torch

from depthpose.cli.pose.methods import PoseMethod
from depthpose.core.files import read_depth_png
from depthpose.pose.datasets import Instance
from depthpose.pose.footprint import explained_mask
from depthpose.pose.geometry.surface import Surface, prepare_surface
from depthpose.pose.inputs import AnyInput
from depthpose.pose.predictions import PoseJob, Prediction
from depthpose.pose.types import ObjectModel, ViewInput


def read_whole_view(instance: Instance, object: str, name: str) -> ViewInput:
    """Read the depth image of an instance without its mask."""
    depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
    everywhere = torch.ones_like(depth_m, dtype=torch.bool)
    return ViewInput(name=name, depth_m=depth_m, mask=everywhere, K=instance.K, object=object)


def make_masked_job(job: PoseJob[Any], prediction: Prediction, method: PoseMethod) -> PoseJob[Any]:
    """Make the job that reads an image with the mask of a predicted object."""
    read = partial(_read_masked_by_pose, job, prediction, method)
    return replace(job, name=prediction.estimate.name, read=read)


def _read_masked_by_pose(job: PoseJob[Any], prediction: Prediction, method: PoseMethod) -> AnyInput:
    """Read a whole depth image, masked to the pixels that a predicted pose explains.

    A cloud, and an image whose object has no pose, are read as they are.
    """
    view = job.read()
    estimate = prediction.estimate
    model = next((model for model in method.models if model.name == estimate.object), None)
    if model is None or estimate.camera_from_model is None or not isinstance(view, ViewInput):
        return view
    mask = explained_mask(view, estimate.camera_from_model, _sample_surface_once(model))
    return replace(view, name=estimate.name, mask=mask, object=model.name)


@lru_cache(maxsize=32)
def _sample_surface_once(model: ObjectModel) -> Surface:
    """Sample the surface of a model once for all frames that show it."""
    return prepare_surface(model)
