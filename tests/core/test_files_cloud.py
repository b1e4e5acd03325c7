import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from depthpose.core.errors import InputError
from depthpose.core.files import PointCloud, read_cloud, read_points_bin, write_cloud
from depthpose.core.files.points import decompress_lzf

POINTS = torch.tensor([[0.0, 1.5, -2.0], [3.25, 4.0, 5.0]])
COLOR = torch.tensor([[255.0, 0, 7], [1, 2, 3]]) / 255
PLY_PROPERTIES = (
    "property double x\nproperty float y\nproperty float z\nproperty float nx\n"
    "property uchar red\nproperty uchar green\nproperty uchar blue\n"
)
PCD_HEADER = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U U\n"
    "COUNT 1 1 1 3 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA "
)


def same(
    found: PointCloud, points: torch.Tensor = POINTS, color: torch.Tensor | None = COLOR
) -> bool:
    if color is None or found.color is None:
        return torch.equal(found.points, points) and found.color is color
    return torch.equal(found.points, points) and torch.allclose(found.color, color)


def ply_rows(order: str) -> bytes:
    rows = zip(POINTS.tolist(), (COLOR * 255).round().int().tolist(), strict=True)
    return b"".join(struct.pack(f"{order}dfffBBB", *p, 9.0, *c) for p, c in rows)


def pack_lzf(data: bytes) -> bytes:
    """Compress with literals and, wherever 3 bytes or more came before, a reference."""
    out, at = bytearray(), 0
    while at < len(data):
        length, start = 0, 0
        for candidate in range(max(0, at - 8191), at):
            n = 0
            while n < 264 and at + n < len(data) and data[candidate + n] == data[at + n]:
                n += 1
            if n > length:
                length, start = n, candidate
        if length < 3:
            out += bytes([0, data[at]])
            at += 1
            continue
        back = at - start - 1
        short = min(length - 2, 7)
        out.append(short << 5 | back >> 8)
        if short == 7:
            out.append(length - 9)
        out.append(back & 255)
        at += length
    return bytes(out)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("with_color", [True, False])
@given(
    points=hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.just(3)),
        elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
    )
)
def test_written_clouds_come_back(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, with_color: bool, points: np.ndarray
) -> None:
    path = tmp_path_factory.mktemp("cloud") / f"x{suffix}"
    color = torch.randint(0, 256, points.shape) / 255 if with_color else None
    write_cloud(path, PointCloud(points=torch.from_numpy(points), color=color))
    assert same(read_cloud(path), torch.from_numpy(points), color)


