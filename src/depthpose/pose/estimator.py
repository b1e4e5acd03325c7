"""What every estimator of poses offers: one object, several, whole depth images, sequences."""

from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch
from tqdm import tqdm

from depthpose.core.camera import AnyCamera, choose_lens
from depthpose.core.devices import (
    force_float32,
    iterate_in_float32,
    map_in_threads,
    refused_memory,
)
from depthpose.core.errors import InputError, suggest_name
from depthpose.core.files import AnyPicture
from depthpose.core.rigid import Rigid
from depthpose.core.stopwatch import Stopwatch
from depthpose.core.units import Unit
from depthpose.pose.background import AnyBackground, add_background
from depthpose.pose.color_inputs import add_color
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.datasets.detections import Box, Detection, mask_view
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.inputs import (
    AnyArray,
    AnyCloud,
    AnyInput,
    AnyMask,
    cloud_input,
    labels_input,
    rigid_input,
    split_instances,
    view_input,
)
from depthpose.pose.pipeline import register
from depthpose.pose.refusals import estimate_or_refusal, unreadable_on_error
from depthpose.pose.search import Instances, SearchTargets, find_objects
from depthpose.pose.track import track
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.verify.decide import choose_object, seconds_of_all
from depthpose.pose.verify.target_object import TargetObject

NEEDS_MASK = "a regressed depth image takes a depth image with a mask; give both, or other weights"
_NAME = "input"  # what an input is called that came without a name


