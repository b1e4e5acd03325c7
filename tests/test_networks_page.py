"""The diagrams of docs/networks.md: drawn from the modules, and legible."""

import importlib
import itertools
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from xml.etree import ElementTree

import pytest
import torch
from tests.written import ROOT

from depthpose.depth.config import GeneratorConfig, PSMNetConfig
from depthpose.depth.generators import Discriminator, UNetGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.pose.networks.fcn import FCN
from depthpose.pose.networks.resunet import ResUNet, ResUNetConfig

FIGURES = ("2-2", "2-3", "2-4", "3-1", "3-3")
SVG = "{http://www.w3.org/2000/svg}"


@contextmanager
def beside_the_docs() -> Iterator[None]:
    sys.path.insert(0, str(ROOT / "docs/ext"))
    yield
    sys.path.remove(str(ROOT / "docs/ext"))


@pytest.fixture(scope="module")
def networks() -> ModuleType:
    with beside_the_docs():
        return importlib.import_module("networks")


@pytest.fixture(scope="module")
def diagrams(networks: ModuleType) -> ModuleType:
    with beside_the_docs():
        return importlib.import_module("diagrams")


def lines_of(diagram: tuple[list, list]) -> list[str]:
    return [line for box in diagram[0] for line in box.lines]


@pytest.mark.parametrize("number", FIGURES)
def test_no_box_hides_another_and_no_arrow_begins_in_nothing(
    networks: ModuleType, diagrams: ModuleType, number: str
) -> None:
    boxes, arrows = networks.FIGURES[number]()
    svg = diagrams.draw(boxes, arrows, number).replace("<svg ", f'<svg xmlns="{SVG[1:-1]}" ', 1)
    picture = ElementTree.fromstring(svg)
    edges = [
        [float(rect.attrib[side]) for side in ("x", "y", "width", "height")]
        for rect in picture.iter(f"{SVG}rect")
    ]
    for (x, y, width, height), (u, v, other, tall) in itertools.combinations(edges, 2):
        assert x + width < u or u + other < x or y + height < v or v + tall < y
    assert {a.start for a in arrows} | {a.end for a in arrows} <= {box.name for box in boxes}
    assert len({box.name for box in boxes}) == len(boxes)
    assert len(list(picture.iter(f"{SVG}path"))) == len(arrows) + 1, "and the head of an arrow"


@pytest.mark.parametrize(
    ("number", "said"),
    [
        ("2-2", {"54,413,955 weights", "2,768,705 weights", "one a patch of 70x70"}),
        ("2-3", {"54,413,955 weights", "5,224,768 weights", "3x256x512", "256x512"}),
        ("2-4", {"C512: 4x4, stride 2", "C64: 4x4, stride 2", "1x2", "6x256x512"}),
        ("3-1", {"8,774,168 weights", "1 of 14 classes", "N x 64", "N x 8 x 3", "1 mm"}),
        ("3-3", {"conv: F 32, K 7, S 1", "conv: F 312, K 1, S 1", "8 mm",
                 "13 objects x 8 keypoints x 3"}),
    ],
)  # fmt: skip
def test_a_figure_shows_the_published_numbers(
    networks: ModuleType, number: str, said: set[str]
) -> None:
    assert said <= set(lines_of(networks.FIGURES[number]()))


def test_another_network_is_another_picture(networks: ModuleType) -> None:
    """No number is typed into a picture."""
    with torch.device("meta"):
        depth = networks.DepthNetworks(
            UNetGenerator(GeneratorConfig(width=8, levels=6)),
            Discriminator("pixel"),
            PSMNet(PSMNetConfig(width=8, max_disparity_px=48)).eval(),
            (256, 320),
        )
        segmentation = FCN(2)
    layers = lines_of(networks.adversaries(depth))
    assert layers.count("C64: 4x4, stride 2") == 3
    assert "C3: 4x4 transposed, stride 2" in layers
    assert "4x5" in layers
    assert "one a patch of 1x1" in layers
    assert "3x256x320" in lines_of(networks.pipeline(depth))
    config = ResUNetConfig(classes=2, keypoints=4, first_kernel=3, encoder=(4, 6, 8, 10),
                           decoder=(5, 6, 7, 8), inputs=9)  # fmt: skip
    pose = networks.PoseNetworks(segmentation, ResUNet(config).eval(), 0.008, (64, 32))
    layers = lines_of(networks.sparse(pose))
    assert {"F 9", "conv: F 4, K 3, S 1", "block of 2: F 10, K 3, S 1", "64 mm",
            "conv: F 24, K 1, S 1", "N x 4 x 3"} <= set(layers)  # fmt: skip
    assert {"3x32x64", "1 of 3 classes", "N x 5"} <= set(lines_of(networks.method(pose)))
