"""Weights by what names them: a file, a folder, a name in the package, or one on the hub.

Nothing heavy is imported here, so that a name that leads nowhere is refused at once.
"""

from pathlib import Path

from depthpose.core.errors import InputError, nearest_name
from depthpose.core.hub import WEIGHTS_FILE, fetch_weights, is_on_hub

SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the weights that come with the package."""

_IN_REPOSITORY = ("kitti-nc", "linemod-nc", "bunny-nc", "ycb")
"""Weights that stay out of the wheel."""


def find_weights(name: str | Path) -> Path:
    """Find a weights file: by its path, its folder, its name in the package, or on the hub.

    Args:
        name: a file; weights that came with the package, by name; a folder with one file of
            weights, or with ``model.safetensors``; or ``hf://OWNER/NAME`` (``core.hub``).

    Raises:
        InputError: none of these; the nearest name is said.
    """
    path = Path(name)
    shipped = {file.stem: file for file in SHIPPED.glob("*.safetensors")}
    if path.is_file():
        return path
    if str(name) in shipped:
        return shipped[str(name)]
    if path.is_dir():
        return _only_weights(path)
    if is_on_hub(name):
        return fetch_weights(str(name))
    if str(name) in _IN_REPOSITORY:
        raise InputError(
            f"weights {str(name)!r}: not in the wheel, for their terms or their size. Take "
            f"src/depthpose/weights/{name}.safetensors from the repository and give its path."
        )
    raise InputError(
        f"weights {str(name)!r}: neither a file nor the name of weights that came with depthpose; "
        f"{nearest_name(str(name), shipped)} 'depthpose weights import' brings in published ones, "
        "hf://OWNER/NAME those on the hub."
    )


def _only_weights(folder: Path) -> Path:
    files = sorted(folder.glob("*.safetensors"))
    named = [file for file in files if file.name == WEIGHTS_FILE] or files
    if len(named) == 1:
        return named[0]
    which = ", ".join(file.name for file in files) or "none"
    raise InputError(
        f"{folder}: a folder of weights holds one .safetensors file, or one called {WEIGHTS_FILE}; "
        f"here: {which}. Name the file."
    )
