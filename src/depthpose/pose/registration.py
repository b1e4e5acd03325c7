"""Registration: poses of objects from their models alone, without training.

The steps by which an object is posed are those of :mod:`depthpose.pose.pipeline`.
"""

from collections.abc import Mapping, Sequence

from depthpose.core.devices import force_float32
from depthpose.core.errors import InputError
from depthpose.core.units import Unit
from depthpose.pose.config import EstimateConfig
from depthpose.pose.estimator import PoseEstimator
from depthpose.pose.inputs import AnyInput
from depthpose.pose.mesh import (
    AnyModel,
    AnySymmetry,
    assign_symmetries,
    declare_symmetry,
    read_model,
    refuse_equal_names,
    with_found_symmetries,
)
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.pose.verify.target_object import require_surface


class Registration(PoseEstimator):
    """Poses of objects whose models are seen for the first time.

    Pairs of points of the cloud propose poses, ICP refines them, and the evidence against the best
    decides whether it is the answer, as it does for :class:`~depthpose.GeoPoseNet`.

    Example::

        parts = Registration.load("part.stl", unit="mm")
        estimate = parts.estimate(cloud="scan.ply", unit="mm")

    Args:
        models: the objects.
        config: ICP, limits; the seed is that of voting.

    Raises:
        InputError: no model, two of one name, or one of few points without faces.
    """

    holder = "models"
    expects_all = True

    def __init__(self, models: Sequence[ObjectModel], config: EstimateConfig | None = None) -> None:
        super().__init__(models, config)
        if not models:
            raise InputError(
                "registration looks for CAD files and none is given; name one: STL, PLY, OBJ or GLB"
            )
        refuse_equal_names(models)
        for model in models:
            require_surface(model)
        if config is not None and not config.with_icp:
            raise InputError("registration refines by ICP; omit --no-icp (with_icp=False)")
        if config is not None and config.register_refused:
            raise InputError(
                "registration has no network whose refusals it could register; omit "
                "--register-refused (register_refused=True)"
            )

    @classmethod
    @force_float32()
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
            config: ICP, limits; the seed is that of voting.
            symmetry: that a part has, in place of those that are found: ``"z,18"`` looks alike
                after each of 18 equal turns about an axis along z, ``"z,free"`` after any, and
                ``"z,6+x,2"`` has two axes; BOP's entry of an object, or a JSON file of it. The axis
                goes where the surface has it. For several files: a dict from
                names of objects to their symmetries.

        Raises:
            InputError: no file, two of one name, one that is not read, without a surface or unit; a
                symmetry that is none, or of no object.
        """
        return cls(read_parts(cad, unit, symmetry), config)

    def __repr__(self) -> str:
        names = self.objects
        objects = ", ".join(names) if len(names) <= 5 else f"{len(names)} objects"
        return f"Registration(of {objects})"

    def prepare(self) -> None:
        """Prepare every model now, about a second each; else it is done when first asked for."""
        for name in self.objects:
            self._find_object(name).prepare(is_searched=True)

    def _estimate(
        self,
        pose_input: AnyInput,
        *,
        is_expected: bool = True,  # noqa: ARG002  a model alone is tried as it is expected
    ) -> PoseEstimate:
        """Register one input, or search its region."""
        return self._register_or_search(pose_input)


def read_parts(
    cad: Sequence[AnyModel],
    unit: Unit | None,
    symmetry: AnySymmetry | Mapping[str, AnySymmetry] | Sequence[str] | None = None,
) -> list[ObjectModel]:
    """Read the models of CAD files with their declared or found symmetries.

    Arguments and errors are those of :meth:`Registration.load`.
    """
    models = [read_model(path, unit, number=k) for k, path in enumerate(cad, start=1)]
    declared = assign_symmetries(symmetry, [model.name for model in models])
    for k, model in enumerate(models):
        if model.name in declared:
            models[k] = declare_symmetry(model, declared[model.name])
    return [with_found_symmetries(model) for model in models]
