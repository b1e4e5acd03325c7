"""What every estimator of poses offers: one object, several, whole depth images, sequences.

The one that needs no training follows it.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
from tqdm import tqdm

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import AnyCamera, choose_lens
from depthpose.core.devices import each_in_own_arithmetic, each_in_threads, own_arithmetic
from depthpose.core.errors import InputError, full_memory, nearest_name
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.cloud import Refusal, local_planes, prepare_cloud, thin
from depthpose.pose.config import CloudConfig, EstimateConfig, RefusalConfig
from depthpose.pose.estimator.candidates import (
    Candidate,
    KnownObject,
    find_candidates,
    nearest_posed,
    surface_signals,
    tilt_of,
    turn_best,
    unexplained,
    with_copies,
)
from depthpose.pose.estimator.find import (
    SearchTargets,
    find_objects,
    nothing_found,
    which_object,
)
from depthpose.pose.estimator.fit import answer_of, refused, with_status
from depthpose.pose.estimator.inputs import (
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
from depthpose.pose.estimator.track import TrackedObject, track
from depthpose.pose.mesh import (
    AnyModel,
    AnySymmetry,
    declare_symmetry,
    read_model,
    refuse_one_name,
    symmetry_of_each,
    with_found_symmetries,
)
from depthpose.pose.refine import refine_best
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.voting.point_pairs import prepare_pairs, propose_poses

Made = TypeVar("Made")
_NAME = "input"  # what an input is called that came without a name
_VOXEL = 0.05  # of the diameter
_LEAST = 500  # points of a model without faces
_PROPOSALS = 40
_SMOOTHED = 1500  # of so many points 20 neighbours lay the plane that gives a normal
_FITS_LESS = 0.25
"""A turn that leaves by so much more of the readings unexplained is none that a search names."""
_TILT_NOISE = 0.01
"""By so much the tilt of one pose differs from one drawing of points to the next: less says nothing
of which of two poses that look alike is the right one."""


class PoseEstimator:
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
        self.objects = tuple(model.name for model in models)
        """Names of the objects."""
        self._objects: dict[str, KnownObject] = {}  # those that were asked for

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
        total = len(inputs) if isinstance(inputs, Sized) else None
        each = self._each(inputs, threads)
        return list(tqdm(each, total=total, unit=" poses", disable=not with_progress))

    def _each(
        self, inputs: Iterable[AnyInput], threads: int, *, is_likely: bool = True
    ) -> Iterator[PoseEstimate]:
        """Give each input's estimate in order; ``is_likely``: most of them show their object."""
        del is_likely
        return each_in_threads(partial(or_unreadable, self._estimate), inputs, threads)

    def _estimate(self, given: AnyInput) -> PoseEstimate:
        """Estimate one input; an estimator of many at once has its own :meth:`_each`."""
        raise NotImplementedError

    @torch.no_grad()
    @own_arithmetic()
    def _answers(self, inputs: Sequence[AnyInput], *, is_likely: bool) -> list[PoseEstimate]:
        """Estimate inputs; raise the :class:`InputError` of one that could not be taken."""
        answers: list[PoseEstimate] = []
        for one in self._each(inputs, 1, is_likely=is_likely):
            if one.status == "unreadable":
                raise InputError(one.reason)
            answers.append(one)
        return answers

    def _pose_near(
        self, inputs: Sequence[CloudInput], poses: Sequence[Rigid]
    ) -> list[PoseEstimate]:
        """Estimate clouds by the poses that were proposed for each."""
        raise NotImplementedError

    @own_arithmetic()
    def estimate(
        self,
        *,
        cloud: AnyCloud | None = None,
        unit: Unit | None = None,
        depth: AnyArray | None = None,
        mask: AnyMask | None = None,
        camera: AnyCamera | None = None,
        focal_px: float | None = None,
        object: str | None = None,
    ) -> PoseEstimate:
        """Estimate one pose, from a cloud or from a depth image with a mask.

        Args:
            cloud: points of the object alone, in the camera frame (x right, y down, z forward); a
                file, rows of points, or a cloud of trimesh or Open3D.
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
        which = self.objects[0] if object is None else self._known(object).model.name
        if cloud is not None and depth is None and mask is None:
            given = cloud_input(cloud, unit or "m", which, _NAME)
        else:
            lens = choose_lens(camera, focal_px)
            if cloud is not None or depth is None or mask is None or lens is None:
                raise InputError("estimate: give cloud=, or depth=, mask= and camera= together")
            given = view_input(depth, mask, lens, which, _NAME, unit)
        if object is not None or len(self.models) == 1:
            return self._answers([given], is_likely=True)[0]
        tried = [replace(given, object=name) for name in self.objects]
        estimates = self._answers(tried, is_likely=False)
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
        which = self._known(object).model.name
        view = view_input(depth, labels != 0, lens, which, _NAME, unit)
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
        one, the object is estimated from the points there. What is refused is left out, and, where
        several objects are asked for, what is likelier not there than there.

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
        names = self.objects if asked is None else [self._known(name).model.name for name in asked]
        if not names:
            raise InputError("find: objects names none; give those that may be there, or omit it")
        view = view_input(depth, None, camera, names[0], _NAME, unit)
        return self.find_in(view, names)

    @torch.no_grad()
    @own_arithmetic()
    def find_in(
        self, view: ViewInput, objects: Sequence[str], *, is_sure: bool = False
    ) -> list[PoseEstimate]:
        """Do as :meth:`find` does for a view; its mask limits where is looked.

        Args:
            view: depth and camera.
            objects: which may be there.
            is_sure: answer only what is likelier there than not, and search once.
        """
        known = SearchTargets(
            names=objects,
            object_of=self._prepared,
            pose_near=self._pose_near,
            max_size_error=self.refusal.max_size_error,
            is_sure=is_sure,
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
            An estimate for each frame, whose ``tracking`` is ``tracked``, ``found`` or ``lost``. A
            frame that cannot be taken, as None or an image of another size than the camera's, has
            the status ``unreadable`` and costs the others nothing.

        Raises:
            InputError: an unknown object, or a ``first`` that is no pose.
        """
        which = self._known(object).model.name
        if isinstance(frames, str | Path):
            raise InputError(
                f"track: frames is {str(frames)!r}, one path; give a list of files or arrays in "
                "their order, such as list_images of depthpose.core.files gives of a folder"
            )
        start = None if first is None else rigid_input(first)
        made = partial(cloud_input, unit=unit or "m", object=which)
        if camera is not None:
            made = partial(view_input, mask=None, camera=camera, object=which, unit=unit)

        def read(number: int, frame: AnyArray) -> AnyInput | PoseEstimate:
            name = f"{_NAME}_{number}"
            try:
                return made(frame, name=name)
            except InputError as error:
                reason = str(error)
            return PoseEstimate(name=name, object=which, status="unreadable", reason=reason)

        return self.track_in((read(*one) for one in enumerate(frames)), which, start)

    def track_in(
        self, frames: Iterable[AnyInput | PoseEstimate], object: str, first: Rigid | None = None
    ) -> Iterator[PoseEstimate]:
        """Do as :meth:`track` does for views and clouds; a view's mask limits where is looked.

        In place of a frame that cannot be read there is an estimate that says so.
        """

        def look(given: AnyInput) -> PoseEstimate:
            if isinstance(given, CloudInput):
                return self._answers([given], is_likely=False)[0]
            began = time.perf_counter()
            found = self.find_in(given, [object], is_sure=True)
            return found[0] if found else nothing_found(given, object, time.perf_counter() - began)

        known = self._known(object)
        followed = TrackedObject(
            model=known.model,
            surface=known.surface,
            refusal=self.refusal,
            icp=self.config.icp,
            look=look,
        )
        return each_in_own_arithmetic(track(frames, followed, first))

    def _known(self, name: str | None) -> KnownObject:
        """Give an object by its name, with its surface; None where one alone is known."""
        names = self.objects
        if name is None:
            if len(names) > 1:
                raise InputError(
                    f"estimate: {self._holder} know {', '.join(names)}; say which by object="
                )
            name = self.models[0].name
        if not isinstance(name, str):
            known = ", ".join(map(repr, names))
            raise InputError(f"object {name!r} is no text; give the name of one: {known}")
        if name not in names:
            nearest = nearest_name(name, names)
            raise InputError(f"object {name!r}: {self._holder} do not know it; {nearest}")
        if name not in self._objects:
            number = names.index(name)
            model = self.models[number]
            surface = prepare_surface(model, self.config.icp.surface_points)
            self._objects[name] = KnownObject(number=number, model=model, surface=surface)
        return self._objects[name]

    def _prepared(self, name: str) -> KnownObject:
        """Give an object by its name, with its point pairs, near-symmetries and turns."""
        known = with_copies(self._known(name), up_to_symmetry=self.config.up_to_symmetry)
        if known.pairs is None:
            known.pairs = prepare_pairs(known.surface)
        return known


