"""An encoder that is exported in a part of the time: of one plain block a stage."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from depthpose.depth import encoder


@contextmanager
def short_encoder() -> Iterator[None]:
    """Build encoders of the same strides, kernels and channels, of one block a stage."""
    with pytest.MonkeyPatch.context() as patch:
        stages = tuple(stage._replace(blocks=1, expansion=1) for stage in encoder._STAGES)
        patch.setattr(encoder, "_STAGES", stages)
        yield
