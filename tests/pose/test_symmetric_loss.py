"""The loss of a training is the same for every truth that looks alike."""

import pytest
import torch

from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.networks.resunet import ResUNet, ResUNetConfig
from depthpose.pose.synthetic import make_part
from depthpose.pose.train import PoseTask, PoseTraining
from depthpose.pose.train.clouds import CloudBatch
from depthpose.pose.types import VotingPoints

_SMALL = ResUNetConfig(classes=1, first_kernel=3, encoder=(4, 4, 8, 8), decoder=(4, 4, 4, 8))
_STEP = 0.05
"""Of a training's turns about an axis: each makes of their set the same set."""


class _Stubborn(ResUNet):
    """Answers the same, whatever it is shown."""

    answer: torch.Tensor

    def directions(self, points: VotingPoints) -> torch.Tensor:  # noqa: ARG002
        return self.answer


def _batch(pose: Rigid, points_m: torch.Tensor) -> CloudBatch:
    cells = torch.floor(points_m / CloudConfig().voxel_m).long()
    return CloudBatch(
        points_m=points_m.float(),
        coordinates=torch.nn.functional.pad(cells, (1, 0)),
        features=torch.ones(len(cells), 1),
        class_of=torch.tensor([0]),
        R=pose.R[None].float(),
        t_m=pose.t_m[None].float(),
    )


@pytest.mark.parametrize(("part", "copies"), [("flange", 6), ("spool", 63)])
@pytest.mark.parametrize("mode", ["mse", "cosine", "l1"])
def test_each_declared_symmetry_leaves_the_loss_as_it_is(part: str, copies: int, mode: str) -> None:
    model = make_part(part, 1)
    generator = torch.Generator().manual_seed(0)
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator).double())
    pose = Rigid(q * torch.linalg.det(q), torch.tensor([0.1, -0.05, 0.8]).double())
    chosen = torch.randint(len(model.vertices_m), (30,), generator=generator)
    points_m = pose.apply(model.vertices_m[chosen].double())
    network = _Stubborn(_SMALL)
    config = PoseTraining(loss=mode)
    task = PoseTask(network, [model], config)
    # Near one truth, but right for none: the choice of the copy has a say.
    towards = pose.apply(task._copies_m[0, -1].double()) - points_m[:, None]
    noise = 0.3 * torch.randn(towards.shape, generator=generator)
    network.answer = (torch.nn.functional.normalize(towards, dim=-1) + noise).float()

    def loss_of(truth: Rigid) -> float:
        (turn,) = list(task.step(_batch(truth, points_m)))
        return float(turn.loss.detach())

    turns = symmetry_transforms(model.symmetries, _STEP)
    assert len(turns.R) == copies
    expected = loss_of(pose)
    for R, t_m in zip(turns.R.double(), turns.t_m.double(), strict=True):
        assert loss_of(pose @ Rigid(R, t_m)) == pytest.approx(expected, rel=1e-4)
    # Another turn is another truth, which costs more.
    tilt = torch.tensor([[1.0, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]).double()
    assert loss_of(pose @ Rigid(tilt, torch.zeros(3).double())) > 1.05 * expected
