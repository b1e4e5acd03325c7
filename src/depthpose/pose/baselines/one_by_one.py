"""RANSAC as the published loops do it: one hypothesis at a time, in NumPy, over all points."""

import numpy as np
from jaxtyping import Float64


def ransac_one_by_one(
    points_m: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n k 3"],
    hypotheses: int = 50,
    min_cosine: float = 0.99,
    seed: int = 0,
) -> Float64[np.ndarray, "k 3"]:
    """Find every keypoint with a loop over keypoints and hypotheses.

    A hypothesis is the point nearest to the lines of two random points; its inliers are the points
    whose unit direction comes within an angle of it; the best is refitted on its inliers.

    Args:
        points_m: where the votes start.
        directions: of unit length.
        hypotheses: tried for each keypoint; published practice is 50.
        min_cosine: of the angle of an inlier.
        seed: of the pairs.
    """
    random = np.random.default_rng(seed)
    found = []
    for k in range(directions.shape[1]):
        n = directions[:, k]
        best, chosen = -1, np.ones(len(n), bool)
        for _ in range(hypotheses):
            pair = random.choice(len(points_m), 2, replace=False)
            try:
                tried = np.linalg.solve(*_normal_equations(points_m[pair], n[pair]))
            except np.linalg.LinAlgError:
                continue
            way = tried - points_m
            inliers = (way * n).sum(1) / np.sqrt((way * way).sum(1)).clip(1e-300) > min_cosine
            count = np.count_nonzero(inliers)
            if count > best:
                best, chosen = count, inliers
        try:
            refitted = np.linalg.solve(*_normal_equations(points_m[chosen], n[chosen]))
        except np.linalg.LinAlgError:  # no inlier but parallel ones, or none: all votes count
            refitted = np.linalg.lstsq(*_normal_equations(points_m, n), rcond=None)[0]
        found.append(refitted)
    return np.stack(found)


def _normal_equations(points_m: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the point nearest to the lines through ``points_m`` along ``n``; singular if parallel."""
    A = len(points_m) * np.eye(3) - n.T @ n
    return A, points_m.sum(0) - n.T @ (n * points_m).sum(1)
