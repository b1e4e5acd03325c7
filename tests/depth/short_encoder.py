"""An encoder that is exported in a part of the time: of one plain block a stride."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from depthpose.depth import encoder


@contextmanager
def short_encoder() -> Iterator[None]:
    """Build encoders of the same strides, kernels and channels, of one block a stride.

    No block widens: the whole encoder, which slow tests export, has the same operations twice.
    """
    last = [encoder._STAGES[number] for number in encoder._LAST_AT_STRIDE]
    strides = [1] + (len(last) - 1) * [2]
    with pytest.MonkeyPatch.context() as patch:
        stages = tuple(
            (1, kernel, step, 1, width)
            for (_, kernel, _, _, width), step in zip(last, strides, strict=True)
        )
        patch.setattr(encoder, "_STAGES", stages)
        patch.setattr(encoder, "_LAST_AT_STRIDE", tuple(range(len(stages))))
        yield
