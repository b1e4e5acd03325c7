"""Synthetic views of known objects as a dataset."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.data import DataLoader

from depthpose.core.errors import InputError
from depthpose.core.loop import sample_generator
from depthpose.core.rigid import Rigid
from depthpose.pose.augment import (
    grow_mask,
    measure,
    occlude,
    random_levels,
    random_rotation,
    shift_mask,
    uniform,
    whole,
)
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import CloudConfig, ObjectsConfig
from depthpose.pose.synthetic.views import (
    CleanView,
    Shape,
    draw_view,
    gaze,
    make_shape,
    pixel_to_ray,
    pose_of_middle,
    silhouette_of,
    turn_view,
)
from depthpose.pose.types import (
    CloudInput,
    CloudSample,
    ObjectModel,
    PoseTruth,
    ViewInput,
    ViewSample,
)

_BANK_SEED = 0x0B7EC7
_TILT_RAD = math.radians(75)
"""A table is seen from no flatter an angle."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stored:
    """A clean view in half the memory.

    Attributes:
        depth_m: less the distance of the middle, float16: to 0.1 mm for what is below 0.2 m.
        middle_m: that distance.
        K: of the window.
        camera_from_model: the pose.
    """

    depth_m: Float[Tensor, "h w"]
    middle_m: float
    K: Float[Tensor, "3 3"]
    camera_from_model: Rigid


