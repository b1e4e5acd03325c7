import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real() -> Path:
    """Folder of the real samples."""
    folder = os.environ.get("DEPTHPOSE_DATA")
    if not folder:
        pytest.skip("DEPTHPOSE_DATA names no folder of real samples")
    return Path(folder)
