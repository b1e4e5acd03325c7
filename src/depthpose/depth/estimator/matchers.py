"""Which matcher an estimator gets, and what of one image's depth is asked of it."""

from dataclasses import replace
from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.depth.config import Answer, MatcherConfig, SGBMConfig
from depthpose.depth.stereo import Matcher, PSMNetMatcher, SGBMMatcher
from depthpose.depth.synthesis import SelectionGenerator
from depthpose.depth.weights import DepthWeights


def set_answer(found: DepthWeights | None, answer: Answer) -> None:
    """Let depth of one image come from elsewhere than the weights say.

    Raises:
        InputError: the generator has no disparity of its own, or there is none.
    """
    generator = None if found is None else found.generator
    if isinstance(generator, SelectionGenerator):
        generator.config = replace(generator.config, answer=answer)
    elif generator is None or answer != generator.config.answer:
        raise InputError(
            f"answer is {answer!r}, which takes the weights of a generator that selects; leave it "
            "away: these have none, or one that paints, whose views a matcher reads."
        )


def choose_matcher(
    weights: str | Path | None,
    found: DepthWeights | None,
    matcher: str | Path | Matcher | None,
    own: DepthWeights | None,
    config: MatcherConfig | SGBMConfig | None,
) -> Matcher | None:
    """Take the matcher that was named, or that of the weights; None where one image needs none.

    Args:
        weights: as the user named them.
        found: what they hold.
        matcher: as the user named it.
        own: what weights of a matcher alone hold.
        config: how the matcher runs.

    Raises:
        InputError: there is none, or one of another kind than the config.
    """
    run = config if isinstance(config, MatcherConfig) else MatcherConfig()
    if isinstance(config, SGBMConfig) and matcher != "sgbm":
        raise InputError(
            f"config is of SGBM, but matcher is {matcher!r}; give matcher='sgbm' or a MatcherConfig"
        )
    if matcher == "sgbm":
        if found is not None and found.generator is None:
            raise InputError(
                f"weights is {str(weights)!r} and matcher is 'sgbm', which takes no weights of a "
                "matcher. Leave one of the two away."
            )
        return SGBMMatcher(config if isinstance(config, SGBMConfig) else SGBMConfig())
    if matcher is not None and not isinstance(matcher, str | Path):
        return matcher
    holder = found if own is None else own
    if holder is not None and holder.matcher is not None:
        return PSMNetMatcher(holder.matcher, run)
    generator = None if found is None else found.generator
    if matcher is None and generator is not None and generator.config.answer == "own":
        return None
    raise InputError(
        f"weights is {None if weights is None else str(weights)!r} and matcher is "
        f"{None if matcher is None else str(matcher)!r}: there is no matcher in that. Give "
        "weights='psmnet.safetensors' or matcher='sgbm', which needs none; a generator and a "
        "matcher become one file by 'depthpose weights pack G --matcher S --out W'."
    )
