"""The folder of models: meshes, and what ``models_info`` says of them."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from depthpose.core.errors import InputError
from depthpose.pose.config import MeshConfig
from depthpose.pose.datasets.layouts import layout_of
from depthpose.pose.datasets.linemod import read_yaml
from depthpose.pose.datasets.parse import entry_number, number, read_mapping
from depthpose.pose.mesh import read_model, symmetries_from_bop
from depthpose.pose.types import ObjectModel

_FOLDERS = ("models", "models_eval", "models_points")


def models_folder(folder: Path) -> Path:
    """Find the folder of models of a data set.

    Raises:
        InputError: there is none.
    """
    found = next((folder / name for name in _FOLDERS if (folder / name).is_dir()), None)
    if found is None:
        raise InputError(f"{folder}: no folder {' or '.join(_FOLDERS)}; put the meshes there")
    return found


def read_models_info(home: Path) -> dict[int, dict[str, Any]]:
    """Read ``models_info.json`` or ``.yml`` by number of object; nothing where there is neither.

    Raises:
        InputError: it is damaged.
    """
    as_json, as_yaml = home / "models_info.json", home / "models_info.yml"
    if as_json.is_file():
        content: dict[Any, Any] = read_mapping(as_json)
    elif as_yaml.is_file():
        content = read_yaml(as_yaml)
    else:
        return {}
    wrong = [k for k, v in content.items() if entry_number(k) is None or not isinstance(v, dict)]
    if wrong:
        raise InputError(
            f"{home}: models_info entry {str(wrong[0])[:80]!r} is no object's; correct it"
        )
    return {int(key): entry for key, entry in content.items()}


def model_path(home: Path, number: int) -> Path | None:
    """Find the mesh of an object, whichever layout names it."""
    named = (home / f"obj_{number:06d}.ply", home / f"obj_{number:02d}.ply")
    return next((path for path in named if path.is_file()), None)


def read_bop_models(
    folder: Path, numbers: Iterable[int], config: MeshConfig | None = None
) -> dict[int, ObjectModel]:
    """Read models with their declared symmetries, diameters and names.

    The diameter is the declared one, where there is one: published numbers are shares of it. The
    two symmetric objects of Linemod_preprocessed, which declares none, get theirs.

    Raises:
        InputError: a mesh is missing, or something is damaged.
    """
    home = models_folder(folder)
    infos, (_, layout) = read_models_info(home), layout_of(folder)
    models: dict[int, ObjectModel] = {}
    for wanted in sorted(set(numbers)):
        path = model_path(home, wanted)
        if path is None:
            raise InputError(f"{home}: no obj_{wanted:06d}.ply for object {wanted}; put it there")
        info, source = infos.get(wanted, {}), f"{home / 'models_info.json'}: object {wanted}"
        symmetries = symmetries_from_bop(info, source=source)
        if symmetries.is_none:
            symmetries = layout.symmetries(wanted)
        model = read_model(
            path,
            "mm",
            name=object_name(wanted, info),
            number=wanted,
            symmetries=symmetries,
            config=config,
        )
        declared_m = 0.001 * number(info, "diameter", 1000 * model.diameter_m, source)
        models[wanted] = replace(model, diameter_m=declared_m)
    return models


def object_names(folder: Path) -> dict[int, str]:
    """Say what samples call each object that ``models_info`` lists.

    Raises:
        InputError: there is no folder of models, or the file is damaged.
    """
    infos = read_models_info(models_folder(folder))
    return {number: object_name(number, info) for number, info in infos.items()}


def object_name(number: int, info: dict[str, Any]) -> str:
    """Say what samples call an object."""
    return str(info.get("name", f"obj_{number:06d}"))
