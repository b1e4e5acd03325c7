"""Blocks of inputs, each of which becomes one shard of results; fixed by the first run."""

import json
from collections.abc import Sequence
from dataclasses import dataclass

from depthpose.core.engine.items import Item
from depthpose.core.errors import InputError
from depthpose.core.files.store import exists, join, publish_bytes, read_from

PLAN = "plan.jsonl"


@dataclass(frozen=True, slots=True)
class Block:
    """Inputs whose results are one shard: listed ones, or those of a tar shard.

    Attributes:
        shard: name of the shard, without a suffix.
        items: the inputs; none where ``tar`` holds them.
        tar: path or URL of a WebDataset shard.
    """

    shard: str
    items: tuple[Item, ...] = ()
    tar: str | None = None

    def to_json(self) -> str:
        """Write it as a line."""
        row = {"shard": self.shard, "items": [[i.name, *i.files] for i in self.items]}
        return json.dumps(row if self.tar is None else {"shard": self.shard, "tar": self.tar})

    @classmethod
    def from_json(cls, line: str) -> "Block":
        """Read what :meth:`to_json` wrote."""
        row = json.loads(line)
        items = tuple(Item(name, tuple(files)) for name, *files in row.get("items", ()))
        return cls(row["shard"], items, row.get("tar"))


def make_plan(out: str, items: Sequence[Item], tars: Sequence[str], size: int) -> list[Block]:
    """Divide inputs into blocks as an earlier run did; what is new gets blocks of its own.

    The plan is a file in ``out``, so that a shard means the same inputs in every run, whatever
    has been added to a folder since.

    Args:
        out: folder of the results.
        items: listed inputs.
        tars: tar shards, a block each.
        size: inputs of a block.

    Raises:
        InputError: an earlier run gave a name to another file, or the place refuses.
    """
    known = _read_plan(join(out, PLAN))
    files = {item.name: item.files for block in known for item in block.items}
    for item in items:
        if files.get(item.name, item.files) != item.files:
            raise InputError(
                f"{out}: {item.name!r} is the result of {files[item.name][0]}, not of "
                f"{item.files[0]}; two files of one name need two folders: choose another"
            )
    new = [item for item in items if item.name not in files]
    there = {block.tar for block in known}
    lots: list[tuple[tuple[Item, ...], str | None]] = [
        (tuple(new[k : k + size]), None) for k in range(0, len(new), size)
    ]
    lots += [((), tar) for tar in tars if tar not in there]
    blocks = known + [
        Block(f"{len(known) + k:06d}", some, tar) for k, (some, tar) in enumerate(lots)
    ]
    if lots:
        lines = "".join(f"{block.to_json()}\n" for block in blocks)
        publish_bytes(lines.encode(), join(out, PLAN))
    return blocks


def _read_plan(url: str) -> list[Block]:
    if not exists(url):
        return []
    try:
        return [Block.from_json(line) for line in read_from(url).decode().splitlines()]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{url}: not a plan of blocks ({error}); choose another folder") from error
