import io
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from depthpose.core.files import read_map, write_map


@pytest.mark.parametrize("suffix", [".npy", ".pfm"])
@given(
    array=hnp.arrays(
        np.float32,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=6),
        elements=st.floats(width=32, allow_infinity=False),
    )
)
def test_maps_come_back_to_the_bit(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, array: np.ndarray
) -> None:
    path = tmp_path_factory.mktemp("map") / f"x{suffix}"
    write_map(path, torch.from_numpy(array))
    back = read_map(path)
    np.testing.assert_array_equal(back.numpy(), array)
    assert back.is_contiguous()


@pytest.mark.parametrize("dtype", ["<f2", "<f4", "<f8", ">f2", ">f4", ">f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy_of_every_float_and_layout(tmp_path: Path, dtype: str, order: str) -> None:
    array = np.arange(6, dtype=dtype).reshape(2, 3)
    np.save(tmp_path / "x.npy", np.asarray(array, order="F" if order == "F" else "C"))
    assert read_map(tmp_path / "x.npy").tolist() == [[0, 1, 2], [3, 4, 5]]


def test_npy_of_version_2_is_read(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ones((2, 2)), version=(2, 0))
    (tmp_path / "x.npy").write_bytes(stream.getvalue())
    assert read_map(tmp_path / "x.npy").tolist() == [[1, 1], [1, 1]]


@pytest.mark.parametrize(("scale", "order"), [("-1.0", "<f4"), ("1", ">f4"), ("-0.0039", "<f4")])
@pytest.mark.parametrize("newline", ["\n", "\r\n", " "])
def test_pfm_rows_run_from_bottom_to_top(
    tmp_path: Path, scale: str, order: str, newline: str
) -> None:
    body = np.array([[3, np.inf], [1, 2]], order).tobytes()
    header = f"Pf{newline}2 2{newline}{scale}{newline}"
    (tmp_path / "x.pfm").write_bytes(header.encode() + body)
    found = read_map(tmp_path / "x.pfm")
    assert found[0].tolist() == [1, 2]
    assert float(found[1, 0]) == 3
    assert torch.isnan(found[1, 1])
