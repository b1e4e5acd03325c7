"""Settings of depth: frozen dataclasses that refuse unusable values."""

from depthpose.depth.config.data import AugmentConfig as AugmentConfig
from depthpose.depth.config.data import DegradeConfig as DegradeConfig
from depthpose.depth.config.data import PairsConfig as PairsConfig
from depthpose.depth.config.data import StreetsConfig as StreetsConfig
from depthpose.depth.config.data import TruthKind as TruthKind
from depthpose.depth.config.matching import BaselineName as BaselineName
from depthpose.depth.config.matching import LightConfig as LightConfig
from depthpose.depth.config.matching import MatcherConfig as MatcherConfig
from depthpose.depth.config.matching import PSMNetConfig as PSMNetConfig
from depthpose.depth.config.matching import SGBMConfig as SGBMConfig
from depthpose.depth.config.matching import Speed as Speed
from depthpose.depth.config.synthesis import Answer as Answer
from depthpose.depth.config.synthesis import GeneratorConfig as GeneratorConfig
from depthpose.depth.config.synthesis import SelectionConfig as SelectionConfig
