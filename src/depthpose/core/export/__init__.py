"""A network to a file that runs without torch, and the proof that both answer alike."""

from depthpose.core.export.freeze import Export as Export
from depthpose.core.export.freeze import freeze as freeze
from depthpose.core.export.freeze import network_model as network_model
from depthpose.core.export.freeze import proof_path as proof_path
from depthpose.core.export.graph import Graph as Graph
from depthpose.core.export.graph import Value as Value
from depthpose.core.export.proof import Case as Case
from depthpose.core.export.proof import Limit as Limit
