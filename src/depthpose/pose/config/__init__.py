"""Settings of the pose package that need no torch: frozen dataclasses that check their values."""

from depthpose.core.units import Unit as Unit
from depthpose.core.units import metres_of as metres_of
from depthpose.pose.config.estimate import DiameterTable as DiameterTable
from depthpose.pose.config.estimate import EstimateConfig as EstimateConfig
from depthpose.pose.config.estimate import EvaluationConfig as EvaluationConfig
from depthpose.pose.config.estimate import RefusalConfig as RefusalConfig
from depthpose.pose.config.estimate import SymmetryRule as SymmetryRule
from depthpose.pose.config.geometry import CloudConfig as CloudConfig
from depthpose.pose.config.geometry import IcpConfig as IcpConfig
from depthpose.pose.config.geometry import InlierTest as InlierTest
from depthpose.pose.config.geometry import MeshConfig as MeshConfig
from depthpose.pose.config.geometry import VotingConfig as VotingConfig
from depthpose.pose.config.geometry import VotingMethod as VotingMethod
from depthpose.pose.config.objects import ObjectsConfig as ObjectsConfig
from depthpose.pose.config.objects import SensorConfig as SensorConfig
from depthpose.pose.config.objects import SensorKind as SensorKind
