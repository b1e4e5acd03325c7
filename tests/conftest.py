import contextlib
import os
from pathlib import Path

import pytest
from hypothesis import settings


@pytest.fixture(scope="session")
def real() -> Path:
    """Folder of the real samples."""
    folder = os.environ.get("DEPTHPOSE_DATA")
    if not folder:
        pytest.skip("DEPTHPOSE_DATA names no folder of real samples")
    return Path(folder)


@pytest.fixture(scope="session")
def after_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which ``depthpose demo`` has run."""
    from depthpose.cli import main

    folder = tmp_path_factory.mktemp("demo")
    with contextlib.chdir(folder):
        assert main(["demo"]) == 0
    return folder


# How long an example takes is the machine's, not the code's.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")
