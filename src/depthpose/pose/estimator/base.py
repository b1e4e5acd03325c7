"""What every estimator of poses offers: one object, several, whole depth images, sequences."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch
from tqdm import tqdm

from depthpose.core.camera import AnyCamera, choose_lens
from depthpose.core.devices import each_in_own_arithmetic, own_arithmetic, refused_memory
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.estimator.candidates import PoseAmbiguities, find_copies, with_status
from depthpose.pose.estimator.find import (
    ROUNDS,
    SearchTargets,
    find_objects,
    nothing_found,
    which_object,
)
from depthpose.pose.estimator.inputs import (
    AnyArray,
    AnyInput,
    AnyMask,
    Refusal,
    cloud_input,
    labels_input,
    rigid_input,
    split_instances,
    view_input,
)
from depthpose.pose.estimator.track import TrackedObject, track
from depthpose.pose.surface import Surface, prepare_surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.voting.point_pairs import PairTable, prepare_pairs

Made = TypeVar("Made")
_NAME = "input"  # what an input is called that came without a name


class PoseEstimator(ABC):
    """Known objects, what is kept of each, and every form of input.

    Args:
        models: the objects.
        config: ICP, limits, device.
        refusal: when an answer is withheld.
    """

    _holder = "the weights"
    """What knows the objects, in errors."""

    def __init__(
        self, models: Sequence[ObjectModel], config: EstimateConfig | None, refusal: RefusalConfig
    ) -> None:
        self.config = EstimateConfig() if config is None else config
        self.models, self.refusal = tuple(models), refusal
        self._numbers = {model.name: k for k, model in enumerate(models)}
        # What is made of a model, by its number, when it is first asked for.
        self._surfaces: dict[int, Surface] = {}
        self._copies: dict[int, PoseAmbiguities] = {}
        self._prepared_pairs: dict[int, PairTable] = {}

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects."""
        return tuple(self._numbers)

    def _objects_in_short(self) -> str:
        count = len(self.objects)
        return ", ".join(self.objects) if count <= 5 else f"{count} objects"

    @torch.no_grad()
    @own_arithmetic()
    def estimate_many(
        self, inputs: Iterable[AnyInput], *, threads: int = 1, with_progress: bool = False
    ) -> list[PoseEstimate]:
        """Estimate many, of any objects: of each a pose, or the reason why there is none.

        What cannot be taken at all, as an unknown object or a mask that does not fit its depth
        image, has the status ``unreadable`` and costs the others nothing.

        Args:
            inputs: clouds and views; a generator's are taken as they are needed.
            threads: so many are worked at at a time.
            with_progress: show a bar on the terminal.

        Raises:
            InputError: fewer than one thread, or inputs that are neither.
        """
        if isinstance(inputs, AnyInput):
            raise InputError("estimate_many takes several inputs; give one as [input]")

        def typed() -> Iterator[AnyInput]:
            for given in inputs:
                if not isinstance(given, AnyInput):
                    raise InputError(
                        "estimate_many takes CloudInput and ViewInput of depthpose.pose.types, not "
                        f"a {type(given).__name__}; files and arrays go to estimate(), one at a "
                        "time"
                    )
                yield given

        total = len(inputs) if isinstance(inputs, Sized) else None
        each = self._each(typed(), threads)
        return list(tqdm(each, total=total, unit=" poses", disable=not with_progress))

    @abstractmethod
    def _each(
        self, inputs: Iterable[AnyInput], threads: int, *, is_likely: bool = True
    ) -> Iterator[PoseEstimate]:
        """Give each input's estimate in order; ``is_likely``: most of them show their object."""

    @torch.no_grad()
    @own_arithmetic()
    def _try_many(self, inputs: Sequence[AnyInput]) -> list[PoseEstimate]:
        """Estimate inputs of which most do not show their object."""
        return [answered(one) for one in self._each(inputs, 1, is_likely=False)]

    @abstractmethod
    def _pose_near(
        self, inputs: Sequence[CloudInput], poses: Sequence[Rigid]
    ) -> list[PoseEstimate]:
        """Estimate clouds by the poses that were proposed for each."""

    @own_arithmetic()
    def estimate(
        self,
        *,
        cloud: AnyArray | None = None,
        unit: Unit | None = None,
        depth: AnyArray | None = None,
        mask: AnyMask | None = None,
        camera: AnyCamera | None = None,
        focal_px: float | None = None,
        object: str | None = None,
    ) -> PoseEstimate:
        """Estimate one pose, from a cloud or from a depth image with a mask.

        Args:
            cloud: points of the object alone, in the camera frame (x right, y down, z forward).
            unit: of the cloud, metres by default; of a depth image, where its camera says none.
            depth: a 16-bit PNG or whole numbers in the camera's ``depth_unit_m``, or metres.
            mask: the object's pixels, not 0; a picture, an array, or COCO's run lengths. One that
                numbers several objects (1, 2, ...) is refused: ``mask == 1`` is one of them.
            camera: of the depth image, its file of any format that is read, a dict of what such a
                file has, or the 3x3 matrix K.
            focal_px: the focal length alone [px], in place of a camera.
            object: which one; None: whichever of those that are known it is, if any.

        Raises:
            InputError: an unknown object, a file that cannot be read, shapes that do not fit. What
                the data themselves lack is no error but a refusal.
        """
        which = self.objects[0] if object is None else self._object(object)
        names = self.objects if object is None else (which,)
        if cloud is not None and depth is None and mask is None:
            return self._which(cloud_input(cloud, unit or "m", which, _NAME), names)
        lens = choose_lens(camera, focal_px)
        if cloud is not None or depth is None or mask is None or lens is None:
            raise InputError("estimate: give cloud=, or depth=, mask= and camera= together")
        return self._which(view_input(depth, mask, lens, which, _NAME, unit), names)

    def _which(self, given: AnyInput, names: Sequence[str]) -> PoseEstimate:
        """Estimate one input as each of several objects, and take the one that it shows."""
        if len(names) == 1:
            return answered(self.estimate_many([given])[0])
        estimates = self._try_many([replace(given, object=name) for name in names])
        return with_status(which_object(estimates, self.refusal), self.config.min_certainty)

    @own_arithmetic()
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
        view = view_input(depth, labels != 0, lens, self._object(object), _NAME, unit)
        pieces = split_instances(labels) or [view.mask]
        views = [replace(view, mask=m, name=f"{_NAME}_{k}") for k, m in enumerate(pieces)]
        return self.estimate_many(views)

    @own_arithmetic()
    def find(
        self,
        depth: AnyArray,
        camera: AnyCamera,
        objects: Sequence[str] | str | None = None,
        unit: Unit | None = None,
    ) -> list[PoseEstimate]:
        """Find and pose known objects in a depth image without masks, the best answer first.

        Point pairs of the whole image vote for poses of each object; where the image agrees with
        one, the object is estimated from the points there. What is refused is left out.

        Args:
            depth: as for :meth:`estimate`.
            camera: of the depth image.
            objects: which may be there, or which one; None: all that are known.
            unit: of the depth, where its camera says none.

        Returns:
            Estimates that have a pose, ok or ambiguous; none where nothing was found.

        Raises:
            InputError: as for :meth:`estimate`.
        """
        asked = [objects] if isinstance(objects, str) else objects
        names = self.objects if asked is None else [self._object(name) for name in asked]
        if not names:
            raise InputError("find: objects names none; give those that may be there, or omit it")
        view = view_input(depth, None, camera, names[0], _NAME, unit)
        return self.find_in(view, names)

    @torch.no_grad()
    @own_arithmetic()
    def find_in(
        self, view: ViewInput, objects: Sequence[str], rounds: int = ROUNDS
    ) -> list[PoseEstimate]:
        """Do as :meth:`find` does for a view; its mask limits where is looked.

        Args:
            view: depth and camera.
            objects: which may be there.
            rounds: so often, at most, for what is there more than once.
        """
        known = SearchTargets(
            names=objects,
            surface_of=lambda name: self._surface(self._number(name)),
            pairs_of=lambda name: self._pairs(self._number(name)),
            pose_near=self._pose_near,
            max_size_error=self.refusal.max_size_error,
            rounds=rounds,
        )
        found = find_objects(view, known)
        return [with_status(estimate, self.config.min_certainty) for estimate in found]

    def track(
        self,
        frames: Iterable[AnyArray],
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
                looked for only where it was, so they need ``first``. They are taken one
                by one, as their estimates are taken.
            camera: of the depth images.
            object: which one; None where one alone is known.
            first: the pose in the first frame, as far as it is known, or its 4x4 matrix in metres;
                None: it is looked for.
            unit: as for :meth:`estimate`.

        Yields:
            An estimate for each frame, whose ``tracking`` is ``tracked``, ``found`` or ``lost``.

        Raises:
            InputError: as for :meth:`estimate`.
        """
        which = self._object(object)
        if isinstance(frames, str | Path):
            raise InputError(
                f"track: frames is {str(frames)!r}, one path; give a list of files or arrays in "
                "their order, such as list_images of depthpose.core.files gives of a folder"
            )
        start = None if first is None else rigid_input(first)

        def given(frame: AnyArray, number: int) -> AnyInput:
            name = f"{_NAME}_{number}"
            if camera is None:
                return cloud_input(frame, unit or "m", which, name)
            return view_input(frame, None, camera, which, name, unit)

        inputs = (given(frame, number) for number, frame in enumerate(frames))
        return self.track_in(inputs, which, start)

    def track_in(
        self, frames: Iterable[AnyInput], object: str, first: Rigid | None = None
    ) -> Iterator[PoseEstimate]:
        """Do as :meth:`track` does for views and clouds; a view's mask limits where is looked."""

        def look(given: AnyInput) -> PoseEstimate:
            if isinstance(given, CloudInput):
                return self._try_many([given])[0]
            began = time.perf_counter()
            found = self.find_in(given, [object], rounds=1)
            return found[0] if found else nothing_found(given, object, time.perf_counter() - began)

        number = self._number(object)
        followed = TrackedObject(
            model=self.models[number],
            surface=self._surface(number),
            refusal=self.refusal,
            icp=self.config.icp,
            look=look,
        )
        return each_in_own_arithmetic(track(frames, followed, first))

    def _object(self, name: str | None) -> str:
        if name is None and len(self._numbers) == 1:
            return self.objects[0]
        if name is None:
            raise InputError(
                f"estimate: {self._holder} know {', '.join(self.objects)}; say which by object="
            )
        self._number(name)
        return name

    def _surface(self, number: int) -> Surface:
        if number not in self._surfaces:
            model = self.models[number]
            self._surfaces[number] = prepare_surface(model, self.config.icp.surface_points)
        return self._surfaces[number]

    def _copies_of(self, number: int) -> PoseAmbiguities:
        if number not in self._copies:
            up_to_symmetry = self.config.up_to_symmetry
            self._copies[number] = find_copies(self.models[number], up_to_symmetry=up_to_symmetry)
        return self._copies[number]

    def _pairs(self, number: int) -> PairTable:
        if number not in self._prepared_pairs:
            self._prepared_pairs[number] = prepare_pairs(self._surface(number))
        return self._prepared_pairs[number]

    def _number(self, name: str) -> int:
        if not isinstance(name, str):
            known = ", ".join(map(repr, self.objects))
            raise InputError(f"object {name!r} is no text; give the name of one: {known}")
        if name not in self._numbers:
            nearest = nearest_name(name, self.objects)
            raise InputError(f"object {name!r}: {self._holder} do not know it; {nearest}")
        return self._numbers[name]


def or_unreadable(work: Callable[[AnyInput], Made], given: AnyInput) -> Made | PoseEstimate:
    """Do work for an input; where it raises :class:`InputError`, the estimate says so."""
    try:
        with refused_memory(given.name):
            return work(given)
    except InputError as error:
        return refused(given, Refusal(status="unreadable", reason=str(error)), {})


def answered(found: PoseEstimate) -> PoseEstimate:
    """Give an estimate, or raise the :class:`InputError` of an input that could not be taken."""
    if found.status == "unreadable":
        raise InputError(found.reason)
    return found


def refused(given: AnyInput, refusal: Refusal, seconds: dict[str, float]) -> PoseEstimate:
    """Give the estimate of an input that cannot be posed."""
    return PoseEstimate(
        name=given.name,
        object=given.object,
        status=refusal.status,
        reason=refusal.reason,
        seconds=seconds,
    )
