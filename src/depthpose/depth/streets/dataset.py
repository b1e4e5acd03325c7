"""Made street scenes as a dataset."""

from dataclasses import dataclass

from depthpose.depth.config import StreetsConfig
from depthpose.depth.streets.frame import draw_street
from depthpose.depth.types import StereoInput, StereoSample, StereoTruth


@dataclass(frozen=True)
class Streets:
    """Made pairs, each a function of the seed and its index alone: no order, no state, no files.

    Attributes:
        config: what the frames are like.
    """

    config: StreetsConfig

    def __len__(self) -> int:
        """How many there are."""
        return self.config.frames

    def __getitem__(self, index: int) -> StereoSample:
        """Make one sample; its truth is exact, and NaN in the sky.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        frame = draw_street(self.config, index)
        name = f"street_{self.config.seed}_{index:06d}"
        return StereoSample(
            input=StereoInput(name=name, left=frame.left, right=frame.right, camera=frame.rig),
            truth=StereoTruth(
                disparity_px=frame.disparity_px,
                depth_m=frame.depth_m,
                occluded=frame.occluded,
                right_disparity_px=frame.right_disparity_px,
                is_sky=frame.is_sky,
            ),
        )
