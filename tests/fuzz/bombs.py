"""Small files that ask for much memory or time; as a program, what each takes to be refused.

    python -m tests.fuzz.bombs FOLDER

prints a line of JSON for each: what was said, the peak of memory (MB) and processor time (s) of a
process of its own.
"""

import json
import os
import struct
import sys
import time
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import torch
import trimesh
from safetensors.torch import save
from tests.fuzz.corpus import look, sparse_glb
from tests.fuzz.damage import pack_glb, png_chunk

from depthpose.core.camera import read_camera
from depthpose.core.checkpoint import read_checkpoint
from depthpose.core.config import config_to_dict, read_config
from depthpose.core.errors import InputError
from depthpose.core.files import (
    read_cloud,
    read_image,
    read_json,
    read_key_values,
    read_map,
    read_points_bin,
)
from depthpose.core.loop import read_metrics
from depthpose.depth.config import PSMNetConfig
from depthpose.depth.datasets import read_split
from depthpose.depth.datasets.frames import read_plain_calibration
from depthpose.depth.train import STAGES
from depthpose.depth.weights import read_depth_weights
from depthpose.pose.datasets import read_detections, read_mask
from depthpose.pose.datasets.entries import read_mapping
from depthpose.pose.mesh import read_model
from depthpose.pose.predictions import read_bop_results

Bomb = tuple[str, Callable[[], bytes | int], Callable[[Path], object]]
"""Name of the file; its bytes, or the size of a file of zeros; what reads it."""


