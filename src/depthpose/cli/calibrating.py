"""``depthpose depth calibrate``."""

from pathlib import Path

import tyro

from depthpose.depth.config import MatcherConfig


def calibrate(
    weights: tyro.conf.Positional[str],
    data: list[Path],
    out: Path,
    alarm_share: float = 0.01,
    split: str | None = None,
    device: str = "cpu",
) -> int:
    """Choose when one image is refused as unlike what weights know.

    Their mean confidence is measured on images that they shall know; what lies below that of all
    but a share of these is refused by 'depth predict'. Tensors stay as they are.

        depthpose depth calibrate mine.safetensors --data my_pairs --out mine-calibrated.safetensors

    Args:
        weights: weights with a generator that selects, by name or file.
        data: folders of such images: KITTI raw, object, 2012/2015, or plain folders of pairs.
        out: the file of the calibrated weights.
        alarm_share: share of these images that may be refused.
        split: name or file of a split, for the first folder.
        device: cpu, cuda, cuda:1, ...
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import find_weights
    from depthpose.core.run import refuse_to_replace
    from depthpose.depth import unlike
    from depthpose.depth.estimator import FakestereoNet
    from depthpose.depth.kitti import join_datasets, open_dataset

    refuse_to_replace(out)
    path = find_weights(weights)
    parts = [open_dataset(folder, split if k == 0 else None) for k, folder in enumerate(data)]
    dataset = join_datasets(parts)
    net = FakestereoNet.load(path, config=MatcherConfig(device=device), with_unlike=True)
    shown = tqdm(range(len(dataset)), unit=" images", disable=None)
    known = unlike.measure_familiarity(net, map(dataset.read_input, shown))
    least = unlike.calibrate(path, known, alarm_share, out)
    print(f"{len(known)} images: mean confidence {min(known):.3f} to {max(known):.3f}")
    print(f"refused below {least:.3f}; calibrated weights: {out}")
    return 0
