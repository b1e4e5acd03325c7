"""Whether what was posed is the object: the size that fits best, and the mirror image."""

from depthpose.core.rigid import Rigid
from depthpose.pose.estimator.fit import BORDER_PX, Seen
from depthpose.pose.estimator.mirror import mirror_gain
from depthpose.pose.estimator.prepare import Prepared
from depthpose.pose.estimator.scale import Scale, scale_of
from depthpose.pose.mesh import is_mirror_alike
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import Fit, Identity, ObjectModel

_OFFSET_M = 0.006
"""Sensors are off along the ray as a whole by 3 to 6 mm: so much nearer, a thing looks larger."""
_SURE = 2.0
"""Standard deviations."""
_SIZE_GAIN = 0.05
"""Where another size gains less (0.25 % of the diameter), what is seen of the surface fits at many,
or a sensor errs so: the right pose of a real bowl gains 0.032 at 1.07."""
_MIRROR_GAIN = 0.02
"""Gain from which a cloud is that of a mirrored copy, 0.1 % of the diameter: of right answers for
synthetic views it was at most 0.004, where the mirror image is not nearly the model."""
_OTHER_SIZES = 0.1
"""Sizes so far from 1 must be excluded for an identity to be confirmed."""
_SHOWN = 0.95
"""And so much of what was seen of the surface must agree."""
_BESIDE = 0.005
"""And no more of the readings may lie beside the silhouette, as those of a larger copy do."""


def identity_of(
    cloud: Prepared,
    pose: Rigid,
    model: ObjectModel,
    surface: Surface,
    fit: Fit,
    seen: Seen,
    max_size_error: float,
) -> Identity:
    """Fit another size and the mirror image, and say whether one of them is what was seen.

    Args:
        cloud: of the object.
        pose: after ICP.
        model: the object.
        surface: of it.
        fit: of the pose.
        seen: what the camera saw, for the width of its pixels.
        max_size_error: by how much the size may differ beyond what the sensor explains.
    """
    scale = scale_of(cloud.cloud_m, pose, surface)
    mirror = None
    if not is_mirror_alike(model):
        mirror = mirror_gain(cloud.cloud_m, pose, surface)
    distance_m = float(cloud.cloud_m[:, 2].double().median())
    border_m = BORDER_PX * distance_m / float(seen.K[0, 0])
    sensor = _OFFSET_M / distance_m + 2 * border_m / surface.diameter_m
    off = abs(scale.times - 1)
    is_other_size = off > max_size_error + sensor + _SURE * scale.sigma and scale.gain > _SIZE_GAIN
    measured = {
        "size": scale.times,
        "size_deviation": scale.sigma,
        "mirror_gain": None if mirror is None else NEAR * mirror,
    }
    if mirror is not None and mirror > max(_MIRROR_GAIN, scale.gain if is_other_size else 0.0):
        reason = (
            f"the mirror image of {model.name} fits better (by {NEAR * mirror:.2%} of the "
            "diameter): a mirrored copy, another object, or a camera whose x or y axis points "
            "the other way"
        )
        return Identity(status="contradicted", reason=reason, **measured)
    if is_other_size:
        reason = (
            f"{_size_words(scale)}, and the sensor explains {max_size_error + sensor:.0%}: a copy "
            "of another size, another object, or a wrong unit or camera"
        )
        return Identity(status="contradicted", reason=reason, **measured)
    reason = ""
    if off + _SURE * scale.sigma > _OTHER_SIZES + sensor:
        reason = f"what was seen does not fix the size: {_size_words(scale)}"
    elif mirror is not None and mirror > -_MIRROR_GAIN:
        reason = f"the mirror image of {model.name} fits what was seen as well"
    elif scale.gain > _SIZE_GAIN:
        reason = f"{_size_words(scale)}, which a sensor's errors may explain"
    elif fit.beyond > _BESIDE:
        reason = f"{fit.beyond:.1%} of the object's readings lie beside the posed silhouette"
    elif fit.agrees < _SHOWN:
        reason = f"{1 - fit.agrees:.0%} of what was seen of the surface does not agree"
    return Identity(status="not excluded" if reason else "confirmed", reason=reason, **measured)


def _size_words(scale: Scale) -> str:
    return (
        f"{scale.times:.2f} times the model's size fits best (standard deviation {scale.sigma:.2f})"
    )
