"""The objects of a training, from CAD files or a data set."""

from collections.abc import Callable, Sequence
from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.pose.bop.models import models_folder, read_bop_models, read_models_info
from depthpose.pose.mesh import read_model, with_found_symmetries
from depthpose.pose.objects import make_part
from depthpose.pose.train.config import ModelsConfig
from depthpose.pose.types import ObjectModel


def read_models(
    config: ModelsConfig, tell: Callable[[str], None] | None = None
) -> tuple[ObjectModel, ...]:
    """Read the models that a training names.

    Args:
        config: which.
        tell: told of symmetries that were found and are not declared, taken or not.

    Raises:
        InputError: none is named, or of two kinds, two have one name, or a file is damaged.
    """
    given = [name for name in ("cad", "bop", "parts") if getattr(config, name)]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} are given; take the models from one of them")
    if config.parts:
        return tuple(make_part(p, n, config.mesh) for n, p in enumerate(config.parts, start=1))
    if not config.bop and not config.cad:
        raise InputError("there is no object to learn; name its CAD file (--cad FILE --unit mm)")
    models = _from_bop(Path(config.bop), config) if config.bop else _from_cad(config)
    return tuple(
        with_found_symmetries(
            model,
            tell,
            is_taken=config.with_found_symmetries,
            tolerance=config.symmetry_tolerance,
        )
        for model in models
    )


def _from_cad(config: ModelsConfig) -> tuple[ObjectModel, ...]:
    models = tuple(
        read_model(path, config.unit, number=number, config=config.mesh)
        for number, path in enumerate(config.cad, start=1)
    )
    names = [model.name for model in models]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"two CAD files are called {twice[0]!r}, and an object is known by its name; rename one"
        )
    return models


def _from_bop(folder: Path, config: ModelsConfig) -> tuple[ObjectModel, ...]:
    numbers: Sequence[int] = config.objects or _numbers(models_folder(folder))
    models = read_bop_models(folder, numbers, config.mesh)
    return tuple(models[number] for number in sorted(models))


def _numbers(home: Path) -> list[int]:
    known = read_models_info(home)
    files = [path.stem.removeprefix("obj_") for path in home.glob("obj_*.ply")]
    found = sorted({int(name) for name in files if name.isdigit()} | set(known))
    if not found:
        raise InputError(f"{home}: holds no obj_NNNNNN.ply; put the models there")
    return found
