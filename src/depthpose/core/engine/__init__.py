"""Big jobs: inputs divided into blocks, which many workers turn into one shard of results each.

The engine deals with files and names; what a worker computes from them is a function.
"""

from depthpose.core.engine.job import PLAN as PLAN
from depthpose.core.engine.job import RayEngine as RayEngine
from depthpose.core.engine.job import ShardedJob as ShardedJob
from depthpose.core.engine.job import read_results as read_results
from depthpose.core.engine.job import run_job as run_job
from depthpose.core.engine.job import shard_results as shard_results
from depthpose.core.engine.work import Files as Files
from depthpose.core.engine.work import Function as Function
from depthpose.core.engine.work import Inputs as Inputs
from depthpose.core.engine.work import Item as Item
from depthpose.core.engine.work import Sample as Sample
from depthpose.core.engine.work import ShardRecord as ShardRecord
from depthpose.core.engine.work import Work as Work
from depthpose.core.engine.work import find_items as find_items