class Objects:
    """Synthetic partial views, each a function of the seed and its index alone: no order, no state.

    Args:
        models: what is shown; sample i shows ``models[i % len(models)]``.
        config: how the samples look.
        cloud: how they are lifted to clouds.

    Raises:
        InputError: no model, or one that does not fit before the camera.
    """

    def __init__(
        self,
        models: Sequence[ObjectModel],
        config: ObjectsConfig | None = None,
        cloud: CloudConfig | None = None,
    ) -> None:
        if not models:
            raise InputError("there is no object to show; give one model at least")
        self.models = tuple(models)
        self.config = ObjectsConfig() if config is None else config
        self.cloud = CloudConfig() if cloud is None else cloud
        for model in self.models:
            _refuse_near(model, self.config)
        self._shapes: dict[int, Shape] = {}
        self._views: dict[tuple[int, int], _Stored] = {}

    def __len__(self) -> int:
        """How many samples there are."""
        return self.config.number

    def __getitem__(self, index: int) -> CloudSample:
        """Make one partial cloud.

        Raises:
            IndexError: there is no such sample.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        return self.sample(index)

    def draw_stored(self, workers: int) -> None:
        """Draw all stored views now, in so many processes.

        Processes that are forked later share them. Without this each process draws a view when a
        sample first needs it, and keeps it for itself.
        """
        bank = _Bank(self)
        views = DataLoader(bank, batch_size=None, num_workers=workers)  # pyright: ignore[reportArgumentType]
        for index, view in enumerate(views):
            # Tensors that a worker process sends hold file descriptors; copies do not.
            self._views[bank.place(index)] = copy.deepcopy(view)

    def sample(self, index: int) -> CloudSample:
        """Make the partial cloud of any index, also beyond the number of samples."""
        view = self.view(index)
        given, model = view.input, self.models[index % len(self.models)]
        points_m = cloud_from_depth(
            given.depth_m, given.mask, given.K, model.diameter_m, self.cloud
        )
        return CloudSample(
            input=CloudInput(name=given.name, points_m=points_m, object=given.object),
            truth=view.truth,
        )

    def view(self, index: int) -> ViewSample:
        """Make the window of depth and the mask that a sample is lifted from."""
        number = index % len(self.models)
        generator = sample_generator(index, self.config.seed)
        clean = self._clean_view(number, generator)
        silhouette = silhouette_of(clean)
        depth_m, visible = clean.depth_m, silhouette
        if self.config.with_background:
            depth_m = self._before_background(clean, self._shape(number), generator)
        if uniform(generator, 0.0, 1.0) < self.config.occluded_share:
            share = uniform(generator, *self.config.occlusion)
            depth_m, visible = occlude(depth_m, silhouette, share, generator)
        most = self.config.mask_error_px
        grow_px = whole(generator, 2 * most + 1) - most
        # Pixels of the full image.
        scale = float(clean.K[0, 0]) / self.config.focal_px[0]
        mask = grow_mask(visible, round(grow_px * scale))
        focal_px = (float(clean.K[0, 0]), self.config.focal_px[0])
        measured_m = measure(depth_m, focal_px, self.config.sensor, generator)
        most = self.config.mask_shift_px
        rows, columns = (whole(generator, 2 * most + 1) - most for _ in range(2))
        mask = shift_mask(mask, round(rows * scale), round(columns * scale))
        return self._as_sample(index, clean, measured_m, mask, visible)

    def _as_sample(
        self,
        index: int,
        clean: CleanView,
        measured_m: Float[Tensor, "h w"],
        mask: Bool[Tensor, "h w"],
        visible: Bool[Tensor, "h w"],
    ) -> ViewSample:
        model, pose = self.models[index % len(self.models)], clean.camera_from_model
        given = ViewInput(
            name=f"{model.name}_{self.config.seed}_{index:06d}",
            depth_m=measured_m,
            mask=mask,
            K=clean.K,
            object=model.name,
        )
        everything = max(int(silhouette_of(clean).sum()), 1)
        truth = PoseTruth(
            camera_from_model=pose.float(),
            visible_fraction=int(visible.sum()) / everything,
        )
        return ViewSample(input=given, truth=truth)

    def _clean_view(self, number: int, generator: torch.Generator) -> CleanView:
        """Draw the object anew, or turn the camera of a stored view."""
        shape, views = self._shape(number), self.config.views
        if views is None:
            R, distance_m, K = self._pose(generator)
            turn = self._gaze(number, distance_m, K, generator)
            middle = turn[:, 2] * distance_m
            return draw_view(shape, pose_of_middle(shape, turn @ R, middle), K)
        stored = self._stored(number, whole(generator, views))
        K = self.intrinsics(float(stored.K[0, 0]) / self.config.focal_px[0])
        turn = self._gaze(number, stored.middle_m, K, generator)
        before = CleanView(
            depth_m=stored.depth_m.float() + stored.middle_m,
            K=stored.K,
            camera_from_model=stored.camera_from_model,
        )
        return turn_view(before, turn, shape, K)

    def _stored(self, number: int, place: int) -> _Stored:
        if (number, place) not in self._views:
            index = place * len(self.models) + number
            R, distance_m, K = self._pose(sample_generator(index, self.config.seed + _BANK_SEED))
            shape = self._shape(number)
            middle = torch.tensor([0.0, 0.0, distance_m], dtype=torch.float64)
            view = draw_view(shape, pose_of_middle(shape, R, middle), K)
            self._views[number, place] = _Stored(
                depth_m=(view.depth_m - distance_m).half(),
                middle_m=distance_m,
                K=view.K,
                camera_from_model=view.camera_from_model,
            )
        return self._views[number, place]

    def _shape(self, number: int) -> Shape:
        if number not in self._shapes:
            self._shapes[number] = make_shape(self.models[number])
        return self._shapes[number]

    def _pose(self, generator: torch.Generator) -> tuple[Tensor, float, Tensor]:
        R = random_rotation(generator)
        distance_m = uniform(generator, *self.config.distance_m)
        return R, distance_m, self.intrinsics(uniform(generator, *self.config.resolution))

    def intrinsics(self, scale: float = 1.0) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix of the sensor's image at so many times its size."""
        (fx, fy), (cx, cy) = self.config.focal_px, self.config.principal_point_px
        rows = [
            [scale * fx, 0, scale * (cx + 0.5) - 0.5],
            [0, scale * fy, scale * (cy + 0.5) - 0.5],
        ]
        return torch.tensor([*rows, [0, 0, 1]], dtype=torch.float64)

    def _gaze(
        self, number: int, distance_m: float, K: Tensor, generator: torch.Generator
    ) -> Float[Tensor, "3 3"]:
        """Look so that the object lies somewhere in the image, whole, and rolled at random."""
        diameter = self.models[number].diameter_m
        scale = float(K[0, 0]) / self.config.focal_px[0]
        radius_px = float(K[0, 0]) * 0.5 * diameter / max(distance_m - 0.5 * diameter, 1e-3)
        place = []
        for size, middle in zip(self.config.image_px, K[:2, 2].tolist(), strict=True):
            low, high = radius_px, scale * size - 1 - radius_px
            place.append(uniform(generator, low, high) if low < high else middle)
        roll_rad = uniform(generator, 0.0, 2 * math.pi)
        pixel = torch.tensor([*place, 1.0], dtype=torch.float64)
        return gaze(pixel_to_ray(K) @ pixel, roll_rad)

    def _before_background(
        self, clean: CleanView, shape: Shape, generator: torch.Generator
    ) -> Float[Tensor, "h w"]:
        """Put a table or wall behind the object, and something else beside it."""
        pose = clean.camera_from_model
        hull_m = shape.hull_m @ pose.R.mT + (pose.t_m + pose.R @ shape.middle_m)
        tilt, side = uniform(generator, 0.0, _TILT_RAD), uniform(generator, 0.0, 2 * math.pi)
        # It stands upright in the picture of its own pixel, so tilt is from the line of sight.
        normal = gaze(hull_m.mean(0), side) @ torch.tensor(
            [math.sin(tilt), 0.0, -math.cos(tilt)], dtype=torch.float64
        )
        gap_m = max(0.0, uniform(generator, -0.2, 0.3))
        offset = float((hull_m @ normal).min()) - gap_m
        a, b, c = (normal @ pixel_to_ray(clean.K)).tolist()
        height, width = clean.depth_m.shape
        slope = a * torch.arange(width)[None] + b * torch.arange(height)[:, None] + c
        behind_m = torch.where(slope * offset > 0, offset / slope, torch.nan)
        near, far = float(hull_m[:, 2].min()), float(hull_m[:, 2].max())
        levels = random_levels(height, width, generator)
        level = float(levels.amin()) + uniform(generator, 0.0, 0.6) * float(
            levels.amax() - levels.amin()
        )
        clutter_m = uniform(generator, near, far + 0.2)
        is_clutter = (levels < level) & ~(behind_m < clutter_m)
        behind_m = torch.where(is_clutter, clutter_m, behind_m)
        return torch.where(clean.depth_m.isfinite(), clean.depth_m, behind_m)


class _Bank:
    """The stored views of all objects by index."""

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def __len__(self) -> int:
        return (self._objects.config.views or 0) * len(self._objects.models)

    def __getitem__(self, index: int) -> _Stored:
        return self._objects._stored(*self.place(index))

    def place(self, index: int) -> tuple[int, int]:
        return index % len(self._objects.models), index // len(self._objects.models)


def _refuse_near(model: ObjectModel, config: ObjectsConfig) -> None:
    nearest = config.distance_m[0]
    if nearest < model.diameter_m:
        raise InputError(
            f"distance_m begins at {nearest:g} m, but object {model.name!r} is "
            f"{model.diameter_m:.3g} m wide: the camera would stand in it. Begin at "
            f"{1.5 * model.diameter_m:.2g} or farther, or correct the unit of the model."
        )