def png(width: int, height: int, mode: int = 2) -> bytes:
    """A whole picture of one colour: some hundred kilobytes of any size."""
    row = bytes(1 + width * (3 if mode == 2 else 1))
    packer = zlib.compressobj(1)
    rows = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, mode, 0, 0, 0)
    chunks = png_chunk(b"IHDR", header) + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def packed_pcd(points: int) -> bytes:
    """Points of zeros: each reference of LZF repeats 264 bytes."""
    size = 12 * points
    packed = b"\x00\x00" + b"\xe0\xff\x00" * ((size - 1) // 264)
    rest = (size - 1) % 264
    packed += b"\x00\x00" * rest
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {points}\n"
    sizes = struct.pack("<II", len(packed), size)
    return f"{head}DATA binary_compressed\n".encode() + sizes + packed


def many_nodes() -> bytes:
    """One mesh of twelve triangles, placed a million times."""
    good = trimesh.creation.box().export(file_type="glb")
    assert isinstance(good, bytes)
    (size,) = struct.unpack("<I", good[12:16])
    tree = json.loads(good[20 : 20 + size])
    mesh = next(node["mesh"] for node in tree["nodes"] if "mesh" in node)
    tree["nodes"] = [{"mesh": mesh}] * 200_000
    tree["scenes"] = [{"nodes": list(range(200_000))}]
    return pack_glb(tree, good[20 + size :])


def deep_nodes() -> bytes:
    """A chain of nodes, each with a mesh: the cube of its length for each of them."""
    good = trimesh.creation.box().export(file_type="glb")
    assert isinstance(good, bytes)
    (size,) = struct.unpack("<I", good[12:16])
    tree = json.loads(good[20 : 20 + size])
    tree["nodes"] = [{"mesh": 0, "children": [k + 1]} for k in range(5000)] + [{"mesh": 0}]
    tree["scenes"] = [{"nodes": [0]}]
    return pack_glb(tree, good[20 + size :])


def comb_obj(teeth: int, times: int) -> bytes:
    """Polygons that turn back at each tooth."""
    rows = [f"v {2 * k + x} {y} 0\n" for k in range(teeth)
            for x, y in ((0, 0), (0.9, 10), (1, 10), (1.9, 0))]  # fmt: skip
    text = "".join(rows) + f"v {2 * teeth} -1 0\nv 0 -1 0\n"
    return (text + times * f"f {' '.join(map(str, range(1, 4 * teeth + 3)))}\n").encode()


def npy(shape: object, descr: str = "<f4") -> bytes:
    """A header and nothing behind it."""
    text = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode().ljust(117)
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text + b"\n"


def wide_weights() -> bytes:
    """A matcher whose config asks for a million channels."""
    config = config_to_dict(PSMNetConfig()) | {"width": 10**6}
    metadata = {"kind": "psmnet", "config": json.dumps(config)}
    return save({"a": torch.zeros(1)}, metadata)


def laughs() -> bytes:
    """YAML that is a billion words once its references are followed."""
    text = "a: &a [x,x,x,x,x,x,x,x,x]\n"
    for one, other in zip("abcdefgh", "bcdefghi", strict=True):
        text += f"{other}: &{other} [{','.join([f'*{one}'] * 9)}]\n"
    return text.encode()


def in_mm(path: Path) -> object:
    return read_model(path, "mm")


def camera(path: Path) -> object:
    return read_camera(path, (640, 480))


def config(path: Path) -> object:
    return read_config(path, STAGES["view"][0])


def pairs(path: Path) -> object:
    return read_plain_calibration(path, "a", 640, 480)


def metrics(path: Path) -> object:
    return read_metrics(path.parent)


LZF = (
    b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 89478485\nDATA binary_compressed\n"
)
HUGE = 2**28 + 1
LINES = 2**26
BOMBS: dict[str, Bomb] = {
    "GLB, a sparse accessor": ("x.glb", lambda: sparse_glb(10**9), in_mm),
    "GLB, 200,000 nodes": ("x.glb", many_nodes, in_mm),
    "GLB, nodes in nodes": ("x.glb", deep_nodes, in_mm),
    "OBJ of a comb": ("x.obj", lambda: comb_obj(1200, 1), in_mm),
    "OBJ of combs": ("x.obj", lambda: comb_obj(1200, 1000), in_mm),
    "OBJ of a line that goes on": ("x.obj", lambda: 2**23 * b"a\\\n", in_mm),
    "PCD, LZF of 1 GB": ("x.pcd", lambda: packed_pcd(2**30 // 12), read_cloud),
    "PCD, LZF that says 1 GB": ("x.pcd", lambda: LZF + struct.pack("<II", 2, 1073741820) + b"\0\0",
                                read_cloud),
    "PNG of 8192x8192": ("x.png", lambda: png(8192, 8192), look),
    "PNG of 60,000 columns": ("x.png", lambda: png(60_000, 1000), look),
    "PNG of 5792x5792": ("x.png", lambda: png(5792, 5792), look),
    "PNG of 8192x8192, read": ("x.png", lambda: png(8192, 8192), read_image),
    "mask of 8192x8192": ("x.png", lambda: png(8192, 8192, 0), read_mask),
    "BMP of 30000x30000": ("x.bmp", lambda: b"BM" + struct.pack("<IIIIiiHH", 0, 0, 54, 40, 30000,
                           30000, 1, 24) + bytes(24), read_image),
    "PPM of 60000x60000": ("x.ppm", lambda: b"P6 60000 60000 255\n", read_image),
    "NPY of 70 dimensions": ("x.npy", lambda: npy((1,) * 70) + bytes(4), look),
    "NPY of Booleans": ("x.npy", lambda: npy((True, True)) + bytes(4), look),
    "NPY of bool": ("x.npy", lambda: npy((9, 9), "|b1") + bytes(81), look),
    "NPY of an enormous shape": ("x.npy", lambda: npy((10**12, 10**12)), read_map),
    "NPY of nothing times much": ("x.npy", lambda: npy((0, 10**30)), read_cloud),
    "NPY of 400 digits": ("x.npy", lambda: npy((10**90, 3)), read_cloud),
    "NPY of 5 GB": ("x.npy", lambda: 5 * 2**30, read_map),
    "PLY of 256 MB": ("x.ply", lambda: HUGE, read_cloud),
    "PLY, a trillion vertices": ("x.ply", lambda: b"ply\nformat ascii 1.0\nelement vertex "
                                 b"999999999999\nproperty float x\nend_header\n1\n", read_cloud),
    "mesh PLY, a trillion faces": ("x.ply", lambda: b"ply\nformat binary_little_endian 1.0\n"
                                   b"element vertex 999999999\nproperty float x\n"
                                   b"element face 999999999\n"
                                   b"property list uchar int i\nend_header\n1", in_mm),
    "text PLY mesh": ("x.ply", lambda: b"ply\nformat ascii 1.0\n" + LINES * b"\n", in_mm),
    "OBJ of lines": ("x.obj", lambda: LINES * b"\n", in_mm),
    "OBJ of vertices": ("x.obj", lambda: 2**24 * b"v 0 0 0\n", in_mm),
    "STL of lines": ("x.stl", lambda: b"solid\n" + LINES * b"\n", in_mm),
    "STL of 4 G triangles": ("x.stl", lambda: bytes(80) + b"\xff" * 4 + bytes(500), in_mm),
    "scan of zeros": ("x.bin", lambda: HUGE, read_points_bin),
    "XYZ of lines": ("x.xyz", lambda: LINES * b"\n", read_cloud),
    "XYZ of points": ("x.xyz", lambda: LINES // 6 * b"1 2 3\n" + b"1 2\n", read_cloud),
    "split of lines": ("x.txt", lambda: LINES * b"\n", read_split),
    "split of 16 MB": ("x.txt", lambda: 2**24 * b"\n", read_split),
    "calibration of lines": ("x.txt", lambda: 2**20 * b"\n", camera),
    "pairs of lines": ("x.txt", lambda: 2**24 * b"\n", pairs),
    "key values of lines": ("x.txt", lambda: 2**20 * b"\n", read_key_values),
    "metrics of lines": ("metrics.jsonl", lambda: LINES * b"\n", metrics),
    "metrics of rows": ("metrics.jsonl", lambda: 2**22 * b'{"step":1}\n' + b"\n", metrics),
    "results of lines": ("x.csv", lambda: LINES * b"\n", read_bop_results),
    "JSON of lists": ("x.json", lambda: b"[" + LINES // 3 * b"[]," + b"0]", read_json),
    "JSON of numbers": ("x.json", lambda: b"[" + 2**23 * b"1000," + b"x]", read_detections),
    "JSON of names": ("x.json", lambda: b"{" + b",".join(b'"%d":1' % i for i in range(2**21))
                      + b",}", read_json),
    "JSON of one letter": ("x.json", lambda: '"é'.encode() + LINES * b"a", read_json),
    "JSON, deep": ("x.json", lambda: 2**24 * b"[", look),
    "YAML, deep lists": ("x.yaml", lambda: 2**17 * b"[", camera),
    "YAML, deep blocks": ("x.yaml", lambda: 2**16 * b"- ", camera),
    "YAML of laughs": ("x.yaml", laughs, camera),
    "config, deep lists": ("x.yaml", lambda: 2**17 * b"[", config),
    "config of laughs": ("x.yaml", laughs, config),
    "LineMOD's YAML, deep": ("gt.yml", lambda: 2**20 * b"[", read_mapping),
    "LineMOD's YAML of lists": ("gt.yml", lambda: b"[" + 2**22 * b"[]," + b"]", read_mapping),
    "XML, deep": ("x.xml", lambda: 2**16 * b"<a>", camera),
    "run lengths of a huge mask": ("x.json", lambda: b'{"size": [100000, 100000], "counts": '
                                   b"[10000000000]}", look),
    "run lengths without end": ("x.json", lambda: b'{"size": [4, 4], "counts": "'
                                + 2**22 * b"o" + b'"}', look),
    "weights of a million channels": ("w.safetensors", wide_weights, read_depth_weights),
    "weights of another kind": ("w.safetensors", lambda: save({"a": torch.zeros(2**27)},
                                {"x": "y"}), read_checkpoint),
}  # fmt: skip


def blow(path: Path, read: Callable[[Path], object]) -> dict[str, object]:
    """Read a file; say how it ended and what it took."""
    began = time.process_time()
    try:
        found, said = read(path), ""
        outcome = "odd" if isinstance(found, int) and found == 1 else "read"
    except InputError as error:
        outcome, said = "refused", str(error)
    except BaseException as error:  # noqa: BLE001 - what comes is what is looked for
        outcome, said = type(error).__name__, str(error)
    import resource  # not on Windows

    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = time.process_time() - began
    return {"outcome": outcome, "said": said[:300], "mb": peak_kib / 1000, "s": seconds}


def main(folder: Path) -> None:
    """Try each bomb in a process of its own."""
    warnings.simplefilter("ignore")
    for name, (file, make, read) in BOMBS.items():
        path = folder / file
        pid = os.fork()  # making a bomb takes memory too
        if pid == 0:
            data = make()
            with path.open("wb") as target:
                target.truncate(data) if isinstance(data, int) else target.write(data)
            os._exit(0)
        os.waitpid(pid, 0)
        end, begin = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.write(begin, json.dumps(blow(path, read)).encode())
            os._exit(0)
        os.close(begin)
        _, status = os.waitpid(pid, 0)
        said = os.read(end, 10_000).decode() or json.dumps({"outcome": f"signal {status}"})
        os.close(end)
        path.unlink()
        print(json.dumps({"name": name, **json.loads(said)}), flush=True)  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1]))