class PoseEstimator:
    """Known objects, what is kept of each, and every form of input.

    Args:
        models: the objects.
        config: ICP, limits, device.
        refusal: the limits of the weights, which hold where ``config`` has none.
    """

    holder: ClassVar = "weights"
    """What knows the objects, in messages."""
    needs_mask: ClassVar = False
    """Whether it takes nothing but a depth image with a mask: no cloud, and no search."""
    expects_all: ClassVar = False
    """Whether every object is expected in every image, as that of a CAD file is."""

    def __init__(
        self,
        models: Sequence[ObjectModel],
        config: EstimateConfig | None,
        refusal: RefusalConfig | None = None,
    ) -> None:
        self.config = EstimateConfig() if config is None else config
        if self.config.refusal is None:
            self.config = replace(self.config, refusal=refusal)
        self.models = tuple(models)
        self.objects = tuple(model.name for model in models)
        """Names of the objects."""
        self._targets_by_name = {
            model.name: TargetObject(
                number=number,
                model=model,
                surface_points=self.config.icp.surface_points,
                deviation_m=self.config.object_deviation_m,
            )
            for number, model in enumerate(models)
        }

    @torch.no_grad()
    @force_float32()
    def estimate_many(
        self, inputs: Iterable[AnyInput], *, threads: int = 1, with_progress: bool = False
    ) -> list[PoseEstimate]:
        """Estimate many, of any objects: of each a pose, or the reason why there is none.

        What cannot be taken at all, as an unknown object or a mask that does not fit its depth
        image, has the status ``unreadable`` and costs the others nothing.

        Args:
            inputs: clouds and views; a generator's are taken as they are needed.
            threads: how many inputs are estimated at the same time.
            with_progress: show a bar on the terminal.

        Raises:
            InputError: fewer than one thread, or inputs that are neither.
        """
        if isinstance(inputs, AnyInput):
            raise InputError("estimate_many takes several inputs; give one as [input]")
        total = len(inputs) if isinstance(inputs, Sized) else None
        estimates = self._estimate_each(map(_require_input, inputs), threads)
        return list(tqdm(estimates, total=total, unit=" poses", disable=not with_progress))

    def _estimate_each(self, inputs: Iterable[AnyInput], threads: int) -> Iterator[PoseEstimate]:
        """Estimate each input, in order; one that cannot be taken at all is ``unreadable``.

        Args:
            inputs: clouds and views.
            threads: how many inputs are estimated at the same time.
        """

        def estimate(pose_input: AnyInput) -> PoseEstimate:
            """Estimate one of them."""
            return unreadable_on_error(pose_input, partial(self._estimate, pose_input))

        return map_in_threads(estimate, inputs, threads)

    def _estimate(self, pose_input: AnyInput, *, is_expected: bool = True) -> PoseEstimate:
        """Estimate one input.

        Args:
            pose_input: a cloud or a view.
            is_expected: whether the input is meant to show its object. Else it is a try of an
                object that may well not be there, and the evidence decides whether it is.

        Raises:
            InputError: it cannot be taken at all.
        """
        raise NotImplementedError

    def _register_or_search(self, pose_input: AnyInput) -> PoseEstimate:
        """Register one object to the points of its mask, or search it in the mask as in a box.

        It is searched if the mask is a region, or if the registration is doubtful.
        """
        if isinstance(pose_input, ViewInput) and pose_input.is_region:
            return self._search_region(pose_input)
        target = self._find_object(pose_input.object).prepare()
        watch = Stopwatch()
        work = partial(register, pose_input, target, self.config, watch)
        estimate = estimate_or_refusal(pose_input, watch, work)
        if estimate.status != "doubtful" or not isinstance(pose_input, ViewInput):
            return estimate

        # A mask whose pose is doubtful may not fit its object.
        in_region = self._search_region(replace(pose_input, is_region=True))
        seconds = seconds_of_all([estimate, in_region])
        return replace(in_region if in_region.is_posed else estimate, seconds=seconds)

    def _search_region(self, view: ViewInput, *, is_expected: bool = True) -> PoseEstimate:
        """Search the object of a view in its mask, as in a box.

        ``is_expected``: whether it is there, as :meth:`_estimate` takes it.
        """
        targets = self._targets([view.object], "one" if is_expected else "one at most")
        best = find_objects(view, targets)[0]
        return replace(best, name=view.name)

    def _targets(self, names: Sequence[str], instances: Instances = "any number") -> SearchTargets:
        """Prepare objects for a search, of which there are so many ``instances``.

        Raises:
            InputError: an unknown object, or this estimator cannot search.
        """
        if self.needs_mask:
            raise InputError(NEEDS_MASK)
        return SearchTargets(
            objects={name: self._find_object(name).prepare(is_searched=True) for name in names},
            config=self.config,
            instances=instances,
        )

    @torch.no_grad()
    @force_float32()
    def estimate(  # noqa: PLR0913  every form of input
        self,
        *,
        cloud: AnyCloud | None = None,
        unit: Unit | None = None,
        depth: AnyArray | None = None,
        mask: AnyMask | None = None,
        camera: AnyCamera | None = None,
        focal_px: float | None = None,
        object: str | None = None,
        box: Box | None = None,
        color: AnyPicture | None = None,
        color_camera: AnyCamera | None = None,
        color_from_depth: Rigid | AnyArray | None = None,
        background: AnyBackground | None = None,
    ) -> PoseEstimate:
        """Estimate one pose, from a cloud or from a depth image with a mask or a box.

        Args:
            cloud: points of the object alone, in the camera frame (x right, y down, z forward); a
                file, rows of points, or a cloud of trimesh or Open3D.
            unit: of the cloud, metres by default; or of a depth image whose camera says none.
            depth: a 16-bit PNG or whole numbers in the camera's ``depth_unit_m``; or floats, which
                are metres unless ``unit`` is given.
            mask: the object's pixels, not 0; a picture, an array, or COCO's run lengths. One that
                numbers several objects (1, 2, ...) is refused: ``mask == 1`` is one of them.
            camera: of the depth image, its file of any format that is read, a dict of what such a
                file has, or the 3x3 matrix K.
            focal_px: the focal length alone [px], in place of a camera.
            object: which one; None: whichever of those that are known it is, if any.
            box: in place of a mask, the left, top, right and bottom edge of a detector's box [px]:
                the object is searched for in it.
            color: colour image of the same moment, which tells apart copies of a coloured model
                that depth does not: RGB, of the depth camera's frame unless it has its own camera.
            color_camera: of the colour image; None: that of the depth image.
            color_from_depth: the depth camera in the colour camera's frame; None: at one place.
            background: what the camera sees without the objects, none of which is taken for one: an
                empty frame, as ``depth``, or a :class:`~depthpose.pose.background.PosedBin`.

        Raises:
            InputError: an unknown object, a file that cannot be read, shapes that do not fit. What
                the data themselves lack is no error but a refusal.
        """
        # A cloud, or a depth image with what belongs to it.
        which = self.objects[0] if object is None else self._find_object(object).model.name
        of_view = {
            "depth": depth, "mask": mask, "box": box, "camera": camera, "focal_px": focal_px,
            "color": color, "color_camera": color_camera, "color_from_depth": color_from_depth,
            "background": background,
        }  # fmt: skip
        unused = [f"{name}=" for name, value in of_view.items() if value is not None]
        if cloud is not None and unused:
            raise InputError(
                f"estimate: {', '.join(unused)} belong to a depth image, not to cloud=; omit them, "
                "or omit cloud= and give depth=, camera= and one of mask= and box= together"
            )
        if cloud is not None:
            pose_input = cloud_input(cloud, unit or "m", which, _NAME)
        else:
            # A view by its mask or its box, with background and colours.
            lens = choose_lens(camera, focal_px)
            if depth is None or lens is None or (mask is None) == (box is None):
                raise InputError(
                    "estimate: give cloud=, or depth=, camera= and one of mask= and box= together"
                )
            pose_input = view_input(depth, mask, lens, which, _NAME, unit)
            if box is not None:
                pose_input = mask_view(pose_input, Detection(box=box))
            pose_input = add_background(pose_input, background, lens, unit)
            models = self.models if object is None else [self._find_object(object).model]
            pose_input = add_color(pose_input, models, color, color_camera, color_from_depth)

        # Of one object, or of whichever fits best.
        with refused_memory(_NAME):
            if object is not None or len(self.models) == 1:
                return self._estimate(pose_input)
            tried = [replace(pose_input, object=name) for name in self.objects]
            estimates = [self._estimate(attempt, is_expected=False) for attempt in tried]
        return choose_object(estimates, self.config.min_certainty)

    @force_float32()
    def estimate_instances(
        self,
        *,
        depth: AnyArray,
        mask: AnyMask,
        camera: AnyCamera | None = None,
        focal_px: float | None = None,
        object: str | None = None,
        unit: Unit | None = None,
    ) -> list[PoseEstimate]:
        """Estimate every instance of one object in one mask, the largest first.

        A mask that numbers its objects (1, 2, ...) shows one instance a number. Any other is split
        into connected pieces; instances that touch in the image stay one piece.

        Args:
            depth: as for :meth:`estimate`.
            mask: of all instances.
            camera: of the depth image, as for :meth:`estimate`.
            focal_px: the focal length alone [px], in place of a camera.
            object: which one; None where one alone is known.
            unit: of the depth, where its camera says none.

        Raises:
            InputError: as for :meth:`estimate`.
        """
        lens = choose_lens(camera, focal_px)
        if lens is None:
            raise InputError("estimate_instances: give camera= or focal_px=")
        labels = labels_input(mask, _NAME)
        which = self._find_object(object).model.name
        view = view_input(depth, labels != 0, lens, which, _NAME, unit)
        pieces = split_instances(labels) or [view.mask]
        views = [replace(view, mask=m, name=f"{_NAME}_{k}") for k, m in enumerate(pieces)]
        return self.estimate_many(views)

    @torch.no_grad()
    @force_float32()
    def find(
        self,
        depth: AnyArray | ViewInput,
        camera: AnyCamera | None = None,
        objects: Sequence[str] | str | None = None,
        unit: Unit | None = None,
        background: AnyBackground | None = None,
    ) -> list[PoseEstimate]:
        """Find and pose known objects in a depth image without masks.

        Point pairs of the whole image vote for poses of each object; where the image agrees with
        one, the object is estimated from the points there.

        Args:
            depth: as for :meth:`estimate`; or a view with all of this but the objects, of which
                only the mask is searched.
            camera: of the depth image.
            objects: which may be there, or which one; None: all that are known.
            unit: of the depth, where its camera says none.
            background: as for :meth:`estimate`.

        Returns:
            An estimate for each instance that was found, the best first. Then, for each object that
            was not found, a refusal (``is_posed`` is False) that says what the nearest miss was.

        Raises:
            InputError: as for :meth:`estimate`; or ``objects`` names none.
        """
        asked = [objects] if isinstance(objects, str) else objects
        names = list(self.objects)
        if asked is not None:
            names = [self._find_object(name).model.name for name in asked]
        if not names:
            raise InputError("find: objects names none; give those that may be there, or omit it")
        if isinstance(depth, ViewInput):
            view = depth
            of_image = {"camera": camera, "unit": unit, "background": background}
            unused = [f"{name}=" for name, value in of_image.items() if value is not None]
            if unused:
                raise InputError(
                    f"find: {', '.join(unused)} belong to a depth image, and a view has its own; "
                    "omit them"
                )
        else:
            # A view names one object, which a search does not read.
            view = view_input(depth, None, camera, names[0], _NAME, unit)
            view = add_background(view, background, camera, unit)
        return find_objects(view, self._targets(names))

    def track(
        self,
        frames: Iterable[AnyArray | AnyInput | PoseEstimate | None],
        camera: AnyCamera | None = None,
        object: str | None = None,
        first: Rigid | AnyArray | None = None,
        unit: Unit | None = None,
    ) -> Iterator[PoseEstimate]:
        """Follow one object through a sequence, each frame from the pose of the one before by ICP.

        Where the camera saw through the posed surface, or little of it, or what is seen fixes no
        pose, the object is looked for anew in the frame; where it is not found either it is lost,
        and looked for in the next.

        Args:
            frames: depth images as for :meth:`estimate`, in their order; without a camera clouds in
                the camera frame, of the object alone, or of what is about it too: in these it is
                looked for only where it was, so they need ``first``. They are taken one by one, as
                their estimates are taken. Views and clouds that are read already are taken too; in
                a view only its mask is searched.
            camera: of the depth images.
            object: which one, in place of the objects that views and clouds name; None where one
                alone is known.
            first: the pose in the first frame, as far as it is known, or its 4x4 matrix in metres;
                None: it is looked for.
            unit: as for :meth:`estimate`.

        Yields:
            An estimate for each frame, whose ``tracking`` is ``tracked``, ``found`` or ``lost``. A
            frame that cannot be taken, as None or an image of another size than the camera's, has
            the status ``unreadable`` and costs the others nothing. An estimate in place of a frame,
            which says why it cannot be read, stays as it is.

        Raises:
            InputError: an unknown object, a ``first`` that is no pose, or an estimator that cannot
                search without one.
        """
        target = self._find_object(object)
        which = target.model.name
        if isinstance(frames, str | Path):
            raise InputError(
                f"track: frames is {str(frames)!r}, one path; give a list of files or arrays in "
                "their order, such as list_images of depthpose.core.files gives of a folder"
            )
        start = None if first is None else rigid_input(first)
        if self.needs_mask and start is None:
            raise InputError(NEEDS_MASK)
        convert = partial(cloud_input, unit=unit or "m", object=which)
        if camera is not None:
            convert = partial(view_input, mask=None, camera=camera, object=which, unit=unit)

        def read(
            number: int, frame: AnyArray | AnyInput | PoseEstimate | None
        ) -> AnyInput | PoseEstimate:
            """Read a frame; one that cannot be read is an estimate that says so."""
            if isinstance(frame, PoseEstimate):
                return frame
            if isinstance(frame, AnyInput):
                return replace(frame, object=which)
            name = f"{_NAME}_{number}"
            reason = f"{name}: there is no frame, a None in its place"
            if frame is not None:
                try:
                    return convert(frame, name=name)
                except InputError as error:
                    reason = str(error)
            return PoseEstimate(name=name, object=which, status="unreadable", reason=reason)

        @torch.no_grad()
        def search(pose_input: AnyInput) -> PoseEstimate:
            """Pose the object in a frame without a pose of the frame before."""
            if self.needs_mask:
                return PoseEstimate(
                    name=pose_input.name, object=which, status="no pose found", reason=NEEDS_MASK
                )
            if isinstance(pose_input, CloudInput):
                return self._estimate(pose_input, is_expected=False)
            return find_objects(pose_input, self._targets([which], "one at most"))[0]

        inputs = (read(number, frame) for number, frame in enumerate(frames))
        estimates = track(inputs, target.prepare(), self.config, search, start)
        return iterate_in_float32(estimates)

    def surface_of(self, object: str) -> Surface:
        """Return the sampled surface of an object, by which its poses are refined and compared.

        Raises:
            InputError: no object has this name.
        """
        return self._find_object(object).surface

    def _find_object(self, name: str | None) -> TargetObject:
        """Find an object by its name; None where one alone is known.

        Raises:
            InputError: no object has this name, or several are known and none is named.
        """
        names = self.objects
        if name is None:
            if len(names) > 1:
                raise InputError(
                    f"estimate: the {self.holder} know {', '.join(names)}; say which by object="
                )
            name = self.models[0].name
        if not isinstance(name, str):
            listing = ", ".join(map(repr, names))
            raise InputError(f"object {name!r} is no text; give the name of one: {listing}")
        if name not in self._targets_by_name:
            nearest = suggest_name(name, names)
            raise InputError(f"object {name!r}: the {self.holder} do not know it; {nearest}")
        return self._targets_by_name[name]


def _require_input(pose_input: AnyInput) -> AnyInput:
    """Return an input; raise an :class:`InputError` where it is something else."""
    if not isinstance(pose_input, AnyInput):
        raise InputError(
            "estimate_many takes CloudInput and ViewInput of depthpose.pose.types, not a "
            f"{type(pose_input).__name__}; files and arrays go to estimate(), one at a time"
        )
    return pose_input