@pytest.mark.parametrize(
    ("name", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")]
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_binary_ply_with_more_than_points(
    tmp_path: Path, name: str, order: str, newline: str
) -> None:
    header = (
        f"ply\nformat {name} 1.0\ncomment made here\nelement camera 1\nproperty short id\n"
        f"element vertex 2\n{PLY_PROPERTIES}element face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).replace("\n", newline)
    face = b"\x03" + bytes(12)
    (tmp_path / "x.ply").write_bytes(header.encode() + b"\x01\x02" + ply_rows(order) + face)
    assert same(read_cloud(tmp_path / "x.ply"))


def test_text_ply_with_faces(tmp_path: Path) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex 2\n{PLY_PROPERTIES}element face 1\n"
    rows = "0 1.5 -2 9 255 0 7\n3.25 4 5 9 1 2 3\n3 0 1 1\n"
    text = f"{header}property list uchar int vertex_indices\nend_header\n{rows}"
    (tmp_path / "x.ply").write_text(text)
    assert same(read_cloud(tmp_path / "x.ply"))


def pcd_columns() -> list[np.ndarray]:
    rgb = (COLOR * 255).round().int().numpy()
    packed = (rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]).astype("<u4")
    return [*POINTS.numpy().astype("<f4").T, np.zeros((2, 3), "u1"), packed]


def test_binary_pcd_with_padding(tmp_path: Path) -> None:
    x, y, z, gap, rgb = pcd_columns()
    rows = b"".join(b"".join(c[i].tobytes() for c in (x, y, z, gap, rgb)) for i in range(2))
    (tmp_path / "x.pcd").write_bytes(f"{PCD_HEADER}binary\n".encode() + rows)
    assert same(read_cloud(tmp_path / "x.pcd"))


def test_compressed_pcd(tmp_path: Path) -> None:
    body = b"".join(np.ascontiguousarray(c).tobytes() for c in pcd_columns())
    packed = pack_lzf(body)
    data = f"{PCD_HEADER}binary_compressed\n".encode()
    data += struct.pack("<II", len(packed), len(body)) + packed
    (tmp_path / "x.pcd").write_bytes(data)
    assert same(read_cloud(tmp_path / "x.pcd"))


def test_text_pcd_of_an_organised_cloud_leaves_out_what_was_not_seen(tmp_path: Path) -> None:
    text = (
        "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 2\nDATA ascii\n"
        "0 1.5 -2\nnan nan nan\n3.25 4 5\nnan nan nan\n"
    )
    (tmp_path / "x.pcd").write_text(text)
    assert same(read_cloud(tmp_path / "x.pcd"), color=None)


@given(
    st.binary(max_size=300)
    | st.builds(lambda b, n: b * n, st.binary(max_size=9), st.integers(1, 90))
)
def test_lzf_undoes_its_compression(data: bytes) -> None:
    assert decompress_lzf(memoryview(pack_lzf(data)), len(data)) == data


@pytest.mark.parametrize("text", ["0 1.5 -2\n3.25 4 5\n", "# x, y, z\n0,1.5,-2, 9\n\n3.25;4;5;9\n"])
@pytest.mark.parametrize("suffix", [".xyz", ".txt"])
def test_text_rows(tmp_path: Path, suffix: str, text: str) -> None:
    (tmp_path / f"x{suffix}").write_text(text)
    assert same(read_cloud(tmp_path / f"x{suffix}"), color=None)


def test_npy_rows_of_more_columns(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", np.column_stack([POINTS.double().numpy(), np.ones(2)]))
    assert same(read_cloud(tmp_path / "x.npy"), color=None)


def test_velodyne_rows(tmp_path: Path) -> None:
    rows = torch.arange(12.0).reshape(3, 4)
    (tmp_path / "x.bin").write_bytes(rows.numpy().astype("<f4").tobytes())
    assert torch.equal(read_points_bin(tmp_path / "x.bin"), rows)
    assert torch.equal(read_points_bin(tmp_path / "x.bin", columns=3), rows.reshape(4, 3))


SCAN = [[0.1, 0.25, 1.5], [-0.2, 0.3, 1.6], [0.05, -0.07, 1.4], [0.3, 0.12, 1.55]]


def scan_rows(between: str = " ", *, decimal: str = ".", first: int | None = None) -> str:
    """The points of a scan, a row each; with a column that counts them."""
    lines = [between.join(f"{v:.2f}".replace(".", decimal) for v in point) for point in SCAN]
    if first is not None:
        lines = [f"{first + k}{between}{line}" for k, line in enumerate(lines)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        scan_rows(","),
        scan_rows(", "),
        scan_rows(decimal=","),
        scan_rows("\t", decimal=","),
        scan_rows(";", decimal=","),
        scan_rows("; ", decimal=","),
        scan_rows(", ", decimal=","),
        scan_rows(first=0),
        scan_rows(";", decimal=",", first=1),
        "x y z\n" + scan_rows(),
        '"ID";"X";"Y";"Z"\n' + scan_rows(";", decimal=",", first=77),
        "//X Y Z\n" + scan_rows(),
        "# z y x\n" + "".join(f"{z} {y} {x}\n" for x, y, z in SCAN),
        "# all of it\n" + scan_rows(),
        "".join(f"{n} {row}\n" for n, row in zip("3479", scan_rows().splitlines(), strict=True)),
        scan_rows(";", decimal=",") + "1,#QNAN;1,#QNAN;1,#QNAN\n",
        "4\n" + scan_rows(),
        "-nan(ind) 1.#QNAN -1.#IND00\n" + scan_rows() + "nan(0x8) 2 3 # far\n",
    ],
)
def test_text_as_other_programs_write_it(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.txt").write_text(text)
    assert torch.allclose(read_cloud(tmp_path / "x.txt").points, torch.tensor(SCAN))


def test_columns_are_taken_by_their_names_and_a_count_is_none(tmp_path: Path) -> None:
    turned = "".join(f"{z} 7 {x} {y}\n" for x, y, z in SCAN)
    (tmp_path / "x.txt").write_text("z i x y\n" + turned)
    assert torch.allclose(read_cloud(tmp_path / "x.txt").points, torch.tensor(SCAN))
    np.save(tmp_path / "x.npy", np.c_[np.arange(1, 5), SCAN])
    assert torch.allclose(read_cloud(tmp_path / "x.npy").points, torch.tensor(SCAN))
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "x.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n"
        "1 2 3\n-nan(ind) 1.#QNAN 0\n"
    )
    assert read_cloud(tmp_path / "x.ply").points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (scan_rows(",", decimal=","), "commas may part numbers or be decimal signs"),
        ("0,1,0,2,0,7\n0,2,0,2,0,7\n", r"decimal signs .* a first line of names \(x,y,z"),
        ("1.000,5 2.000,5 3.000,5\n" * 4, "commas may part numbers or be decimal signs"),
        ((scan_rows() * 2).replace("\n", " "), r"1 rows of 24 .* save the transpose"),
        (
            "".join(f"30{n} 200 {row}\n" for n, row in enumerate(scan_rows().splitlines())),
            r"two whole numbers \(300 and 200\), which look like a pixel's place",
        ),
        ("a b c\n" + scan_rows(), "begins by 'a b c', neither numbers nor names of columns"),
        ("x y z r\n" + scan_rows(), "names 4 columns, but rows have 3"),
        ("5\n" + scan_rows(), "declares 5 points but 4 rows follow"),
        ("1.#INF 2 3\n" + scan_rows(), "a coordinate is infinite"),
    ],
)
def test_text_that_cannot_be_understood_is_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "x.xyz").write_text(text)
    with pytest.raises(InputError, match=said):
        read_cloud(tmp_path / "x.xyz")


