"""``depthpose weights ...`` and ``depthpose export ...``."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any, Literal

import tyro

from depthpose.cli.arguments import NewPath, WeightsName
from depthpose.core.errors import InputError
from depthpose.core.units import Unit

if TYPE_CHECKING:
    from depthpose.core.checkpoint import Checkpoint
    from depthpose.core.export import Export


_LICENCE_WIDTH = 31
"""Characters of the column 'licence' of the list of weights."""
_DATA_WIDTH = 33
"""Characters of the column 'trained on'."""


def list_weights(folder: Path | None = None) -> int:
    """List the weights that came with depthpose, or those in a folder.

    Args:
        folder: list the weights in this folder instead.
    """
    from depthpose.core.checkpoint import SHIPPED, read_checkpoint
    from depthpose.report.page import format_plain_table

    weights_folder = folder or SHIPPED
    files = sorted(weights_folder.glob("*.safetensors"))
    if not files:
        print(
            f"No weights in {weights_folder}. 'depthpose weights import' imports a published "
            "checkpoint."
        )
        return 0
    rows: list[dict[str, str]] = []
    for path in files:
        checkpoint = read_checkpoint(path)
        licence = checkpoint.facts.get("licence", "")
        trained_on = checkpoint.facts.get("trained_on", "")
        row = {
            "name": path.stem,
            "kind": checkpoint.kind,
            "MB": f"{path.stat().st_size / 1e6:.1f}",
            "licence": shorten(licence, _LICENCE_WIDTH, placeholder=" ..."),
            "trained on": shorten(trained_on, _DATA_WIDTH, placeholder=" ..."),
        }
        rows.append(row)
    print(format_plain_table(rows), end="")
    print("'depthpose weights show NAME' prints origin, terms and settings of one.")
    return 0


def show_weights(weights: tyro.conf.Positional[WeightsName]) -> int:
    """Print what a weights file holds: kind, settings, parameters, origin, licence, sha256.

    Args:
        weights: a .safetensors file, or the name of weights that came with depthpose.
    """
    from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint

    path = find_weights(weights)
    checkpoint = read_checkpoint(path)
    # Statistics of batch normalisation and meshes are stored too, but are not learnt.
    statistics = ("running_mean", "running_var", "num_batches_tracked")
    learnt = [
        tensor
        for name, tensor in checkpoint.state.items()
        if not name.endswith(statistics) and not name.startswith("models.")
    ]
    settings = _read_settings(checkpoint, str(path))
    if "models" in checkpoint.config:
        models = checkpoint.config["models"]
        settings["objects"] = ", ".join(f"{model['name']} ({model['number']})" for model in models)
    about_file = {
        "file": path,
        "sha256": file_sha256(path),
        "kind": checkpoint.kind,
        "parameters": sum(tensor.numel() for tensor in learnt),
    }
    for name, value in {**about_file, **checkpoint.facts, **settings}.items():
        print(f"{name}: {value}")
    return 0


def _read_settings(checkpoint: "Checkpoint", source: str) -> dict[str, Any]:
    """Read the settings of weights: of pose and depth networks with defaults, else as stored.

    ``source``: the file, for errors.
    """
    from depthpose.depth import weights as depth_weights
    from depthpose.pose import weights as pose_weights

    if checkpoint.kind in pose_weights.POSE_NETWORKS:
        return pose_weights.settings_of(checkpoint, source)
    depth_kinds = (depth_weights.BOTH, *depth_weights.GENERATORS, *depth_weights.MATCHERS)
    if checkpoint.kind in depth_kinds:
        return depth_weights.settings_of(checkpoint, source)
    return dict(checkpoint.config)


def import_weights(
    kind: tyro.conf.Positional[Literal["psmnet", "resnet18", "efficientnet-lite0"]],
    file: tyro.conf.Positional[Path],
    out: NewPath,
    align_corners: Literal["true", "false"] | None = None,
) -> int:
    """Turn a published checkpoint into a weights file of depthpose.

    The checkpoint is read without running any code in it; pickled objects but tensors are refused.

    Args:
        kind: psmnet, the stacked hourglass; resnet18, an encoder trained on ImageNet, which
            segmentation can start from (.pth of tensors or .safetensors); efficientnet-lite0, an
            encoder that 'depth train select' can start from.
        file: the published checkpoint, e.g. pretrained_model_KITTI2015.tar (do not unpack it).
        out: the .safetensors file to write.
        align_corners: psmnet: how it was trained to upsample: true for the authors' first weights
            (2018, PyTorch 0.4), false for those of 2021 (1.8.1). A wrong choice costs about 1 px.
    """
    from depthpose.core.run_folder import refuse_to_replace

    if align_corners is not None and kind != "psmnet":
        raise InputError(
            f"--align-corners {align_corners}: is for psmnet, and {kind} ignores it; omit it"
        )
    refuse_to_replace(out)
    if kind == "psmnet":
        from depthpose.depth.stereo import import_psmnet

        if align_corners is None:
            raise InputError(
                "weights import psmnet needs --align-corners true (weights of 2018) or false "
                "(of 2021): the file does not say, and a wrong choice costs about a pixel."
            )
        import_psmnet(file, out, align_corners=align_corners == "true")
    elif kind == "resnet18":
        from depthpose.pose.networks.fcn import import_resnet18

        import_resnet18(file, out)
    else:
        from depthpose.depth.encoder import import_encoder

        import_encoder(file, out)
    return show_weights(str(out))


def pack_weights(
    weights: tyro.conf.Positional[WeightsName],
    out: NewPath,
    trained_on: str,
    licence: str,
    matcher: WeightsName | None = None,
    terms: str = "",
    half: bool = False,
) -> int:
    """Write a generator and a matcher into one file, and its card for users beside it (.md).

        depthpose weights pack runs/finetune/fakestereo.safetensors --out street.safetensors
            --trained-on 'my drives of 2026' --licence MIT --half

    Args:
        weights: weights of the generator, of the matcher, or of both, by name or file.
        out: the .safetensors file to write.
        trained_on: the data, for the card.
        licence: under which terms the weights may be used.
        matcher: what matches the two views: weights with a matcher, by name or file.
        terms: terms of use, printed whenever the weights are loaded; those of the parts are kept
            too.
        half: store 16-bit floats: half the size.
    """
    from depthpose.core.checkpoint import add_terms, find_weights, warn_of_terms
    from depthpose.core.files import atomic_write
    from depthpose.core.loop import format_card
    from depthpose.core.run_folder import refuse_to_replace
    from depthpose.depth.weights import read_depth_weights, read_matcher, write_depth_weights

    card = out.with_suffix(".md")
    refuse_to_replace(out)
    refuse_to_replace(card)
    depth_weights = read_depth_weights(find_weights(weights))
    parts = [weights] if matcher is None else [weights, matcher]
    warn_of_terms(add_terms({}, parts))
    new_facts = {"trained_on": trained_on, "licence": licence}
    if terms:
        new_facts["terms"] = terms
    facts = add_terms(new_facts, parts)
    write_depth_weights(
        out,
        generator=depth_weights.generator,
        matcher=depth_weights.matcher if matcher is None else read_matcher(find_weights(matcher)),
        facts=facts,
        with_half=half,
    )
    with atomic_write(card) as unfinished:
        unfinished.write_text(format_card(out.stem, dict(sorted(facts.items()))))
    print(f"card: {card}")
    return show_weights(str(out))


def complete_weights(
    weights: tyro.conf.Positional[WeightsName], models: Path, out: NewPath, unit: Unit = "mm"
) -> int:
    """Add meshes to pose weights that came without, because the meshes may not be passed on.

        depthpose weights complete linemod-nc --models lm --out linemod.safetensors
        depthpose weights complete bunny-nc --models bunny.ply --unit m --out bunny.safetensors

    Args:
        weights: a file, or the name of weights that came with the package.
        models: folder of the dataset in BOP's layout, whose models the weights were trained on; or
            the model file of a single object.
        out: the .safetensors file to write; every other command takes it.
        unit: unit of a model file; BOP's are in mm.
    """
    from depthpose.core.checkpoint import find_weights
    from depthpose.core.run_folder import refuse_to_replace
    from depthpose.pose.datasets.layouts import read_bop_models
    from depthpose.pose.mesh import read_model
    from depthpose.pose.weights import complete_weights as complete
    from depthpose.pose.weights import read_object_numbers

    refuse_to_replace(out)
    path = find_weights(weights)
    numbers = read_object_numbers(path)
    if not models.is_file():
        meshes = read_bop_models(models, numbers)
    elif len(numbers) == 1:
        meshes = {numbers[0]: read_model(models, unit, number=numbers[0])}
    else:
        raise InputError(
            f"--models {models}: one file serves weights of one object, and {path} knows "
            f"{len(numbers)}; give the folder of the dataset that it was trained on"
        )
    complete(path, meshes, out)
    return show_weights(str(out))


def export_depth(out: NewPath, weights: WeightsName = "default", what: str | None = None) -> int:
    """Write the depth networks as one ONNX file that runs without torch, and prove that it agrees.

    The graph does all that the estimator does at the quick speed, at any size: one image and its K
    to metres, sky and the right view; or a pair to disparity and confidence. NAME.proof.json has
    its differences to PyTorch at several sizes; beyond the limit nothing is written. Needs the
    extra export.

        depthpose export depth --out depth.onnx
        depthpose export depth --weights psmnet.safetensors --out psmnet.onnx

    Args:
        out: the .onnx file to write.
        weights: weights of a generator, a matcher or both, by name or file ('depthpose weights
            list').
        what: image: one image to depth; pair: a rectified pair to disparity. By default image
            where the weights have a generator, else pair.
    """
    from depthpose.core.checkpoint import find_weights
    from depthpose.depth.export import make_export
    from depthpose.depth.weights import read_depth_weights

    path = find_weights(weights)
    depth_weights = read_depth_weights(path)
    facts = _collect_graph_facts(weights, path, depth_weights.facts)
    return _write_graph(out, make_export(depth_weights, what, facts))


def export_pose(out: NewPath, weights: WeightsName = "parts") -> int:
    """Write the network of directions as one ONNX file that runs without torch, and prove it.

    The graph takes voxels (cloud, x, y, z; each once) and their features, and gives the direction
    from each to every keypoint of every object; it does neither voxelise nor vote, run ICP or
    refuse. NAME.proof.json has its differences to PyTorch on several clouds; beyond the limit
    nothing is written. Needs the extra export.

        depthpose export pose --out pose.onnx

    Args:
        out: the .onnx file to write.
        weights: weights of a pose network, by name or file ('depthpose weights list').
    """
    from depthpose.core.checkpoint import find_weights
    from depthpose.pose.export import pose_export
    from depthpose.pose.weights import read_pose_weights

    path = find_weights(weights)
    pose_weights = read_pose_weights(path)
    facts = _collect_graph_facts(weights, path, pose_weights.facts)
    return _write_graph(out, pose_export(pose_weights, facts))


def _collect_graph_facts(weights: str, path: Path, facts: Mapping[str, str]) -> dict[str, str]:
    """Collect the facts that a graph of weights is to hold, and print the terms of the weights.

    Args:
        weights: name or file, as it was typed.
        path: file of the weights.
        facts: facts of the weights: licence, terms, ...
    """
    from depthpose.core.checkpoint import file_sha256, warn_of_terms

    warn_of_terms(facts)
    origin = {"format": "onnx", "weights": Path(weights).name, "weights_sha256": file_sha256(path)}
    return {**facts, **origin}


def _write_graph(out: Path, export: "Export") -> int:
    """Write a graph and its proof, print how it differs from PyTorch, and return the exit code.

    ``out``: the .onnx file.
    """
    from depthpose.core.export import write_export
    from depthpose.report.page import format_markdown_table

    differences = write_export(out, export)
    rows = [
        {name: f"{value:.1e}" if isinstance(value, float) else value for name, value in row.items()}
        for row in differences
    ]
    print(format_markdown_table(rows), end="")
    size_mb = out.stat().st_size / 1e6
    proof = out.with_suffix(".proof.json").name
    print(f"{out}: {size_mb:.1f} MB; the differences are in {proof}")
    return 0
