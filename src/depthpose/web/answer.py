"""What the page shows of one estimate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from depthpose.core.draw import Scale
from depthpose.core.scene import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """A picture among the files.

    Attributes:
        file: its name.
        caption: says what it shows, with its scale.
        values: file with a number for each pixel, which the page reads out under the pointer.
        unit: of these numbers.
        scale: what its colours mean.
    """

    file: str
    caption: str
    values: str | None = None
    unit: str = ""
    scale: Scale | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """An estimate, or a refusal.

    Attributes:
        is_ok: whether there is what was asked for.
        said: one sentence: the result, or why there is none.
        facts: name and value, in order.
        tables: by title, rows of equal length.
        pictures: some of the files.
        scene: the 3D view.
        terms: of the weights that were used, where they bind whoever uses them.
        files: to be taken away, by name.
    """

    is_ok: bool
    said: str
    facts: Sequence[tuple[str, str]]
    scene: Scene
    terms: str = ""
    tables: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)
    pictures: Sequence[Shown] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)


def read_files(folder: Path) -> dict[str, bytes]:
    """Take the files of a folder into memory, so that the folder can go."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
