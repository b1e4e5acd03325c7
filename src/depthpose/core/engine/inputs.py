"""The inputs of a sharded job, and their division into blocks.

Inputs are listed from folders, patterns and manifests, or lie in tar shards in WebDataset's layout.
The first run decides the blocks; later ones only add to them.
"""

import csv
import io
import json
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path, PurePosixPath

from depthpose.core.errors import InputError
from depthpose.core.files import stores
from depthpose.core.files.disk import find_partners, open_file_system, refuse_equal_names

PLAN = "plan.jsonl"
"""The blocks of a job, one a line."""
_TAR_SUFFIXES = (".tar", ".tar.gz", ".tgz")


@dataclass(frozen=True, slots=True)
class InputFormat:
    """The files that each input consists of: their roles and suffixes.

    A manifest has a column for each role. In a tar shard the file of a role is
    ``KEY.ROLE.SUFFIX``, or ``KEY.SUFFIX`` where there is only one role.
    """

    roles: tuple[str, ...]  #: a word for each file of an input, such as ``("left", "right")``
    suffixes: tuple[str, ...]  #: suffixes of the files, in lower case, with the dot


@dataclass(frozen=True, slots=True)
class ListedInput:
    """An input that is listed by its files, in place of one that lies in a tar shard."""

    name: str  #: name of its results: unique in a job, relative, without a suffix
    files: tuple[str, ...]  #: paths or URLs, in the order of the roles


def list_inputs(words: Sequence[str], input_format: InputFormat) -> list[ListedInput]:
    """List the inputs that files, folders, patterns or manifests name; tar shards are not read.

    Args:
        words: one file, folder or pattern for each role, whose files are paired by their names or
            the numbers in them; or, of a single role, any number of them; or manifests (``.csv``).
        input_format: the files that each input consists of.

    Raises:
        InputError: nothing is found, roles cannot be paired, or two inputs have one name.
    """
    roles = input_format.roles
    manifests = [word for word in words if word.lower().endswith(".csv")]
    paths = [word for word in words if word not in manifests]
    if paths and len(paths) != len(roles) > 1:
        raise InputError(
            f"{', '.join(paths)}: an input has {' and '.join(roles)}; give a path for each of "
            "them, or one manifest"
        )

    inputs: list[ListedInput] = []
    for manifest in manifests:
        inputs += _read_manifest(manifest, roles)
    if len(roles) == 1:
        for path in paths:
            urls = stores.list_files(path, input_format.suffixes)
            inputs += [ListedInput(PurePosixPath(url).stem, (url,)) for url in urls]
    elif paths:
        inputs += _pair_roles(paths, input_format.suffixes)

    files_by_name = [(listed.name, listed.files[0]) for listed in inputs]
    refuse_equal_names(files_by_name, "give a manifest with a column 'name'")
    return inputs


def _pair_roles(paths: Sequence[str], suffixes: Sequence[str]) -> Iterator[ListedInput]:
    """Yield the inputs whose files of each role are behind one path, paired by their names.

    Two paths that name a single file each are a pair, whatever these are called.
    """
    first_urls, *other_urls = (stores.list_files(path, suffixes) for path in paths)
    first_stems = [PurePosixPath(url).stem for url in first_urls]
    urls_of_role = [first_urls]
    for path, urls in zip(paths[1:], other_urls, strict=True):
        stems = [PurePosixPath(url).stem for url in urls]
        # A path of a single file is listed as that file alone.
        first_is_file = first_stems == [PurePosixPath(paths[0]).stem]
        is_file = stems == [PurePosixPath(path).stem]
        if first_is_file and is_file:
            partners = [0]
        else:
            partners = find_partners(first_stems, stems, f"{paths[0]} and {path}")
        urls_of_role.append([urls[partner] for partner in partners])
    for urls_of_input in zip(*urls_of_role, strict=True):
        yield ListedInput(PurePosixPath(urls_of_input[0]).stem, urls_of_input)


