"""GeoPoseNet: clouds and depth images of known objects to poses."""

from pathlib import Path

from depthpose.core.checkpoint import find_weights, warn_of_terms
from depthpose.pose.config import EstimateConfig
from depthpose.pose.estimator.inference import PoseInference
from depthpose.pose.weights import read_pose_weights


class GeoPoseNet(PoseInference):
    """The 6-DoF pose of a known object from its partial cloud, or the reason why there is none.

    Example::

        net = GeoPoseNet.load("parts")
        found = net.estimate(cloud="mug.ply", unit="mm", object="mug")
        print(found.camera_from_model if found.is_ok else found.reason)

    Args:
        weights: the network and the objects that it knows.
        config: voting, ICP, limits, device.
    """

    name = ""
    """What the weights were called; nothing where they came from memory."""

    @classmethod
    def load(
        cls, weights: str | Path = "parts", config: EstimateConfig | None = None
    ) -> "GeoPoseNet":
        """Build an estimator from weights, by file, folder, name or ``hf://OWNER/NAME``.

        Weights whose terms bind the user say so (:class:`LicenceNotice`).

        Raises:
            InputError: no such weights, or none of a pose network.
        """
        found = read_pose_weights(find_weights(weights))
        warn_of_terms(found.facts)
        net = cls(found, config)
        net.name = str(weights)
        return net

    from_pretrained = load
    """The same as :meth:`load`."""

    def __repr__(self) -> str:
        """Say it in one line: the network, its objects, weights, device."""
        said = f"{type(self._network).__name__} of {', '.join(self.objects)}"
        named = f", weights {self.name!r}" if self.name else ""
        return f"GeoPoseNet({said}{named}, {self.config.device})"

    @property
    def terms(self) -> str:
        """Terms of the weights, where they bind whoever uses them; else nothing."""
        return self.weights.facts.get("terms", "")
