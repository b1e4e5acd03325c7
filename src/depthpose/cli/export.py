"""``depthpose export ...``."""

from pathlib import Path
from typing import Any


def export_depth(out: Path, weights: str = "default", what: str | None = None) -> int:
    """Write the depth networks as one ONNX file that runs without torch, and prove that it agrees.

    The graph does all that the estimator does at the quick speed, at any size: one image and its K
    to metres, sky and the right view; or a pair to disparity and confidence. Its outputs are
    compared with PyTorch's at several sizes and the differences written to NAME.proof.json; beyond
    the limit nothing is written. Needs the extra export.

        depthpose export depth --out depth.onnx
        depthpose export depth --weights psmnet.safetensors --out psmnet.onnx

    Args:
        out: the .onnx file to write.
        weights: of a generator, a matcher or both, by name or file ('depthpose weights list').
        what: image: one image to depth; pair: a rectified pair to disparity. By default image
            where the weights have a generator, else pair.
    """
    from depthpose.core.checkpoint import find_weights
    from depthpose.core.export import freeze
    from depthpose.depth.export import depth_export
    from depthpose.depth.weights import read_depth_weights

    path = find_weights(weights)
    found = read_depth_weights(path)
    facts = _facts(weights, path, found.facts)
    return _say(out, freeze(out, depth_export(found, what, facts)))


def export_pose(out: Path, weights: str = "parts") -> int:
    """Write the network of directions as one ONNX file that runs without torch, and prove it.

    The graph takes voxels (cloud, x, y, z; each once) and their features, and gives the direction
    from each to every keypoint of every object; coarser levels and kernel maps are made inside it.
    It does neither voxelise nor vote, run ICP or refuse. Its outputs are compared with PyTorch's
    on several clouds and the differences written to NAME.proof.json; beyond the limit nothing is
    written. Needs the extra export.

        depthpose export pose --out pose.onnx

    Args:
        out: the .onnx file to write.
        weights: of a pose network, by name or file ('depthpose weights list').
    """
    from depthpose.core.checkpoint import find_weights
    from depthpose.core.export import freeze
    from depthpose.pose.export import pose_export
    from depthpose.pose.weights import read_pose_weights

    path = find_weights(weights)
    found = read_pose_weights(path)
    return _say(out, freeze(out, pose_export(found, _facts(weights, path, found.facts))))


def _facts(weights: str, path: Path, card: Any) -> dict[str, Any]:  # noqa: ANN401
    from depthpose.core.checkpoint import file_sha256, warn_of_terms

    warn_of_terms(card)
    own = {"format": "onnx", "weights": Path(weights).name, "weights_sha256": file_sha256(path)}
    return {**card, **own}


def _say(out: Path, rows: Any) -> int:  # noqa: ANN401
    from depthpose.core.export import proof_path
    from depthpose.report.page import markdown_table

    shown = [{k: f"{v:.1e}" if isinstance(v, float) else v for k, v in row.items()} for row in rows]
    print(markdown_table(shown), end="")
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; the differences are in "
          f"{proof_path(out).name}")  # fmt: skip
    return 0