def _read_manifest(url: str, roles: Sequence[str]) -> Iterator[ListedInput]:
    """Yield the inputs of a CSV table, a row each.

    It has a column for each role, with URLs or paths; relative paths begin in the table's folder. A
    column ``name`` may name the results; else the name is the stem of the first file.
    """
    try:
        text = io.StringIO(stores.read_from(url).decode("utf-8-sig"), newline="")
        rows = list(csv.DictReader(text, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{url}: not a CSV table in UTF-8 ({error}); save it so") from error
    folder = url.rpartition("/")[0] or "."
    for number, row in enumerate(rows, 1):
        missing = [role for role in roles if not row.get(role)]
        if missing:
            raise InputError(
                f"{url}: row {number} has no {missing[0]!r}; the columns are "
                f"{', '.join(roles)} (paths or URLs) and, if you like, name"
            )
        files: list[str] = []
        for role in roles:
            path = row[role]
            is_absolute = "://" in path or path.startswith("/")
            files.append(path if is_absolute else stores.absolute(stores.join(folder, path)))
        name = str(row.get("name") or PurePosixPath(files[0]).stem)
        _refuse_unsafe_name(name, f"{url}: row {number}")
        yield ListedInput(name, tuple(files))


def _refuse_unsafe_name(name: str, source: str) -> None:
    """Refuse a name of results that is empty or would lead out of their folder."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name or "\\" in name:
        raise InputError(
            f"{source}: the name {name!r} is no name of a result; write letters, digits and '/'"
        )


@dataclass(frozen=True, slots=True)
class Block:
    """Inputs whose results go into one shard: listed inputs, or those of a tar shard."""

    shard: str  #: name of the shard of results, without its suffix
    listed: tuple[ListedInput, ...] = ()  #: empty where there is a ``tar``
    tar: str | None = None  #: path or URL of a WebDataset shard that holds the inputs

    def to_json(self) -> str:
        """Encode the block as one line of JSON."""
        if self.tar is not None:
            return json.dumps({"shard": self.shard, "tar": self.tar})
        items = [[listed.name, *listed.files] for listed in self.listed]
        return json.dumps({"shard": self.shard, "items": items})

    @classmethod
    def from_json(cls, line: str) -> "Block":
        """Decode a line of :meth:`to_json`."""
        row = json.loads(line)
        items = row.get("items", ())
        listed = tuple(ListedInput(name, tuple(files)) for name, *files in items)
        return cls(row["shard"], listed, row.get("tar"))


def plan_blocks(
    out: str, inputs: Sequence[ListedInput], tars: Sequence[str], block_size: int
) -> list[Block]:
    """Divide inputs into blocks as an earlier run did; new inputs get new blocks.

    The plan is a file in ``out``, so that a shard means the same inputs in every run, whatever
    has been added to a folder since.

    Args:
        out: folder of the results, by path or URL.
        inputs: listed inputs.
        tars: tar shards of inputs; each becomes one block.
        block_size: number of listed inputs of a block.

    Returns:
        All blocks: those of the plan, in its order, then the new ones.

    Raises:
        InputError: an input has the name of an earlier one, but other files.
    """
    blocks: list[Block] = []
    plan = stores.join(out, PLAN)
    lines = stores.read_from(plan).splitlines() if stores.exists(plan) else []
    # Of a damaged plan the blocks before the damage are taken.
    with suppress(ValueError, KeyError, TypeError, AttributeError):
        for line in lines:
            blocks.append(Block.from_json(line.decode()))  # noqa: PERF401

    planned_count = len(blocks)
    planned_tars = {block.tar for block in blocks}
    planned_files = {listed.name: listed.files for block in blocks for listed in block.listed}
    for listed in inputs:
        files = planned_files.get(listed.name, listed.files)
        if files != listed.files:
            raise InputError(
                f"{out}: {listed.name!r} is the result of {files[0]}, not of "
                f"{listed.files[0]}; two files of one name need two folders: choose another"
            )

    new_inputs = [listed for listed in inputs if listed.name not in planned_files]
    for start in range(0, len(new_inputs), block_size):
        block_inputs = tuple(new_inputs[start : start + block_size])
        blocks.append(Block(f"{len(blocks):06d}", block_inputs))
    for tar in tars:
        if tar not in planned_tars:
            blocks.append(Block(f"{len(blocks):06d}", tar=tar))
    if len(blocks) > planned_count:
        stores.publish("".join(f"{block.to_json()}\n" for block in blocks).encode(), plan)
    return blocks


def read_tar(url: str) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each file of a tar, plain or compressed, in the tar's order.

    Raises:
        InputError: it is damaged, holds a link or a device, or two files of one name.
    """
    names: set[str] = set()
    try:
        with open_file_system(url, "read") as (fs, inner):
            file = fs.open(inner, "rb")
        with file, tarfile.open(fileobj=file, mode="r|*") as tar:
            for member in tar:
                if not (member.isfile() or member.isdir()):
                    raise InputError(
                        f"{url}: {member.name!r} is a link or device, and no file; pack the files "
                        "themselves (tar --dereference --hard-dereference)"
                    )
                if member.isfile() and member.name in names:
                    raise InputError(
                        f"{url}: holds {member.name!r} twice; keep one of the two, and pack it anew"
                    )
                names.add(member.name)
                content = tar.extractfile(member) if member.isfile() else None
                if content is not None:
                    yield member.name, content.read()
    except (tarfile.TarError, EOFError, OSError) as error:
        raise InputError(f"{url}: not an intact tar file ({error}); make it anew") from error


@dataclass(frozen=True, slots=True)
class LocalInput:
    """An input whose files are on this machine, or the reason why they are not."""

    name: str  #: name of its results
    files: tuple[Path, ...] = ()  #: local paths, in the order of the roles
    failure: str = ""  #: why it has no files; "" where it has


@dataclass(frozen=True, kw_only=True)
class JobInputs:
    """All inputs of a job: listed ones, and tar shards that hold others."""

    listed: Sequence[ListedInput]  #: listed inputs
    tars: Sequence[str] = ()  #: paths or URLs of tar shards of inputs
    input_format: InputFormat  #: the files that each input consists of

    @classmethod
    def find(cls, words: Sequence[str], input_format: InputFormat) -> "JobInputs":
        """Find the inputs that words name: tar shards, and what :func:`list_inputs` takes.

        Raises:
            InputError: nothing is found, or as in :func:`list_inputs`.
        """
        tar_words = [word for word in words if word.lower().endswith(_TAR_SUFFIXES)]
        other_words = [word for word in words if word not in tar_words]
        listed = list_inputs(other_words, input_format) if other_words else []
        tars: dict[str, None] = {}  # each once, in their order
        for word in tar_words:
            # .gz: only the last suffix of .tar.gz is compared.
            for url in stores.list_files(word, (".tar", ".tgz", ".gz")):
                if url.lower().endswith(_TAR_SUFFIXES):
                    tars[url] = None
        if not listed and not tars:
            raise InputError(f"{', '.join(words)}: name no input; a manifest needs a line for each")
        return cls(listed=listed, tars=list(tars), input_format=input_format)

    @contextmanager
    def open_first(self) -> Iterator[Sequence[Path]]:
        """Yield local paths of the files of the first input, for checks before the job.

        They are there while the ``with`` block runs.

        Raises:
            InputError: it cannot be read.
        """
        # Only read, so its shard of results needs no name.
        block = Block("", (self.listed[0],)) if self.listed else Block("", tar=self.tars[0])
        with tempfile.TemporaryDirectory(prefix="depthpose-") as scratch:
            first = next(fetch_inputs(block, self.input_format, Path(scratch)))
            if first.failure:
                raise InputError(first.failure)
            yield first.files


def fetch_inputs(block: Block, input_format: InputFormat, scratch: Path) -> Iterator[LocalInput]:
    """Yield the inputs of a block, with their files copied to ``scratch`` if they are not local.

    An input that cannot be read, and a tar that is damaged or empty, is yielded with its failure.
    """
    for listed in block.listed:
        try:
            copies = tuple(stores.local_copy(url, scratch) for url in listed.files)
            local = LocalInput(listed.name, copies)
        except InputError as error:
            local = LocalInput(listed.name, failure=str(error))
        yield local
    if block.tar is None:
        return

    is_empty = True
    try:
        for local in _unpack_inputs(block.tar, input_format, scratch):
            is_empty = False
            yield local
    except InputError as error:
        yield LocalInput(PurePosixPath(block.tar).name, failure=str(error))
    else:
        if is_empty:
            failure = f"{block.tar}: holds no file; pack inputs into it, or leave it out"
            yield LocalInput(PurePosixPath(block.tar).name, failure=failure)


def _unpack_inputs(tar: str, input_format: InputFormat, scratch: Path) -> Iterator[LocalInput]:
    """Unpack the inputs of a tar shard to ``scratch``: adjacent files with one key are an input.

    The key is the path up to the first point of the file's name.
    """
    roles = input_format.roles
    members = ((PurePosixPath(name), data) for name, data in read_tar(tar))
    for key_path, members_of_key in groupby(
        members, lambda member: member[0].parent / member[0].name.partition(".")[0]
    ):
        key = str(key_path)
        unpacked: dict[str, Path] = {}
        for member, data in members_of_key:
            ending = member.name.partition(".")[2]
            role, _, suffix = ending.rpartition(".")
            if not role and len(roles) == 1:
                role = roles[0]
            # Other files, such as a caption, are no part of the input.
            if role in roles and f".{suffix}".lower() in input_format.suffixes:
                unpacked[role] = Path(tempfile.mkdtemp(dir=scratch)) / f"{role}.{suffix}"
                unpacked[role].write_bytes(data)

        missing = [role for role in roles if role not in unpacked]
        failure = ""
        if missing:
            failure = f"{tar}: {key!r} has no {missing[0]}; a sample holds {', '.join(roles)}"
        try:
            _refuse_unsafe_name(key, tar)
        except InputError as error:
            failure = str(error)
        if not failure:
            yield LocalInput(key, tuple(unpacked[role] for role in roles))
            continue
        for file in unpacked.values():
            shutil.rmtree(file.parent, ignore_errors=True)
        yield LocalInput(key, failure=failure)
