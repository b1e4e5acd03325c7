"""Where a training lives: its folder, claimed for one config, and the weights it leaves."""

import dataclasses
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from depthpose.core.checkpoint import bound_facts, file_sha256, find_weights, say_terms
from depthpose.core.config import config_to_dict, write_config
from depthpose.core.loop import Progress, run_files
from depthpose.core.run import claim_folder, find_shard
from depthpose.pose.config import CloudConfig, RefusalConfig
from depthpose.pose.estimator.alternatives import near_symmetry_lines
from depthpose.pose.train.config import FramesConfig
from depthpose.pose.types import ObjectModel
from depthpose.pose.weights import AnyNetwork, PoseWeights

_SAID = 3
"""Turns of an object that look nearly alike, on a card."""
_FREE = ("workers", "device", "save_every_steps", "validate_every_steps", "log_every_steps")
"""Knobs of the loop that change no weight: a resumed run may have others."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """Where a training lives, and who watches.

    Attributes:
        folder: the run folder; the weights lie in it, named after what was trained.
        resume: go on from its last state.
        finish: make weights of its last state, without another step.
        on_step: told after each step.
        tell: told what a person should know before it begins.
    """

    folder: Path
    resume: bool = False
    finish: bool = False
    on_step: Callable[[Progress], None] | None = None
    tell: Callable[[str], None] | None = None

    @property
    def words(self) -> dict[str, Any]:
        """What the loop is told of it."""
        return {"resume": self.resume, "finish": self.finish, "on_step": self.on_step}


def claim_run(config: Any, run: Run, files: Sequence[str] = ()) -> None:  # noqa: ANN401
    """Make the folder this config's own.

    Args:
        config: of any training; it has ``loop``, ``start`` and perhaps ``held_out``.
        run: where.
        files: that decide what is learnt, beside the config: their content is remembered.

    Raises:
        InputError: the folder is another config's.
    """
    settings = {"stage": type(config).__name__, **config_to_dict(config)}
    settings["loop"] = {k: v for k, v in settings["loop"].items() if k not in _FREE}
    settings["loop"]["processes"] = find_shard().world
    for judged in ("held_out", "calibration"):  # no weight of the network follows from these
        settings.pop(judged, None)
    settings["sha256"] = [file_sha256(Path(path)) for path in files]
    if config.start is not None:
        settings["start_sha256"] = file_sha256(find_weights(config.start))
        say_terms(bound_facts({}, [config.start]))
    names = ("pose", "pointnet", "depth-image", "segmentation")
    claim_folder(run.folder, settings, [file for name in names for file in run_files(name)])
    write_config(run.folder / "config.yaml", config)


def train_words(what: str, config: Any) -> str:  # noqa: ANN401
    """Give the words of the command that trains this, the CAD files among them, for the card."""
    cad = [word for path in config.models.cad for word in ("--cad", path)]
    unit = ["--unit", config.models.unit] if cad else []
    return shlex.join(["pose", "train", "--what", what, *cad, *unit])


def packed(
    network: AnyNetwork,
    models: tuple[ObjectModel, ...],
    config: Any,  # noqa: ANN401
) -> PoseWeights:
    """Put a trained network and its objects together, with what the card says of them."""
    frames: FramesConfig | None = config.frames
    cloud: CloudConfig = config.cloud
    names = ", ".join(model.name for model in models)
    source = "made views" if frames is None else f"{Path(frames.folder).name} and made views"
    facts = {
        "trained_on": f"{source} of {names}",
        "licence": config.models.licence,
    }
    if config.models.terms:
        facts["terms"] = config.models.terms
    return PoseWeights(
        network=network.cpu().eval(),
        models=models,
        cloud=cloud,
        refusal=RefusalConfig(),
        facts=with_origin(facts, config),
    )


def card_facts(weights: PoseWeights) -> dict[str, str]:
    """Put before the facts of weights their objects, sizes, and turns that look nearly alike."""
    known = ", ".join(f"{m.name} ({1000 * m.diameter_m:.0f} mm)" for m in weights.models)
    lines = {model.name: near_symmetry_lines(model) for model in weights.models}
    near = "; ".join(f"{name}: {', '.join(some[:_SAID])}" for name, some in lines.items() if some)
    return {"objects": known} | ({"nearly_alike": near} if near else {}) | dict(weights.facts)


def with_origin(facts: Mapping[str, str], config: Any) -> dict[str, str]:  # noqa: ANN401
    """Add to a card the stage, and the weights that it began with: their terms bind it too."""
    origin = {**facts, "stage": type(config).__name__}
    if config.start is None:
        return origin
    return bound_facts({**origin, "began_with": Path(config.start).stem}, [config.start])


def with_classes(
    network: Any,  # noqa: ANN401
    models: Sequence[ObjectModel],
    cloud: CloudConfig,
) -> Any:  # noqa: ANN401
    """Give a network's config the classes and keypoints of the objects, the inputs of the cloud."""
    sizes = {
        "classes": len(models),
        "keypoints": len(models[0].keypoints_m),
        "inputs": cloud.features,
    }
    known = {field.name for field in dataclasses.fields(network)}
    return dataclasses.replace(network, **{k: v for k, v in sizes.items() if k in known})
