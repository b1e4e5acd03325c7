"""What estimates depth in a command: OpenCV's matcher or networks, and how they are built."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from depthpose.cli.engine import PackedWeights
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint
from depthpose.core.devices import device_of_process, usable_device, usable_precision
from depthpose.core.errors import InputError
from depthpose.depth.config import Answer, MatcherConfig, SGBMConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.types import Estimator
from depthpose.depth.weights import MATCHERS, Use


class DepthMethod(NamedTuple):
    """An estimator, its name in tables, and the JSON values that decide its results.

    ``with_right``: whether it takes the real right view.
    """

    name: str
    estimator: Estimator
    settings: dict[str, Any]
    with_right: bool = True


@dataclass(frozen=True, kw_only=True)
class SGBMSpec:
    """The settings from which OpenCV's matcher of pairs, StereoSGBM, is built; it has no weights.

    ``with_filled_holes``: pixels without a match get the disparity of their neighbours.
    ``with_check``: as of :class:`DepthNetworkSpec`.
    """

    with_filled_holes: bool = False
    with_check: bool = False

    def build(self) -> DepthMethod:
        """Build the matcher, with the settings of our tables."""
        config = SGBMConfig(with_filled_holes=self.with_filled_holes)
        name = "sgbm-filled" if self.with_filled_holes else "sgbm"
        net = FakestereoNet(SGBMMatcher(config), with_check=self.with_check)
        return DepthMethod(name, net, {"matcher": "sgbm", **asdict(config)})

    def with_packed_weights(self) -> "SGBMSpec":
        """Return the spec for workers of other machines: itself, for there are no weights."""
        return self


@dataclass(frozen=True, kw_only=True)
class DepthNetworkSpec:
    """The weights and settings from which this process, or a worker, builds networks of depth."""

    weights: str | PackedWeights  #: name or file, or its content
    config: MatcherConfig  #: how the networks run
    with_right: bool | None = None  #: they take the real right view; None: only a matcher does
    matcher: str | None = None  #: of the synthesised view: other weights, or sgbm; None: their own
    # A measurement counts all images and pairs, so nothing is refused by default.
    allow_ood: bool = True  #: answer out-of-distribution images too
    with_check: bool = False  #: refuse pairs that are swapped, not rectified or no pair
    answer: Answer | None = None  #: where depth of one image comes from; None: as the weights say
    use: Use | None = None  #: build only the networks that images, or pairs, need; None: all

    def build(self) -> DepthMethod:
        """Build the networks on the device of the config.

        Raises:
            InputError: the device or the weights cannot be used, or lack the network that the input
                needs: a generator for one image, a matcher for a pair.
        """
        if isinstance(self.weights, PackedWeights):
            with self.weights.unpacked() as file:
                return self._build_from(file)
        return self._build_from(self.weights)

    def _build_from(self, weights: str) -> DepthMethod:
        """Build the networks of a weights file, perhaps with another matcher."""
        config = self._make_usable_config()
        path = find_weights(weights)
        kind = read_checkpoint(path).kind
        is_matcher = kind in MATCHERS
        with_right = is_matcher if self.with_right is None else self.with_right
        if is_matcher and not with_right:
            raise InputError(
                f"{path}: matches pairs, but depth from one image is asked for. Give weights that "
                "synthesise the right view."
            )

        # What decides the results.
        settings: dict[str, Any] = {
            "matcher": kind,
            "weights": path.stem,
            "weights_sha256": file_sha256(path),
        }
        if not is_matcher:
            settings["input"] = "both views" if with_right else "left view"
        settings |= asdict(config)

        # Which matcher runs, and where depth of one image comes from.
        matcher: SGBMMatcher | Path | None = None
        answer = self.answer
        if self.matcher is None:
            name = path.stem
            name += "-both" if with_right and not is_matcher else ""
            name += "" if answer is None else f"-{answer}"
        else:
            answer = "matched"
            matcher, matcher_name, matcher_settings = _find_other_matcher(self.matcher)
            name = f"{path.stem}-{matcher_name}"
            settings |= {**matcher_settings, "matcher": f"{kind} with {matcher_name}"}

        net = FakestereoNet.load(
            path,
            matcher=matcher,
            config=config,
            answer=answer,
            allow_ood=self.allow_ood,
            with_check=self.with_check,
            use=self.use,
        )
        if with_right and net.matcher is None:
            raise InputError(
                f"{path}: answers depth of one image, and holds no matcher, which a pair needs. "
                "Give weights with one, or sgbm."
            )
        if not with_right and net.synthesiser is not None:
            settings["answer"] = net.synthesiser.config.answer
            settings["scales"] = list(net.synthesiser.scales)
        return DepthMethod(name, net, settings, with_right)

    def _make_usable_config(self) -> MatcherConfig:
        """Return the config with the device of this process, and the precision it computes in.

        Raises:
            InputError: this machine has no such device.
        """
        device = device_of_process(self.config.device)
        usable_device(device)
        is_bf16 = usable_precision(self.config.precision, device) == "bf16"
        return replace(self.config, precision="bf16" if is_bf16 else "fp32", device=device)

    def with_packed_weights(self) -> "DepthNetworkSpec":
        """Return the spec with the content of its weights file, for workers of other machines."""
        assert self.matcher in (None, "sgbm")
        if isinstance(self.weights, PackedWeights):
            return self
        return replace(self, weights=PackedWeights.read(self.weights))


DepthMethodSpec = SGBMSpec | DepthNetworkSpec


def make_pair_spec(
    matcher: str | None, weights: str, config: MatcherConfig, *, with_check: bool = True
) -> DepthMethodSpec:
    """Make the spec of what matches real pairs.

    Args:
        matcher: sgbm, or weights with a matcher; None: the matcher of ``weights``.
        weights: name or file of weights.
        config: how networks run.
        with_check: refuse pairs that are swapped, not rectified or no pair.
    """
    if matcher == "sgbm":
        return SGBMSpec(with_check=with_check)
    return DepthNetworkSpec(
        weights=matcher or weights,
        config=config,
        with_right=True,
        with_check=with_check,
        use="pairs",
    )


def settings_on_workers(spec: DepthMethodSpec) -> dict[str, Any]:
    """Compute the settings of a method that workers build, whose device this machine may lack.

    They are read from networks on the CPU of this machine; device and precision are those that are
    asked of the workers.
    """
    if isinstance(spec, SGBMSpec):
        return spec.build().settings
    on_cpu = replace(spec, config=replace(spec.config, device="cpu", precision="fp32"))
    settings = on_cpu.build().settings
    return {**settings, "device": spec.config.device, "precision": spec.config.precision}


def _find_other_matcher(matcher: str) -> tuple[SGBMMatcher | Path, str, dict[str, Any]]:
    """Find the matcher of the synthesised view that replaces the weights' own.

    Returns:
        OpenCV's matcher or a weights file, its name, and the JSON values that decide its results.
    """
    if matcher == "sgbm":
        config = SGBMConfig(with_filled_holes=True)
        return SGBMMatcher(config), "sgbm", asdict(config)
    path = find_weights(matcher)
    return path, path.stem, {"matcher_sha256": file_sha256(path)}
