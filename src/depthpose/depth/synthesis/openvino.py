"""The generator that selects, computed by OpenVINO on the processor."""

import sys
import warnings
from importlib import import_module
from typing import Any, Literal

import torch
from torch import Tensor, nn

from depthpose.core.devices import usable_precision
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.depth.synthesis.selection import Images, Logits, SelectionGenerator

Precision = Literal["fp32", "bf16"]
"""What OpenVINO computes in."""


class OpenvinoGenerator(SelectionGenerator):
    """Answers what :class:`SelectionGenerator` answers, sizes free, on the processor.

    Converting the network takes some seconds. There are no gradients, and a training of the network
    that it was made from does not change it.

    Args:
        generator: its weights and its rig; it is put into eval mode.
        precision: fp32, or bf16.

    Raises:
        MissingExtraError: OpenVINO is not installed.
    """

    def __init__(self, generator: SelectionGenerator, precision: Precision = "fp32") -> None:
        nn.Module.__init__(self)
        self.config = generator.config
        self.register_buffer("planes", generator.planes, persistent=False)
        self._request = _compiled(generator.eval(), precision).create_infer_request()

    def forward(self, image: Images) -> tuple[Logits, Logits]:
        """Answer the logits of the left and of the right view."""
        found = self._request.infer([image.detach().contiguous().numpy()])
        # Copied: the next image is written to the same memory.
        left, right = (torch.from_numpy(found[k].copy()) for k in range(2))
        return left, right


def openvino_generator(
    generator: nn.Module, device: str, precision: Precision = "fp32"
) -> OpenvinoGenerator:
    """Let OpenVINO compute a generator, in fp32 where the processor has no bf16.

    Raises:
        InputError: a generator of another kind, or another device than the processor.
        MissingExtraError: OpenVINO is not installed.
    """
    if not isinstance(generator, SelectionGenerator):
        raise InputError(
            "engine is 'openvino', which computes generators that select, and these weights hold "
            "a U-Net; omit engine."
        )
    if device != "cpu":
        raise InputError(
            f"engine is 'openvino', which computes on the processor, and device is {device!r}; "
            "omit one of the two."
        )
    is_bf16 = usable_precision(precision, device) == "bf16"
    return OpenvinoGenerator(generator, "bf16" if is_bf16 else "fp32")


def import_openvino() -> Any:  # noqa: ANN401  OpenVINO's classes carry few types
    """Import OpenVINO without its telemetry, which reports each import over the network.

    Raises:
        MissingExtraError: it is not installed.
    """
    sys.modules.setdefault("openvino_telemetry", None)  # pyright: ignore[reportArgumentType]
    try:
        return import_module("openvino")
    except ImportError as error:
        raise MissingExtraError("openvino", "openvino", "engine='openvino'") from error


def _compiled(generator: SelectionGenerator, precision: Precision) -> Any:  # noqa: ANN401
    openvino = import_openvino()
    multiple = generator.config.side_multiple_px
    with warnings.catch_warnings():  # the tracer speaks of our check of sizes
        warnings.simplefilter("ignore")
        example: Tensor = torch.zeros(1, 3, 2 * multiple, 3 * multiple)
        model = openvino.convert_model(generator, example_input=example)
    model.reshape([-1, 3, -1, -1])
    # Said always: a processor with bf16 is given bf16 otherwise.
    hint = {"fp32": "f32", "bf16": "bf16"}[precision]
    wanted = {"INFERENCE_PRECISION_HINT": hint, "INFERENCE_NUM_THREADS": torch.get_num_threads()}
    return openvino.Core().compile_model(model, "CPU", wanted)