def or_unreadable(work: Callable[[AnyInput], Made], given: AnyInput) -> Made | PoseEstimate:
    """Do work for an input; where it raises :class:`InputError`, the estimate says so."""
    if not isinstance(given, AnyInput):
        raise InputError(
            "estimate_many takes CloudInput and ViewInput of depthpose.pose.types, not a "
            f"{type(given).__name__}; files and arrays go to estimate(), one at a time"
        )
    try:
        return work(given)
    except InputError as error:
        reason = str(error)
    except (MemoryError, RuntimeError) as error:
        if (said := full_memory(error)) is None:
            raise
        reason = f"{given.name}: {said}"
    return refused(given, Refusal(status="unreadable", reason=reason), {})


class Registration(PoseEstimator):
    """Poses of objects whose models are seen for the first time.

    Pairs of points of the cloud propose poses, ICP refines them, and the evidence against the best
    decides whether it is the answer, as it does for :class:`~depthpose.GeoPoseNet`.

    Example::

        parts = Registration.load("part.stl", unit="mm")
        found = parts.estimate(cloud="scan.ply", unit="mm")

    Args:
        models: the objects.
        config: ICP, limits; the seed is that of voting.
        refusal: when an answer is withheld; None: by the usual limits.

    Raises:
        InputError: no model, two of one name, or one of few points without faces.
    """

    _holder = "the models"

    def __init__(
        self,
        models: Sequence[ObjectModel],
        config: EstimateConfig | None = None,
        refusal: RefusalConfig | None = None,
    ) -> None:
        super().__init__(models, config, refusal or RefusalConfig())
        if not models:
            raise InputError(
                "registration looks for CAD files and none is given; name one: STL, PLY, OBJ or GLB"
            )
        refuse_one_name(models)
        for model in models:
            points = len(model.vertices_m)
            if len(model.faces) == 0 and points < _LEAST:
                raise InputError(
                    f"{model.name}: {points} points without faces are no surface; export the part "
                    f"as a mesh with triangles, such as STL, or give {_LEAST} points"
                )
        if config is not None and not config.with_icp:
            raise InputError("registration refines by ICP; omit --no-icp (with_icp=False)")
        if config is not None and config.register_refused:
            raise InputError(
                "registration has no network whose refusals it could register; omit "
                "--register-refused (register_refused=True)"
            )

    @classmethod
    @own_arithmetic()
    def load(
        cls,
        *cad: AnyModel,
        unit: Unit | None = None,
        config: EstimateConfig | None = None,
        symmetry: AnySymmetry | Mapping[str, AnySymmetry] | Sequence[str] | None = None,
    ) -> "Registration":
        """Read CAD files; declared or found symmetries of a part make its copies one answer.

        Args:
            cad: PLY, STL, OBJ, GLB, or meshes of trimesh or Open3D; an object is called as its
                file, or as :func:`~depthpose.pose.mesh.read_model` says.
            unit: of the numbers in the files; None where all are GLB, which has metres.
            config: as above.
            symmetry: that a part has, in place of those that are found: ``"z,18"`` looks alike
                after each of 18 equal turns about an axis along z, ``"z,free"`` after any, and
                ``"z,6+x,2"`` has two axes; BOP's entry of an object, or a JSON file of it. The axis
                goes where the surface has it. Of several files a dict from names.

        Raises:
            InputError: no file, two of one name, one that is not read, without a surface or unit; a
                symmetry that is none, or of no object.
        """
        models = [read_model(path, unit, number=k) for k, path in enumerate(cad, start=1)]
        declared = symmetry_of_each(symmetry, [model.name for model in models])
        models = [
            declare_symmetry(m, declared[m.name]) if m.name in declared else m for m in models
        ]
        return cls([with_found_symmetries(m, None, is_taken=True) for m in models], config)

    def __repr__(self) -> str:
        names = self.objects
        objects = ", ".join(names) if len(names) <= 5 else f"{len(names)} objects"
        return f"Registration(of {objects})"

    def prepare(self) -> None:
        """Prepare every model now, about a second each; else it is done when first asked for."""
        for name in self.objects:
            self._prepared(name)

    def _pose_near(
        self, inputs: Sequence[CloudInput], poses: Sequence[Rigid]
    ) -> list[PoseEstimate]:
        """Refine the poses that were proposed, without votes of the clouds alone."""
        both, threads = zip(inputs, poses, strict=True), torch.get_num_threads()
        return list(each_in_threads(lambda one: self._estimate(*one), both, threads))

    def _estimate(self, given: AnyInput, poses: Rigid | None = None) -> PoseEstimate:
        """Estimate a pose, from those that were proposed if there are any."""
        known = self._prepared(given.object)  # once for all inputs, and in the seconds of none
        assert known.pairs is not None
        assert known.copies is not None
        model, surface = known.model, known.surface
        began = time.perf_counter()
        cloud = CloudConfig(voxel_m=min(0.9, _VOXEL * model.diameter_m), max_points=None)
        prepared = prepare_cloud(given, model, cloud, self.config)
        seconds = {"cloud": time.perf_counter() - began}
        if isinstance(prepared, Refusal):
            return refused(given, prepared, seconds)
        began = time.perf_counter()
        proposals, cloud_m = poses, prepared.cloud_m.double()
        if proposals is None:
            generator = torch.Generator().manual_seed(self.config.voting.seed)
            dense_m = take_evenly(cloud_m, _SMOOTHED)
            some_m = dense_m[thin(dense_m, torch.zeros_like(dense_m), _VOXEL * surface.diameter_m)]
            normals, _ = local_planes(dense_m, some_m)
            proposals = propose_poses(some_m, normals, known.pairs, _PROPOSALS, generator)
        voted = time.perf_counter()
        seconds["voting"] = voted - began
        best = refine_best(cloud_m, proposals, surface, replace(self.config.icp, starts=1))
        icp = best.refined
        if float(icp.inlier_share) == 0:
            reason = "no pose lays the model near the points: another object, or too little of it"
            return refused(given, Refusal(status="votes do not meet", reason=reason), seconds)
        first = Candidate(icp.camera_from_model, icp.covariance, float(icp.residual_m))
        others, turned, config = best.others, list[Candidate](), self.config
        if poses is None:
            first, others, turned = turn_best(cloud_m, first, others, known, config.icp)
        else:  # the readings are what a pose explains, and say little between its turns
            copied = first.pose @ known.copies.turns
            left = unexplained(cloud_m, Rigid.cat([first.pose[None], copied]), surface)
            others = Rigid.cat([others, copied[left[1:] < left[0] + _FITS_LESS]])
        candidates = find_candidates(cloud_m, first, others, turned, known, config, is_refined=True)
        found = Rigid.stack([one.pose for one in candidates])
        evidence = surface_signals(cloud_m, found, surface)
        thinned_m = take_evenly(cloud_m, 500)  # as tilt_of takes of a cloud
        for pose, signals in zip([one.pose for one in candidates], evidence, strict=True):
            # The plane through neighbours is tilted where a part has edges and thin features too,
            # whatever the pose: so it is on the cloud moved onto the posed surface.
            _, index = nearest_posed(thinned_m, pose, surface)
            own = tilt_of(pose.apply(surface.points_m[index]), pose[None], surface)
            signals["tilt"] = max(_TILT_NOISE, signals["tilt"] - float(own))
        seconds["icp"] = time.perf_counter() - voted
        return answer_of(prepared, known, candidates, evidence, self.refusal, self.config, seconds)