def test_a_signalling_nan_is_read_without_a_warning(tmp_path: Path) -> None:
    """One that the long fuzz of readers found: NumPy rounds it with a warning."""
    table = np.ones((4, 3), np.float32)
    table.view(np.uint32)[2, 0] = 0x7FA00000
    np.save(tmp_path / "x.npy", table)
    assert read_cloud(tmp_path / "x.npy").points[:, 1].eq(1).all()


@pytest.mark.parametrize(
    ("viewpoint", "is_said"),
    [
        ("0 0 0 1 0 0 0", False),
        ("0 0 0 -1 0 0 0", False),
        ("0 0 0 0 0 0 0", False),
        ("0 0 1.2 1 0 0 0", True),
        ("0 0 0 0.7071 0 0.7071 0", True),
        ("0 0 0 nan 0 0 0", True),
        ("sensor", True),
    ],
)
def test_a_viewpoint_that_is_not_applied_is_named(
    tmp_path: Path, viewpoint: str, is_said: bool
) -> None:
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\n"
    text = f"{head}VIEWPOINT {viewpoint}\nPOINTS 2\nDATA ascii\n0 1.5 -2\n3.25 4 5\n"
    (tmp_path / "x.pcd").write_text(text)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert same(read_cloud(tmp_path / "x.pcd"), color=None)
    expected = [f"its VIEWPOINT {viewpoint} "] if is_said else []
    assert [str(one.message)[len(str(tmp_path / "x.pcd: ")) :][: len(e)]
            for one, e in zip(said, expected, strict=True)] == expected  # fmt: skip
