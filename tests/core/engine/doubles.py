"""What stands for real work and for a cluster in the tests of the engine."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from depthpose.core.engine import (
    Computation,
    InputFormat,
    LocalInput,
    ResultWriter,
    ShardRecord,
    read_records,
    read_shard,
)
from depthpose.core.engine.inputs import Block
from depthpose.core.engine.shards import BlockProcessor
from depthpose.core.errors import InputError
from depthpose.core.files import read_text

TEXTS = InputFormat(roles=("text",), suffixes=(".txt",))


def reverse_work(log: str) -> Computation:
    """Turn the letters of text files round; a file with "bad" in it fails. Each call is logged."""
    start = Reverser(log).start
    return Computation(
        make_writer=start, input_format=TEXTS, endings=("back.txt", "length"), batch=2
    )


@dataclass(frozen=True)
class Reverser:
    log: str

    def start(self) -> ResultWriter:
        self._note("start")
        return self._reverse

    def _reverse(self, samples: Sequence[LocalInput], out: Path) -> list[str]:
        return [self._one(sample, out) for sample in samples]

    def _one(self, sample: LocalInput, out: Path) -> str:
        self._note(sample.name)
        try:
            text = "".join(read_text(path) for path in sample.files)
        except InputError as error:
            return str(error)
        if "bad" in text:
            return f"{sample.files[0]}: is bad"
        target = out / f"{sample.name}.back.txt"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text[::-1])
        (out / f"{sample.name}.length").write_text(str(len(text)))
        return ""

    def _note(self, word: str) -> None:
        with Path(self.log).open("a") as file:
            file.write(f"{word}\n")


class InProcessEngine:
    """A test double of a cluster: one runner in this process; it may die before a block."""

    def __init__(self, dies_at: int | None = None) -> None:
        self.dies_at = dies_at

    def __call__(
        self, blocks: Sequence[Block], computation: Computation, out: str
    ) -> Iterator[ShardRecord]:
        processor = BlockProcessor(computation, out)
        for number, block in enumerate(blocks):
            if number == self.dies_at:
                raise InputError("the double died, as it was asked to")
            yield processor.process(block)


def write_texts(folder: Path, texts: dict[str, str]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def unpacked(out: Path) -> dict[str, dict[str, bytes]]:
    """All results of a folder of shards; a name that is there twice fails."""
    found: dict[str, dict[str, bytes]] = {}
    for done in read_records(str(out)):
        for name, files in read_shard(str(out), done):
            assert name not in found
            found[name] = files
    return found
